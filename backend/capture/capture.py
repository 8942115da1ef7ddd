"""One capture: undistorted pinhole views, ID maps and points, read from disk on demand."""

from __future__ import annotations

import copy
import hashlib
import json
import os
import re
import threading
from collections import Counter, OrderedDict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import numpy as np
from PIL import Image as PilImage

from ..protocol import HOLDOUT_EVERY, InputError, Reporter, write_atomic, write_json
from .colmap import Camera, Image, Model, Problem, find_model, read_model
from .files import (
    IMAGE_SUFFIXES,
    Files,
    encode_mask,
    image_size,
    is_colour_mask,
    is_three_channel,
    mask_names,
    read_image,
    read_mask,
    read_names,
    write_image,
)
from .undistort import Pinhole, is_pinhole, pinhole_for, resample_image, resample_mask, to_pycolmap, undistort

MAX_SIZE = 1600
"""Longer side, in pixels, that images are reduced to unless asked otherwise."""

_CACHE_VERSION = 1
_ASPECT_TOLERANCE = 0.01
_MIN_VIEWS_TO_HOLD_OUT = 3
_KEYPOINT_TOLERANCE = 0.5
_T = TypeVar("_T")
_R = TypeVar("_R")


@dataclass(frozen=True)
class View:
    """One posed image, undistorted. K (3,3) float64 in pixels, the first pixel's centre at (0.5, 0.5); viewmat (4,4)
    float64 world to camera, OpenCV axes (x right, y down, z forward)."""

    name: str
    image_file: Path
    mask_file: Path | None
    K: np.ndarray
    viewmat: np.ndarray
    width: int
    height: int
    camera_id: int


@dataclass(frozen=True)
class Points:
    """COLMAP's points: xyz (M,3) float64 world, rgb (M,3) uint8, error (M,) float32 pixels (negative: unknown),
    ids (M,) int64 COLMAP's own numbers."""

    xyz: np.ndarray
    rgb: np.ndarray
    error: np.ndarray
    ids: np.ndarray


@dataclass(frozen=True)
class Keypoints:
    """Where COLMAP observed points in one view: xy (n,2) float64 in the undistorted view's pixels (some may lie
    outside it), point_index (n,) int64 into the capture's points."""

    xy: np.ndarray
    point_index: np.ndarray


