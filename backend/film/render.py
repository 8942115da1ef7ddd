"""Rendering of a film frame: color, depth, and the coverage of each pixel by objects.

Splats store and blend the sRGB-encoded colors of the photos, as they were trained. The result is decoded to linear
light, and then averaged over the shutter time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from ..model.draw import in_parts
from ..raster import Camera, Rendered, devices, object_ranks, rasterize
from ..raster.ranked_ids import add_ranked
from ..shared.color.srgb import decode, encode
from ..shared.reconstruction.shot import Frame, Sample, Shot
from .cryptomatte import RANKS
from .stage import Stage

FAR = 1e10
"""Depth of empty pixels, as in Blender."""

_KEPT = 16
"""Most objects of each pixel that are kept while the samples of a frame are summed."""
_FAINTEST = 1e-6

_Planes = tuple[NDArray[np.float32], NDArray[np.float32] | None, list[NDArray]]
"""Light (h, w, 4), depth (h, w) if it is wanted, and ranked IDs and their coverage (ranks, h, w)."""


class FilmImage(NamedTuple):
    """A rendered frame.

    Attributes:
        rgba: (H, W, 4) float32, linear light with sRGB primaries, premultiplied.
        depth: (H, W) float32 along the camera's axis; `FAR` in empty pixels.
        ids: (RANKS, H, W) int32 indices in the stage's names, by descending coverage; -1: none.
        coverage: (RANKS, H, W) float32 of each object; the sum over all objects is alpha.
    """

    rgba: NDArray[np.float32]
    depth: NDArray[np.float32]
    ids: NDArray[np.int32]
    coverage: NDArray[np.float32]


def draw_frame(stage: Stage, shot: Shot, frame: Frame, after_sample: Callable[[int], object]) -> FilmImage:
    """Render a frame, in parts if the GPU's memory is not enough for the whole.

    Args:
        stage: The splats.
        shot: The size and other settings of all frames.
        frame: The frame with its samples.
        after_sample: Called with the number of samples that are drawn; may raise to cancel.

    Returns:
        The image, averaged over the samples; the depth is that of the middle one.
    """
    count, shape = len(frame.samples), (shot.height, shot.width)
    rgba = np.zeros((*shape, 4), np.float32)
    depth = np.full(shape, FAR, np.float32)
    kept = RANKS if count == 1 else min(_KEPT, max(RANKS, len(stage.names)))
    ids = np.full((*shape, kept), -1, np.int32)
    coverage = np.zeros((*shape, kept), np.float32)
    for number, sample in enumerate(frame.samples):
        is_middle = number == frame.middle
        for rows, (light, its_depth, ranked) in _draw(stage, shot, sample, is_middle, kept):
            rgba[rows] += light
            if its_depth is not None:
                depth[rows] = its_depth
            add_ranked(ids[rows], coverage[rows], *ranked)
        after_sample(number + 1)
    rgba /= np.float32(count)
    coverage /= np.float32(count)
    return FilmImage(rgba, depth, _first(ids), _first(coverage))


def _first(ranked: NDArray) -> NDArray:
    """Return the first RANKS of (H, W, n) as (RANKS, H, W)."""
    return np.ascontiguousarray(np.moveaxis(ranked[..., :RANKS], -1, 0))


def to_srgb_8bit(rgba: NDArray) -> NDArray[np.uint8]:
    """Return a frame (H, W, 4) as 8-bit sRGB with straight alpha."""
    alpha = rgba[..., 3:]
    straight = encode(rgba[..., :3] / np.maximum(alpha, _FAINTEST))
    return np.rint(255.0 * np.clip(np.concatenate([straight, alpha], -1), 0.0, 1.0)).astype(np.uint8)


def _draw(stage: Stage, shot: Shot, sample: Sample, with_depth: bool, ranks: int) -> Iterator[tuple[slice, _Planes]]:
    """Render a sample; yields rows of the image, and their planes."""
    camera = Camera(sample.viewmat, sample.K, shot.width, shot.height, near=sample.clip[0], blur=stage.blur)
    splats: dict[str, Any] = stage.at(sample, shot.only_named)

    def render(part: Camera) -> _Planes:
        with torch.no_grad():
            drawn = rasterize(
                **splats, camera=part, want_depth=with_depth, want_median=with_depth, primitive=stage.primitive
            )
        depth = _depth(drawn, shot.depth_scale) if with_depth else None
        return _light(drawn), depth, [devices.host(plane) for plane in object_ranks(drawn, ranks)]

    return in_parts(camera, splats["means"].device, render)


def _light(drawn: Rendered) -> NDArray[np.float32]:
    """Return linear light (H, W, 4): unpremultiplied, decoded, and premultiplied again."""
    alpha = devices.host(drawn.alpha)[..., None]
    blended = np.moveaxis(devices.host(drawn.color), 0, -1)
    return np.concatenate([decode(blended / np.maximum(alpha, _FAINTEST)) * alpha, alpha], -1)


def _depth(drawn: Rendered, scale: float) -> NDArray[np.float32]:
    """Return the depth (H, W): the median, which is on a surface even at occlusion edges, unlike the mean.

    Where alpha is too small for a median, the mean is used.
    """
    assert drawn.depth is not None and drawn.median is not None
    alpha, mean, median = (devices.host(plane) for plane in (drawn.alpha, drawn.depth, drawn.median))
    found = np.where(median > 0, median, mean / np.maximum(alpha, _FAINTEST))
    return np.where(alpha > _FAINTEST, found * scale, FAR).astype(np.float32)
