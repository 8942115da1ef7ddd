"""The files that the poses of a capture are computed from, and whether they have changed since."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from ..errors import InputError
from ..formats.json_file import read_json
from ..formats.photos_source import (
    FORMER,
    LISTS,
    NOT_OF_USERS,
    PHOTOS,
    REPORT,
    SOURCE,
    VIDEOS,
    WORK,
    PhotosSource,
    has_poses,
    read_source,
)
from ..formats.regular_file import is_folder
from ..reconstruction.folder import Reconstruction

_COUNTED = PHOTOS | VIDEOS | {".npy", ".npz"}
"""Suffixes of photos, videos and masks."""


def has_poses_of(capture: Path, wanted: PhotosSource) -> bool:
    """Return whether a capture has poses that were computed as wanted, of the same files.

    Photos to leave out, the set and the networks may be others. Poses of a run that was killed do not count.
    """
    stored = read_source(capture)
    if stored is None or not has_poses(capture) or is_folder(capture / WORK / FORMER):
        return False
    features = stored.features if wanted.features == "auto" else wanted.features
    own = replace(wanted, features=features, leave_out=stored.leave_out, set=stored.set, matcher=stored.matcher)
    if own != stored:
        return False
    report = capture / WORK / REPORT
    try:
        known, computed = read_json(report).get("files"), report.stat().st_mtime_ns
    except (InputError, AttributeError, OSError):
        return False
    found = _states(wanted, capture)
    if found is None:
        return False
    # Earlier versions wrote no hash.
    return all(changed <= computed for *_, changed in found) if known is None else known == _digest(found)


def digest_of_files(source: PhotosSource, capture: Path) -> str | None:
    """Return a hash of the names, sizes and times of the files that poses are computed from; None if some are gone.

    Args:
        source: the photos and videos, whose folder may have masks, captures and reconstructions in it.
        capture: the capture that is made of them; it may be their folder, of which only images/ counts then.
    """
    found = _states(source, capture)
    return None if found is None else _digest(found)


def folders_of_results(paths: Iterable[Path], top: Path) -> set[Path]:
    """Return the captures and reconstructions in the folder `top`, by all paths there; it is none of them itself."""
    settings = Reconstruction(top).settings.name
    found = set()
    for path in paths:
        if path.name == settings:
            found.add(path.parent)
        elif path.parts[-2:] == (WORK, SOURCE):
            found.add(path.parents[1])
    return {folder for folder in found if top in folder.parents}


def _digest(found: list[tuple[str, int, int]]) -> str:
    return hashlib.sha256(repr(found).encode()).hexdigest()[:16]


def _states(source: PhotosSource, capture: Path) -> list[tuple[str, int, int]] | None:
    """Return the names, sizes and times of the files that poses are computed from; None if some are gone."""
    lenses = source.calibration
    try:
        tops = [(top, [top] if top.is_file() else _files_of(top, capture)) for top in source.photos]
        if lenses is not None:
            tops.append((lenses, [lenses] if lenses.is_file() else sorted(lenses.glob("cameras.*"))))
        found = [
            (path.relative_to(top).as_posix(), status.st_size, status.st_mtime_ns)
            for top, paths in tops
            for path in paths
            for status in (path.stat(),)
        ]
    except OSError:
        return None
    return found if all(paths for _, paths in tops) else None


def _files_of(top: Path, capture: Path) -> list[Path]:
    """Return the photos, videos, masks and lists of names in a folder, but for those in captures and reconstructions.

    The lists are beside a folder of photos or of masks, since they are copied from there.
    """
    paths = list(top.rglob("*"))
    made = folders_of_results(paths, top)
    is_own = top.resolve() == capture.resolve()
    has_photos = (top / "images").is_dir()
    folders = ("images",) if is_own else ("images", "masks") if has_photos else None
    has_lists = not is_own and (has_photos or (top / "masks").is_dir())

    def counts(path: Path) -> bool:
        parts = path.relative_to(top).parts
        if has_lists and len(parts) == 1 and LISTS.fullmatch(path.name):
            return path.is_file()
        return (
            path.suffix.lower() in _COUNTED
            and not any(part.startswith(NOT_OF_USERS) for part in parts)
            and (folders is None or parts[0] in folders)
            and made.isdisjoint(path.parents)
            and path.is_file()
        )

    return sorted(path for path in paths if counts(path))