class Capture:
    """Views sorted by name, points, and their images and ID maps, decoded on demand within a memory budget.

    `names` holds the labels' names without 0, `left_out` (n,) int64 the IDs that pass for 0, `warnings` sentences for
    the user, `counts` what was found. `prepared`: whether `image` and `mask` can be had, or would have to be resampled
    first. Arrays that the methods return are shared and read-only; all methods
    may be called from several threads.
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
        colour_masks: bool,
        memory_mb: float,
        prepared: bool = True,
    ) -> None:
        self.folder = folder
        self.views = views
        self.points = points
        self.names = names
        self.warnings = warnings
        self.counts = counts
        self._ids_of_views = ids_of_views
        self._raw = raw
        self._colour_masks = colour_masks
        self._held = _Held(memory_mb * 1e6)
        self.prepared = prepared
        self.left_out = np.zeros(0, np.int64)
        enough = len(views) >= _MIN_VIEWS_TO_HOLD_OUT
        held_out = [i for i in range(len(views)) if enough and i % HOLDOUT_EVERY == 0]
        self.test_indices: tuple[int, ...] = tuple(held_out)
        self.train_indices: tuple[int, ...] = tuple(i for i in range(len(views)) if i not in set(held_out))

    def __len__(self) -> int:
        return len(self.views)

    def edited(self, names: Mapping[int, str], left_out: Iterable[int]) -> Capture:
        """The same capture with these names too, and with the IDs `left_out` as 0; decoded files are shared."""
        other = copy.copy(self)
        other.left_out = np.unique(np.array(list(left_out), np.int64))
        other.names = {i: name for i, name in {**self.names, **names}.items() if i not in other.left_out}
        return other

    def without_masks(self) -> Capture:
        """The same capture as if no image had an ID map; decoded files are shared."""
        other = copy.copy(self)
        other.views = tuple(replace(view, mask_file=None) for view in self.views)
        other._ids_of_views = [()] * len(self.views)
        return other

    def without_training_on(self, names: Collection[str]) -> Capture:
        """The same capture, where the views of these names are neither trained on nor held out."""
        other = copy.copy(self)
        other.train_indices = tuple(i for i in self.train_indices if self.views[i].name not in names)
        return other

    def without_left_out(self, ids: np.ndarray) -> np.ndarray:
        """`ids`, of any shape, with those left out as 0."""
        return np.where(np.isin(ids, self.left_out), 0, ids) if len(self.left_out) else ids

    @property
    def has_masks(self) -> bool:
        """Whether any view has an ID map."""
        return any(view.mask_file is not None for view in self.views)

    @property
    def object_ids(self) -> np.ndarray:
        """The IDs other than 0 that occur in the masks: (n,) int64, ascending."""
        ids = np.array(sorted({i for ids in self._ids_of_views for i in ids} - {0}), np.int64)
        return ids[~np.isin(ids, self.left_out)]

    def ids_in(self, index: int) -> tuple[int, ...]:
        """The IDs, 0 among them, that occur in one view's mask, ascending; empty where it has none."""
        return tuple(np.unique(self.without_left_out(np.array(self._ids_of_views[index], np.int64))).tolist())

    def camera_of(self, index: int) -> str:
        """The model, as COLMAP calls it, of the camera that took a view."""
        return self._raw[index][0].model

    def is_original(self, index: int) -> bool:
        """Whether a view's picture is used as it is on disk: no lens bends it, and it is not too large."""
        view = self.views[index]
        return _in_place(self._raw[index][0], view.width, view.height)

    def observed(self, index: int) -> np.ndarray:
        """Which points COLMAP observed in a view: (n,) int64, an index may come twice."""
        return self._raw[index][1].point_index.astype(np.int64)

    def image(self, index: int, downscale: int = 1) -> np.ndarray:
        """A view's pixels: (height // downscale, width // downscale, 3) uint8, the mean over blocks of
        downscale x downscale; a remainder at the right and bottom is cropped."""
        return self._held.get(("image", index, downscale), lambda: self._read_image(index, downscale))

    def mask(self, index: int, downscale: int = 1) -> np.ndarray | None:
        """A view's ID map, the size of `image`: (h, w) int64, taken at each block's centre; None where it has none."""
        if self.views[index].mask_file is None:
            return None
        ids = self._held.get(("mask", index, downscale), lambda: self._read_mask(index, downscale))
        return self.without_left_out(ids.astype(np.int64))

    def K(self, index: int, downscale: int = 1) -> np.ndarray:
        """The intrinsics (3,3) float64 that belong to `image(index, downscale)`."""
        K = self.views[index].K.copy()
        K[:2] /= downscale
        return K

    def keypoints(self, index: int) -> Keypoints:
        """The points that COLMAP observed in a view. Those that the inverse distortion does not reach are left out."""
        camera, image = self._raw[index]
        K = self.views[index].K
        if is_pinhole(camera):
            lens = to_pycolmap(camera)
            centre = np.array([lens.principal_point_x, lens.principal_point_y])
            xy = (image.xy - centre) / np.array([lens.focal_length_x, lens.focal_length_y])
        else:
            xy = undistort(to_pycolmap(camera), image.xy, _KEYPOINT_TOLERANCE)
        found = np.isfinite(xy).all(1)
        pixels = xy[found] * [K[0, 0], K[1, 1]] + K[:2, 2]
        return Keypoints(pixels, image.point_index[found].astype(np.int64))

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
        ids = read_mask(path, self._colour_masks)
        self._check_unchanged(index, path, (ids.shape[1], ids.shape[0]))
        width, height = self._reduced_size(index, downscale)
        first = downscale // 2
        return np.ascontiguousarray(ids[first::downscale, first::downscale][:height, :width])

    def _check_unchanged(self, index: int, path: Path, size: tuple[int, int]) -> None:
        view = self.views[index]
        if size != (view.width, view.height):
            raise InputError(
                f"{path} was {view.width}x{view.height} pixels and is now {size[0]}x{size[1]}; start again."
            )

    def _reduced_size(self, index: int, downscale: int) -> tuple[int, int]:
        view = self.views[index]
        width, height = view.width // downscale, view.height // downscale
        if downscale < 1 or width < 1 or height < 1:
            raise ValueError(f"a view of {view.width}x{view.height} cannot be reduced by {downscale}")
        return width, height


