"""What a training can be told, and how its rates fall as it goes on."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ..model.anchors import Layout


@dataclass(frozen=True)
class Settings:
    """Choices that make the model what it is; a checkpoint only continues under the same ones.

    mode: `explicit` or `view`; sh_degree: of explicit colour; offsets: splats an anchor; voxel: edge of an anchor's
    cell in world units (None: the median spacing of the points); max_anchors: growth stops there.
    background: `learned`, `black` or `white`. zero_is_object: whether pixels of ID 0 are taught as a class.
    primitive: `3d` Gaussians or `2d` discs; for discs, normal_weight: how much the normals are to agree with the depth,
    distortion_weight: how much the splats along a ray are to lie at one depth, and half of volume_weight for the area.
    pyramid: whether pictures are reduced at the start of the training (None: those that are large).
    """

    seed: int = 0
    mode: str = "explicit"
    sh_degree: int = 1
    offsets: int = 10
    voxel: float | None = None
    max_anchors: int = 200_000
    background: str = "learned"
    semantic_weight: float = 0.1
    ssim_weight: float = 0.2
    volume_weight: float = 0.01
    zero_is_object: bool = False
    primitive: str = "3d"
    normal_weight: float = 0.05
    distortion_weight: float = 10.0
    pyramid: bool | None = None

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)

    def in_effect(self) -> dict[str, Any]:
        """The choices that matter: 3D Gaussians have no normals and no distortion."""
        surface = () if self.primitive == "2d" else ("normal_weight", "distortion_weight")
        return {name: value for name, value in asdict(self).items() if name not in surface}

    @property
    def layout(self) -> Layout:
        """Columns of an anchor's row."""
        return Layout(offsets=self.offsets)


REST_FROM = 0.05
"""Share of the points that no mask ever gave an object, from which on unlabelled pixels are taken for the rest of the
scene rather than for gaps in the masks. Objects that are taught nothing there spread over it."""


def rest_is_taught(point_ids: np.ndarray) -> bool:
    """Whether unlabelled pixels show the rest of the scene, where the points' objects are point_ids (M,)."""
    return bool((np.asarray(point_ids) == 0).mean() >= REST_FROM)


GROW_FROM, GROW_UNTIL = 0.1, 0.6
"""Growth runs between these shares of the training; its statistics start half way to the first."""

_GROW_OFTEN, _GROW_SELDOM, _GROW_PART = 25, 100, 0.02


def growth_interval(step: int) -> int:
    """Steps until anchors grow again: often at first, which shortens short trainings; later, when there are more
    anchors to look through and each round changes less, a part of the steps so far."""
    return int(min(max(_GROW_OFTEN, _GROW_PART * step), _GROW_SELDOM))


PLATEAU_FROM, PLATEAU_UNTIL = 0.2, 0.8
"""Between these shares of the training the rates hardly fall. Most is learned there; the fall after it settles what has
been learned."""
_FALLEN = {PLATEAU_FROM: 0.25, PLATEAU_UNTIL: 0.3}
"""How far the rates have fallen at both ends of the plateau, 0 (not at all) to 1."""

SURFACE_FROM = 0.25
"""Share of the training from which on discs are taught normals and depth: before, there is no surface yet."""

_ROW_RATES = {
    "offset_columns": (4e-2, 4e-4),
    "extent_columns": (2.8e-2, 2.8e-3),
    "feature_columns": (3e-2, 3e-3),
    "opacity_columns": (8e-2, 8e-3),
    "shape_columns": (4e-2, 4e-3),
    "color_columns": (2e-2, 2e-3),
}
HEAD_RATES = {
    "hidden": (4e-3, 1e-4),
    "opacity": (2e-3, 2e-5),
    "shape": (4e-3, 1e-4),
    "color": (4e-3, 2.5e-5),
    "background": (1e-2, 1e-4),
}


def rate(ends: tuple[float, float], share: float) -> float:
    """Learning rate after a share (0 to 1) of the training: from the first end to the last, exponential before and
    after the plateau and on it."""
    fallen = np.interp(share, [0.0, *_FALLEN, 1.0], [0.0, *_FALLEN.values(), 1.0])
    return float(ends[0] * (ends[1] / ends[0]) ** fallen)


def row_rates(layout: Layout, share: float) -> np.ndarray:
    """Learning rate of each column of the anchors' rows: (columns,) float32."""
    rates = np.zeros(layout.columns, np.float32)
    for name, ends in _ROW_RATES.items():
        rates[getattr(layout, name)] = rate(ends, share)
    return rates


_LEAST_PIXELS, _LEAST_OF_SMALL = 300, 50
"""Pictures are reduced to no less than this, small ones, where that is asked for, to no less than the other."""


def downscale_at(share: float, longest: int, pyramid: bool | None = None) -> int:
    """Coarse to fine: by how much to reduce pictures of `longest` pixels after a share of the training; `pyramid` as in
    `Settings`."""
    wanted = 4 if share < 0.08 else 2 if share < 0.25 else 1
    least = _LEAST_OF_SMALL if pyramid else _LEAST_PIXELS
    while wanted > 1 and (pyramid is False or longest // wanted < least):
        wanted //= 2
    return wanted
