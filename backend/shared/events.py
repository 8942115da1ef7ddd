"""Events that a command reports while it runs, and their output as JSON lines."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TextIO

from .durations import Estimate, awake_seconds
from .formats.json_file import plain


class Reporter:
    """Receiver of a command's events; this base class discards them (for tests and library use).

    status(message): the current activity. progress(done, total, ...): extra fields such as `seconds_left` as keywords.
    preview(path): an image was written. quality(**figures): metrics on held-out views (psnr, miou, miou_all, mbiou),
    with the seconds and the step of the training, and `zero_is_background`, which decides between miou and miou_all as
    in `lead_miou`. warning(message). A command ends with one of done(**fields), stopped(message)
    if the user stopped it, and error(message).

    expect(parts): the parts of the command, as in `StagedReporter`. begin(part, message): a part begins, with its first
    status. Receivers that do not combine the progress of parts ignore the parts.
    """

    def expect(self, parts: Mapping[str, tuple[str, float]]) -> None: ...

    def begin(self, part: str, message: str) -> None:  # noqa: ARG002
        self.status(message)

    def status(self, message: str, **stage: Any) -> None: ...

    def progress(self, done: float, total: float, **fields: Any) -> None: ...

    def check(self) -> None:
        """Raise Cancelled if the user wants to stop; for work that has no progress to report."""

    def preview(self, path: Path, **fields: Any) -> None: ...

    def quality(self, **figures: Any) -> None: ...

    def answer(self, **fields: Any) -> None: ...

    def warning(self, message: str) -> None: ...

    def error(self, message: str, **fields: Any) -> None: ...

    def stopped(self, message: str) -> None: ...

    def done(self, **fields: Any) -> None: ...

    def close(self) -> None: ...


class StagedReporter(Reporter):
    """Combines the progress of a command's parts to that of the whole command, and forwards all events.

    The user sees stages, each of one or more parts. A command calls `expect` with part -> (stage, expected seconds), in
    the order in which they run, and `begin` for each part that takes place; the seconds of parts that have not begun
    may be corrected by another `expect`. Seconds that are a `Limit` are those of any computer. The progress of the
    command never decreases, and it stays below 1 until the command ends.

    Each status has the fields `stage`, `number` and `of`, if there are several stages. `seconds_left` of progress is
    the time left of the whole command as `Estimate` knows it, or None; a part may report its own.

    Args:
        reporter: Receives the events.
        clock: Returns a time in seconds that stands still while the command is paused.
    """

    def __init__(self, reporter: Reporter, clock: Callable[[], float] = awake_seconds) -> None:
        self._reporter = reporter
        self._stages: dict[str, str] = {}
        self._estimate = Estimate(clock)

    def expect(self, parts: Mapping[str, tuple[str, float]]) -> None:
        self._stages.update({part: stage for part, (stage, _) in parts.items()})
        self._estimate.expect({part: seconds for part, (_, seconds) in parts.items()})

    def begin(self, part: str, message: str) -> None:
        left = self._estimate.begin(part) if part in self._stages else None
        self.status(message)
        if part in self._stages:
            self._tell(left)

    def status(self, message: str, **stage: Any) -> None:
        names = list(dict.fromkeys(self._stages.values()))
        if self._estimate.part and len(names) > 1 and not stage:
            name = self._stages[self._estimate.part]
            stage = {"stage": name, "number": names.index(name) + 1, "of": len(names)}
        self._reporter.status(message, **stage)

    def progress(self, done: float, total: float, **fields: Any) -> None:
        if not self._estimate.part:
            self._reporter.progress(done, total, **fields)
            return
        fraction = min(max(done / total, 0.0), 1.0) if total > 0 else 0.0
        left = self._estimate.advance(fraction, fields.pop("seconds_left", None))
        self._tell(left, **fields)

    def _tell(self, left: float | None, **fields: Any) -> None:
        seconds_left = None if left is None else round(left, 1)
        self._reporter.progress(round(self._estimate.progress, 5), 1.0, seconds_left=seconds_left, **fields)

    def preview(self, path: Path, **fields: Any) -> None:
        self._reporter.preview(path, **fields)

    def quality(self, **figures: Any) -> None:
        self._reporter.quality(**figures)

    def answer(self, **fields: Any) -> None:
        self._reporter.answer(**fields)

    def warning(self, message: str) -> None:
        self._reporter.warning(message)

    def error(self, message: str, **fields: Any) -> None:
        self._reporter.error(message, **fields)

    def stopped(self, message: str) -> None:
        self._reporter.stopped(message)

    def done(self, **fields: Any) -> None:
        self._reporter.done(**fields)

    def close(self) -> None:
        self._reporter.close()


class JsonReporter(Reporter):
    """Writes each event as one JSON object per line."""

    def __init__(self, stream: TextIO | None = None) -> None:
        self.stream = stream or sys.stdout

    def _emit(self, type: str, **fields: Any) -> None:
        event = {"type": type, "time": round(time.time(), 3), **fields}
        # ASCII, whatever the encoding of the stream; names of files may contain lone surrogates.
        self.stream.write(json.dumps(plain(event), allow_nan=False) + "\n")
        self.stream.flush()

    def status(self, message: str, **stage: Any) -> None:
        self._emit("status", message=message, **stage)

    def progress(self, done: float, total: float, **fields: Any) -> None:
        self._emit("progress", done=done, total=total, **fields)

    def preview(self, path: Path, **fields: Any) -> None:
        self._emit("preview", path=str(path), **fields)

    def quality(self, **figures: Any) -> None:
        self._emit("quality", **figures)

    def answer(self, **fields: Any) -> None:
        self._emit("answer", **fields)

    def warning(self, message: str) -> None:
        self._emit("warning", message=message)

    def error(self, message: str, **fields: Any) -> None:
        self._emit("error", message=message, **fields)

    def stopped(self, message: str) -> None:
        self._emit("done", stopped=True, message=message)

    def done(self, **fields: Any) -> None:
        self._emit("done", **fields)