class _Held:
    """The most recently used arrays, within a number of bytes; safe between threads."""

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
        # Made outside the lock, so that threads decode at the same time; twice the same is harmless.
        array = make()
        array.setflags(write=False)
        with self._lock:
            if key not in self._arrays and array.nbytes <= self.budget:
                self._arrays[key] = array
                self.bytes += array.nbytes
                while self.bytes > self.budget:
                    self.bytes -= self._arrays.popitem(last=False)[1].nbytes
        return array


# Taking stock: what both loading and checking need


@dataclass
class _Source:
    """One registered image that is on disk."""

    image: Image
    camera: Camera
    target: Pinhole
    image_path: Path
    mask_path: Path | None


@dataclass
class _Survey:
    folder: Path
    model: Model
    sources: list[_Source]
    names: dict[int, str]
    warnings: list[str]
    counts: dict[str, Any]
    colour_masks: bool


def _refuse(sentence: str) -> NoReturn:
    raise InputError(sentence)


def _survey(folder: Path, max_size: int, problem: Problem, reporter: Reporter) -> _Survey:
    """What the capture holds. `problem` raises or collects; what makes going on pointless is raised in any case."""
    if not folder.is_dir():
        what = "is a file, not a folder" if folder.exists() else "does not exist"
        raise InputError(f"The capture {folder} {what}; expected a folder with images/ and sparse/0/.")
    reporter.status("Reading the COLMAP model")
    try:
        model_folder, warnings = find_model(folder)
    except OSError as error:
        raise InputError(f"{error.filename or folder} cannot be read ({error.strerror}); check it.") from error
    model = read_model(model_folder)
    warnings += model.warnings
    no_names: dict[int, str] = {}
    names = _tolerating(problem, lambda: read_names(folder), no_names)

    targets: dict[int, Pinhole | None] = {}
    for camera_id in sorted({image.camera_id for image in model.images}):
        targets[camera_id] = _tolerating(
            problem, partial(pinhole_for, model.cameras[camera_id], model.file("cameras"), max_size), None
        )
    if not any(targets.values()):
        raise InputError(f"{model.file('cameras')} holds no camera that can be used; run COLMAP anew.")

    images_folder, masks_folder = folder / "images", folder / "masks"
    if not images_folder.is_dir():
        raise InputError(f"{images_folder} does not exist; put the images that the COLMAP model names there.")
    files = Files(images_folder)
    masks = Files(masks_folder) if masks_folder.is_dir() else None
    sources, absent, unmasked = [], [], []
    for image in sorted(model.images, key=lambda image: image.name):
        if re.match(r"[/\\]|[A-Za-z]:", image.name) or ".." in re.split(r"[/\\]", image.name):
            problem(
                f"{model.file('images')} names an image {image.name}, which lies outside {images_folder}; rename it."
            )
            continue
        path = files.find(image.name)
        if path is None:
            absent.append(image.name)
            continue
        mask_path = None
        if masks is not None:
            accepted, lossy = mask_names(image.name)
            mask_path = masks.first(accepted)
            if mask_path is None and (jpeg := masks.first(lossy)) is not None:
                problem(f"{jpeg} is a JPEG, whose compression changes IDs; save the mask as PNG.")
            if mask_path is None:
                unmasked.append(image.name)
        target = targets[image.camera_id]
        if target is not None:
            sources.append(_Source(image, model.cameras[image.camera_id], target, path, mask_path))
    present = len(model.images) - len(absent)
    if absent and not present:
        raise InputError(
            f"{images_folder} holds none of the {len(absent)} images that {model.file('images')} names, for instance "
            f"{absent[0]}; put them there."
        )
    if absent:
        warnings.append(
            f"{len(absent)} of {len(model.images)} images in the model are not in {images_folder} and are left out, "
            f"for instance {absent[0]}."
        )
    registered = {source.image_path for source in sources}
    on_disk = [path for path in files.paths if Path(path).suffix.lower() in IMAGE_SUFFIXES]
    unregistered = [path for path in on_disk if images_folder / path not in registered]
    if unregistered and len(registered) == present:
        warnings.append(
            f"{len(unregistered)} of {len(on_disk)} images in {images_folder} are not in the model, for instance "
            f"{unregistered[0]}; COLMAP could not place them and they are not used."
        )
    if unmasked:
        first = masks_folder / Path(unmasked[0]).with_suffix(".png")
        if 2 * len(unmasked) > present:
            problem(
                f"The mask {first} is missing, as are those of {len(unmasked)} of {present} images: add them, or "
                f"remove {masks_folder} to work without objects."
            )
        else:
            warnings.append(f"{len(unmasked)} of {present} images have no mask, for instance {first} is missing.")
    if present < _MIN_VIEWS_TO_HOLD_OUT:
        warnings.append(f"Only {present} images can be used, so none is held out and quality cannot be measured.")
    centres = np.array([-image.viewmat[:3, :3].T @ image.viewmat[:3, 3] for image in model.images])
    extent = float(np.abs(model.xyz - np.median(model.xyz, 0)).max())
    if len(centres) > 1 and float(np.ptp(centres, 0).max()) <= 1e-9 * max(extent, 1e-30):
        warnings.append(f"All cameras in {model.file('images')} stand at one place, so depth cannot be told.")

    counts = {
        "registered": len(model.images),
        "used": present,
        "missing": len(absent),
        "unregistered": len(unregistered),
        "masks": present - len(unmasked) if masks is not None else 0,
        "points": len(model.xyz),
        "cameras": dict(Counter(model.cameras[i].model for i in sorted(targets))),
    }
    return _Survey(folder, model, sources, names, warnings, counts, _colour_coded(sources, problem))


