"""The trained model: anchors, heads, background, and the transform between world and scene units."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numba import prange

from ..gpu.kernel import kernel as gpu_kernel
from ..raster import devices
from ..raster.kernel import kernel
from ..shared.class_table import ClassTable
from ..shared.splats.blending import EPS_2D
from .anchors import LOG_EXTENT_MAX, Anchors
from .generate import Generated, generate
from .heads import Heads
from .splats import Splats, blocks, converted

DISC_THICKNESS = 1e-3
"""Third scale of a disc in files, as a fraction of the smaller of the other two."""


@dataclass(frozen=True)
class Normalization:
    """Transform from world to scene units: scene = (world - center) * scale.

    In scene units, float32 suffices for georeferenced, tiny and huge captures.
    """

    center: tuple[float, float, float]
    scale: float

    def to_scene(self, xyz: np.ndarray) -> np.ndarray:
        """Convert world positions (M, 3) to scene units, float64."""
        return (np.asarray(xyz, np.float64) - np.array(self.center)) * self.scale

    def to_world(self, xyz: np.ndarray) -> np.ndarray:
        """Convert scene positions (M, 3) to world units, float64."""
        return np.asarray(xyz, np.float64) / self.scale + np.array(self.center)

    def viewmat(self, viewmat: np.ndarray) -> np.ndarray:
        """Convert a world-to-camera matrix (4, 4) to scene units, both of the world and of camera space."""
        out = np.array(viewmat, np.float64)
        out[:3, 3] = (out[:3, 3] + out[:3, :3] @ np.array(self.center)) * self.scale
        return out

    @classmethod
    def of(cls, camera_centers: np.ndarray, points: np.ndarray) -> Normalization:
        """Compute a normalization centered on the points' median.

        The median distances from it become at most 1 for points and at most 2 for cameras.
        """
        center = np.median(points, axis=0)
        spread = np.median(np.linalg.norm(points - center, axis=1))
        reach = np.median(np.linalg.norm(camera_centers - center, axis=1)) / 2
        size = max(spread, reach)
        scale = 1.0 / size if np.isfinite(size) and size > 0 else 1.0
        return cls((float(center[0]), float(center[1]), float(center[2])), float(scale))


@dataclass
class ObjectModel:
    """A trained model.

    Attributes:
        anchors, heads: anchors in scene units, and the heads.
        background: (3,) RGB in display space, 0 .. 1.
        classes: the object IDs of the anchors' class indices; class 0 is "no object".
        normalization: transform between the capture's world and scene units.
        primitive: "3d" Gaussians or "2d" discs.
        blur: variance in square pixels of the low-pass filter with which 3D Gaussians are trained and drawn.
    """

    anchors: Anchors
    heads: Heads
    background: torch.Tensor
    classes: ClassTable
    normalization: Normalization
    primitive: str = "3d"
    blur: float = EPS_2D

    @property
    def device(self) -> torch.device:
        """The device of the model's tensors."""
        return self.background.device

    def to(self, device: torch.device) -> ObjectModel:
        """Move the model to another device; returns the model."""
        self.anchors, self.heads, self.background = (
            self.anchors.to(device), self.heads.to(device), self.background.detach().to(device)
        )  # fmt: skip
        return self

    @property
    def explicit(self) -> bool:
        """Whether the model can be exported as plain splats without loss."""
        return not self.heads.view_dependent

    def generate(self, seen: torch.Tensor | None = None, camera_center: np.ndarray | None = None) -> Generated:
        """Generate Gaussians without gradients.

        Args:
            seen: (n,) int64, the anchors; None: all.
            camera_center: (3,), the camera's center in scene units; required only if the model is view-dependent.

        Returns:
            The Gaussians in scene units; discs have the third scale of the thin 3D Gaussians used for them in files.
        """
        a = self.anchors
        pick = (lambda x: x) if seen is None else (lambda x: x[seen])
        with torch.no_grad():
            g = generate(a.layout, pick(a.positions), pick(a.rows), pick(a.ids), self.heads, camera_center).only_valid()
            if self.primitive == "2d":
                g.scales[:, 2] = DISC_THICKNESS * g.scales[:, :2].amin(1)
            return g

    def splats(self, seen: torch.Tensor | None = None) -> tuple[Splats, np.ndarray]:
        """Convert a view-independent model to plain splats.

        Args:
            seen: (n,) int64, the anchors; None: all.

        Returns:
            Splats in world units, and source (N,) int64: anchor * offsets + offset of each splat.

        Raises:
            ValueError: The model is view-dependent.
        """
        g = self.generate(seen).cpu()
        usable = _normalize(g.quats.numpy())
        g = g if usable.all() else g.select(torch.from_numpy(usable))
        means, quats, scales, opacities, sh, ids, source = (part.numpy() for part in g[:7])
        # Each array is freed when its conversion replaces it, since those of all splats are large.
        del g
        if seen is not None:
            anchor, offset = np.divmod(source, self.anchors.layout.offsets)
            source = devices.host(seen)[anchor] * self.anchors.layout.offsets + offset
        means = converted(means, self.normalization.to_world)
        scales = converted(scales, lambda values: values.astype(np.float64) / self.normalization.scale)
        ids = converted(ids, self.classes.ids_of, np.int64)
        return Splats(means, quats, scales, opacities, sh, ids, blur=self.blur), source


