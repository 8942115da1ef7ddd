"""Photos and videos as the images/ of a new capture, grouped by the camera that took them."""

from __future__ import annotations

import os
import shutil
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from ...capture.files import Files, image_size, mask_names, mask_size, same_shape
from ...capture.mask_sources import MaskFiles
from ...shared.errors import Cancelled, InputError
from ...shared.formats.file_names import legible
from ...shared.formats.json_file import read_json, write_json
from ...shared.formats.photos_source import NOT_OF_USERS, PHOTOS, VIDEOS, WORK, natural_order
from ...shared.photos.source_files import folders_of_results
from ...shared.stopping import StoppingReporter
from .. import database
from . import photo_files, video
from .masks import copy_rest, warn_of_gone, write_masks
from .stamps import FILES, IMAGES, MASKS, Stamps

FRAMES = "frames.json"
"""File in sfm/ with the frames that were taken of each video."""
_READS_ALL_NAMES = os.name != "nt"
_LEAST_FREE = 1.2
"""Free space on the disk, relative to the size of the photos, below which they are not copied."""


class Photo(NamedTuple):
    """A photo of a capture.

    Attributes:
        name: path within images/, with slashes.
        camera: what photos of one camera with one focal length have in common.
        size: what photos of one size have in common.
    """

    name: str
    camera: str
    size: str


class Taken(NamedTuple):
    """The photos of a capture.

    Attributes:
        photos: in natural order of their names.
        unreadable: name -> reason for files that cannot be read.
        videos: the names of the frames of each video in their order, so that neighbors show the same.
    """

    photos: list[Photo]
    unreadable: dict[str, str]
    videos: list[list[str]]