def _tolerating(problem: Problem, make: Callable[[], _T], otherwise: _T) -> _T:
    try:
        return make()
    except InputError as error:
        problem(str(error))
        return otherwise


def _colour_coded(sources: list[_Source], problem: Problem) -> bool:
    """Whether three-channel masks code IDs in colours. It holds for the capture, not for a file: ID 65,793 is grey."""
    for source in sources:
        if source.mask_path is not None:
            if not _tolerating(problem, partial(is_three_channel, source.mask_path), True):
                return False
            if _tolerating(problem, partial(is_colour_mask, source.mask_path), False):
                return True
    return False


def _checked_size(source: _Source, size: tuple[int, int], cameras_file: Path) -> None:
    camera = source.camera
    if size != (camera.width, camera.height):
        raise InputError(
            f"{source.image_path} is {size[0]}x{size[1]} pixels, but {cameras_file} gives its camera {camera.id} "
            f"{camera.width}x{camera.height}; use the images that COLMAP was run on."
        )


def _checked_mask(source: _Source, colour: bool) -> np.ndarray:
    """The mask as it is on disk; raises InputError where its aspect ratio is not the image's."""
    assert source.mask_path is not None
    ids = read_mask(source.mask_path, colour)
    height, width = ids.shape
    camera = source.camera
    # A shape differs by rounding when one more or one less pixel would make it agree.
    expected = height * camera.width / camera.height
    if abs(width - expected) > max(1.0, _ASPECT_TOLERANCE * expected):
        raise InputError(
            f"{source.mask_path} is {width}x{height} pixels, but its image {source.image_path.name} is "
            f"{camera.width}x{camera.height}; make the mask the image's size."
        )
    return ids


def _in_parallel(work: Callable[[_T], _R], items: Iterable[_T]) -> Iterator[_R]:
    """Results in order; the first error stops what has not begun."""
    pool = ThreadPoolExecutor(max(1, min(4, os.cpu_count() or 1)))
    try:
        yield from pool.map(work, items)
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


# Loading


def load_capture(
    folder: str | Path,
    cache: str | Path | None,
    memory_mb: float = 2000,
    max_size: int = MAX_SIZE,
    reporter: Reporter | None = None,
) -> Capture:
    """Read a capture: images/, a COLMAP model (sparse/0, sparse/ or beside images/), and optionally masks/ and
    labels.json or labels.txt.

    Images that are distorted, or longer than `max_size` pixels (0: any size), are resampled once into `cache`; later
    loads only look whether their sources changed. Without a cache nothing is resampled or written: such a capture is
    only `prepared` where no image needs it. `memory_mb` bounds what decoded images may take. Raises InputError with one
    sentence that names the file; a run that is killed leaves no half-written file.
    """
    reporter = reporter or Reporter()
    folder, cache = Path(folder), None if cache is None else Path(cache) / "views"
    survey = _survey(folder, max_size, _refuse, reporter)
    if cache is None:
        reporter.status("Looking through the masks")
    else:
        try:
            cache.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            what = f"The folder {cache.parent} cannot be written to ({error.strerror}); choose another."
            raise InputError(what) from error
        reporter.status("Preparing the images")
    views, ids_of_views = [], []
    found = _in_parallel(
        lambda source: _looked_at(source, survey) if cache is None else _prepare(source, survey, cache), survey.sources
    )
    for done, (view, ids) in enumerate(found, 1):
        views.append(view)
        ids_of_views.append(ids)
        reporter.progress(done, len(survey.sources), what="images")
    model = survey.model
    for sentence in survey.warnings:
        reporter.warning(sentence)
    return Capture(
        folder,
        tuple(views),
        Points(model.xyz, model.rgb, model.error, model.ids),
        survey.names,
        survey.warnings,
        survey.counts,
        ids_of_views,
        [(source.camera, source.image) for source in survey.sources],
        survey.colour_masks,
        memory_mb,
        prepared=cache is not None
        or all(_in_place(source.camera, source.target.width, source.target.height) for source in survey.sources),
    )


