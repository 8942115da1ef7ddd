"""Integration of a view into the samples of a sparse signed distance field."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import prange
from scipy.ndimage import distance_transform_edt

from ...raster import Camera
from ...raster.kernel import kernel
from ..views import ALPHA_SEEN, ObjectView, SceneMap
from .blocks import SAMPLES, SIDE

_UNCERTAINTY_HALF = 3.0
"""Uncertainty of a pixel's depth, in pixels, at which its weight is one half."""

_MIN_SLOPE = 0.15
"""Lower limit of the cosine between ray and surface normal."""


@dataclass(frozen=True)
class Observation:
    """The observation of one object in one view.

    Attributes:
        surface_depth: (H, W) float32, depth of the visible surface along z, infinite where there is none.
        confidence: (H, W), weight of `surface_depth`, 0 .. 1.
        x, y: Upper left corner of the rectangle (h, w) of the following arrays.
        object_depth: The object's depth where it is visible, otherwise 0.
        depth_uncertainty: Expected error of `object_depth`.
        slope: Change of the distance from the surface per step along z.
        weight: Weight of each pixel.
        silhouette_distance: Distance from the object's outline in pixels, negative inside.
    """

    camera: Camera
    surface_depth: np.ndarray
    confidence: np.ndarray
    x: int
    y: int
    object_depth: np.ndarray
    depth_uncertainty: np.ndarray
    slope: np.ndarray
    weight: np.ndarray
    silhouette_distance: np.ndarray

    @property
    def nbytes(self) -> int:
        """Memory of the arrays."""
        return sum(value.nbytes for value in vars(self).values() if isinstance(value, np.ndarray))


def visible_depth(view: ObjectView) -> np.ndarray:
    """Return the object's depth (h, w), 0 where the object is not visible."""
    return np.where(view.visible * view.alpha >= ALPHA_SEEN, view.depth, np.float32(0))


def prepare_observation(scene: SceneMap, view: ObjectView | None, margin: int, jump: float) -> Observation:
    """Prepare a view for `add`.

    Args:
        scene: The render of the whole scene.
        view: The render of the object alone; None if it is out of view.
        margin: The width in pixels of the border around the object in which distances from its outline are needed.
        jump: The smallest difference of depth, in scene units, between neighboring pixels of different surfaces.
    """
    surface_depth = np.where(scene.depth > 0, scene.depth, np.float32(np.inf))
    confidence = _confidence(scene.depth_uncertainty, scene.depth, scene.camera)
    if view is None:
        nothing = np.zeros((0, 0), np.float32)
        return Observation(scene.camera, surface_depth, confidence, 0, 0, nothing, nothing, nothing, nothing, nothing)
    height, width = view.alpha.shape
    x0, y0 = max(view.x - margin, 0), max(view.y - margin, 0)
    x1, y1 = min(view.x + width + margin, surface_depth.shape[1]), min(view.y + height + margin, surface_depth.shape[0])
    object_depth = np.zeros((y1 - y0, x1 - x0), np.float32)
    depth_uncertainty = np.zeros_like(object_depth)
    inside = slice(view.y - y0, view.y - y0 + height), slice(view.x - x0, view.x - x0 + width)
    object_depth[inside], depth_uncertainty[inside] = visible_depth(view), view.depth_uncertainty
    seen = object_depth > 0
    if seen.any():
        silhouette_distance = _silhouette_distance(seen, object_depth, surface_depth[y0:y1, x0:x1], jump)
    else:
        silhouette_distance = np.full(object_depth.shape, max(margin, 1), np.float32)
    K = scene.camera.K
    slope = np.zeros_like(object_depth)
    weight = np.zeros_like(object_depth)
    _slopes(object_depth, K[0, 0], K[1, 1], K[0, 2] - x0, K[1, 2] - y0, jump, slope, weight)
    weight *= _confidence(depth_uncertainty, object_depth, scene.camera)
    return Observation(
        scene.camera,
        surface_depth,
        confidence,
        x0,
        y0,
        object_depth,
        depth_uncertainty,
        slope,
        weight,
        silhouette_distance,
    )


def _confidence(depth_uncertainty: np.ndarray, depth: np.ndarray, camera: Camera) -> np.ndarray:
    """Compute the weight of a depth from its uncertainty, 0 .. 1; 1 where there is no depth."""
    pixels = depth_uncertainty / np.where(depth > 0, depth, 1) * np.float32(camera.K[0, 0])
    return (1 / (1 + (pixels / np.float32(_UNCERTAINTY_HALF)) ** 2)).astype(np.float32)


