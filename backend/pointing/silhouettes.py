"""Splats outside the silhouettes of their object, which show as soon as it is alone.

A training compares whole pictures. Nothing in them tells what is hidden behind other splats, so that those of an object
can reach far beyond it, such as below the cloth that it lies on. Where a pixel of a mask shows the background, though,
no splat of an object belongs on its ray, whether hidden or not.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
import torch

from ..model.generate import Generated
from ..raster import Camera
from .splat_graph import contributions

OUTSIDE = 0.5
"""A splat is outside if more than this fraction of what it adds to pictures of its object alone is on background."""

HIDDEN = 0.3
"""Fraction of the same that the splat may add to pixels with an ID in whole pictures; if more of it is seen there, it
only lies behind things without ID in the other photos."""

_LEAST = 0.05


def outside_silhouettes(
    splats: Generated,
    object_ids: np.ndarray,
    primitive: str,
    views: Iterable[tuple[Camera, np.ndarray]],
    progress: Callable[[int], object],
) -> np.ndarray:
    """Find the splats that lie on the background in most of the views in which their object alone would show them.

    Args:
        splats: N splats, in scene units.
        object_ids: (N,) their objects; 0 is the background.
        primitive: "3d" or "2d".
        views: cameras and masks (H, W) of the same size, in which 0 is the background.
        progress: receives the number of finished views.

    Returns:
        (N,) bool; False for those of no object.
    """
    rows = {object_id: np.flatnonzero(object_ids == object_id) for object_id in np.unique(object_ids[object_ids > 0])}
    alone = {key: splats.select(torch.from_numpy(at).to(splats.means.device)) for key, at in rows.items()}
    own, background, seen = np.zeros((3, len(object_ids)))
    for done, (camera, mask) in enumerate(views, 1):
        seen += _drawn_on(splats, camera, [mask > 0], primitive)[:, 0]
        for object_id, at in rows.items():
            shown = _drawn_on(alone[object_id], camera, [mask == object_id, mask == 0], primitive)
            own[at] += shown[:, 0]
            background[at] += shown[:, 1]
        progress(done)
    total = own + background
    return (total > _LEAST) & (background > OUTSIDE * total) & (seen < HIDDEN * total)


def _drawn_on(splats: Generated, camera: Camera, regions: list[np.ndarray], primitive: str) -> np.ndarray:
    """Return how much each of N splats adds to up to three regions (H, W) of a picture, (N, 3) in pixels."""
    planes = np.zeros((3, camera.height, camera.width), np.float32)
    planes[: len(regions)] = regions
    return contributions(splats, camera, planes, primitive)
