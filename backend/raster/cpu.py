"""The CPU renderer: NumPy arrays in, pictures and gradients out. See `backend.raster` for the torch interface."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from .camera import Camera
from .cpu_bin import bin_splats, depth_order
from .cpu_ids import most_probable
from .cpu_project import project, project_backward
from .cpu_tiles import blend, blend_backward
from .discs import TILT_COLUMNS
from .splats import GRADIENT_COLUMNS, HALF_H, SPLAT_COLUMNS, view_of

_NO_PLANE = np.zeros((1, 1), np.float32)
_NO_PLANES = np.zeros((1, 1, 1), np.float32)
_NO_LABELS = np.zeros((1, 1), np.int32)


@dataclass
class Gaussians:
    """Contiguous float32 arrays: means (N, 3), quats (N, 4) wxyz of any length, scales (N, 3) linear, opacities (N,),
    sh (N, K, 3); and ids (N,) int32."""

    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    sh: np.ndarray
    ids: np.ndarray


@dataclass
class Frame:
    """A picture and what its gradient needs. color (3, H, W), transmittance (H, W); if asked weight, depth, median
    (H, W), normals (3, H, W) and moments (2, H, W), see `blend`."""

    gaussians: Gaussians
    camera: Camera
    labels: np.ndarray | None
    color: np.ndarray
    transmittance: np.ndarray
    weight: np.ndarray | None
    depth: np.ndarray | None
    median: np.ndarray | None
    normals: np.ndarray | None
    moments: np.ndarray | None
    splats: np.ndarray
    tilts: np.ndarray | None
    tiles: np.ndarray
    members: np.ndarray
    places: np.ndarray
    slots: np.ndarray
    ends: np.ndarray
    screen_gradient: np.ndarray | None = field(default=None)

    @property
    def seen(self) -> np.ndarray:
        """(N,) bool: splats whose footprint meets the picture."""
        return self.splats[:, HALF_H] > 0


def forward(
    gaussians: Gaussians,
    camera: Camera,
    labels: np.ndarray | None = None,
    want_depth: bool = False,
    want_median: bool = False,
    want_normals: bool = False,
    want_moments: bool = False,
    flat: bool = False,
) -> Frame:
    """Draw `gaussians`, as discs if `flat`. labels (H, W) int32: also sum, per pixel, the weights of splats whose id is
    the label. Normals and moments are those of discs."""
    g = gaussians
    count, height, width = g.means.shape[0], int(camera.height), int(camera.width)
    splats = np.empty((count, SPLAT_COLUMNS), np.float32)
    tilts = np.empty((count, TILT_COLUMNS), np.float32) if flat else None
    outlines = np.empty((count, SPLAT_COLUMNS), np.float32) if flat else splats
    project(
        g.means, g.quats, g.scales, g.opacities, g.sh, view_of(camera, flat), width, height, splats, tilts, outlines
    )
    tiles, members, places, slots = bin_splats(outlines, depth_order(splats, g.ids), width, height)

    def planes(wanted: bool, *shape: int) -> np.ndarray | None:
        return np.empty((*shape, height, width), np.float32) if wanted else None

    color = np.empty((3, height, width), np.float32)
    transmittance = np.empty((height, width), np.float32)
    weight, depth, median = planes(labels is not None), planes(want_depth), planes(want_median)
    normals, moments = planes(want_normals, 3), planes(want_moments, 2)
    ends = np.empty(tiles.size - 1, np.int64)
    blend(
        splats, tilts, g.ids, _NO_LABELS if labels is None else labels, tiles, members, labels is not None, want_depth,
        want_median, want_normals, want_moments, color, transmittance, _or_none(weight), _or_none(depth),
        _or_none(median), _or_none(normals, _NO_PLANES), _or_none(moments, _NO_PLANES), ends,
    )  # fmt: skip
    return Frame(
        g, camera, labels, color, transmittance, weight, depth, median, normals, moments, splats, tilts,
        tiles, members, places, slots, ends,
    )  # fmt: skip


def _or_none(plane: np.ndarray | None, none: np.ndarray = _NO_PLANE) -> np.ndarray:
    return none if plane is None else plane


def backward(
    frame: Frame,
    g_color: np.ndarray,
    g_alpha: np.ndarray,
    g_weight: np.ndarray | None = None,
    g_depth: np.ndarray | None = None,
    g_normals: np.ndarray | None = None,
    g_moments: np.ndarray | None = None,
) -> Gaussians:
    """Gradients of a frame's Gaussians (ids are None's stand-in: left empty) from those of its planes.

    Also sets frame.screen_gradient (N, 2): the gradient with respect to each centre in pixels.
    """
    g, camera = frame.gaussians, frame.camera
    labels = frame.labels
    with_normals = frame.normals is not None and g_normals is not None
    rows = np.empty((frame.members.size, GRADIENT_COLUMNS * (2 if with_normals else 1)), np.float32)
    blend_backward(
        frame.splats, frame.tilts, g.ids, _NO_LABELS if labels is None else labels, frame.tiles, frame.members,
        frame.places, frame.ends, labels is not None and g_weight is not None,
        frame.depth is not None and g_depth is not None, with_normals,
        frame.moments is not None and g_moments is not None,
        frame.color, frame.transmittance, _or_none(frame.weight), _or_none(frame.depth),
        _or_none(frame.normals, _NO_PLANES), _or_none(frame.moments, _NO_PLANES),
        g_color, g_alpha, _or_none(g_weight), _or_none(g_depth), _or_none(g_normals, _NO_PLANES),
        _or_none(g_moments, _NO_PLANES), rows,
    )  # fmt: skip
    out = Gaussians(
        np.empty_like(g.means), np.empty_like(g.quats), np.empty_like(g.scales), np.empty_like(g.opacities),
        np.empty_like(g.sh), np.empty(0, np.int32),
    )  # fmt: skip
    frame.screen_gradient = np.empty((g.means.shape[0], 2), np.float32)
    project_backward(
        g.means, g.quats, g.scales, g.opacities, g.sh, view_of(camera, frame.tilts is not None),
        frame.splats, frame.tilts, frame.slots, rows,
        out.means, out.quats, out.scales, out.opacities, out.sh, frame.screen_gradient,
    )  # fmt: skip
    return out


def object_map(frame: Frame) -> tuple[np.ndarray, np.ndarray]:
    """The most probable ID of each pixel (H, W) int32, -1 where nothing is drawn, and its probability (H, W)."""
    shape = (frame.camera.height, frame.camera.width)
    best_id = np.empty(shape, np.int32)
    best_weight = np.empty(shape, np.float32)
    most_probable(frame.splats, frame.tilts, frame.gaussians.ids, frame.tiles, frame.members, best_id, best_weight)
    return best_id, best_weight
