"""A model as a picture: what evaluation, previews and the render command show."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

from .. import device
from ..model.object_model import ObjectModel, anchors_in_view
from . import object_map, rasterize
from .camera import Camera


class Picture(NamedTuple):
    """image (H, W, 3) float32 in [0, 1]; ids (H, W) int64 object IDs and probability (H, W) float32 (None if not
    asked for); alpha (H, W); depth (H, W) expected depth in world units, 0 where nothing is (None if not asked for)."""

    image: np.ndarray
    ids: np.ndarray | None
    probability: np.ndarray | None
    alpha: np.ndarray
    depth: np.ndarray | None


def draw(model: ObjectModel, camera: Camera, want_ids: bool = True, want_depth: bool = False) -> Picture:
    """Draw `model` through `camera` (scene units) over the model's background."""
    viewmat, intrinsics = camera.arrays()
    seen = anchors_in_view(model.anchors, viewmat, intrinsics, camera.width, camera.height, camera.near)
    g = model.generate(seen, camera.centre)
    with torch.no_grad():
        drawn = rasterize(*g[:6], camera, want_depth=want_depth, primitive=model.primitive)
        image = drawn.color + (1 - drawn.alpha) * model.background.detach()[:, None, None]
        image = image * torch.tensor(camera.gain).to(image.device)[:, None, None]
        pixels = device.host(image.clamp(0, 1).permute(1, 2, 0).contiguous())
    alpha = device.host(drawn.alpha)
    depth = None
    if drawn.depth is not None:
        depth = device.host(drawn.depth) / np.maximum(alpha, 1e-6) / np.float32(model.normalization.scale)
    ids = probability = None
    if want_ids:
        classes, probability = (device.host(plane) for plane in object_map(drawn))
        ids = np.where(classes >= 0, model.object_ids[np.maximum(classes, 0)], 0)
    return Picture(pixels, ids, probability, alpha, depth)