def take_photos(
    sources: Sequence[Path],
    capture: Path,
    frames: int | None,
    reporter: StoppingReporter,
    lenses: Collection[tuple[int, int]] = (),
) -> Taken:
    """Copy photos and frames of videos to the images/ of a capture, unless they are there.

    Args:
        sources: a folder with photos and videos, also in subfolders or in its folder images/, and, optionally, masks/
            and files with names, which are copied, too, again if they have changed; or files of photos and videos.
            Photos named like another one with `_mask` are its masks. Masks that are JPEGs in black and white are
            written as PNG. If they are gone, the copies that the capture has are used.
        capture: the capture's folder.
        frames: wanted number of frames of each video; None: by its motion.
        reporter: receives progress and warnings.
        lenses: sizes (width, height) of the photos whose lenses are known, for which they are turned or not.

    Raises:
        InputError: There are fewer than two photos, or too little space on the disk.
    """
    from_copies = are_copied(sources, capture)
    if from_copies:
        sources = [capture / IMAGES]
    source = sources[0]
    if source.is_dir():
        base = source / IMAGES if (source / IMAGES).is_dir() else source
        found = _listed(base, source / MASKS, capture)
    else:
        given = [path.absolute() for path in sources]
        found = _without_doubles(given)
        if sum(path.suffix.lower() in PHOTOS for path in found) < 2:
            # A single photo beside a video of its name is no Live Photo.
            found = _in_order([*found, *(path for path in given if path.suffix.lower() in VIDEOS)])
        try:
            base = Path(os.path.commonpath([path.parent for path in found]))
        except ValueError as error:
            raise InputError(f"{found[0]} and {found[-1]} are on two disks; copy the photos to one folder.") from error
    found, unreadable = _with_legible_names(found, base)
    found, are_beside = _without_masks(found)
    is_alone = len(found) == 1 and not source.is_dir()
    in_place = base.resolve() == (capture / IMAGES).resolve()
    videos = [] if in_place else [path for path in found if path.suffix.lower() in VIDEOS]
    files = [path for path in found if path.suffix.lower() in PHOTOS]
    if len(files) < 2 and not videos:
        count = "only one photo" if files else "no photos"
        raise InputError(f"{base} contains {count}; poses need at least two photos of the same scene.")
    if not in_place:
        copies = ((path, capture / IMAGES / _readable(path.relative_to(base))) for path in files)
        _require_space([path for path, copy in copies if not _is_copied(copy)], capture)
    if len(files) > 1:
        reporter.status(f"Reading {len(files)} photos of {base}")
    has_masks = are_beside or (source / MASKS).is_dir()
    if has_masks:
        masks_there = Files(base if are_beside else source / MASKS)
        turn = _are_upright(files, lambda path: _mask_size(masks_there, path.relative_to(base), are_beside))
    elif lenses:
        turn = _are_upright(files, lambda path: _lens_size(lenses, image_size(path)))
    else:
        turn = True
    turn = turn and not in_place
    photos = []
    names: dict[str, str] = {}
    taken_names: set[str] = set()
    stamps = Stamps(capture)
    for number, path in enumerate(files):
        try:
            reporter.progress(number, len(files))
        except Cancelled:
            stamps.write()
            raise
        relative = path.relative_to(base)
        name = relative.as_posix()
        try:
            is_raw = path.suffix.lower() in photo_files.RAW
            camera = "" if is_raw else photo_files.camera_of(path, turn)
            if in_place and not photo_files.is_read_by_colmap(path):
                raise InputError(f"{path.name} would have to be converted; choose another folder as --out.")
            if (projection := photo_files.projection_of(path)) is not None:
                raise InputError(
                    f"{path.name} is {projection}, which no pinhole camera takes; cut it into perspective images first."
                )
            copy = _readable(relative)
            if copy != relative and (in_place or has_masks):
                raise InputError(f"{path.name} is a name that COLMAP cannot read on Windows; use plain letters.")
            if not in_place:
                copy = photo_files.path_of_copy(path, copy)
                if copy.as_posix() in taken_names:
                    raise InputError(f"{path.name} has the name of another photo once it is converted; rename it.")
                taken_names.add(copy.as_posix())
            is_changed = not from_copies and stamps.has_changed(name, path, turn)
            if is_changed:
                database.remove_all(capture / WORK)
            if not in_place:
                # Without a stamp, a copy is of an unknown state: the run that made it was killed.
                again = is_changed or not stamps.is_known(name)
                copied = photo_files.copy_photo(path, capture / IMAGES / copy, turn, again)
                relative = copied.relative_to(capture / IMAGES)
                if is_raw:
                    camera = photo_files.camera_of(copied, False)
            photos.append(Photo(relative.as_posix(), f"{Path(name).parent} {camera}", camera.split(" ")[0]))
            names[name] = relative.as_posix()
        except InputError as error:
            unreadable[name] = str(error)
    stamps.write()
    stems = Counter(_stem_in(base, path).casefold() for path in videos)
    filmed = []
    for path in videos:
        folder = "" if is_alone else _stem_in(base, path)
        if stems[folder.casefold()] > 1:
            folder = path.relative_to(base).as_posix()
        folder = _readable(Path(folder)).as_posix() if folder else ""
        try:
            taken = _frames_of(path, capture, folder, frames, reporter)
            own = [(Path(folder) / name).as_posix() for name in taken]
            photos += [
                Photo(name, f"video {folder}", "{}x{}".format(*image_size(capture / IMAGES / name))) for name in own
            ]
            filmed.append(own)
        except InputError as error:
            if is_alone:
                raise
            unreadable[path.relative_to(base).as_posix()] = str(error)
    if len(photos) < 2:
        why = next(iter(unreadable.values()), "a single photo has no pose.")
        raise InputError(f"Of the photos in {base}, {len(photos)} can be read; {why}")
    try:
        if source.is_dir() and (base != source or (source / MASKS).is_dir()):
            masks = MaskFiles(source / MASKS, names, base)
            if not in_place:
                copy_rest(source, masks, names, capture, stamps)
            write_masks(masks, source / MASKS, masks.lossy, names, capture, stamps)
        if are_beside:
            masks = MaskFiles(base, names, base)
            write_masks(masks, base, masks.photos, names, capture, stamps)
    except InputError:
        # Of the masks before the one that cannot be read.
        stamps.write()
        raise
    if not from_copies and not in_place:
        warn_of_gone(names.values(), capture, stamps, reporter)
    stamps.write()
    return Taken(photos, unreadable, filmed)


