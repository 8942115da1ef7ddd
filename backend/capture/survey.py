"""Validation of a capture and listing of its contents, before any image is prepared."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import numpy as np
from PIL import Image as PilImage

from ..shared.defaults import MAX_SIZE
from ..shared.errors import InputError
from ..shared.events import Reporter
from ..shared.formats.photos_source import IMAGES, read_source
from ..shared.reconstruction.folder import STROKES
from ..shared.reconstruction.objects import default_name
from .capture import MIN_VIEWS_TO_HOLD_OUT
from .colmap import COLMAP, Camera, Image, Model
from .files import (
    Files,
    image_size,
    is_color_mask,
    is_resized,
    is_three_channel,
    mask_names,
    mask_size,
    read_image,
    read_mask,
    same_shape,
)
from .made_masks import is_made
from .models import none_found, photo_files, photos_folder, read_capture_model
from .names import HELD_OUT, read_held_out, read_names
from .undistort import Pinhole, is_pinhole, pinhole_for, scaled

Problem = Callable[[str], None]
"""Handler of a problem, given as a sentence; either raises or collects it."""

_CONVERTED = (".exr", ".json", ".xml")
"""Kinds of files of other programs that `masks` makes masks of, and that are none themselves."""
_PIXELS_AT_ONCE = 100_000_000
"""Number of pixels that may be processed at a time, with about 15 bytes for each."""
_LARGEST = 4
"""Largest factor by which a mask's sides may be longer than its image's, and an image's than its camera's, which limits
the memory to read them."""
_SMALL = 64
"""Longer side in pixels of an image that is considered small; masks of smaller ones may be as large as its."""
_T = TypeVar("_T")
_R = TypeVar("_R")


@dataclass
class Source:
    """One image of the model that exists on disk, with its mask, its camera and the pinhole camera of its view.

    The camera and the image's observations are scaled to the photo where that has another size than the model says.
    """

    image: Image
    camera: Camera
    target: Pinhole
    image_path: Path
    mask_path: Path | None


@dataclass
class Survey:
    """The contents of a capture before its images are read.

    Attributes:
        held_out: the views that test.txt names, if any.
        on_objects: whether only objects belong to the scene, since these turned before a background at rest.
    """

    folder: Path
    model: Model
    sources: list[Source]
    names: dict[int, str]
    warnings: list[str]
    counts: dict[str, Any]
    color_masks: bool
    held_out: frozenset[str] | None
    on_objects: bool


def refuse(sentence: str) -> NoReturn:
    """Raise a problem as InputError."""
    raise InputError(sentence)


def survey_capture(
    folder: Path, max_size: int, problem: Problem, reporter: Reporter, photos_only: bool = False
) -> Survey:
    """List the contents of a capture.

    Args:
        folder: The capture.
        max_size: Largest longer side of the views, in pixels; 0 for no limit.
        problem: Called with each problem that makes the capture unusable; may raise or collect it.
        reporter: Receives the status.
        photos_only: Whether masks, names of objects and held-out views do not count.

    Returns:
        The survey; if `problem` only collects, the survey of the usable parts.

    Raises:
        InputError: A problem that prevents further checks, regardless of `problem`.
    """
    if not folder.is_dir():
        what = "is a file, not a folder" if folder.exists() else "does not exist"
        raise InputError(f"The capture {folder} {what}; expected a folder with images/ and sparse/0/.")
    reporter.status("Reading the cameras and points")
    model = read_capture_model(folder)
    warnings = list(model.warnings)
    no_names: dict[int, str] = {}
    names = no_names if photos_only else _tolerate(problem, lambda: read_names(folder), no_names)

    targets: dict[Camera, Pinhole | None] = {}

    def target_of(camera: Camera) -> Pinhole | None:
        if camera not in targets:
            targets[camera] = _tolerate(problem, partial(pinhole_for, camera, model.file("cameras"), max_size), None)
        return targets[camera]

    camera_ids = sorted({image.camera_id for image in model.images})
    for camera_id in camera_ids:
        target_of(model.cameras[camera_id])
    if not any(targets.values()):
        raise InputError(f"{model.file('cameras')} contains no usable camera; run {model.program} again.")

    images_folder, masks_folder = folder / "images", folder / "masks"
    if model.program != COLMAP:
        images_folder = photos_folder(folder)
    elif not images_folder.is_dir():
        raise InputError(f"{images_folder} does not exist; put the images that the COLMAP model names there.")
    files = photo_files(folder, images_folder)
    masks = Files(masks_folder) if masks_folder.is_dir() and not photos_only else None
    total, absent = len(model.images) + len(model.absent), list(model.absent)
    sources, unmasked, resized = [], [], []
    paths = {path for image in model.images if (path := files.find(image.name)) is not None}
    with ThreadPoolExecutor(max(1, min(4, os.cpu_count() or 1))) as pool:
        sizes = dict(zip(paths, pool.map(_size_of, paths), strict=True))
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
                problem(f"{jpeg} is a JPEG, whose compression changes IDs; save it as PNG, or use `masks`.")
            if mask_path is None:
                unmasked.append(image.name)
        camera = model.cameras[image.camera_id]
        if target_of(camera) is None:
            continue
        fitting = _fitting(camera, sizes[path])
        if fitting != camera:
            resized.append((image.name, fitting, camera))
            image = replace(image, xy=image.xy * [fitting.width / camera.width, fitting.height / camera.height])
        if (target := target_of(fitting)) is not None:
            sources.append(Source(image, fitting, target, path, mask_path))
    present = total - len(absent)
    if absent and not present:
        raise none_found(images_folder, absent, model.file("images"))
    if absent:
        warnings.append(
            f"{len(absent)} of {total} images in the model are not in {images_folder} and are left out, "
            f"for instance {absent[0]}."
        )
    registered = {source.image_path for source in sources}
    on_disk = [path for path in files.paths if Path(path).suffix.lower() in IMAGES]
    unregistered = [path for path in on_disk if images_folder / path not in registered]
    if unregistered and len(registered) == present:
        warnings.append(
            f"{len(unregistered)} of {len(on_disk)} images in {images_folder} are not in the model, for instance "
            f"{unregistered[0]}; {model.program} could not register them, and they are not used."
        )
    if resized:
        name, fitting, camera = resized[0]
        warnings.append(
            f"{len(resized)} of {present} images have another size than their cameras, which are scaled to them; for "
            f"instance {name} is {fitting.width}x{fitting.height} pixels, and its camera in {model.file('cameras')} "
            f"{camera.width}x{camera.height}."
        )
    if unmasked:
        first = masks_folder / Path(unmasked[0]).with_suffix(".png")
        # Masks made here are of the photos that somebody has annotated or that are trained on.
        if 2 * len(unmasked) > present and not is_made(masks_folder):
            assert masks is not None
            problem(
                _unconverted(masks)
                or f"The mask {first} is missing, as are those of {len(unmasked)} of {present} images: add them, or "
                f"remove {masks_folder} to work without objects."
            )
        elif not (masks_folder / STROKES).is_file():
            warnings.append(f"{len(unmasked)} of {present} images have no mask, for instance {first} is missing.")
    held_out = None if photos_only else _tolerate(problem, partial(_held_out, folder, model, sources), None)
    if held_out is None and present < MIN_VIEWS_TO_HOLD_OUT:
        warnings.append(f"Only {present} images can be used, so none is held out and quality cannot be measured.")
    centers = np.array([-image.viewmat[:3, :3].T @ image.viewmat[:3, 3] for image in model.images])
    extent = float(np.abs(model.xyz - np.median(model.xyz, 0)).max())
    if len(centers) > 1 and float(np.ptp(centers, 0).max()) <= 1e-9 * max(extent, 1e-30):
        warnings.append(f"All cameras in {model.file('images')} have the same position, so depth cannot be determined.")

    counts = {
        "registered": total,
        "used": present,
        "missing": len(absent),
        "unregistered": len(unregistered),
        "masks": present - len(unmasked) if masks is not None else 0,
        "points": len(model.xyz),
        "cameras": dict(Counter(model.cameras[i].model for i in camera_ids)),
    }
    made_from = read_source(folder)
    return Survey(
        folder, model, sources, names, warnings, counts, _is_color_coded(sources, problem), held_out,
        on_objects=made_from is not None and made_from.features == "objects",
    )  # fmt: skip


def _unconverted(masks: Files) -> str | None:
    """Return a sentence about a folder of masks that has none but those of other programs; None for other folders."""
    kinds = Counter(Path(path).suffix.lower() for path in masks.paths)
    if not kinds or not kinds.keys() <= set(_CONVERTED):
        return None
    files = " and ".join(f"{count} {suffix} file{'s' * (count > 1)}" for suffix, count in kinds.items())
    return (
        f"{masks.folder} contains {files}, which must be converted to masks: use `masks` (Import Masks) with this "
        "folder, or remove it to work without objects."
    )


def _held_out(folder: Path, model: Model, sources: list[Source]) -> frozenset[str] | None:
    """Return the views that test.txt holds out; None without the file. Raises InputError if it cannot be followed."""
    names = read_held_out(folder)
    if names is None:
        return None
    path, known = folder / HELD_OUT, {*(image.name for image in model.images), *model.absent}
    unknown = [name for name in names if name not in known]
    if unknown:
        raise InputError(
            f"{path} names {unknown[0][:200]}, which {model.file('images')} does not have; correct the name or remove "
            "its line."
        )
    if sources and all(source.image.name in names for source in sources):
        raise InputError(f"{path} names all {len(sources)} views, so none is left to train on; remove some lines.")
    return frozenset(names)


def _tolerate(problem: Problem, make: Callable[[], _T], otherwise: _T) -> _T:
    try:
        return make()
    except InputError as error:
        problem(str(error))
        return otherwise


def _is_color_coded(sources: list[Source], problem: Problem) -> bool:
    """Return whether three-channel masks encode IDs as colors, for the whole capture, as ID 65,793 encodes as gray."""
    for source in sources:
        if source.mask_path is not None:
            if _tolerate(problem, partial(check_mask_size, source), None) is None:
                continue
            if not _tolerate(problem, partial(is_three_channel, source.mask_path), True):
                return False
            if _tolerate(problem, partial(is_color_mask, source.mask_path), False):
                return True
    return False


def _size_of(photo: Path) -> tuple[int, int] | None:
    """Return the size of a photo; None if it cannot be read, which is reported where all of it is."""
    try:
        return image_size(photo)
    except InputError:
        return None


def _fitting(camera: Camera, size: tuple[int, int] | None) -> Camera:
    """Return an image's camera, scaled to the size of a photo that was reduced or enlarged, but not cropped."""
    own = camera.width, camera.height
    if size is None:
        return camera
    is_scaled = size != own and is_resized(size, own) and not _is_far_larger(size, camera)
    return scaled(camera, *size) if is_scaled else camera


