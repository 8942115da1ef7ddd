"""Loading of a capture; images are undistorted and reduced once, into a cache."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image as PilImage

from ..shared.defaults import MAX_SIZE
from ..shared.errors import InputError
from ..shared.events import Reporter
from ..shared.formats.atomic import make_folder, write_atomic
from ..shared.formats.json_file import parse_json, write_json
from ..shared.formats.regular_file import read_regular
from .capture import Capture, Points, View, needs_no_resampling
from .files import encode_mask, image_size, mask_size, read_image, write_image
from .survey import Source, Survey, check_mask, check_size, distinct_ids, refuse, run_in_parallel, survey_capture
from .undistort import resample_image, resample_mask

_CACHE_VERSION = 2
_BACKGROUND = (128, 128, 128)
"""Color behind objects that turned before a background at rest."""


def load_capture(
    folder: str | Path,
    cache: str | Path | None,
    memory_mb: float = 2000,
    max_size: int = MAX_SIZE,
    reporter: Reporter | None = None,
    photos_only: bool = False,
) -> Capture:
    """Load a capture.

    A capture has images/, a COLMAP model (sparse/0, sparse/ or beside images/) or a file with the cameras of another
    program (see `models.read_capture_model`), and optionally masks/, labels.json or labels.txt, and test.txt with the
    names of the held-out views. Images that are distorted or too large are resampled into the cache, and again only if
    their source files change. An interrupted run leaves no incomplete files.

    Args:
        folder: The capture.
        cache: Folder for resampled files. If None, nothing is resampled or written, and the capture is `prepared` only
            if no image needs resampling.
        memory_mb: Memory limit for decoded images, in megabytes.
        max_size: Largest longer side of the views, in pixels; 0 for no limit.
        reporter: Receives status, progress and warnings.
        photos_only: Whether masks, names of objects and held-out views do not count, and may be wrong.

    Returns:
        The capture; its images and masks are decoded on demand.

    Raises:
        InputError: The capture cannot be used; the message contains the path of the file at fault.
    """
    reporter = reporter or Reporter()
    folder, cache = Path(folder), None if cache is None else Path(cache) / "views"
    survey = survey_capture(folder, max_size, refuse, reporter, photos_only)
    if cache is None:
        reporter.status("Reading the masks")
    else:
        try:
            make_folder(cache)
        except OSError as error:
            what = f"The folder {cache.parent} cannot be written to ({error.strerror}); choose another."
            raise InputError(what) from error
        reporter.status("Preparing the images")
    views, ids_of_views = [], []
    found = run_in_parallel(
        lambda source: _read_view(source, survey) if cache is None else _prepare_view(source, survey, cache),
        survey.sources,
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
        survey.color_masks,
        memory_mb,
        prepared=cache is not None
        or (
            not survey.on_objects
            and all(
                needs_no_resampling(source.camera, source.target.width, source.target.height)
                and (
                    source.mask_path is None
                    or mask_size(source.mask_path) == (source.target.width, source.target.height)
                )
                for source in survey.sources
            )
        ),
        held_out=survey.held_out,
    )


def _read_view(source: Source, survey: Survey) -> tuple[View, tuple[int, ...]]:
    """Check one view without resampling; returns the view and the IDs in its mask."""
    check_size(source, image_size(source.image_path), survey.model.file("cameras"))
    ids = () if source.mask_path is None else tuple(distinct_ids(check_mask(source, survey.color_masks)))
    return _view_of(source, source.image_path, source.mask_path), ids


def _view_of(source: Source, image_file: Path, mask_file: Path | None) -> View:
    target, image = source.target, source.image
    return View(
        image.name, image_file, mask_file, target.K.copy(), image.viewmat, target.width, target.height,
        source.camera.id,
    )  # fmt: skip


def _prepare_view(source: Source, survey: Survey, cache: Path) -> tuple[View, tuple[int, ...]]:
    """Check one view and resample it into the cache if necessary; returns the view and the IDs in its mask.

    The stamp file beside the cached files records their sources and is written last.
    """
    name = source.image.name
    camera, target = source.camera, source.target
    # The digest includes the size, so that loading a capture at another size does not replace files in use.
    digest = hashlib.sha256(f"{name}\0{target.width}x{target.height}".encode()).hexdigest()[:12]
    stem = re.sub(r"[^A-Za-z0-9_-]+", "_", name)[-40:].strip("_") + "-" + digest
    stamp_path = cache / f"{stem}.json"
    made_from = {
        "version": _CACHE_VERSION,
        "image": _identify(source.image_path),
        "mask": _identify(source.mask_path) if source.mask_path else None,
        "color_masks": survey.color_masks,
        "camera": [camera.model, camera.width, camera.height, list(camera.params)],
        "target": [target.width, target.height, target.K.tolist()],
    }
    if survey.on_objects:
        made_from["on_objects"] = True
    stamp = _read_stamp(stamp_path, made_from, cache)
    if stamp is None:
        try:
            stamp = _resample(source, survey, cache, stem, made_from)
            write_json(stamp_path, stamp)
        except OSError as error:
            raise InputError(
                f"{error.filename or cache} cannot be written ({error.strerror}); free some space or choose "
                "another folder."
            ) from error
    image_file = cache / stamp["image_file"] if stamp["image_file"] else source.image_path
    mask_file = cache / stamp["mask_file"] if stamp["mask_file"] else source.mask_path
    return _view_of(source, image_file, mask_file), tuple(stamp["ids"])


def _identify(path: Path) -> list[Any]:
    try:
        status = path.stat()
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}); check the file.") from error
    return [str(path.resolve()), status.st_size, status.st_mtime_ns]


def _read_stamp(path: Path, made_from: dict[str, Any], cache: Path) -> dict[str, Any] | None:
    """Read the stamp of cached files; None if they are invalid and must be rebuilt. A damaged cache is not an error."""
    try:
        stamp = parse_json(read_regular(path))
        if stamp["made_from"] != made_from:
            return None
        if not all(type(number) is int and number >= 0 for number in stamp["ids"]):
            return None
        for key in ("image_file", "mask_file"):
            if stamp[key] and (cache / stamp[key]).stat().st_size != stamp[f"{key}_bytes"]:
                return None
        return stamp
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _resample(source: Source, survey: Survey, cache: Path, stem: str, made_from: dict[str, Any]) -> dict[str, Any]:
    camera, target = source.camera, source.target
    stamp: dict[str, Any] = {"made_from": made_from, "ids": []}
    files: dict[str, str | None] = {"image_file": None, "mask_file": None}
    check_size(source, image_size(source.image_path), survey.model.file("cameras"))
    pixels = read_image(source.image_path)
    in_place = needs_no_resampling(camera, target.width, target.height)
    ids = None if source.mask_path is None else check_mask(source, survey.color_masks)
    if survey.on_objects and ids is not None:
        pixels = _cut_out(pixels, ids)
    if survey.on_objects or not in_place:
        files["image_file"] = f"{stem}.png"
        write_image(cache / f"{stem}.png", pixels if in_place else resample_image(pixels, camera, target))
    if ids is not None:
        if not in_place or ids.shape != (target.height, target.width):
            ids = resample_mask(ids, camera, target)
            suffix, data = encode_mask(ids)
            files["mask_file"] = f"{stem}.mask{suffix}"
            write_atomic(cache / f"{stem}.mask{suffix}", data)
        stamp["ids"] = distinct_ids(ids)
    for key, name in files.items():
        stamp[key] = name
        stamp[f"{key}_bytes"] = (cache / name).stat().st_size if name else None
    return stamp


def _cut_out(image: PilImage.Image, ids: np.ndarray) -> PilImage.Image:
    """Return an image with objects before one color; what stands still behind them contradicts the poses."""
    shape = PilImage.fromarray((ids > 0).astype(np.uint8) * 255).resize(image.size, PilImage.Resampling.NEAREST)
    return PilImage.composite(image.convert("RGB"), PilImage.new("RGB", image.size, _BACKGROUND), shape)