def are_copied(sources: Sequence[Path], capture: Path) -> bool:
    """Return whether photos or videos are gone whose copies or frames an earlier run has put into a capture."""
    return (capture / WORK / FILES).is_file() and not all(path.exists() for path in sources)


def _stem_in(base: Path, path: Path) -> str:
    """Return the path of a file from a folder on, without its suffix."""
    return path.relative_to(base).with_suffix("").as_posix()


def _readable(relative: Path) -> Path:
    """Return the path of a copy in images/ that COLMAP can open: on Windows, it reads names in plain letters only."""
    if _READS_ALL_NAMES or str(relative).isascii():
        return relative
    letters = (c if c.isascii() else f"u{ord(c):x}" for c in relative.as_posix())
    return Path("".join(letters))


def _without_masks(paths: Sequence[Path]) -> tuple[list[Path], bool]:
    """Return the photos and videos without those that are masks of others beside them, and whether there are masks."""
    known = {path.as_posix().casefold() for path in paths}
    candidates = (name.casefold() for path in paths for names in mask_names(path.as_posix(), True) for name in names)
    masks = known & set(candidates)
    return [path for path in paths if path.as_posix().casefold() not in masks], bool(masks)


def _are_upright(photos: Sequence[Path], size_for: Callable[[Path], tuple[int, int] | None]) -> bool:
    """Return whether photos are to be turned as their EXIF orientation says.

    The first one that is turned by a right angle, and for which a size is known, decides.

    Args:
        photos: the photos.
        size_for: returns the width and height that a photo must have, up to a factor; None if it does not matter.
    """
    for path in photos:
        with suppress(InputError):
            if photo_files.is_turned_by_right_angle(path) and (wanted := size_for(path)) is not None:
                size = image_size(path)
                return not same_shape(wanted, size) and same_shape(wanted, size[::-1])
    return False


def _mask_size(masks: Files, photo: Path, are_beside: bool) -> tuple[int, int] | None:
    """Return the size of a photo's mask, None without one."""
    accepted, lossy = mask_names(photo.as_posix(), are_beside)
    found = masks.first(accepted) or masks.first(lossy)
    return None if found is None else mask_size(found)


def _lens_size(lenses: Collection[tuple[int, int]], size: tuple[int, int]) -> tuple[int, int] | None:
    """Return the size of the lens that fits a photo as it is stored, or else turned; None without one."""
    return next((each for each in (size, size[::-1]) if each in lenses), None)


def _frames_of(path: Path, capture: Path, folder: str, count: int | None, reporter: StoppingReporter) -> list[str]:
    """Take the frames of a video, unless that was done, and return their names in a folder of images/."""
    listed = capture / WORK / FRAMES
    known = read_json(listed) if listed.exists() else {}
    status = path.stat()
    asked = {"file": str(path.resolve()), "bytes": status.st_size, "modified": status.st_mtime_ns, "frames": count}
    entry = known.get(folder, {})
    names = entry.get("names") if all(entry.get(key) == value for key, value in asked.items()) else None
    if entry and any(entry.get(key) != asked[key] for key in ("bytes", "modified")):
        # Frames of another video have the same names, whose features would be kept.
        database.remove_all(capture / WORK)
        for name in entry.get("names", []):
            (capture / IMAGES / folder / name).unlink(missing_ok=True)
        write_json(listed, {name: other for name, other in known.items() if name != folder})
        entry = {}
    before = [capture / IMAGES / folder / name for name in entry.get("names", [])]
    if names is None or not all((capture / IMAGES / folder / name).is_file() for name in names):
        reporter.status(f"Choosing frames of {path.name}")
        names = video.write_frames(path, capture / IMAGES / folder, count, reporter)
        for old in before:
            if old.name not in names:
                old.unlink(missing_ok=True)
        write_json(listed, {**known, folder: {**asked, "names": names}})
    return names


