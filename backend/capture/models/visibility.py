"""Observations of points for models that have none: which points of a point cloud each image shows, and where.

Exposure and repeated views are measured on observed points, which point clouds do not tell.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.ndimage import minimum_filter

from ...shared.errors import InputError
from ..colmap import Camera, Image, Model
from ..files import read_image
from ..undistort import is_pinhole, to_pycolmap, undistort

_MOST_HIDING = 20_000
_MOST_OBSERVED = 5_000
"""Numbers of points, spread over the cloud, that may hide others and that may be observed; more would cost much time
for each image."""
_MOST_PHOTOS = 8
_MOST_COMPARED = 500
"""Numbers of photos, and of points, whose colors are compared."""
_FEWEST_COMPARED = 30
_RAY_WITHIN = 1e-3
"""Largest difference between a ray and that of its pixel; beyond, the lens folds over there."""


def with_observations(model: Model, most: int = _MOST_OBSERVED) -> Model:
    """Return a model with observations of at most this many points, wherever no other point hides them."""
    hiding = _spread(len(model.xyz), _MOST_HIDING)
    observed = hiding[_spread(len(hiding), most)]
    is_candidate = np.isin(hiding, observed)
    xyz = model.xyz[hiding]
    images = []
    for image in model.images:
        seen, xy = _visible(xyz, is_candidate, image, model.cameras[image.camera_id])
        images.append(replace(image, xy=xy, point_index=hiding[seen]))
    return replace(model, images=images)


def color_agreement(models: Sequence[Model], photos: Path) -> list[float]:
    """Return how well the colors of points agree with those of the photos that show them.

    Args:
        models: Models that differ in their points only.
        photos: The folder of the photos.

    Returns:
        The correlation of the colors for each model, which does not depend on exposure; 0 where none is known.
    """
    pairs: list[list[np.ndarray]] = [[] for _ in models]
    for number in _spread(len(models[0].images), _MOST_PHOTOS):
        image = models[0].images[number]
        try:
            pixels = np.asarray(read_image(photos / image.name))
        except InputError:  # It is reported when all photos are read.
            continue
        camera = models[0].cameras[image.camera_id]
        scale = np.array([pixels.shape[1] / camera.width, pixels.shape[0] / camera.height])
        for model, found in zip(models, pairs, strict=True):
            shown = with_observations(replace(model, images=[image]), _MOST_COMPARED).images[0]
            column, row = (shown.xy * scale).astype(np.int64).T
            found.append(np.stack([model.rgb[shown.point_index], pixels[row, column]]).astype(np.float64))
    return [_correlation(np.concatenate(found, 1)) if found else 0.0 for found in pairs]


def _correlation(colors: np.ndarray) -> float:
    """Return the correlation of two lists of colors (2, n, 3); 0 if they are too few or all the same."""
    if colors.shape[1] < _FEWEST_COMPARED:
        return 0.0
    first, second = colors - colors.mean(1, keepdims=True)
    size = float(np.sqrt((first**2).sum() * (second**2).sum()))
    return float((first * second).sum()) / size if size else 0.0


def _spread(count: int, most: int) -> np.ndarray:
    """Return at most `most` indices of `count` points."""
    return np.arange(count) if count <= most else np.linspace(0, count - 1, most).astype(np.int64)


def _visible(xyz: np.ndarray, is_candidate: np.ndarray, image: Image, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices (n,) of the points (m, 3) that are candidates, in view and not hidden, and their pixels."""
    lens = to_pycolmap(camera)
    local = xyz @ image.viewmat[:3, :3].T + image.viewmat[:3, 3]
    ahead = np.flatnonzero(local[:, 2] > 0)
    with np.errstate(all="ignore"):
        rays = local[ahead, :2] / local[ahead, 2:]
        pixels = np.asarray(lens.img_from_cam(np.column_stack([rays, np.ones(len(rays))])), np.float64).reshape(-1, 2)
        inside = np.flatnonzero(((pixels >= 0) & (pixels < [camera.width, camera.height])).all(1))
        if not is_pinhole(camera):
            off = np.abs(undistort(lens, pixels[inside]) - rays[inside]).max(1, initial=0.0)
            inside = inside[off < _RAY_WITHIN]
    points, pixels = ahead[inside], pixels[inside]
    if not len(points):
        return points, pixels
    depth = local[points, 2]
    # As for votes: each point covers the cells around it, since points are too sparse for a surface.
    cell = max(2.0, float(np.sqrt(camera.width * camera.height / len(points))))
    columns, rows = int(np.ceil(camera.width / cell)), int(np.ceil(camera.height / cell))
    at = (pixels[:, 1] / cell).astype(np.int64) * columns + (pixels[:, 0] / cell).astype(np.int64)
    nearest = np.full(rows * columns, np.inf)
    np.minimum.at(nearest, at, depth)
    nearest = minimum_filter(nearest.reshape(rows, columns), 3, mode="nearest").ravel()
    shown = is_candidate[points] & (depth <= nearest[at] * (1 + 2 * cell / abs(camera.params[0])))
    return points[shown], pixels[shown]