def _in_place(camera: Camera, width: int, height: int) -> bool:
    """Whether a camera's image needs no resampling to become a view of this size."""
    return is_pinhole(camera) and (width, height) == (camera.width, camera.height)


def _looked_at(source: _Source, survey: _Survey) -> tuple[View, tuple[int, ...]]:
    """One view, checked but as it is on disk, and the IDs in its mask."""
    _checked_size(source, image_size(source.image_path), survey.model.file("cameras"))
    ids = () if source.mask_path is None else tuple(_distinct(_checked_mask(source, survey.colour_masks)))
    return _view(source, source.image_path, source.mask_path), ids


def _view(source: _Source, image_file: Path, mask_file: Path | None) -> View:
    target, image = source.target, source.image
    return View(
        image.name, image_file, mask_file, target.K.copy(), image.viewmat, target.width, target.height,
        source.camera.id,
    )  # fmt: skip


def _distinct(ids: np.ndarray) -> list[int]:
    """The IDs of a mask, ascending; small ones are counted, which is faster than sorting all pixels."""
    if ids.size and 0 <= ids.min() and ids.max() < 1 << 16:
        return np.flatnonzero(np.bincount(ids.ravel())).tolist()
    return np.unique(ids).tolist()


def _prepare(source: _Source, survey: _Survey, cache: Path) -> tuple[View, tuple[int, ...]]:
    """One view, ready to use: checked, and resampled into the cache where that is needed and not yet done.

    The stamp beside the cached files is written last and says what they were made from.
    """
    name = source.image.name
    camera, target = source.camera, source.target
    # The size is part of the name, so that captures loaded at two sizes do not pull files from under each other.
    digest = hashlib.sha256(f"{name}\0{target.width}x{target.height}".encode()).hexdigest()[:12]
    stem = re.sub(r"[^A-Za-z0-9_-]+", "_", name)[-40:].strip("_") + "-" + digest
    stamp_path = cache / f"{stem}.json"
    made_from = {
        "version": _CACHE_VERSION,
        "image": _identity(source.image_path),
        "mask": _identity(source.mask_path) if source.mask_path else None,
        "colour_masks": survey.colour_masks,
        "camera": [camera.model, camera.width, camera.height, list(camera.params)],
        "target": [target.width, target.height, target.K.tolist()],
    }
    stamp = _read_stamp(stamp_path, made_from, cache)
    if stamp is None:
        try:
            stamp = _make(source, survey, cache, stem, made_from)
            write_json(stamp_path, stamp)
        except OSError as error:
            raise InputError(
                f"{error.filename or cache} cannot be written ({error.strerror}); free some space or choose "
                "another folder."
            ) from error
    image_file = cache / stamp["image_file"] if stamp["image_file"] else source.image_path
    mask_file = cache / stamp["mask_file"] if stamp["mask_file"] else source.mask_path
    return _view(source, image_file, mask_file), tuple(stamp["ids"])


def _identity(path: Path) -> list[Any]:
    try:
        status = path.stat()
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}); check the file.") from error
    return [str(path.resolve()), status.st_size, status.st_mtime_ns]