def _normalize(quats: np.ndarray) -> np.ndarray:
    """Divide quaternions (N, 4) by their norms, in place; returns (N,) bool, which of them are rotations."""
    usable = np.empty(len(quats), np.bool_)
    for rows in blocks(len(quats)):
        norm = np.linalg.norm(quats[rows].astype(np.float64), axis=1, keepdims=True)
        usable[rows] = norm[:, 0] > 1e-4
        quats[rows] /= np.where(norm > 0, norm, 1)
    return usable


@kernel(parallel=True)
def _in_view(positions, rows, k, viewmat, intrinsics, width, height, near, seen):
    fx, fy, cx, cy = intrinsics
    # The four side planes of the frustum.
    planes = np.empty((4, 2))
    planes[0] = fx, cx
    planes[1] = -fx, width - cx
    planes[2] = fy, cy
    planes[3] = -fy, height - cy
    for a in prange(positions.shape[0]):
        reach = 0.0
        for i in range(3):
            extent = np.exp(min(rows[a, 3 * k + i], np.float32(LOG_EXTENT_MAX)))
            largest = 0.0
            for j in range(k):
                largest = max(largest, abs(rows[a, 3 * j + i]))
            reach += (largest * extent) ** 2
        width3 = 0.0
        for i in range(3):
            width3 = max(width3, np.exp(min(rows[a, 3 * k + 3 + i], np.float32(LOG_EXTENT_MAX))))
        reach = np.sqrt(reach) + 3.4 * width3
        x, y, z = positions[a, 0], positions[a, 1], positions[a, 2]
        px = viewmat[0, 0] * x + viewmat[0, 1] * y + viewmat[0, 2] * z + viewmat[0, 3]
        py = viewmat[1, 0] * x + viewmat[1, 1] * y + viewmat[1, 2] * z + viewmat[1, 3]
        pz = viewmat[2, 0] * x + viewmat[2, 1] * y + viewmat[2, 2] * z + viewmat[2, 3]
        inside = pz + reach > near
        for p in range(4):
            side = px if p < 2 else py
            distance = (planes[p, 0] * side + planes[p, 1] * pz) / np.sqrt(planes[p, 0] ** 2 + planes[p, 1] ** 2)
            # The low-pass filter, or a disc's minimum footprint, adds up to 1.9 pixels at the border.
            margin = 1.9 * max(pz, near) / min(fx, fy)
            inside = inside and distance > -reach - margin
        seen[a] = inside


def _in_view_on_gpu(
    anchors: Anchors, viewmat: np.ndarray, intrinsics: np.ndarray, width: int, height: int, near: float
) -> torch.Tensor:
    """Compute the same as `_in_view`; returns (N,) int32."""
    view = np.concatenate([viewmat[:3].ravel(), intrinsics, [width, height, near]]).astype(np.float32)
    inside = torch.empty(len(anchors), dtype=torch.int32, device=anchors.rows.device)
    gpu_kernel("find_in_view", OFFSETS=anchors.layout.offsets, LOG_EXTENT_MAX=LOG_EXTENT_MAX).for_each(
        len(anchors), anchors.positions, anchors.rows, len(anchors), anchors.layout.columns,
        devices.upload(view, anchors.rows), inside,
    )  # fmt: skip
    return inside


def anchors_in_view(
    anchors: Anchors, viewmat: np.ndarray, intrinsics: np.ndarray, width: int, height: int, near: float
) -> torch.Tensor:
    """Find the anchors whose splats may overlap the image (conservatively); synchronizes with the GPU.

    Args:
        anchors: the anchors of a model.
        viewmat: (4, 4) float64, scene to camera.
        intrinsics: fx, fy, cx, cy in pixels.
        width, height: size of the image in pixels.
        near: near plane in scene units.

    Returns:
        (n,) int64 indices, ascending.
    """
    if devices.on_gpu(anchors.rows):
        return _in_view_on_gpu(anchors, viewmat, intrinsics, width, height, near).nonzero()[:, 0]
    seen = np.empty(len(anchors), np.bool_)
    _in_view(
        anchors.positions.numpy(), anchors.rows.numpy(), anchors.layout.offsets, viewmat, intrinsics, width, height,
        near, seen,
    )  # fmt: skip
    return torch.from_numpy(np.flatnonzero(seen))


def first_anchors_in_view(
    anchors: Anchors, viewmat: np.ndarray, intrinsics: np.ndarray, width: int, height: int, near: float, limit: int
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Find the anchors in view on a GPU without synchronization; otherwise as `anchors_in_view`.

    Args:
        anchors, viewmat, intrinsics, width, height, near: as in `anchors_in_view`.
        limit: upper bound of the number of anchors in view; if there are more, the last of them are left out.

    Returns:
        index (n,) int64, n = min(limit, N): the anchors in view, followed by others; in_view (n,) bool: which are in
        view; () int64: the number of anchors in view.
    """
    inside = _in_view_on_gpu(anchors, viewmat, intrinsics, width, height, near)
    before = inside.cumsum(0)
    count = min(limit, len(anchors))
    index = torch.empty(count, dtype=torch.int64, device=inside.device)
    in_view = torch.empty(count, dtype=torch.bool, device=inside.device)
    gpu_kernel("place_in_view").for_each(len(anchors), inside, before, len(anchors), count, index, in_view)
    return index, in_view, before[-1] if len(anchors) else before.sum()