def _is_far_larger(size: tuple[int, int], camera: Camera) -> bool:
    return max(size) > _LARGEST * max(camera.width, camera.height, _SMALL)


def check_size(source: Source, size: tuple[int, int], cameras_file: Path) -> None:
    """Raise InputError if an image's size (width, height) differs from its camera's."""
    camera = source.camera
    if size != (camera.width, camera.height):
        raise InputError(
            f"{source.image_path} is {size[0]}x{size[1]} pixels, but {cameras_file} gives its camera {camera.id} "
            f"{camera.width}x{camera.height}; use the images that the cameras were computed from."
        )


def check_mask(source: Source, color: bool) -> np.ndarray:
    """Read a mask from disk without resampling; raises InputError if its aspect ratio differs from the image's."""
    assert source.mask_path is not None
    check_mask_size(source)
    return read_mask(source.mask_path, color)


def check_mask_size(source: Source) -> tuple[int, int]:
    """Return a mask's width and height from its header.

    Raises InputError if the aspect ratio differs from the image's, or if the mask is far larger than the image.
    """
    assert source.mask_path is not None
    camera = source.camera
    width, height = mask_size(source.mask_path)
    if _is_far_larger((width, height), camera) or not same_shape((width, height), (camera.width, camera.height)):
        raise InputError(
            f"{source.mask_path} is {width}x{height} pixels, but its image {source.image_path.name} is "
            f"{camera.width}x{camera.height}; make the mask the image's size."
        )
    return width, height