def _silhouette_distance(
    seen: np.ndarray, object_depth: np.ndarray, surface_depth: np.ndarray, jump: float
) -> np.ndarray:
    """Return the distance (h, w) in pixels from the object's outline.

    It is negative inside and where the object may be occluded.
    """
    nearest = distance_transform_edt(~seen, return_distances=False, return_indices=True)
    filled = seen | (surface_depth < object_depth[tuple(nearest)] + jump)
    # On both sides, pixel centers are at least half a pixel from the outline.
    outside, inside = distance_transform_edt(~filled), distance_transform_edt(np.pad(filled, 1, mode="edge"))
    return np.where(filled, 0.5 - inside[1:-1, 1:-1], outside - 0.5).astype(np.float32)


@kernel(parallel=True)
def _slopes(object_depth, fx, fy, cx, cy, jump, slope, weight):
    """Compute slope, the cosine between ray and normal times the ray's length for a step of 1 along z, and weight."""
    height, width = object_depth.shape
    for v in prange(height):
        for u in range(width):
            d = object_depth[v, u]
            if d == 0.0:
                continue
            # Depth differences over one pixel, from the neighbors on the same surface.
            du = 0.0
            dv = 0.0
            sides_u = 0
            sides_v = 0
            for s in (-1, 1):
                if 0 <= u + s < width and object_depth[v, u + s] > 0 and abs(object_depth[v, u + s] - d) < jump:
                    du += s * (object_depth[v, u + s] - d)
                    sides_u += 1
                if 0 <= v + s < height and object_depth[v + s, u] > 0 and abs(object_depth[v + s, u] - d) < jump:
                    dv += s * (object_depth[v + s, u] - d)
                    sides_v += 1
            x = (u + 0.5 - cx) / fx
            y = (v + 0.5 - cy) / fy
            if sides_u:
                du /= sides_u
            if sides_v:
                dv /= sides_v
            # Derivatives of the point (x d, y d, d) by u and v; the normal is their cross product.
            ux, uy, uz = d / fx + x * du, y * du, du
            vx, vy, vz = x * dv, d / fy + y * dv, dv
            nx = uy * vz - uz * vy
            ny = uz * vx - ux * vz
            nz = ux * vy - uy * vx
            length = np.sqrt(nx * nx + ny * ny + nz * nz)
            ray = np.sqrt(x * x + y * y + 1.0)
            along = abs(nx * x + ny * y + nz) / max(length, 1e-30)
            slope[v, u] = max(along, _MIN_SLOPE * ray)
            weight[v, u] = max(along / ray, _MIN_SLOPE)
            if sides_u < 2 or sides_v < 2:
                weight[v, u] *= 0.5


def may_add(camera: Camera, origin: np.ndarray, voxel: float, coords: np.ndarray) -> bool:
    """Return whether a view may show any of the blocks, so that `add` may change them; arguments as for `add`."""
    viewmat, intrinsics = camera.arrays()
    return _shows_any(
        viewmat, intrinsics, float(camera.near), camera.width, camera.height, np.asarray(origin, np.float64),
        float(voxel), coords,
    )  # fmt: skip


@kernel()
def _shows_any(viewmat, intrinsics, near, width, height, origin, voxel, coords):
    center = np.empty(3)
    for b in range(coords.shape[0]):
        radius = _sphere_around(origin, voxel, coords, b, center)
        if _shows(viewmat, intrinsics, near, width, height, center, radius):
            return True
    return False


@kernel()
def _sphere_around(origin, voxel, coords, b, center):
    """Write the center of block b; returns the radius of the sphere around its samples."""
    half = 0.5 * (SIDE - 1) * voxel
    for i in range(3):
        center[i] = origin[i] + coords[b, i] * SIDE * voxel + half
    return half * np.sqrt(3.0)


@kernel()
def _shows(viewmat, intrinsics, near, width, height, center, radius):
    """Return whether a view may show a part of a sphere."""
    fx, fy, cx, cy = intrinsics
    z = viewmat[2, 0] * center[0] + viewmat[2, 1] * center[1] + viewmat[2, 2] * center[2] + viewmat[2, 3]
    if z + radius <= near:
        return False
    if z <= 2 * radius:
        return True
    x = viewmat[0, 0] * center[0] + viewmat[0, 1] * center[1] + viewmat[0, 2] * center[2] + viewmat[0, 3]
    y = viewmat[1, 0] * center[0] + viewmat[1, 1] * center[1] + viewmat[1, 2] * center[2] + viewmat[1, 3]
    u, v = fx * x / z + cx, fy * y / z + cy
    # Upper limit of the projected radius.
    spread = 2 * radius / z * (1 + max(abs(x), abs(y)) / z)
    return not (u + fx * spread < 0 or u - fx * spread > width or v + fy * spread < 0 or v - fy * spread > height)


