"""Undistortion of COLMAP cameras to pinhole cameras: intrinsics, and resampling of images and masks."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap
from PIL import Image as PilImage
from scipy.ndimage import map_coordinates

from ..shared.errors import InputError
from .colmap import Camera

MAX_TAN = math.tan(math.radians(60.0))
"""A pinhole view extends at most 60 degrees to each side, since pixels stretch without bound towards 90 degrees."""

_POLYNOMIAL = {"SIMPLE_RADIAL": 3, "RADIAL": 3, "OPENCV": 4, "FULL_OPENCV": 4}
_STRIP = 1 << 18
_STEP = 1e-5


@dataclass(frozen=True)
class Pinhole:
    """A pinhole camera: K (3, 3) float64, in pixels; the center of the first pixel is at (0.5, 0.5)."""

    K: np.ndarray
    width: int
    height: int


def is_pinhole(camera: Camera) -> bool:
    """Return whether images of this camera need no undistortion."""
    if camera.model in ("SIMPLE_PINHOLE", "PINHOLE"):
        return True
    return camera.model in _POLYNOMIAL and not any(camera.params[_POLYNOMIAL[camera.model] :])


def to_pycolmap(camera: Camera) -> pycolmap.Camera:
    """Convert a camera with valid parameters to pycolmap's type."""
    return pycolmap.Camera(
        camera_id=camera.id,
        model=getattr(pycolmap.CameraModelId, camera.model),
        width=camera.width,
        height=camera.height,
        params=list(camera.params),
    )


def scaled(camera: Camera, width: int, height: int) -> Camera:
    """Return the camera of images that were scaled to this size in pixels; the distortion does not depend on it."""
    lens = to_pycolmap(camera)
    lens.rescale(width, height)
    return replace(camera, width=width, height=height, params=tuple(map(float, lens.params)))


def distort(camera: pycolmap.Camera, xy: np.ndarray) -> np.ndarray:
    """Project normalized pinhole coordinates (n, 2) to the camera's pixels (n, 2); NaN where undefined."""
    rays = np.column_stack([xy, np.ones(len(xy))])
    return np.asarray(camera.img_from_cam(rays), np.float64).reshape(-1, 2)


def undistort(camera: pycolmap.Camera, pixels: np.ndarray, tolerance: float = 0.1) -> np.ndarray:
    """Convert pixels (n, 2) to normalized pinhole coordinates (n, 2); NaN where the inverse does not converge.

    The inverse is iterative and may find a wrong root, so the result must project back within `tolerance` pixels.
    """
    if len(pixels) == 0:
        return np.zeros((0, 2))
    xy = np.asarray(camera.cam_from_img(np.ascontiguousarray(pixels, np.float64)), np.float64).reshape(-1, 2)
    with np.errstate(invalid="ignore", over="ignore"):
        off = np.abs(distort(camera, np.nan_to_num(xy, nan=0.0, posinf=0.0, neginf=0.0)) - pixels).max(1)
        xy[~(off <= tolerance)] = np.nan
    return xy


def pinhole_for(camera: Camera, file: Path, max_size: int) -> Pinhole:
    """Compute the pinhole camera of the undistorted images: the largest upright rectangle without blank pixels.

    Args:
        camera: COLMAP's camera.
        file: The file named in error messages.
        max_size: Limit of the longer side, in pixels; 0 for none. Up to this limit the focal lengths are kept.

    Returns:
        The pinhole camera.

    Raises:
        InputError: No real lens has these parameters.
    """
    who = f"{file} gives camera {camera.id} ({camera.model})"
    if camera.model == "EQUIRECTANGULAR":
        raise InputError(
            f"{who} a full panorama, which no pinhole view can hold; cut it into perspective images first."
        )
    lens = to_pycolmap(camera)
    fx, fy, cx, cy = lens.focal_length_x, lens.focal_length_y, lens.principal_point_x, lens.principal_point_y
    longest = max(camera.width, camera.height)
    degenerate = "the model is degenerate: align the photos again with more images or a simpler camera model"
    if not (0.02 * longest < min(fx, fy) and max(fx, fy) < 1000 * longest):
        raise InputError(
            f"{who} a focal length of {fx:.4g} pixels for an image of {camera.width}x{camera.height}; {degenerate}."
        )
    if not (-longest < cx < 2 * longest and -longest < cy < 2 * longest):
        raise InputError(f"{who} a principal point of ({cx:.4g}, {cy:.4g}), far outside the image; {degenerate}.")
    if is_pinhole(camera):
        return _limited(
            np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float64), camera.width, camera.height, max_size
        )

    box = _inner_box(lens, camera.width, camera.height, fx, fy)
    if box is None:
        raise InputError(f"{who} a distortion that folds over at the middle of the image; {degenerate}.")
    x0, y0, x1, y1 = box
    width, height = math.floor((x1 - x0) * fx + 1e-6), math.floor((y1 - y0) * fy + 1e-6)
    if width < 0.2 * camera.width or height < 0.2 * camera.height or _covered(lens, box, camera) < 0.1:
        raise InputError(
            f"{who} a distortion that no real lens has (of {camera.width}x{camera.height} pixels {max(width, 0)}x"
            f"{max(height, 0)} would remain); {degenerate}."
        )
    # The fraction of a pixel that was rounded off is split between both sides, so that the rectangle stays inside.
    cx, cy = -x0 * fx - ((x1 - x0) * fx - width) / 2, -y0 * fy - ((y1 - y0) * fy - height) / 2
    return _limited(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float64), width, height, max_size)


