"""Paths of the files in a reconstruction folder."""

from __future__ import annotations

import errno
import os
from pathlib import Path

from ..errors import InputError
from ..formats.atomic import PART_PREFIX, PART_SUFFIX, make_folder
from . import cameras, lock, report

STROKES = "strokes.json"
"""Strokes on objects: of a reconstruction, and in the folder masks of a capture whose masks were made of them. Such
masks are those of training views alone."""

IGNORED = (lock.NAME, ".DS_Store", "Thumbs.db", "desktop.ini")
"""Files that a folder without content may contain."""


class Reconstruction:
    """Paths in a reconstruction folder."""

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self.settings = self.folder / "objectgs.json"
        self.objects = self.folder / "objects.json"
        self.plan = self.folder / "plan.json"
        self.cameras = self.folder / cameras.NAME
        self.points = self.folder / "points.ply"
        self.checkpoint = self.folder / "checkpoint"
        self.splats = self.folder / "splats.ply"
        self.strokes = self.folder / STROKES
        self.splat_edits = self.folder / "splat-edits.ply"
        self.anchors = self.folder / "anchors.ply"
        self.meshes = self.folder / "meshes"
        self.previews = self.folder / "previews"
        self.renders = self.folder / "renders"
        self.cache = self.folder / "cache"
        self.evaluation = self.folder / report.EVALUATION
        self.report_json = self.folder / report.REPORT
        self.report_md = self.folder / "report.md"
        self.pictures = self.folder / "pictures"
        self.cells = self.folder / "cells"
        self.built = self.folder / "built.json"

    def require_foreign(self, path: Path) -> None:
        """Raise InputError if `path` is a file of the reconstruction, or is in one of its folders."""
        target = path.resolve()
        for own in (self.folder / lock.NAME, *(own for own in vars(self).values() if own != self.folder)):
            is_same = own.exists() and path.exists() and own.samefile(path)
            if is_same or target == own.resolve() or own.resolve() in target.parents:
                raise InputError(f"{path} belongs to the reconstruction itself; choose another file or folder.")

    def foreign_file(self, capture: Path | None = None) -> str | None:
        """Return the name of a file in a folder that is not a reconstruction; None if commands may use the folder.

        Args:
            capture: The capture's folder, which may be in the reconstruction's.

        Raises:
            InputError: The folder cannot be read.
        """
        if not self.folder.is_dir() or self.settings.exists():
            return None
        try:
            names = sorted(entry.name for entry in os.scandir(self.folder))
        except OSError as error:
            raise InputError(f"The folder {self.folder} cannot be read ({error.strerror}).") from error
        ignored = set(IGNORED)
        if capture is not None and capture.resolve().is_relative_to(self.folder.resolve()):
            parts = capture.resolve().relative_to(self.folder.resolve()).parts
            own = {path.name for path in vars(self).values() if path != self.folder}
            ignored.update(set(parts[:1]) - own)
        return next((name for name in names if name not in ignored and not name.startswith(PART_PREFIX)), None)

    def require_own(self, capture: Path | None = None) -> None:
        """Raise InputError if the folder contains files, apart from those of `capture`, but no reconstruction."""
        foreign = self.foreign_file(capture)
        if foreign is not None:
            raise InputError(
                f"The folder {self.folder} contains files (such as {foreign}), but no reconstruction; choose an "
                "empty or new folder, or use the option --overwrite."
            )

    def create(self) -> Reconstruction:
        """Create the folder and return self; raise InputError if it is not writable."""
        try:
            make_folder(self.folder)
            if not self.folder.is_dir():
                raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR))
        except OSError as error:
            raise InputError(
                f"The folder {self.folder} cannot be written to ({error.strerror}); choose another with --out."
            ) from error
        require_writable(self.folder, "choose another with --out")
        return self

    def require_writable(self) -> None:
        """Raise InputError if the folder exists and cannot be written to, for commands that do so at their end."""
        if self.folder.is_dir():
            require_writable(self.folder, "check its permissions, or copy it to another place")


def require_writable(folder: Path, advice: str) -> None:
    """Raise InputError with `advice` if a folder, or the nearest existing one that it is in, cannot be written to."""
    folder = next((parent for parent in (folder, *folder.parents) if parent.is_dir()), folder)
    probe = folder / f"{PART_PREFIX}write-test-{os.getpid()}{PART_SUFFIX}"
    try:
        probe.write_bytes(b"")
        probe.unlink()
    except OSError as error:
        raise InputError(f"The folder {folder} cannot be written to ({error.strerror}); {advice}.") from error
