"""The CPU renderer on NumPy arrays; see `backend.raster` for the torch interface."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ..camera import Camera
from ..discs import TILT_COLUMNS
from ..splats import GRADIENT_COLUMNS, HALF_H, SPLAT_COLUMNS, view_of
from .binning import bin_splats, depth_order
from .blending import blend
from .blending_backward import blend_backward
from .ids import most_probable
from .projection import project, project_backward

_NO_PLANE = np.zeros((1, 1), np.float32)
_NO_PLANES = np.zeros((1, 1, 1), np.float32)
_NO_LABELS = np.zeros((1, 1), np.int32)


@dataclass
class Gaussians:
    """Parameters of Gaussians, as contiguous arrays.

    means (N, 3), quats (N, 4) wxyz of any length, scales (N, 3) linear, opacities (N,), sh (N, K, 3): float32; ids (N,)
    int32.
    """

    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    sh: np.ndarray
    ids: np.ndarray


@dataclass
class Frame:
    """A rendered image and the data for its gradient.

    Attributes:
        color, transmittance: (3, H, W) and (H, W).
        label_probability, depth, median, surface, normals, moments: the requested planes, see `blend`.
        splats, tilts: the projected splats (splats.py, discs.py).
        isect_offsets, isect_ids, isect_rows, row_offsets: the tile intersections, see `bin_splats`.
        isect_counts: (T,), number of blended intersections of each tile.
        screen_gradient: (N, 2), set by `backward`.
    """

    gaussians: Gaussians
    camera: Camera
    labels: np.ndarray | None
    color: np.ndarray
    transmittance: np.ndarray
    label_probability: np.ndarray | None
    depth: np.ndarray | None
    median: np.ndarray | None
    surface: np.ndarray | None
    normals: np.ndarray | None
    moments: np.ndarray | None
    splats: np.ndarray
    tilts: np.ndarray | None
    isect_offsets: np.ndarray
    isect_ids: np.ndarray
    isect_rows: np.ndarray
    row_offsets: np.ndarray
    isect_counts: np.ndarray
    screen_gradient: np.ndarray | None = field(default=None)

    @property
    def seen(self) -> np.ndarray:
        """(N,) bool: splats whose footprint overlaps the image."""
        return self.splats[:, HALF_H] > 0


def forward(
    gaussians: Gaussians,
    camera: Camera,
    labels: np.ndarray | None = None,
    want_depth: bool = False,
    want_median: bool = False,
    want_surface: bool = False,
    want_normals: bool = False,
    want_moments: bool = False,
    flat: bool = False,
) -> Frame:
    """Render `gaussians`, as discs if `flat`.

    Args:
        gaussians: the splats.
        camera: the view.
        labels: (H, W) int32; if given, label_probability is computed, the sum of the blending weights of the splats
            whose ID is the pixel's label.
        want_depth, want_median, want_surface, want_normals, want_moments: whether to compute these planes; normals and
            moments are available only for discs.
        flat: whether to render discs instead of 3D Gaussians.

    Returns:
        The frame.
    """
    g = gaussians
    count, height, width = g.means.shape[0], int(camera.height), int(camera.width)
    splats = np.empty((count, SPLAT_COLUMNS), np.float32)
    tilts = np.empty((count, TILT_COLUMNS), np.float32) if flat else None
    outlines = np.empty((count, SPLAT_COLUMNS), np.float32) if flat else splats
    project(
        g.means, g.quats, g.scales, g.opacities, g.sh, view_of(camera, flat), width, height, splats, tilts, outlines
    )
    isect_offsets, isect_ids, isect_rows, row_offsets = bin_splats(outlines, depth_order(splats, g.ids), width, height)

    def planes(wanted: bool, *shape: int) -> np.ndarray | None:
        return np.empty((*shape, height, width), np.float32) if wanted else None

    color = np.empty((3, height, width), np.float32)
    transmittance = np.empty((height, width), np.float32)
    label_probability, depth = planes(labels is not None), planes(want_depth)
    median, surface = planes(want_median), planes(want_surface)
    normals, moments = planes(want_normals, 3), planes(want_moments, 2)
    isect_counts = np.empty(isect_offsets.size - 1, np.int64)
    blend(
        splats, tilts, g.ids, _NO_LABELS if labels is None else labels, isect_offsets, isect_ids, labels is not None,
        want_depth, want_median, want_surface, want_normals, want_moments, color, transmittance,
        _or_empty(label_probability), _or_empty(depth), _or_empty(median), _or_empty(surface),
        _or_empty(normals, _NO_PLANES), _or_empty(moments, _NO_PLANES), isect_counts,
    )  # fmt: skip
    return Frame(
        g, camera, labels, color, transmittance, label_probability, depth, median, surface, normals, moments, splats,
        tilts, isect_offsets, isect_ids, isect_rows, row_offsets, isect_counts,
    )  # fmt: skip


def _or_empty(plane: np.ndarray | None, empty: np.ndarray = _NO_PLANE) -> np.ndarray:
    return empty if plane is None else plane


def backward(
    frame: Frame,
    g_color: np.ndarray,
    g_alpha: np.ndarray,
    g_label_probability: np.ndarray | None = None,
    g_depth: np.ndarray | None = None,
    g_normals: np.ndarray | None = None,
    g_moments: np.ndarray | None = None,
) -> Gaussians:
    """Compute the gradients with respect to a frame's Gaussians from those with respect to its planes.

    Args:
        frame: result of `forward`; its screen_gradient (N, 2) is set to the gradient with respect to each splat's
            center in pixels.
        g_color, g_alpha, g_label_probability, g_depth, g_normals, g_moments: gradients in the shapes of the planes;
            g_alpha is with respect to 1 - transmittance.

    Returns:
        The gradients in the shapes of the parameters; ids is empty.
    """
    g, camera = frame.gaussians, frame.camera
    labels = frame.labels
    with_normals = frame.normals is not None and g_normals is not None
    rows = np.empty((frame.isect_ids.size, GRADIENT_COLUMNS * (2 if with_normals else 1)), np.float32)
    blend_backward(
        frame.splats, frame.tilts, g.ids, _NO_LABELS if labels is None else labels, frame.isect_offsets,
        frame.isect_ids, frame.isect_rows, frame.isect_counts, labels is not None and g_label_probability is not None,
        frame.depth is not None and g_depth is not None, with_normals,
        frame.moments is not None and g_moments is not None,
        frame.color, frame.transmittance, _or_empty(frame.label_probability), _or_empty(frame.depth),
        _or_empty(frame.normals, _NO_PLANES), _or_empty(frame.moments, _NO_PLANES),
        g_color, g_alpha, _or_empty(g_label_probability), _or_empty(g_depth), _or_empty(g_normals, _NO_PLANES),
        _or_empty(g_moments, _NO_PLANES), rows,
    )  # fmt: skip
    out = Gaussians(
        np.empty_like(g.means), np.empty_like(g.quats), np.empty_like(g.scales), np.empty_like(g.opacities),
        np.empty_like(g.sh), np.empty(0, np.int32),
    )  # fmt: skip
    frame.screen_gradient = np.empty((g.means.shape[0], 2), np.float32)
    project_backward(
        g.means, g.quats, g.scales, g.opacities, g.sh, view_of(camera, frame.tilts is not None),
        frame.splats, frame.tilts, frame.row_offsets, rows,
        out.means, out.quats, out.scales, out.opacities, out.sh, frame.screen_gradient,
    )  # fmt: skip
    return out


def object_ranks(frame: Frame, ranks: int) -> tuple[np.ndarray, np.ndarray]:
    """Rank the most probable IDs of each pixel; see `backend.raster.object_ranks`."""
    shape = (ranks, frame.camera.height, frame.camera.width)
    best_id = np.empty(shape, np.int32)
    best_probability = np.empty(shape, np.float32)
    most_probable(
        frame.splats, frame.tilts, frame.gaussians.ids, frame.isect_offsets, frame.isect_ids, best_id, best_probability
    )
    return best_id, best_probability