def _limited(K: np.ndarray, width: int, height: int, max_size: int) -> Pinhole:
    if max_size <= 0 or max(width, height) <= max_size:
        return Pinhole(K, width, height)
    scale = max_size / max(width, height)
    w, h = max(1, round(width * scale)), max(1, round(height * scale))
    return Pinhole(np.diag([w / width, h / height, 1.0]) @ K, w, h)


def _inner_box(lens: pycolmap.Camera, width: int, height: int, fx: float, fy: float) -> tuple[float, ...] | None:
    """Return a rectangle (x0, y0, x1, y1), in normalized coordinates, all of whose rays project into the image.

    Rays are followed outward from the image's center until they leave the image or the projection folds over (the
    determinant of its Jacobian is no longer positive), because points beyond the fold project into the image again.
    """
    middle = undistort(lens, np.array([[width / 2, height / 2]]))[0]
    if not np.isfinite(middle).all() or np.abs(middle).max() > MAX_TAN:
        return None
    directions = 256
    angle = np.arange(directions) * (2 * math.pi / directions)
    ray = np.stack([np.cos(angle), np.sin(angle)], 1)
    reach = MAX_TAN * math.sqrt(2) + float(np.abs(middle).max())
    fine = min(reach, 4 * math.hypot(width / fx, height / fy) / 2)
    t = np.unique(np.concatenate([np.linspace(0, reach, 97), np.linspace(0, fine, 129)]))
    good = _valid(lens, middle + t[:, None, None] * ray, width, height, fx, fy)
    if not good[0].all():
        return None
    first_bad = np.where(good.all(0), len(t) - 1, np.argmin(good, 0))
    low, high = t[np.maximum(first_bad - 1, 0)], t[first_bad]
    low = np.where(good.all(0), high, low)
    for _ in range(24):
        between = (low + high) / 2
        inside = _valid(lens, middle + between[:, None] * ray, width, height, fx, fy)
        low, high = np.where(inside, between, low), np.where(inside, high, between)
    edge = middle + low[:, None] * ray
    pixel = distort(lens, edge)
    near = 1e-3 * max(width, height)
    # Each side is placed at the nearest ray that leaves through it, or at the limit if no ray does.
    x0 = max([-MAX_TAN, *edge[pixel[:, 0] < near, 0]])
    x1 = min([MAX_TAN, *edge[pixel[:, 0] > width - near, 0]])
    y0 = max([-MAX_TAN, *edge[pixel[:, 1] < near, 1]])
    y1 = min([MAX_TAN, *edge[pixel[:, 1] > height - near, 1]])
    if not (x0 < middle[0] < x1 and y0 < middle[1] < y1):
        return None
    # Rays may end at a fold instead of a side: shrink the rectangle about its center until no ray ends inside.
    sides = np.where(edge > middle, [x1, y1], [x0, y0]) - middle
    shrink = min(1.0, float(np.max((edge - middle) / sides, 1).min()))
    along = np.linspace(0, 1, 65)[:, None]
    for _ in range(50):
        low_corner, high_corner = middle + ([x0, y0] - middle) * shrink, middle + ([x1, y1] - middle) * shrink
        other = np.array([high_corner[0], low_corner[1]]), np.array([low_corner[0], high_corner[1]])
        border = np.concatenate([a + (b - a) * along for a in (low_corner, high_corner) for b in other])
        # With half a pixel of slack, the samples still come from the outermost pixels.
        if _valid(lens, border, width, height, fx, fy, slack=0.5).all():
            return *map(float, low_corner), *map(float, high_corner)
        shrink *= 0.99
    return None


def _valid(
    lens: pycolmap.Camera, xy: np.ndarray, width: int, height: int, fx: float, fy: float, slack: float = 0.0
) -> np.ndarray:
    """Find which normalized coordinates (..., 2) project without a fold into the image, enlarged by `slack` pixels."""
    shape, flat = xy.shape[:-1], xy.reshape(-1, 2)
    right, down = np.array([_STEP, 0.0]), np.array([0.0, _STEP])
    with np.errstate(invalid="ignore", over="ignore"):
        at = distort(lens, flat)
        dx = (distort(lens, flat + right) - at) / _STEP
        dy = (distort(lens, flat + down) - at) / _STEP
        determinant = (dx[:, 0] * dy[:, 1] - dx[:, 1] * dy[:, 0]) / (fx * fy)
        # Rays with less than 1% of the area on the axis are close to a fold.
        good = (determinant > 0.01) & (at >= -slack).all(1) & (at <= np.array([width, height]) + slack).all(1)
    return good.reshape(shape)


