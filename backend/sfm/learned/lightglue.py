"""Features and matches by networks: SuperPoint finds and describes corners, LightGlue matches them.

The networks are those of a folder with a checkpoint of the package transformers. COLMAP's database holds the features
as those of SIFT, except that descriptors are float32, which their type UNDEFINED tells.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pycolmap
import torch
from PIL import Image

from ...capture.files import read_image, read_mask
from .checkpoint import load_network
from .photos import add_photos, scaled_gray, write_pair

MOST_FEATURES = 2048
"""Most features of a photo. The time of a pair grows with their square."""

_MOST_CORNERS = 1 << 14
"""Most corners that are described before masks and scores leave out some: about one in each cell of 8 x 8 pixels."""
_KEPT = 64
"""Number of photos whose features are kept in memory while pairs are matched."""


class Features(NamedTuple):
    """Features of a photo, the most certain first.

    Attributes:
        points: (n, 2) float32, x and y in pixels, with the center of the first pixel at (0.5, 0.5).
        descriptors: (n, d) float32, of unit length.
        size: width and height of the photo in pixels.
    """

    points: np.ndarray
    descriptors: np.ndarray
    size: tuple[int, int]


Detect = Callable[[np.ndarray], Features]
"""Returns the features of a gray image (h, w) uint8."""
Match = Callable[[Features, Features], np.ndarray]
"""Returns the indices (m, 2) of the matches between two photos with features."""


class _Given(torch.nn.Module):
    """Stands in for the detector of a LightGlue, so that it matches features which were found before."""

    found: tuple[torch.Tensor, None, torch.Tensor, torch.Tensor]

    def forward(self, _: torch.Tensor) -> tuple[torch.Tensor, None, torch.Tensor, torch.Tensor]:
        return self.found


class LightGlue:
    """A LightGlue and its SuperPoint, of a folder with a checkpoint of transformers.

    Args:
        folder: with config.json and weights, *.safetensors or *.bin.

    Raises:
        InputError: The folder lacks a file, is of another architecture, or its weights do not fit its config.json; or
            transformers is not installed.
    """

    def __init__(self, folder: Path) -> None:
        self._network = load_network(folder, self._keep_corners)
        self._detector, self._given = self._network.keypoint_detector, _Given()
        self._network.keypoint_detector = self._given

    def _keep_corners(self, config: Any) -> None:
        """Have all corners found; masks leave some out before the best are taken, and transformers fails on none."""
        corners = config.keypoint_detector_config
        self._least_score, self._border = corners.keypoint_threshold, corners.border_removal_distance
        self._dimensions = corners.descriptor_decoder_dim
        corners.keypoint_threshold, corners.max_keypoints = -1.0, _MOST_CORNERS

    @torch.inference_mode()
    def detect(self, gray: np.ndarray) -> Features:
        """Return the features of a gray image (h, w) uint8."""
        height, width = gray.shape
        if min(height, width) < 2 * self._border + 8:  # Its cells have 8 pixels.
            empty = np.zeros((0, 2), np.float32), np.zeros((0, self._dimensions), np.float32)
            return Features(*empty, (width, height))
        found = self._detector(torch.tensor(gray, dtype=torch.float32)[None, None] / 255, return_dict=True)
        scores, order = found.scores[0].sort(descending=True, stable=True)
        order = order[scores > self._least_score]
        points = (found.keypoints[0, order] * torch.tensor([width, height])).round() + 0.5
        return Features(points.numpy(), found.descriptors[0, order].numpy(), (width, height))

    @torch.inference_mode()
    def match(self, first: Features, second: Features) -> np.ndarray:
        """Return the indices (m, 2) int64 of the matches between two photos, each with at least one feature."""
        most = max(len(first.points), len(second.points))
        points, mask = torch.zeros(1, 2, most, 2), torch.zeros(1, 2, most, dtype=torch.int)
        descriptors = torch.zeros(1, 2, most, self._dimensions)
        for number, (pixels, values, size) in enumerate((first, second)):
            # LightGlue takes both photos to be of one size; so each is scaled to a longer side of 1, centered at 0.5.
            points[0, number, : len(pixels)] = torch.tensor((pixels - np.divide(size, 2)) / max(size) + 0.5)
            descriptors[0, number, : len(pixels)] = torch.tensor(values)
            mask[0, number, : len(pixels)] = 1
        self._given.found = points, None, descriptors, mask
        matched = self._network(torch.zeros(1, 2, 1, 1, 1), return_dict=True).matches[0, 0, : len(first.points)].numpy()
        of_first = np.flatnonzero((matched >= 0) & (matched < len(second.points)))
        return np.column_stack([of_first, matched[of_first]]).astype(np.int64)


def find_features(
    path: Path, images: Path, groups: Sequence[Sequence[str]], masks: Path | None, detect: Detect
) -> None:
    """Write the features of photos to a database, at most `MOST_FEATURES` of each, unless they are there.

    Args:
        path: the database, which is made if it does not exist.
        images: folder of the photos.
        groups: names of the photos that share a camera, whose focal length EXIF may tell.
        masks: folder with NAME.png for each photo, black where there shall be no features; or None.
        detect: finds the features of an image that is scaled to `LONGEST_SIDE`.

    Raises:
        InputError: A photo or a mask cannot be read.
    """
    add_photos(path, images, groups)
    wanted = {name for group in groups for name in group}
    with pycolmap.Database.open(path) as stored:
        for image in stored.read_all_images():
            if image.name not in wanted or stored.exists_descriptors(image.image_id):
                continue
            mask = None if masks is None else read_mask(masks / f"{image.name}.png") > 0
            found = features_of(read_image(images / image.name), mask, detect)
            data = np.ascontiguousarray(found.descriptors, np.float32).view(np.uint8)
            descriptors = pycolmap.FeatureDescriptors(type=pycolmap.FeatureExtractorType.UNDEFINED, data=data)
            with pycolmap.DatabaseTransaction(stored):
                stored.write_keypoints(image.image_id, found.points)
                stored.write_descriptors(image.image_id, descriptors)


def features_of(photo: Image.Image, mask: np.ndarray | None, detect: Detect) -> Features:
    """Return the features of a photo in its own pixels, where a mask (h, w) of its proportions is True."""
    scaled = scaled_gray(photo)
    found = detect(scaled)
    kept = np.arange(len(found.points))[:MOST_FEATURES]
    if mask is not None:
        columns, rows = (found.points * np.divide(mask.shape[::-1], scaled.shape[::-1])).astype(int).T
        kept = np.flatnonzero(mask[rows, columns])[:MOST_FEATURES]
    points = (found.points[kept] * np.divide(photo.size, scaled.shape[::-1])).astype(np.float32)
    return Features(points, found.descriptors[kept], photo.size)


def match_pairs(
    path: Path, pairs: Iterable[tuple[str, str]] | None, match: Match, verification: pycolmap.TwoViewGeometryOptions
) -> None:
    """Match and verify pairs of photos in a database, one after another, unless they are there.

    Args:
        path: the database with the features.
        pairs: names of the photos; None for all pairs.
        match: matches two photos.
        verification: how matches are verified.
    """
    with pycolmap.Database.open(path) as stored:
        images = {image.name: image for image in stored.read_all_images()}
        cameras = {camera.camera_id: camera for camera in stored.read_all_cameras()}

        @lru_cache(_KEPT)
        def features(number: int, camera_id: int) -> Features:
            points = np.asarray(stored.read_keypoints(number), np.float32)
            data = np.ascontiguousarray(stored.read_descriptors(number).data)
            camera = cameras[camera_id]
            return Features(points, data.view(np.float32), (camera.width, camera.height))

        names = sorted(images)
        if pairs is None:
            pairs = ((first, second) for index, first in enumerate(names) for second in names[index + 1 :])
        for pair in pairs:
            first, second = sorted((images[name] for name in pair), key=lambda image: image.image_id)
            if stored.exists_two_view_geometry(first.image_id, second.image_id):
                continue
            one, other = (features(image.image_id, image.camera_id) for image in (first, second))
            indices = match(one, other) if len(one.points) and len(other.points) else np.zeros((0, 2))
            write_pair(stored, (first, second), (one.points, other.points), indices, verification)