def _listed(base: Path, masks: Path, capture: Path) -> list[Path]:
    """Return the photos and videos below a folder, as from `_without_doubles`, but for those in results.

    Args:
        base: the folder.
        masks: folder of their masks, which may be in it.
        capture: the capture, which may be in it, as may be earlier ones and reconstructions.
    """
    try:
        inside = capture.resolve()
        paths = list(base.rglob("*"))
        left_out = {masks, *folders_of_results(paths, base)}
        return _without_doubles(
            path
            for path in paths
            if path.suffix.lower() in PHOTOS | VIDEOS
            and not any(part.startswith(NOT_OF_USERS) for part in path.relative_to(base).parts)
            and path.is_file()
            and left_out.isdisjoint(path.parents)
            and (base.resolve().is_relative_to(inside) or not path.resolve().is_relative_to(inside))
        )
    except OSError as error:
        raise InputError(f"{error.filename or base} cannot be read ({error.strerror}); check it.") from error


def _with_legible_names(paths: Sequence[Path], base: Path) -> tuple[list[Path], dict[str, str]]:
    """Return the files whose names are text, and why others cannot be read, which Linux allows."""
    names = {path: path.relative_to(base).as_posix() for path in paths}
    return [path for path in paths if legible(names[path]) == names[path]], {
        shown: f"{shown} is a name that is not text in UTF-8; rename it."
        for name in names.values()
        if (shown := legible(name)) != name
    }


def _without_doubles(found: Iterable[Path]) -> list[Path]:
    """Return photos and videos in natural order, without what shows the same as another.

    Of a raw or HEIC photo beside its JPEG, the latter is taken, of a raw photo beside its HEIC, that, of two raw ones
    the DNG, and of a Live Photo the photo alone.
    """
    paths = set(found)
    copied = {path.with_suffix("") for path in paths if path.suffix.lower() in photo_files.COPIED}
    developed = {path.with_suffix("") for path in paths if path.suffix.lower() in PHOTOS - photo_files.RAW}
    photos = {path.with_suffix("") for path in paths if path.suffix.lower() in PHOTOS}
    converted = {path.with_suffix("") for path in paths if path.suffix.lower() == ".dng"}

    def is_double(path: Path) -> bool:
        suffix = path.suffix.lower()
        if suffix in photo_files.RAW and suffix != ".dng" and path.with_suffix("") in converted:
            return True
        others = photos if suffix in VIDEOS else developed if suffix in photo_files.RAW else copied
        return suffix not in photo_files.COPIED and path.with_suffix("") in others

    return _in_order(path for path in paths if not is_double(path))


def _in_order(paths: Iterable[Path]) -> list[Path]:
    return sorted(set(paths), key=lambda path: natural_order(path.as_posix()))


def _is_copied(copy: Path) -> bool:
    return any(copy.with_suffix(suffix).exists() for suffix in (copy.suffix, ".jpg", ".png"))


def _require_space(paths: Sequence[Path], capture: Path) -> None:
    needed = sum(path.stat().st_size for path in paths)
    existing = next(folder for folder in (capture, *capture.absolute().parents) if folder.exists())
    free = shutil.disk_usage(existing).free
    if free < _LEAST_FREE * needed:
        raise InputError(
            f"The photos need {needed / 1e9:.1f} GB and the disk of {existing} has {free / 1e9:.1f} GB free; make "
            "room, or choose another --out."
        )