def _read_stamp(path: Path, made_from: dict[str, Any], cache: Path) -> dict[str, Any] | None:
    """The stamp of files that are as they should be, else None: a damaged cache is made anew, never an error."""
    try:
        stamp = json.loads(path.read_text(encoding="utf-8"))
        if stamp["made_from"] != made_from:
            return None
        for key in ("image_file", "mask_file"):
            if stamp[key] and (cache / stamp[key]).stat().st_size != stamp[f"{key}_bytes"]:
                return None
        return stamp
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _make(source: _Source, survey: _Survey, cache: Path, stem: str, made_from: dict[str, Any]) -> dict[str, Any]:
    camera, target = source.camera, source.target
    stamp: dict[str, Any] = {"made_from": made_from, "ids": []}
    files: dict[str, str | None] = {"image_file": None, "mask_file": None}
    pixels = read_image(source.image_path)
    _checked_size(source, pixels.size, survey.model.file("cameras"))
    in_place = _in_place(camera, target.width, target.height)
    if not in_place:
        files["image_file"] = f"{stem}.png"
        write_image(cache / f"{stem}.png", resample_image(pixels, camera, target))
    if source.mask_path is not None:
        ids = _checked_mask(source, survey.colour_masks)
        if not in_place or ids.shape != (target.height, target.width):
            ids = resample_mask(ids, camera, target)
            suffix, data = encode_mask(ids)
            files["mask_file"] = f"{stem}.mask{suffix}"
            write_atomic(cache / f"{stem}.mask{suffix}", data)
        stamp["ids"] = _distinct(ids)
    for key, name in files.items():
        stamp[key] = name
        stamp[f"{key}_bytes"] = (cache / name).stat().st_size if name else None
    return stamp


# Checking


def check_capture(folder: str | Path, max_size: int = MAX_SIZE, reporter: Reporter | None = None) -> dict[str, Any]:
    """What a user wants to know before work begins; reads every image and mask once and writes nothing.

    The dict's "problems" lists a sentence for each thing that makes `load_capture` refuse the capture (empty: it can be
    used), "warnings" what is only worth knowing. A model that cannot be read leaves only "folder", "problems" and
    "warnings".
    """
    reporter = reporter or Reporter()
    folder = Path(folder)
    problems: list[str] = []
    try:
        survey = _survey(folder, max_size, problems.append, reporter)
    except InputError as error:
        return {"folder": str(folder), "problems": [*problems, str(error)], "warnings": []}
    model = survey.model
    reporter.status("Reading the images and masks")

    def look(source: _Source) -> tuple[list[str], list[int]]:
        wrong: list[str] = []
        _tolerating(wrong.append, lambda: _check_image(source, model.file("cameras")), None)
        if source.mask_path is None:
            return wrong, []
        ids = _tolerating(wrong.append, lambda: _checked_mask(source, survey.colour_masks), None)
        return wrong, [] if ids is None else _distinct(ids)

    views_of: Counter[int] = Counter()
    for done, (wrong, ids) in enumerate(_in_parallel(look, survey.sources), 1):
        problems += [sentence for sentence in wrong if sentence not in problems]
        views_of.update(ids)
        reporter.progress(done, len(survey.sources), what="images")
    known = model.error[model.error >= 0]
    sizes = Counter(f"{source.target.width}x{source.target.height}" for source in survey.sources)
    unnamed = sorted(set(survey.names) - set(views_of))
    warnings = list(survey.warnings)
    if views_of and unnamed:
        warnings.append(
            f"The labels name {len(unnamed)} objects that no mask shows, for instance {unnamed[0]} "
            f"({survey.names[unnamed[0]]})."
        )
    observations = sum(len(image.point_index) for image in model.images)
    return {
        "folder": str(folder),
        "model": str(model.folder),
        "problems": problems,
        "warnings": warnings,
        "counts": survey.counts,
        "cameras": [
            {
                "id": camera.id,
                "model": camera.model,
                "width": camera.width,
                "height": camera.height,
                "images": sum(image.camera_id == camera.id for image in model.images),
                "undistort": not is_pinhole(camera),
            }
            for camera in (model.cameras[i] for i in sorted({image.camera_id for image in model.images}))
        ],
        "view_sizes": dict(sizes),
        "points": len(model.xyz),
        "observations": observations,
        "mean_reprojection_error": round(float(known.mean()), 4) if len(known) else None,
        "objects": [
            {"id": i, "name": survey.names.get(i, f"object {i}"), "views": views_of[i]} for i in sorted(views_of) if i
        ],
        "unlabelled_views": views_of[0],
    }


def _check_image(source: _Source, cameras_file: Path) -> PilImage.Image:
    _checked_size(source, image_size(source.image_path), cameras_file)
    return read_image(source.image_path)