def run_in_parallel(work: Callable[[Source], _R], sources: Sequence[Source]) -> Iterator[_R]:
    """Process images in parallel and yield the results in order; the first error cancels images not yet started.

    Large images are processed by fewer threads, to limit memory.
    """
    pixels = max((source.camera.width * source.camera.height for source in sources), default=1)
    fitting = _PIXELS_AT_ONCE // max(pixels, 1)
    pool = ThreadPoolExecutor(max(1, min(4, os.cpu_count() or 1, fitting)))
    try:
        yield from pool.map(work, sources)
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def check_capture(folder: str | Path, max_size: int = MAX_SIZE, reporter: Reporter | None = None) -> dict[str, Any]:
    """Check a capture; reads every image and mask once and writes nothing.

    Args:
        folder: The capture.
        max_size: Largest longer side of the views, in pixels; 0 for no limit.
        reporter: Receives status and progress.

    Returns:
        A JSON-compatible dict. "problems" is a list of sentences, one for each reason why `load_capture` would refuse
        the capture; "warnings" is a list of warnings. If the model cannot be read, the only other key is "folder".
    """
    reporter = reporter or Reporter()
    folder = Path(folder)
    problems: list[str] = []
    try:
        survey = survey_capture(folder, max_size, problems.append, reporter)
    except InputError as error:
        return {"folder": str(folder), "problems": [*problems, str(error)], "warnings": []}
    model = survey.model
    reporter.status("Reading the images and masks")

    def check(source: Source) -> tuple[list[str], list[int]]:
        wrong: list[str] = []
        _tolerate(wrong.append, lambda: _check_image(source, model.file("cameras")), None)
        if source.mask_path is None:
            return wrong, []
        ids = _tolerate(wrong.append, lambda: check_mask(source, survey.color_masks), None)
        return wrong, [] if ids is None else distinct_ids(ids)

    views_of: Counter[int] = Counter()
    for done, (wrong, ids) in enumerate(run_in_parallel(check, survey.sources), 1):
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
            {"id": i, "name": survey.names.get(i, default_name(i)), "views": views_of[i]} for i in sorted(views_of) if i
        ],
        "unlabeled_views": views_of[0],
    }


def _check_image(source: Source, cameras_file: Path) -> PilImage.Image:
    check_size(source, image_size(source.image_path), cameras_file)
    return read_image(source.image_path)


def distinct_ids(ids: np.ndarray) -> list[int]:
    """Return the IDs in a mask, ascending. Small IDs are counted, which is faster than sorting all pixels."""
    if ids.size and ids.min() >= 0 and ids.max() < 1 << 16:
        return np.flatnonzero(np.bincount(ids.ravel())).tolist()
    return np.unique(ids).tolist()
