"""What all networks need: photos as they see them and in a database, and pairs of photos verified there."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap
from PIL import Image

from ..database import camera_of

LONGEST_SIDE = 1024
"""Side in pixels to which larger photos are scaled, as for the training of the networks."""


def scaled_gray(photo: Image.Image, multiple: int = 1) -> np.ndarray:
    """Return a photo in gray (h, w) uint8, its longest side at most `LONGEST_SIDE`.

    Args:
        photo: the photo.
        multiple: number of pixels of which both sides become multiples.
    """
    scale = min(1.0, LONGEST_SIDE / max(photo.size))
    sides = [max(round(scale * side / multiple), 1) * multiple for side in photo.size]
    return np.array(photo.convert("L").resize(sides, Image.Resampling.BILINEAR))


def add_photos(path: Path, images: Path, groups: Sequence[Sequence[str]]) -> None:
    """Write photos to a database without features, unless they are there.

    Args:
        path: the database, which is made if it does not exist.
        images: folder of the photos.
        groups: names of the photos that share a camera, whose focal length EXIF may tell.
    """
    pycolmap.Database.open(path).close()
    for group in groups:
        reader = pycolmap.ImageReaderOptions()
        reader.existing_camera_id = camera_of(path, group)
        pycolmap.import_images(
            path, images, image_names=list(group), camera_mode=pycolmap.CameraMode.SINGLE, options=reader
        )


def write_pair(
    stored: pycolmap.Database,
    images: tuple[pycolmap.Image, pycolmap.Image],
    points: tuple[np.ndarray, np.ndarray],
    matches: np.ndarray,
    verification: pycolmap.TwoViewGeometryOptions,
) -> None:
    """Verify the matches of two photos, and write both to a database at once.

    Args:
        stored: the database.
        images: the photos, that with the smaller ID first.
        points: their features (n, 2) in pixels.
        matches: (m, 2), indices of features that show the same.
        verification: how matches are verified.
    """
    matches = matches.astype(np.uint32)
    geometry = pycolmap.TwoViewGeometry()
    if len(matches) >= verification.min_num_inliers:
        one, other = (stored.read_camera(image.camera_id) for image in images)
        geometry = pycolmap.estimate_two_view_geometry(one, points[0], other, points[1], matches, verification)
    first, second = (image.image_id for image in images)
    with pycolmap.DatabaseTransaction(stored):
        stored.write_matches(first, second, matches)
        stored.write_two_view_geometry(first, second, geometry)
