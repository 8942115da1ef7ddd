"""Drawing a film frame: colour, depth, and which objects cover a pixel by how much.

Splats hold and blend the photos' own encoded (sRGB) colours, as they were trained; what comes out of that is decoded
once, to the light that a renderer counts in, and only then averaged over the shutter's time, as light is.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from .. import device
from ..raster import Camera, Rendered, object_ranks, rasterize
from ..raster.ranks import add_ranked
from .cryptomatte import RANKS
from .shot import Frame, Sample, Shot
from .stage import Stage

FAR = 1e10
"""Depth where nothing is, as Blender's renderers say it."""

_KEPT = 16
"""How many objects of a pixel are told apart while a frame's samples are added up."""
_FAINTEST = 1e-6


class Picture(NamedTuple):
    """rgba (H, W, 4) float32: linear light of sRGB's primaries, premultiplied. depth (H, W) float32: along the camera's
    axis, `FAR` where nothing is. ids (RANKS, H, W) int32: places in the stage's names, from what covers most of the
    pixel down, -1 where there are no more; coverage (RANKS, H, W) float32: of each, their sum is alpha."""

    rgba: NDArray[np.float32]
    depth: NDArray[np.float32]
    ids: NDArray[np.int32]
    coverage: NDArray[np.float32]


def draw_frame(stage: Stage, shot: Shot, frame: Frame, after_sample: Callable[[int], object]) -> Picture:
    """Draw a frame; after_sample(n) is called when n of its samples are drawn, and may raise."""
    count, shape = len(frame.samples), (shot.height, shot.width)
    rgba = np.zeros((*shape, 4), np.float32)
    depth = np.full(shape, FAR, np.float32)
    kept = RANKS if count == 1 else _KEPT
    ids = np.full((*shape, kept), -1, np.int32)
    coverage = np.zeros((*shape, kept), np.float32)
    for number, sample in enumerate(frame.samples):
        is_middle = number == frame.middle
        drawn = _draw(stage, shot, sample, is_middle)
        rgba += _light(drawn)
        if is_middle:
            depth = _depth(drawn, shot.depth_scale)
        add_ranked(ids, coverage, *(device.host(plane) for plane in object_ranks(drawn, kept)))
        after_sample(number + 1)
    rgba /= np.float32(count)
    coverage /= np.float32(count)
    return Picture(rgba, depth, _first(ids), _first(coverage))


def _first(ranked: NDArray) -> NDArray:
    """(H, W, n) as (RANKS, H, W)."""
    return np.ascontiguousarray(np.moveaxis(ranked[..., :RANKS], -1, 0))


def decoded(encoded: NDArray) -> NDArray[np.float32]:
    """sRGB's encoded values as linear light; values above 1 go on along the same curve."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((np.maximum(encoded, 0.0) + 0.055) / 1.055) ** 2.4).astype(
        np.float32
    )


def encoded(linear: NDArray) -> NDArray[np.float32]:
    """What `decoded` takes back."""
    return np.where(
        linear <= 0.0031308, linear * 12.92, 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055
    ).astype(np.float32)


def as_photo(rgba: NDArray) -> NDArray[np.uint8]:
    """A frame's (H, W, 4) as a photo holds it: encoded, 8 bits, alpha not multiplied in."""
    alpha = rgba[..., 3:]
    straight = encoded(rgba[..., :3] / np.maximum(alpha, _FAINTEST))
    return np.rint(255.0 * np.clip(np.concatenate([straight, alpha], -1), 0.0, 1.0)).astype(np.uint8)


def _draw(stage: Stage, shot: Shot, sample: Sample, with_depth: bool) -> Rendered:
    camera = Camera(sample.viewmat, sample.K, shot.width, shot.height, near=sample.clip[0])
    splats: dict[str, Any] = stage.at(sample, shot.only_named)
    with torch.no_grad():
        return rasterize(
            **splats, camera=camera, want_depth=with_depth, want_median=with_depth,
            primitive=stage.primitive,
        )  # fmt: skip


def _light(drawn: Rendered) -> NDArray[np.float32]:
    """(H, W, 4): decoded where nothing is multiplied in, then multiplied with alpha again."""
    alpha = device.host(drawn.alpha)[..., None]
    blended = np.moveaxis(device.host(drawn.color), 0, -1)
    return np.concatenate([decoded(blended / np.maximum(alpha, _FAINTEST)) * alpha, alpha], -1)


def _depth(drawn: Rendered, scale: float) -> NDArray[np.float32]:
    """(H, W): where half of the light is taken, which is on a surface also at the edge of one before another, unlike
    the mean, which lies between them; where less than half is taken, the mean of what takes it."""
    assert drawn.depth is not None and drawn.median is not None
    alpha, mean, median = (device.host(plane) for plane in (drawn.alpha, drawn.depth, drawn.median))
    found = np.where(median > 0, median, mean / np.maximum(alpha, _FAINTEST))
    return np.where(alpha > _FAINTEST, found * scale, FAR).astype(np.float32)
