"""Settings of a training, and schedules of learning rates, growth and resolution over its progress."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ..model.anchors import Layout

MODES = ("explicit", "view", "paper")


@dataclass(frozen=True)
class Settings:
    """Settings that affect the model; a training can be resumed only with the same ones.

    Attributes:
        mode: one of MODES. `explicit` and `view`: see `Heads`; each offset also has residuals of its own, which are
            added to the output of the heads. `paper`: as `view`, without residuals, so that a splat's appearance comes
            from the heads alone, as in ObjectGS section 3.2.
        sh_degree: degree of the colors' spherical harmonics in explicit mode.
        offsets: number of splats per anchor.
        voxel: edge length of an anchor's cell in world units; None: the median spacing of the points, or two
            pixels if that is less.
        max_anchors: largest number of anchors.
        background: `learned`, `black` or `white`.
        semantic_weight, ssim_weight, volume_weight: weights of the terms of the loss. For discs, half of volume_weight
            is applied to their area.
        zero_is_object: whether pixels with ID 0 are supervised as an object.
        primitive: `3d` Gaussians or `2d` discs.
        normal_weight: weight of the loss that aligns the normals of discs with the depth.
        distortion_weight: weight of the loss that concentrates the discs along a ray at one depth.
        pyramid: whether images are downscaled at the start of the training; None: only large ones.
        fit_colors: whether a correction of each photo's colors is fitted (see `PhotoColors`).
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
    fit_colors: bool = False

    def as_dict(self) -> dict[str, Any]:
        """Return the settings as a JSON-compatible dict."""
        return asdict(self)

    def in_effect(self) -> dict[str, Any]:
        """Return the settings that a training has to be resumed with.

        For 3D Gaussians, these are without normal_weight and distortion_weight. fit_colors follows from the plan, and
        trainings of older versions continue without it.
        """
        without = ("fit_colors",) if self.primitive == "2d" else ("fit_colors", "normal_weight", "distortion_weight")
        return {name: value for name, value in asdict(self).items() if name not in without}

    @property
    def view_dependent(self) -> bool:
        """Whether the splats depend on the camera, so that plain splats are only a fit of the model."""
        return self.mode != "explicit"

    @property
    def layout(self) -> Layout:
        """The columns of an anchor's row."""
        return Layout(offsets=self.offsets)


BACKGROUND_FROM = 0.05
"""Fraction of the points in the background from which on unlabeled pixels are considered background instead of gaps in
the masks. Without supervision there, objects would spread over the background."""


def background_is_masked(in_background: np.ndarray) -> bool:
    """Decide whether unlabeled pixels show the background.

    Args:
        in_background: (M,) bool, the points that no mask, or hardly any, shows on an object.

    Returns:
        Whether unlabeled pixels should be supervised to show no object.
    """
    return bool(np.mean(in_background) >= BACKGROUND_FROM)


GROW_FROM, GROW_UNTIL = 0.1, 0.6
"""Range of the progress in which anchors grow; statistics are accumulated from half of GROW_FROM on."""

_MIN_INTERVAL, _MAX_INTERVAL, _INTERVAL_FRACTION = 25, 100, 0.02


def growth_interval(step: int) -> int:
    """Return the number of steps until the next growth.

    It is small at first, for short trainings; later it is a fraction of the steps so far, since there are more anchors
    to process and each round changes less.
    """
    return int(min(max(_MIN_INTERVAL, _INTERVAL_FRACTION * step), _MAX_INTERVAL))


PLATEAU_FROM, PLATEAU_UNTIL = 0.2, 0.8
"""Range of the progress in which the learning rates are nearly constant. Most is learned there; the decay afterward
refines the result."""
_DECAY = {PLATEAU_FROM: 0.25, PLATEAU_UNTIL: 0.3}
"""Decay of the learning rates at both ends of the plateau, from 0 (none) to 1 (complete)."""

SURFACE_FROM = 0.25
"""Progress from which on the normals and depth of discs are supervised; before, there is no surface yet."""

_ROW_RATES = {
    "offset_columns": (4e-2, 4e-4),
    "extent_columns": (2.8e-2, 2.8e-3),
    "feature_columns": (3e-2, 3e-3),
    "opacity_columns": (8e-2, 8e-3),
    "shape_columns": (4e-2, 4e-3),
    "color_columns": (2e-2, 2e-3),
}
RESIDUALS = ("opacity_columns", "shape_columns", "color_columns")
"""Columns of the values that are added to the output of the heads."""

HEAD_RATES = {
    "hidden": (4e-3, 1e-4),
    "opacity": (2e-3, 2e-5),
    "shape": (4e-3, 1e-4),
    "color": (4e-3, 2.5e-5),
    "background": (1e-2, 1e-4),
}


def rate(ends: tuple[float, float], progress: float) -> float:
    """Return the learning rate at a progress of 0 .. 1.

    It decays from ends[0] to ends[1], exponentially before, on and after the plateau.
    """
    decay = np.interp(progress, [0.0, *_DECAY, 1.0], [0.0, *_DECAY.values(), 1.0])
    return float(ends[0] * (ends[1] / ends[0]) ** decay)


def row_rates(settings: Settings, progress: float) -> np.ndarray:
    """Return the learning rate of each column of the anchors' rows: (columns,) float32.

    It is 0 for residuals in paper mode.
    """
    rates = np.zeros(settings.layout.columns, np.float32)
    for name, ends in _ROW_RATES.items():
        if settings.mode != "paper" or name not in RESIDUALS:
            rates[getattr(settings.layout, name)] = rate(ends, progress)
    return rates


_MIN_PIXELS, _MIN_PIXELS_OF_SMALL, _MIN_PIXELS_LATER = 300, 50, 600
"""Smallest longer side of downscaled images, in pixels; the second value applies if `pyramid` is True, the third after
SMALL_UNTIL."""

SMALL_UNTIL, HALF_UNTIL = 0.25, 0.7
"""Progress until which images are downscaled to about `_MIN_PIXELS`, and to about `_MIN_PIXELS_LATER`."""


def downscale_at(progress: float, longest: int, pyramid: bool | None = None) -> int:
    """Return the factor by which images are downscaled, coarse to fine.

    A step on a large image takes as long as several on a small one, which teach more while the splats are still few.

    Args:
        progress: progress of the training, 0 .. 1.
        longest: longer side of an image in pixels.
        pyramid: as in `Settings`.

    Returns:
        4, 2 or 1.
    """
    if pyramid is False or progress >= HALF_UNTIL:
        return 1
    least = _MIN_PIXELS_OF_SMALL if pyramid else _MIN_PIXELS
    if progress >= SMALL_UNTIL:
        least = _MIN_PIXELS_LATER
    return next((factor for factor in (4, 2) if longest // factor >= least), 1)
