"""Which files a capture's photos, masks and names are copies of, to copy those again that have changed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path, PurePosixPath
from typing import Any

from ...shared.formats.atomic import make_folder
from ...shared.formats.json_file import read_json, write_json
from ...shared.formats.photos_source import WORK

IMAGES, MASKS = "images", "masks"
"""Folders of a capture."""
FILES = "photos.json"
"""File in sfm/ with the size and time of each file."""


class Stamps:
    """Size and time of the files that those of a capture were made of, kept in its sfm/."""

    def __init__(self, capture: Path) -> None:
        self._path = capture / WORK / FILES
        self._known: dict[str, list[Any] | None] = read_json(self._path) if self._path.exists() else {}
        self._now: dict[str, list[Any]] = {}

    def has_changed(self, name: str, path: Path, *details: Any) -> bool:
        """Return whether a file, or what else a copy of it depends on, is another than when it was last asked for."""
        status = path.stat()
        self._now[name] = [status.st_size, status.st_mtime_ns, *details]
        return name in self._known and self._known[name] != self._now[name]

    def is_known(self, name: str) -> bool:
        """Return whether a file was asked for in an earlier run, so that its copy is whole and of a known state."""
        return name in self._known

    def masks_not_asked_for(self) -> list[str]:
        """Return the paths in the capture of masks whose originals were not asked for, as they are gone."""
        gone = sorted(name for name in self._known.keys() - self._now.keys() if name.startswith(f"../{MASKS}/"))
        return [name.removeprefix("../") for name in gone if PurePosixPath(name).parts.count("..") == 1]

    def is_asked_for(self, name: str) -> bool:
        """Return whether the original of a path in the capture was asked for now."""
        return f"../{name}" in self._now

    def expect(self, copies: Iterable[Path]) -> None:
        """Write the file, so that after a kill before `write`, the copies that do not exist yet count as changed."""
        capture = self._path.parent.parent
        missing = ((Path("..") / copy.relative_to(capture)).as_posix() for copy in copies if not copy.exists())
        self._write({**self._known, **self._now, **dict.fromkeys(missing)})

    def write(self) -> None:
        """Write the file, with what was asked for now or earlier."""
        self._write({name: stamp for name, stamp in {**self._known, **self._now}.items() if stamp is not None})

    def _write(self, stamps: Mapping[str, list[Any] | None]) -> None:
        make_folder(self._path.parent)
        write_json(self._path, stamps)
