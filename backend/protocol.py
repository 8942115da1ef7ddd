"""What the compute process and its callers agree on: the reconstruction folder, events and errors.

Standard library and NumPy only, so that Blender's own Python can import it.
"""

from __future__ import annotations

import json
import math
import os
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, TextIO

import numpy as np

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
        self.plan = self.folder / "plan.json"
        self.cameras = self.folder / "cameras.json"
        self.points = self.folder / "points.ply"
        self.checkpoint = self.folder / "checkpoint"
        self.splats = self.folder / "splats.ply"
        self.anchors = self.folder / "anchors.ply"
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


@contextmanager
def atomic_path(path: Path, part: Path) -> Iterator[Path]:
    """`part`, beside `path`, for what writes files by itself; synced and renamed at the end, so that `path` is old or
    new, never half.

    An OSError names `path`, also where the system names nothing (a full disk).
    """
    try:
        yield part
        with open(part, "rb+") as file:
            os.fsync(file.fileno())
        os.replace(part, path)
    except BaseException as error:
        part.unlink(missing_ok=True)
        if isinstance(error, OSError):
            error.filename = str(path)
        raise


@contextmanager
def atomic_file(path: Path) -> Iterator[BinaryIO]:
    """A file to write to, which becomes `path` as with `atomic_path`."""
    with atomic_path(path, path.with_name(path.name + ".part")) as part, open(part, "wb") as file:
        yield file


def write_atomic(path: Path, data: bytes) -> None:
    """Write `data` to `path` as `atomic_file` does."""
    with atomic_file(path) as file:
        file.write(data)


def plain(value: Any, where: str = "value") -> Any:
    """NumPy numbers, paths and tuples as what JSON knows; NaN and infinity as None. Raises ValueError for the rest."""
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, np.generic | np.ndarray):
        return plain(value.tolist(), where)
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, Mapping):
        return {str(key): plain(entry, f"{where}.{key}") for key, entry in value.items()}
    if isinstance(value, Sequence):
        return [plain(entry, f"{where}[{i}]") for i, entry in enumerate(value)]
    raise ValueError(f"{where} is a {type(value).__name__}, which JSON cannot hold")


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
        raise InputError(
            f"{path} cannot be read as JSON ({error}); repair it, or delete it and run the step that makes it."
        ) from error


class Reporter:
    """Takes a command's events; this base class drops them (for tests and library use).

    status(message): what is being done now. progress(done, total, ...): any extra fields as keywords,
    `seconds_left` among them. preview(path): a picture was written. quality(**figures): what was measured on held-out
    views, and when: seconds and step of the training, psnr, miou, mbiou. warning(message). A command ends with one of
    done(**fields), stopped(message) where the user asked for it, and error(message).
    """

    def status(self, message: str) -> None: ...

    def progress(self, done: float, total: float, **fields: Any) -> None: ...

    def preview(self, path: Path, **fields: Any) -> None: ...

    def quality(self, **figures: Any) -> None: ...

    def warning(self, message: str) -> None: ...

    def error(self, message: str) -> None: ...

    def stopped(self, message: str) -> None: ...

    def done(self, **fields: Any) -> None: ...

    def close(self) -> None: ...


class JsonReporter(Reporter):
    """Writes each event as one JSON object a line."""

    def __init__(self, stream: TextIO | None = None) -> None:
        self.stream = stream or sys.stdout

    def _emit(self, type: str, **fields: Any) -> None:
        event = {"type": type, "time": round(time.time(), 3), **fields}
        self.stream.write(json.dumps(plain(event), ensure_ascii=False, allow_nan=False) + "\n")
        self.stream.flush()

    def status(self, message: str) -> None:
        self._emit("status", message=message)

    def progress(self, done: float, total: float, **fields: Any) -> None:
        self._emit("progress", done=done, total=total, **fields)

    def preview(self, path: Path, **fields: Any) -> None:
        self._emit("preview", path=str(path), **fields)

    def quality(self, **figures: Any) -> None:
        self._emit("quality", **figures)

    def warning(self, message: str) -> None:
        self._emit("warning", message=message)

    def error(self, message: str) -> None:
        self._emit("error", message=message)

    def stopped(self, message: str) -> None:
        self._emit("done", stopped=True, message=message)

    def done(self, **fields: Any) -> None:
        self._emit("done", **fields)
