"""Masks and names beside photos: their copies in a capture, and the masks for a search of features on objects."""

from __future__ import annotations

import io
import shutil
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from ...capture.files import LOSSY_SUFFIXES, Files, encode_mask, image_size, mask_names, read_mask, same_shape
from ...capture.made_masks import has_ids_of, is_made, kept_masks
from ...capture.mask_sources import MaskFiles, ids_of
from ...capture.names import HELD_OUT, read_held_out, read_names
from ...shared.errors import InputError
from ...shared.events import Reporter
from ...shared.formats.atomic import atomic_path, make_folder, write_atomic
from ...shared.formats.file_names import legible
from ...shared.formats.photos_source import LISTS, WORK
from .. import database
from .stamps import IMAGES, MASKS, Stamps


def write_masks(
    masks: MaskFiles, given: Path, photos: Sequence[str], names: Mapping[str, str], capture: Path, stamps: Stamps
) -> None:
    """Write the masks of photos that are in the folder `given` to a capture; names: of the photos there."""
    place = _place_of_given(capture, given)
    corrected = _corrected(names, place)
    photos = [photo for photo in photos if photo not in corrected]
    stamps.expect(place / (names[photo] + suffix) for photo in photos for suffix in (".png", ".npz"))
    for photo in photos:
        suffix, data = encode_mask(ids_of(masks.read(photo)))
        target = place / (names[photo] + suffix)
        if _is_missing(target, masks.files[photo], capture, stamps):
            make_folder(target.parent)
            write_atomic(target, data)


def copy_rest(source: Path, masks: MaskFiles, names: Mapping[str, str], capture: Path, stamps: Stamps) -> None:
    """Copy masks that are not JPEGs, and files with names, that are beside the photos.

    Args:
        source: the folder with them.
        masks: the masks in its masks/.
        names: of the photos there, in the capture; masks by whose names they are not found get new names.
        capture: the capture.
        stamps: of the copies.
    """
    folder = source / MASKS
    renamed = {
        masks.files[photo]: names[photo] + masks.files[photo].suffix
        for photo in masks.photos
        if masks.files[photo].relative_to(folder).as_posix() not in mask_names(names[photo])[0]
        and names[photo] != photo
    }
    place = _place_of_given(capture, folder)
    corrected = {masks.files.get(photo) for photo in _corrected(names, place)}
    found = [path for path in folder.rglob("*") if path not in corrected]
    targets = {
        **{path: capture / path.name for path in source.iterdir() if LISTS.fullmatch(path.name)},
        **{path: place / renamed.get(path, path.relative_to(folder)) for path in found},
    }
    targets = {
        path: target
        for path, target in targets.items()
        if path.is_file() and path.suffix.lower() not in LOSSY_SUFFIXES and legible(str(path)) == str(path)
    }
    stamps.expect(targets.values())
    for path, target in targets.items():
        if _is_missing(target, path, capture, stamps):
            make_folder(target.parent)
            with atomic_path(target) as part:
                shutil.copyfile(path, part)


def warn_of_gone(photos: Iterable[str], capture: Path, stamps: Stamps, reporter: Reporter) -> None:
    """Say which masks do not exist beside the photos any more or, where others were made of them, are not used.

    They are not deleted, since the user may have changed them there. Where a photo has another mask now, which they
    would hide, `.old` is added to their names.

    Args:
        photos: the names of the photos.
        capture: the capture.
        stamps: of the copies.
        reporter: receives the warning.
    """
    if is_made(capture / MASKS):
        kept, there = Files(kept_masks(capture)), Files(capture / MASKS)
        unused = [name for name in photos if _first(kept, name) and not _first(there, name)]
        if unused:
            count = "a photo" if len(unused) == 1 else f"{len(unused)} photos"
            reporter.status(
                f"The masks of {count}, such as {unused[0]}, are in {kept_masks(capture)} alone; import them from "
                "there to use them."
            )
        return
    gone = [name for name in stamps.masks_not_asked_for() if (capture / name).exists()]
    replaced = set()
    for photo in photos if gone else ():
        own = [f"{MASKS}/{name}" for name in mask_names(photo)[0]]
        if any(stamps.is_asked_for(name) for name in own):
            replaced.update(set(own) & set(gone))
    for name in replaced:
        (capture / name).replace(capture / f"{name}.old")
    gone = [name for name in gone if name not in replaced]
    if gone:
        count = "a mask" if len(gone) == 1 else f"{len(gone)} masks"
        reporter.warning(
            f"The original of {count} in {capture / MASKS} is gone, such as that of {Path(gone[0]).name}; delete the "
            "copies, too, if they are wrong."
        )


