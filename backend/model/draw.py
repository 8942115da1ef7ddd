"""Rendering of a model to images, for evaluation, previews and the render command."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple, TypeVar

import numpy as np
import torch

from ..raster import devices, object_map, rasterize
from ..raster.camera import Camera
from ..raster.gpu.binning import forget_capacity
from .object_model import ObjectModel, anchors_in_view


class RenderedView(NamedTuple):
    """A rendered view of a model.

    Attributes:
        image: (H, W, 3) float32 in [0, 1].
        ids: (H, W) int64, object IDs; None if not requested.
        probability: (H, W) float32, probabilities of the IDs; None if not requested.
        alpha: (H, W).
        depth: (H, W), expected depth in world units, 0 where nothing is drawn; None if not requested.
    """

    image: np.ndarray
    ids: np.ndarray | None
    probability: np.ndarray | None
    alpha: np.ndarray
    depth: np.ndarray | None


_Planes = TypeVar("_Planes")

_LEAST_HEIGHT = 16
"""Height in pixels from which on a part of an image is divided further, where the GPU's memory is full."""


def in_parts(
    camera: Camera, device: torch.device, render: Callable[[Camera], _Planes]
) -> Iterator[tuple[slice, _Planes]]:
    """Render a view as a whole, or its halves, and theirs, where the GPU's memory is not enough.

    Args:
        camera: the view.
        device: the device that renders it.
        render: renders a part of the view; what it returns should not be on the GPU.

    Yields:
        The rows of the image, from top to bottom, and what `render` has returned for them.
    """
    left = [(0, camera.height)]
    while left:
        first, count = left.pop()
        try:
            planes = render(camera if count == camera.height else camera.crop(0, first, camera.width, count))
        except Exception as error:
            if count < 2 * _LEAST_HEIGHT or not devices.is_out_of_memory(error):
                raise
            left += [(first + count // 2, count - count // 2), (first, count // 2)]
        else:
            yield slice(first, first + count), planes
            continue
        # Only now, as the error has kept what it was raised with.
        forget_capacity(device)
        if device.type == "cuda":
            torch.cuda.empty_cache()


def draw(model: ObjectModel, camera: Camera, want_ids: bool = True, want_depth: bool = False) -> RenderedView:
    """Render a model over its background, in parts if the GPU's memory is not enough for the whole.

    Args:
        model: the model.
        camera: the view, in scene units.
        want_ids: whether to compute the most probable object of each pixel.
        want_depth: whether to compute the expected depth.

    Returns:
        The rendered view, as NumPy arrays.
    """
    found = in_parts(camera, model.device, lambda part: _drawn(model, part, want_ids, want_depth))
    parts = [view for _, view in found]
    if len(parts) == 1:
        return parts[0]
    return RenderedView._make(
        None if planes[0] is None else np.concatenate(planes) for planes in zip(*parts, strict=True)
    )


def _drawn(model: ObjectModel, camera: Camera, want_ids: bool, want_depth: bool) -> RenderedView:
    viewmat, intrinsics = camera.arrays()
    seen = anchors_in_view(model.anchors, viewmat, intrinsics, camera.width, camera.height, camera.near)
    g = model.generate(seen, camera.center)
    with torch.no_grad():
        drawn = rasterize(*g[:6], camera, want_depth=want_depth, primitive=model.primitive)
        image = drawn.color + (1 - drawn.alpha) * model.background.detach()[:, None, None]
        image = image * torch.tensor(camera.gain).to(image.device)[:, None, None]
        pixels = devices.host(image.clamp(0, 1).permute(1, 2, 0).contiguous())
    alpha = devices.host(drawn.alpha)
    depth = None
    if drawn.depth is not None:
        depth = devices.host(drawn.depth) / np.maximum(alpha, 1e-6) / np.float32(model.normalization.scale)
    ids = probability = None
    if want_ids:
        classes, probability = (devices.host(plane) for plane in object_map(drawn))
        ids = model.classes.ids_of(classes)
    return RenderedView(pixels, ids, probability, alpha, depth)


def objects_alone(model: ObjectModel, camera: Camera) -> Iterator[tuple[int, np.ndarray]]:
    """Render each object of a model that has splats in a view, without the others.

    Args:
        model: the model.
        camera: the view, in scene units.

    Yields:
        The ID of each object but 0, and its alpha (H, W) float32.
    """
    viewmat, intrinsics = camera.arrays()
    seen = anchors_in_view(model.anchors, viewmat, intrinsics, camera.width, camera.height, camera.near)
    with torch.no_grad():
        splats = model.generate(seen, camera.center).only_valid()
        numbers, counts = splats.ids.unique(return_counts=True)
        by_object = splats.ids.argsort(stable=True).split(counts.tolist())
        for object_id, own in zip(model.classes.ids_of(devices.host(numbers)).tolist(), by_object, strict=True):
            if object_id:
                alone = splats.select(own)
                yield object_id, devices.host(rasterize(*alone[:6], camera, primitive=model.primitive).alpha)
