"""The CPU renderer: NumPy arrays in, pictures and gradients out. See `backend.raster` for the torch interface."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from .camera import Camera
from .cpu_bin import bin_splats, depth_order
from .cpu_ids import most_probable
from .cpu_project import GRADIENT_COLUMNS, HALF_H, SPLAT_COLUMNS, project, project_backward
from .cpu_tiles import blend, blend_backward

_NO_PLANE = np.zeros((1, 1), np.float32)
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
    """A picture and what its gradient needs. color (3, H, W), transmittance (H, W), weight, depth, median if asked."""

    gaussians: Gaussians
    camera: Camera
    labels: np.ndarray | None
    color: np.ndarray
    transmittance: np.ndarray
    weight: np.ndarray | None
    depth: np.ndarray | None
    median: np.ndarray | None
    splats: np.ndarray
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
) -> Frame:
    """Draw `gaussians`. labels (H, W) int32: also sum, per pixel, the weights of splats whose id is the label."""
    g = gaussians
    height, width = int(camera.height), int(camera.width)
    splats = np.empty((g.means.shape[0], SPLAT_COLUMNS), np.float32)
    viewmat, intrinsics = camera.arrays()
    near = float(camera.near)
    project(g.means, g.quats, g.scales, g.opacities, g.sh, viewmat, intrinsics, width, height, near, splats)
    tiles, members, places, slots = bin_splats(splats, depth_order(splats, g.ids), width, height)
    color = np.empty((3, height, width), np.float32)
    transmittance = np.empty((height, width), np.float32)
    weight = np.empty((height, width), np.float32) if labels is not None else None
    depth = np.empty((height, width), np.float32) if want_depth else None
    median = np.empty((height, width), np.float32) if want_median else None
    ends = np.empty(tiles.size - 1, np.int64)
    blend(
        splats, g.ids, _NO_LABELS if labels is None else labels, tiles, members, labels is not None, want_depth,
        want_median, color, transmittance, _or_none(weight), _or_none(depth), _or_none(median), ends,
    )  # fmt: skip
    return Frame(
        g, camera, labels, color, transmittance, weight, depth, median, splats, tiles, members, places, slots, ends
    )


def _or_none(plane: np.ndarray | None) -> np.ndarray:
    return _NO_PLANE if plane is None else plane


def backward(
    frame: Frame,
    g_color: np.ndarray,
    g_alpha: np.ndarray,
    g_weight: np.ndarray | None = None,
    g_depth: np.ndarray | None = None,
) -> Gaussians:
    """Gradients of a frame's Gaussians (ids are None's stand-in: left empty) from those of its planes.

    Also sets frame.screen_gradient (N, 2): the gradient with respect to each centre in pixels.
    """
    g, camera = frame.gaussians, frame.camera
    labels = frame.labels
    rows = np.empty((frame.members.size, GRADIENT_COLUMNS), np.float32)
    blend_backward(
        frame.splats, g.ids, _NO_LABELS if labels is None else labels, frame.tiles, frame.members, frame.places,
        frame.ends, labels is not None and g_weight is not None, frame.depth is not None and g_depth is not None,
        frame.color, frame.transmittance, _or_none(frame.weight), _or_none(frame.depth),
        g_color, g_alpha, _or_none(g_weight), _or_none(g_depth), rows,
    )  # fmt: skip
    out = Gaussians(
        np.empty_like(g.means), np.empty_like(g.quats), np.empty_like(g.scales), np.empty_like(g.opacities),
        np.empty_like(g.sh), np.empty(0, np.int32),
    )  # fmt: skip
    frame.screen_gradient = np.empty((g.means.shape[0], 2), np.float32)
    viewmat, intrinsics = camera.arrays()
    project_backward(
        g.means, g.quats, g.scales, g.opacities, g.sh, viewmat, intrinsics, int(camera.width), int(camera.height),
        frame.splats, frame.slots, rows,
        out.means, out.quats, out.scales, out.opacities, out.sh, frame.screen_gradient,
    )  # fmt: skip
    return out


def object_map(frame: Frame) -> tuple[np.ndarray, np.ndarray]:
    """The most probable ID of each pixel (H, W) int32, -1 where nothing is drawn, and its probability (H, W)."""
    shape = (frame.camera.height, frame.camera.width)
    best_id = np.empty(shape, np.int32)
    best_weight = np.empty(shape, np.float32)
    most_probable(frame.splats, frame.gaussians.ids, frame.tiles, frame.members, best_id, best_weight)
    return best_id, best_weight


def compile_kernels(progress: Callable[[int, int], object] | None = None) -> float:
    """Make every kernel ready, compiled or read from numba's cache on disk; returns the seconds it took.

    progress(done, total) is called before the first and after every kernel. What follows in this process compiles
    nothing more, whatever is asked for; a later process reads the cache (NUMBA_CACHE_DIR, or `__pycache__` beside
    the kernels, or the user's own cache folder where that is not writable).
    """
    started = time.perf_counter()
    total = 3
    report = progress or (lambda done, total: None)
    report(0, total)
    ones = np.ones((1, 4), np.float32)
    g = Gaussians(
        ones[:, :3].copy(), ones, ones[:, :3].copy(), ones[0, :1].copy(), np.zeros((1, 1, 3), np.float32),
        np.zeros(1, np.int32),
    )  # fmt: skip
    camera = Camera(np.eye(4), np.eye(3), 2, 2)
    frame = forward(g, camera, np.zeros((2, 2), np.int32), want_depth=True)
    report(1, total)
    plane = np.ones((2, 2), np.float32)
    backward(frame, np.ones((3, 2, 2), np.float32), plane, plane, plane)
    report(2, total)
    object_map(frame)
    report(3, total)
    return time.perf_counter() - started
