"""A capture in memory: undistorted pinhole views and points, with images and ID maps decoded on demand."""

from __future__ import annotations

import copy
import threading
import zlib
from collections import OrderedDict
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..shared.errors import InputError
from .colmap import Camera, Image
from .files import read_image, read_mask
from .undistort import is_pinhole, to_pycolmap, undistort

HOLDOUT_EVERY = 8
"""Every 8th view by file name is held out of training, unless test.txt names others; quality is measured on these views
only."""

MIN_VIEWS_TO_HOLD_OUT = 3
_PIXEL_TOLERANCE = 0.5
_PIXELS_AT_ONCE = 1 << 18


@dataclass(frozen=True)
class View:
    """One undistorted image and its camera.

    K: (3, 3) float64, in pixels; the center of the first pixel is at (0.5, 0.5).
    viewmat: (4, 4) float64, world to camera, OpenCV axes (x right, y down, z forward).
    """

    name: str
    image_file: Path
    mask_file: Path | None
    K: np.ndarray
    viewmat: np.ndarray
    width: int
    height: int
    camera_id: int

    def to_camera(self, xyz: np.ndarray) -> np.ndarray:
        """Return positions (n, 3) in world units in camera space."""
        return xyz @ self.viewmat[:3, :3].T + self.viewmat[:3, 3]

    def pixels_of(self, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Project positions or directions (n, 3) in camera space: indices of those in the image, columns and rows."""
        x, y, z = xyz.T
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            u = x / z * self.K[0, 0] + self.K[0, 2]
            v = y / z * self.K[1, 1] + self.K[1, 2]
            inside = np.flatnonzero((z > 0) & (u >= 0) & (v >= 0) & (u < self.width) & (v < self.height))
        return inside, u[inside].astype(np.int64), v[inside].astype(np.int64)


@dataclass(frozen=True)
class Points:
    """COLMAP's points.

    xyz: (M, 3) float64, world. rgb: (M, 3) uint8. error: (M,) float32, reprojection error in pixels, negative where
    unknown. ids: (M,) int64, COLMAP's point IDs.
    """

    xyz: np.ndarray
    rgb: np.ndarray
    error: np.ndarray
    ids: np.ndarray


@dataclass(frozen=True)
class Keypoints:
    """COLMAP's observations of points in one view.

    xy: (n, 2) float64, in pixels of the undistorted view; some may lie outside the image.
    point_index: (n,) int64, indices into the capture's points.
    """

    xy: np.ndarray
    point_index: np.ndarray


class Capture:
    """The views (sorted by name) and points of a capture; images and ID maps are decoded on demand, with a cache.

    Returned arrays are shared and read-only. All methods are thread-safe.

    Attributes:
        names: Names of the labels by ID, without 0.
        left_out: (n,) int64, IDs that are treated as 0 (unlabeled).
        warnings: Warnings for the user.
        counts: Numbers of images, masks, points and cameras.
        prepared: Whether `image` and `mask` are available; otherwise the files must be resampled first.
        train_indices, test_indices: Training views and held-out views.
        validation_indices: Views that are neither, on which a training decides when to end.
    """

    def __init__(
        self,
        folder: Path,
        views: tuple[View, ...],
        points: Points,
        names: dict[int, str],
        warnings: list[str],
        counts: dict[str, Any],
        ids_of_views: list[tuple[int, ...]],
        raw: list[tuple[Camera, Image]],
        color_masks: bool,
        memory_mb: float,
        prepared: bool = True,
        held_out: Collection[str] | None = None,
    ) -> None:
        self.folder = folder
        self.views = views
        self.points = points
        self.names = names
        self.warnings = warnings
        self.counts = counts
        self._ids_of_views = ids_of_views
        self._raw = raw
        self._color_masks = color_masks
        self._cache = _ArrayCache(memory_mb * 1e6)
        self.prepared = prepared
        self.left_out = np.zeros(0, np.int64)
        test = default_split(len(views))
        if held_out is not None:
            test = tuple(i for i, view in enumerate(views) if view.name in held_out)
        self.test_indices: tuple[int, ...] = test
        self.train_indices: tuple[int, ...] = tuple(i for i in range(len(views)) if i not in set(test))
        self.validation_indices: tuple[int, ...] = ()
        self._corrected: Collection[int] = ()
        self._correct: Callable[[int, np.ndarray], np.ndarray] | None = None
        self._packed: dict[int, _PackedMask] = {}

    def __len__(self) -> int:
        return len(self.views)

    def edited(self, names: Mapping[int, str], left_out: Iterable[int]) -> Capture:
        """Return this capture with additional names and with the IDs `left_out` as 0; the cache is shared."""
        other = copy.copy(self)
        other.left_out = np.unique(np.array(list(left_out), np.int64))
        other.names = {i: name for i, name in {**self.names, **names}.items() if i not in other.left_out}
        return other

    def without_masks(self) -> Capture:
        """Return this capture without ID maps; the cache is shared."""
        other = copy.copy(self)
        other.views = tuple(replace(view, mask_file=None) for view in self.views)
        other._ids_of_views = [()] * len(self.views)
        return other

    def with_corrected_masks(
        self, indices: Collection[int], correct: Callable[[int, np.ndarray], np.ndarray]
    ) -> Capture:
        """Return this capture with the masks of some views corrected; the cache is shared.

        Args:
            indices: The views.
            correct: Returns the corrected mask (H, W) int64 for a view's index and its mask, both with the objects that
                are left out; negative IDs are of no known object.
        """
        other = copy.copy(self)
        other._corrected, other._correct, other._packed = indices, correct, {}
        return other

    def excluding_from_training(self, names: Collection[str]) -> Capture:
        """Return this capture with the named views removed from the training views; held-out views are unchanged."""
        other = copy.copy(self)
        other.train_indices = tuple(i for i in self.train_indices if self.views[i].name not in names)
        return other

    def validating_on(self, names: Collection[str]) -> Capture:
        """Return this capture with the named views for validation instead of training."""
        other = self.excluding_from_training(names)
        other.validation_indices = tuple(i for i, view in enumerate(self.views) if view.name in names)
        return other

    def without_left_out(self, ids: np.ndarray) -> np.ndarray:
        """Return `ids`, of any shape, with the IDs in `left_out` replaced by 0."""
        return np.where(np.isin(ids, self.left_out), 0, ids) if len(self.left_out) else ids

    @property
    def has_masks(self) -> bool:
        """Whether any view has an ID map."""
        return any(view.mask_file is not None for view in self.views)

    @property
    def object_ids(self) -> np.ndarray:
        """The IDs in the masks, without 0 and those left out: (n,) int64, ascending."""
        ids = np.array(sorted({i for ids in self._ids_of_views for i in ids} - {0}), np.int64)
        return ids[~np.isin(ids, self.left_out)]

    def ids_in(self, index: int) -> tuple[int, ...]:
        """Return the IDs in a view's mask, including 0, ascending; empty if the view has no mask."""
        return tuple(np.unique(self.without_left_out(np.array(self._ids_of_views[index], np.int64))).tolist())

    def camera_model_of(self, index: int) -> str:
        """Return COLMAP's name of the camera model of a view."""
        return self._raw[index][0].model

    def is_original(self, index: int) -> bool:
        """Return whether a view's image file is used unchanged because it is neither distorted nor too large."""
        view = self.views[index]
        return needs_no_resampling(self._raw[index][0], view.width, view.height)

    def observed(self, index: int) -> np.ndarray:
        """Return the indices of the points that COLMAP observed in a view: (n,) int64; an index may occur twice."""
        return self._raw[index][1].point_index.astype(np.int64)

    def image(self, index: int, downscale: int = 1) -> np.ndarray:
        """Return a view's pixels.

        Args:
            index: The view.
            downscale: Downscale factor; blocks of downscale x downscale pixels are averaged.

        Returns:
            (height // downscale, width // downscale, 3) uint8; any remainder at the right and bottom is cropped.

        Raises:
            InputError: The file cannot be read, or its size has changed.
        """
        return self._cache.get(("image", index, downscale), lambda: self._read_image(index, downscale))

    def mask(self, index: int, downscale: int = 1) -> np.ndarray | None:
        """Return a view's ID map.

        Args:
            index: The view.
            downscale: Downscale factor; the center of each block of downscale x downscale pixels is sampled.

        Returns:
            (h, w) int64, the size of `image`; None if the view has no mask.

        Raises:
            InputError: The file cannot be read, or its size has changed.
        """
        if self._correct is None or index not in self._corrected:
            return self.uncorrected_mask(index, downscale)
        # The cache is shared with captures that have other corrections, or none. Masks of all sizes are of the same.
        ids = self._cache.get((self._correct, index), lambda: self._corrected_mask(index))
        return self.without_left_out(self._reduced(ids, index, downscale).astype(np.int64))

    def uncorrected_mask(self, index: int, downscale: int = 1) -> np.ndarray | None:
        """Return a view's ID map as in its file, in the form of `mask`."""
        if self.views[index].mask_file is None:
            return None
        ids = self._cache.get(("mask", index, downscale), lambda: self._read_mask(index, downscale))
        return self.without_left_out(ids.astype(np.int64))

    def keypoints(self, index: int) -> Keypoints:
        """Return COLMAP's observations in a view, except those whose undistortion does not converge."""
        image = self._raw[index][1]
        pixels = self._undistorted(index, image.xy)
        found = np.isfinite(pixels).all(1)
        return Keypoints(pixels[found], image.point_index[found].astype(np.int64))

    def photo_mask(self, index: int, ids: np.ndarray) -> np.ndarray:
        """Return the mask of a view's photo, before its undistortion.

        Args:
            index: The view.
            ids: (h, w) IDs of the undistorted view's pixels.

        Returns:
            (H, W), of the photo's size and the type of `ids`; 0 where the undistorted view does not reach.
        """
        if self.is_original(index):
            return ids
        # Views of one camera are undistorted alike, unless their photos have different sizes.
        at = self._cache.get(("undistorted", self._raw[index][0]), lambda: self._pixels_of_photo(index))
        return np.where(at >= 0, ids.ravel()[at], ids.dtype.type(0))

    def _pixels_of_photo(self, index: int) -> np.ndarray:
        """Return for each pixel of a view's photo the pixel of the view, counted by rows: (H, W) int32, -1: none."""
        camera, view = self._raw[index][0], self.views[index]
        found = np.full((camera.height, camera.width), -1, np.int32)
        across = np.arange(camera.width) + 0.5
        rows_at_once = max(_PIXELS_AT_ONCE // camera.width, 1)
        for first in range(0, camera.height, rows_at_once):
            rows = found[first : first + rows_at_once]
            x, y = np.meshgrid(across, np.arange(first, first + len(rows)) + 0.5)
            # Comparisons with NaN are false.
            at = self._undistorted(index, np.stack([x.ravel(), y.ravel()], 1))
            inside = (at >= 0).all(1) & (at < [view.width, view.height]).all(1)
            column, row = at[inside].astype(np.int32).T
            rows.ravel()[inside] = row * view.width + column
        return found

    def _undistorted(self, index: int, pixels: np.ndarray) -> np.ndarray:
        """Convert pixels (n, 2) of a view's photo to those of the view; NaN where undistortion does not converge."""
        camera, K = self._raw[index][0], self.views[index].K
        lens = to_pycolmap(camera)
        if is_pinhole(camera):
            center = np.array([lens.principal_point_x, lens.principal_point_y])
            xy = (pixels - center) / np.array([lens.focal_length_x, lens.focal_length_y])
        else:
            xy = undistort(lens, pixels, _PIXEL_TOLERANCE)
        return xy * [K[0, 0], K[1, 1]] + K[:2, 2]

    def _read_image(self, index: int, downscale: int) -> np.ndarray:
        image = read_image(self.views[index].image_file)
        self._check_unchanged(index, self.views[index].image_file, image.size)
        width, height = self._reduced_size(index, downscale)
        if downscale > 1:
            image = image.crop((0, 0, width * downscale, height * downscale)).reduce(downscale)
        return np.array(image)

    def _read_mask(self, index: int, downscale: int) -> np.ndarray:
        path = self.views[index].mask_file
        assert path is not None
        ids = read_mask(path, self._color_masks)
        self._check_unchanged(index, path, (ids.shape[1], ids.shape[0]))
        return self._reduced(ids, index, downscale)

    def _corrected_mask(self, index: int) -> np.ndarray:
        """Return the corrected mask in the smallest type that holds its IDs.

        It is kept compressed, whatever the cache drops: the correction takes much longer than the decompression.
        """
        if (packed := self._packed.get(index)) is not None:
            return packed.unpacked()
        mask = self.edited({}, ()).uncorrected_mask(index)
        assert mask is not None and self._correct is not None
        ids = self._correct(index, mask)
        bounds = (np.min_scalar_type(int(each)) for each in (ids.min(initial=0), ids.max(initial=0)))
        ids = ids.astype(np.result_type(*bounds))
        self._packed[index] = _PackedMask(zlib.compress(ids.tobytes(), 1), ids.dtype, ids.shape)
        return ids

    def _reduced(self, ids: np.ndarray, index: int, downscale: int) -> np.ndarray:
        """Return the IDs at the centers of blocks of downscale x downscale pixels."""
        width, height = self._reduced_size(index, downscale)
        first = downscale // 2
        return np.ascontiguousarray(ids[first::downscale, first::downscale][:height, :width])

    def _check_unchanged(self, index: int, path: Path, size: tuple[int, int]) -> None:
        view = self.views[index]
        if size != (view.width, view.height):
            raise InputError(
                f"{path} was {view.width}x{view.height} pixels and is now {size[0]}x{size[1]}; run the command again."
            )

    def _reduced_size(self, index: int, downscale: int) -> tuple[int, int]:
        view = self.views[index]
        width, height = view.width // downscale, view.height // downscale
        if downscale < 1 or width < 1 or height < 1:
            raise ValueError(f"a view of {view.width}x{view.height} cannot be reduced by {downscale}")
        return width, height


def default_split(views: int) -> tuple[int, ...]:
    """Return the indices of the views that are held out of this many if the capture does not name them."""
    return tuple(range(0, views, HOLDOUT_EVERY)) if views >= MIN_VIEWS_TO_HOLD_OUT else ()


def needs_no_resampling(camera: Camera, width: int, height: int) -> bool:
    """Return whether a camera's image can be used unchanged as a view of this size."""
    return is_pinhole(camera) and (width, height) == (camera.width, camera.height)


class _PackedMask(NamedTuple):
    """A compressed mask."""

    data: bytes
    dtype: np.dtype
    shape: tuple[int, ...]

    def unpacked(self) -> np.ndarray:
        """Return the mask."""
        return np.frombuffer(zlib.decompress(self.data), self.dtype).reshape(self.shape)


class _ArrayCache:
    """Least-recently-used cache of arrays with a limit in bytes; thread-safe."""

    def __init__(self, budget: float) -> None:
        self.budget = budget
        self.bytes = 0
        self._arrays: OrderedDict[tuple, np.ndarray] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, key: tuple, make: Callable[[], np.ndarray]) -> np.ndarray:
        with self._lock:
            if key in self._arrays:
                self._arrays.move_to_end(key)
                return self._arrays[key]
        # Decode outside the lock, so that threads run concurrently; decoding a file twice is harmless.
        array = make()
        array.setflags(write=False)
        with self._lock:
            if key not in self._arrays and array.nbytes <= self.budget:
                self._arrays[key] = array
                self.bytes += array.nbytes
                while self.bytes > self.budget:
                    self.bytes -= self._arrays.popitem(last=False)[1].nbytes
        return array
