"""Events that a command reports while it runs, and their output as JSON lines."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any, TextIO

from .formats.json_file import plain


class Reporter:
    """Receiver of a command's events; this base class discards them (for tests and library use).

    status(message): the current activity. progress(done, total, ...): extra fields such as `seconds_left` as keywords.
    preview(path): an image was written. quality(**figures): metrics on held-out views (psnr, miou, miou_all, mbiou),
    with the seconds and the step of the training, and `zero_is_background`, which decides between miou and miou_all as
    in `lead_miou`. warning(message). A command ends with one of done(**fields), stopped(message)
    if the user stopped it, and error(message).
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
    """Writes each event as one JSON object per line."""

    def __init__(self, stream: TextIO | None = None) -> None:
        self.stream = stream or sys.stdout

    def _emit(self, type: str, **fields: Any) -> None:
        event = {"type": type, "time": round(time.time(), 3), **fields}
        # ASCII, whatever the encoding of the stream; names of files may contain lone surrogates.
        self.stream.write(json.dumps(plain(event), allow_nan=False) + "\n")
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