def add(
    observation: Observation, origin: np.ndarray, voxel: float, coords: np.ndarray, reach: float, back: float,
    total: np.ndarray, weights: np.ndarray,
) -> None:  # fmt: skip
    """Add a view to the samples of blocks.

    Args:
        observation: The view.
        origin: (3,) position of grid point 0 in scene units.
        voxel: The spacing of the samples in scene units.
        coords: (B, 3) coordinates of the blocks.
        reach: Truncation distance in front of the surface in scene units.
        back: Truncation distance behind the surface in scene units. Samples farther behind it, and samples occluded by
            other objects, are not changed.
        total: (B, 512) float32 sums of weighted distances in scene units, changed in place.
        weights: (B, 512) float32 sums of weights, changed in place.
    """
    viewmat, intrinsics = observation.camera.arrays()
    _add(
        viewmat, intrinsics, float(observation.camera.near), observation.surface_depth, observation.confidence,
        observation.x, observation.y, observation.object_depth, observation.depth_uncertainty, observation.slope,
        observation.weight, observation.silhouette_distance, np.asarray(origin, np.float64), float(voxel), coords,
        float(reach), float(back), total, weights,
    )  # fmt: skip


@kernel(parallel=True)
def _add(
    viewmat, intrinsics, near, surface_depth, confidence, x0, y0, object_depth, depth_uncertainty, slope, weight,
    silhouette_distance, origin, voxel, coords, reach, back, total, weights,
):  # fmt: skip
    fx, fy, cx, cy = intrinsics
    height, width = surface_depth.shape
    h, w = object_depth.shape
    for b in prange(coords.shape[0]):
        corner = np.empty(3)
        center = np.empty(3)
        radius = _sphere_around(origin, voxel, coords, b, center)
        if not _shows(viewmat, intrinsics, near, width, height, center, radius):
            continue
        for i in range(3):
            corner[i] = origin[i] + coords[b, i] * SIDE * voxel
        for n in range(SAMPLES):
            px = corner[0] + (n // (SIDE * SIDE)) * voxel
            py = corner[1] + (n // SIDE % SIDE) * voxel
            pz = corner[2] + (n % SIDE) * voxel
            z = viewmat[2, 0] * px + viewmat[2, 1] * py + viewmat[2, 2] * pz + viewmat[2, 3]
            if z <= near:
                continue
            u = fx * (viewmat[0, 0] * px + viewmat[0, 1] * py + viewmat[0, 2] * pz + viewmat[0, 3]) / z + cx
            v = fy * (viewmat[1, 0] * px + viewmat[1, 1] * py + viewmat[1, 2] * pz + viewmat[1, 3]) / z + cy
            if not (0 <= u < width and 0 <= v < height):
                continue
            iu, iv = int(u), int(v)
            ru, rv = iu - x0, iv - y0
            inside = 0 <= ru < w and 0 <= rv < h
            su, sv = u - 0.5 - x0, v - 0.5 - y0
            au, av = int(np.floor(su)), int(np.floor(sv))
            tu, tv = su - au, sv - av
            between = 0 <= au < w - 1 and 0 <= av < h - 1
            aside = reach
            if between:
                above = silhouette_distance[av, au] * (1 - tu) + silhouette_distance[av, au + 1] * tu
                below = silhouette_distance[av + 1, au] * (1 - tu) + silhouette_distance[av + 1, au + 1] * tu
                aside = (above * (1 - tv) + below * tv) * z / fx
            elif inside:
                aside = silhouette_distance[rv, ru] * z / fx
            if inside and object_depth[rv, ru] > 0:
                d = object_depth[rv, ru]
                # Interpolate the depth between four pixels of the same surface.
                if between:
                    d00, d01 = object_depth[av, au], object_depth[av, au + 1]
                    d10, d11 = object_depth[av + 1, au], object_depth[av + 1, au + 1]
                    low = min(min(d00, d01), min(d10, d11))
                    high = max(max(d00, d01), max(d10, d11))
                    if low > 0 and (high - low) * slope[rv, ru] < reach:
                        d = (d00 * (1 - tu) + d01 * tu) * (1 - tv) + (d10 * (1 - tu) + d11 * tu) * tv
                distance = (d - z) * slope[rv, ru]
                # Widen and flatten the distance profile by the depth's uncertainty; otherwise, a view whose depth is
                # too large would erase the surface of a view whose depth is too small.
                off = depth_uncertainty[rv, ru] * slope[rv, ru]
                if distance <= -back - off:
                    continue
                gain = weight[rv, ru]
                if distance < 0:
                    gain *= 1 + distance / (back + off)
                distance *= reach / (reach + off)
                distance = max(distance, aside) if aside > 0 else distance
                total[b, n] += gain * min(distance, reach)
                weights[b, n] += gain
            else:
                ahead = surface_depth[iv, iu] - z
                if ahead <= 0:
                    continue
                # The outline does not limit the distance where the object may continue behind an occluder.
                hides = inside and silhouette_distance[rv, ru] < 0
                gain = confidence[iv, iu]
                total[b, n] += gain * (min(reach, ahead) if hides else min(min(reach, ahead), aside))
                weights[b, n] += gain