def _covered(lens: pycolmap.Camera, box: tuple[float, ...], camera: Camera) -> float:
    """Return the fraction of the image's area that the normalized rectangle `box` covers."""
    x0, y0, x1, y1 = box
    s = np.linspace(0, 1, 65)[:-1]
    x = np.concatenate([x0 + (x1 - x0) * s, np.full(64, x1), x1 - (x1 - x0) * s, np.full(64, x0)])
    y = np.concatenate([np.full(64, y0), y0 + (y1 - y0) * s, np.full(64, y1), y1 - (y1 - y0) * s])
    p = distort(lens, np.stack([x, y], 1))
    area = 0.5 * abs(float(np.sum(p[:, 0] * np.roll(p[:, 1], -1) - p[:, 1] * np.roll(p[:, 0], -1))))
    return area / (camera.width * camera.height) if math.isfinite(area) else 0.0


def source_pixels(camera: Camera, target: Pinhole, supersample: int = 1) -> np.ndarray:
    """Compute the position of each target pixel's center in the camera's image.

    Args:
        camera: The camera that took the image.
        target: The pinhole camera.
        supersample: Number n of samples per pixel along each axis.

    Returns:
        (2, n h, n w) float32, in pixels, y before x; -1 where undefined.
    """
    lens = to_pycolmap(camera)
    width, height = target.width * supersample, target.height * supersample
    fx, fy = target.K[0, 0] * supersample, target.K[1, 1] * supersample
    x = (np.arange(width) + 0.5 - target.K[0, 2] * supersample) / fx
    y = (np.arange(height) + 0.5 - target.K[1, 2] * supersample) / fy
    result = np.empty((2, height, width), np.float32)
    rows = max(1, _STRIP // width)
    for first in range(0, height, rows):
        part = y[first : first + rows]
        xy = np.stack(np.broadcast_arrays(x[None, :], part[:, None]), -1).reshape(-1, 2)
        pixel = distort(lens, xy).reshape(len(part), width, 2)
        result[0, first : first + rows] = pixel[..., 1]
        result[1, first : first + rows] = pixel[..., 0]
    return np.nan_to_num(result, copy=False, nan=-1.0)


def resample_image(image: PilImage.Image, camera: Camera, target: Pinhole) -> PilImage.Image:
    """Resample an RGB image of `camera` to `target`: bilinear, with averaging if the target is coarser."""
    if is_pinhole(camera):
        return image.resize((target.width, target.height), PilImage.Resampling.HAMMING)
    # If the target is coarser, average whole blocks, then take 2 x 2 samples per pixel for the remaining factor.
    fx = to_pycolmap(camera).focal_length_x
    ratio = fx / target.K[0, 0]
    block = max(1, math.floor(ratio + 1e-6))
    supersample = 2 if ratio / block > 1.2 else 1
    source = image.reduce(block) if block > 1 else image
    # Positions are measured from pixel edges, but array indices from pixel centers.
    at = source_pixels(camera, target, supersample) / np.float32(block) - np.float32(0.5)
    planes = np.asarray(source)
    out = np.empty((*at.shape[1:], 3), np.uint8)
    for channel in range(3):
        values = map_coordinates(planes[..., channel], at, np.float32, order=1, mode="nearest", prefilter=False)
        out[..., channel] = np.clip(np.rint(values), 0, 255)
    result = PilImage.fromarray(out)
    return result.reduce(supersample) if supersample > 1 else result


def resample_mask(mask: np.ndarray, camera: Camera, target: Pinhole) -> np.ndarray:
    """Resample an ID map (h, w) of `camera` to `target` with nearest-neighbor sampling, which creates no new IDs.

    The map may have any size with the camera's aspect ratio; the result has the target's size.
    """
    rows, columns = mask.shape
    if is_pinhole(camera):
        y = ((np.arange(target.height) + 0.5) * (rows / target.height)).astype(np.int64)
        x = ((np.arange(target.width) + 0.5) * (columns / target.width)).astype(np.int64)
        return mask[np.minimum(y, rows - 1)[:, None], np.minimum(x, columns - 1)[None, :]]
    at = source_pixels(camera, target)
    y = np.clip((at[0] * (rows / camera.height)).astype(np.int64), 0, rows - 1)
    x = np.clip((at[1] * (columns / camera.width)).astype(np.int64), 0, columns - 1)
    return mask[y, x]
