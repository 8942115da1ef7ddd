"""What the compute process and its callers agree on: the reconstruction folder, events and errors.

Standard library and NumPy only, so that Blender's own Python can import it.
"""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path
from typing import Any, TextIO

EXIT_DONE = 0
EXIT_FAILED = 1
EXIT_BAD_INPUT = 2
EXIT_CANCELLED = 130

HOLDOUT_EVERY = 8
"""Every 8th view by file name is held out of training and is the only one quality is measured on."""


class InputError(Exception):
    """What the user gave cannot be used; the message is one plain sentence that names the file."""


class Cancelled(Exception):
    """The user asked to stop; everything worth keeping is on disk."""


class Reconstruction:
    """Paths inside one reconstruction folder."""

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self.settings = self.folder / "objectgs.json"
        self.objects = self.folder / "objects.json"
        self.points = self.folder / "points.ply"
        self.checkpoint = self.folder / "checkpoint"
        self.splats = self.folder / "splats.ply"
        self.meshes = self.folder / "meshes"
        self.previews = self.folder / "previews"
        self.renders = self.folder / "renders"
        self.cache = self.folder / "cache"
        self.report_json = self.folder / "report.json"
        self.report_md = self.folder / "report.md"
        self.pictures = self.folder / "pictures"

    def create(self) -> Reconstruction:
        """Make the folder; raises InputError when it cannot be written to."""
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            probe = self.folder / f".write-test-{os.getpid()}"
            probe.write_bytes(b"")
            probe.unlink()
        except OSError as error:
            raise InputError(
                f"The folder {self.folder} cannot be written to ({error.strerror}); choose another with --out."
            ) from error
        return self


def write_atomic(path: Path, data: bytes) -> None:
    """Write `data` beside `path`, sync it, then rename, so that `path` is either old or new, never half."""
    part = path.with_name(path.name + ".part")
    try:
        with open(part, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise


def write_json(path: Path, value: Any) -> None:
    """Write `value` as JSON, atomically; NaN is refused, since readers of JSON cannot take it."""
    write_atomic(path, (json.dumps(value, indent=1, ensure_ascii=False, allow_nan=False) + "\n").encode())


def read_json(path: Path) -> Any:
    """Read JSON; raises InputError that names the file when it is missing or broken."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise InputError(f"{path} does not exist; run the step that makes it first.") from error
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read as JSON ({error}).") from error


class Reporter:
    """Takes a command's events; this base class drops them (for tests and library use).

    status(message): what is being done now. progress(done, total, ...): any extra fields as keywords,
    `seconds_left` among them. preview(path): a picture was written. warning(message). done(**fields).
    """

    def status(self, message: str) -> None: ...

    def progress(self, done: float, total: float, **fields: Any) -> None: ...

    def preview(self, path: Path, **fields: Any) -> None: ...

    def warning(self, message: str) -> None: ...

    def error(self, message: str) -> None: ...

    def done(self, **fields: Any) -> None: ...


class JsonReporter(Reporter):
    """Writes each event as one JSON object a line."""

    def __init__(self, stream: TextIO | None = None) -> None:
        self.stream = stream or sys.stdout

    def _emit(self, type: str, **fields: Any) -> None:
        event = {"type": type, "time": round(time.time(), 3), **fields}
        self.stream.write(json.dumps(event, ensure_ascii=False) + "\n")
        self.stream.flush()

    def status(self, message: str) -> None:
        self._emit("status", message=message)

    def progress(self, done: float, total: float, **fields: Any) -> None:
        self._emit("progress", done=done, total=total, **fields)

    def preview(self, path: Path, **fields: Any) -> None:
        self._emit("preview", path=str(path), **fields)

    def warning(self, message: str) -> None:
        self._emit("warning", message=message)

    def error(self, message: str) -> None:
        self._emit("error", message=message)

    def done(self, **fields: Any) -> None:
        self._emit("done", **fields)