def _place_of_given(capture: Path, given: Path) -> Path:
    """Return where masks of the folder `given` belong: in masks/, unless others were made of them, whose IDs differ."""
    return capture / MASKS if has_ids_of(capture / MASKS, given) else kept_masks(capture)


def _corrected(names: Mapping[str, str], place: Path) -> set[str]:
    """Return the photos that have a mask in a folder where masks were made; names: of the photos in the capture."""
    files = Files(place)
    return {photo for photo, name in names.items() if _first(files, name)} if is_made(place) else set()


def _first(masks: Files, name: str) -> Path | None:
    """Return the mask of a photo, or None."""
    return masks.first(mask_names(name)[0])


def _is_missing(target: Path, path: Path, capture: Path, stamps: Stamps) -> bool:
    """Return whether a mask or list of names is not in the capture, or is one of an earlier state of the given file.

    Masks that were made there of others are not replaced.
    """
    has_changed = stamps.has_changed((Path("..") / target.relative_to(capture)).as_posix(), path)
    return not target.exists() or (has_changed and not is_made(capture / MASKS))


def write_object_masks(capture: Path, names: Sequence[str], folder: Path, reporter: Reporter) -> None:
    """Write for each photo of a capture where features may be: on objects, or everywhere without a mask.

    If a mask is another than before, the features on objects are forgotten.

    Args:
        capture: the capture, with masks/.
        names: the photos.
        folder: receives NAME.png, black where there is no object.
        reporter: receives a warning if many photos have no mask.

    Raises:
        InputError: No photo has a mask, one cannot be read, or the finished capture could not be.
    """
    found: dict[str, Path] = {}
    for masks in (Files(kept_masks(capture)), Files(capture / MASKS)):
        found |= {name: path for name in names if (path := _first(masks, name))}
    if not found:
        raise InputError(f"{capture / MASKS} has no mask of any photo; add masks, or use features everywhere.")
    _require_readable(capture, names)
    unmasked = [name for name in names if name not in found]
    if 2 * len(unmasked) > len(names) and not is_made(capture / MASKS):
        # Those without a mask may get no pose, and then do not count.
        reporter.warning(
            f"{len(unmasked)} of {len(names)} photos have no mask, for instance {unmasked[0]}; the capture cannot be "
            "used if that holds for more than half of those with a pose."
        )
    for name in names:
        size = image_size(capture / IMAGES / name)
        ids = read_mask(found[name]) if name in found else np.ones((1, 1), np.uint8)
        if name in found and not same_shape(ids.shape[::-1], size):
            raise InputError(
                f"{found[name]} is {ids.shape[1]}x{ids.shape[0]} pixels, but the photo {name} is {size[0]}x{size[1]}; "
                "make the mask the photo's size."
            )
        # COLMAP looks features up in it by the pixels of the photo.
        shown = Image.fromarray((ids > 0).astype(np.uint8) * 255)
        buffer = io.BytesIO()
        (shown if shown.size == size else shown.resize(size, Image.Resampling.NEAREST)).save(
            buffer, "PNG", compress_level=1
        )
        target = folder / f"{name}.png"
        if target.exists():
            if target.read_bytes() == buffer.getvalue():
                continue
            database.remove_on_objects(capture / WORK)
        make_folder(target.parent)
        write_atomic(target, buffer.getvalue())


def _require_readable(capture: Path, names: Sequence[str]) -> None:
    """Raise InputError for what would only be refused after hours, when the finished capture is read."""
    read_names(capture)
    unknown = [name for name in read_held_out(capture) or () if name not in names]
    if unknown:
        raise InputError(
            f"{capture / HELD_OUT} names {unknown[0][:200]}, which is no photo in {capture / IMAGES}; correct the name "
            "or remove its line."
        )
