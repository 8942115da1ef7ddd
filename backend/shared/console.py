"""Output of a command's events to a terminal."""

from __future__ import annotations

import contextlib
import shutil
import sys
import threading
import time
from pathlib import Path
from typing import Any, TextIO

from .durations import counted_down, time_left
from .events import Reporter
from .reconstruction.report import MIOU_LABELS, lead_miou

SECONDS_BETWEEN_LINES = 5.0
SECONDS_BETWEEN_REDRAWS = 0.1
SECONDS_BETWEEN_COUNTS = 1.0
"""Between two redraws of a bar without an event."""
BAR_COLUMNS = 30


def _figures(fields: dict[str, Any]) -> list[str]:
    """Format the known figures among an event's fields, with units, in a fixed order; of the mIoUs, the leading one."""
    lead = lead_miou(fields, fields.get("zero_is_background") is True)
    formats = {
        "loss": "loss {:.4f}",
        "splats": "{:,.0f} splats",
        "psnr": "PSNR {:.1f} dB",
        "ssim": "SSIM {:.3f}",
        lead: MIOU_LABELS[lead] + " {:.3f}",
        "mbiou": "mBIoU {:.3f}",
    }
    return [text.format(fields[name]) for name, text in formats.items() if isinstance(fields.get(name), int | float)]


def _block(stream: TextIO) -> str:
    """Return the character that fills the bar, or # if the stream's encoding does not have it."""
    try:
        "█".encode(stream.encoding or "utf-8")
    except (UnicodeEncodeError, LookupError):
        return "#"
    return "█"


class ConsoleReporter(Reporter):
    """Prints a progress bar with the remaining time on a terminal, otherwise plain lines, at most one every 5 seconds.

    Progress, status and results go to `stream` (stdout), warnings and errors to `errors` (stderr).
    """

    def __init__(self, stream: TextIO | None = None, errors: TextIO | None = None) -> None:
        self.stream = stream or sys.stdout
        self.errors = errors or sys.stderr
        self.on_terminal = self.stream.isatty()
        self._bar = ""
        """The progress bar on screen; empty if there is none."""
        self._done = 0.0
        self._left: float | None = None
        self._lock = threading.RLock()
        self._ended = threading.Event()
        self._last_line = -SECONDS_BETWEEN_LINES
        self._kept: dict[str, Any] = {}
        self._preview_folder: Path | None = None

    def status(self, message: str, **_stage: Any) -> None:
        """Print the current activity, to which the following progress belongs."""
        self.close()
        self._print(message, self.stream)

    def progress(self, done: float, total: float, **fields: Any) -> None:
        """Update the bar; figures that are not part of every event (psnr, miou) stay visible until they change."""
        self._kept.update({name: value for name, value in fields.items() if value is not None})
        now, finished = time.monotonic(), done >= total
        interval = SECONDS_BETWEEN_REDRAWS if self.on_terminal else SECONDS_BETWEEN_LINES
        if now - self._last_line < interval and not finished:
            return
        self._last_line = now
        self._done, self._left = done / total if total else 1.0, None if finished else fields.get("seconds_left")
        if self.on_terminal:
            self._draw_bar()
            if finished:
                self._end_bar()
        else:
            percentage = f"{100 * done / total:3.0f}%" if total else "    "
            self._print(f"  {percentage}  {self._text()}".rstrip(), self.stream)

    def preview(self, path: Path, **_fields: Any) -> None:
        """Print the folder of the preview images once instead of each image."""
        folder = Path(path).parent
        if folder != self._preview_folder:
            self._preview_folder = folder
            self._print(f"  previews in {folder}", self.stream)

    def warning(self, message: str) -> None:
        self._print(f"warning: {message}", self.errors)

    def error(self, message: str, **_fields: Any) -> None:
        self.close()
        self._print(f"error: {message}", self.errors)

    def stopped(self, message: str) -> None:
        """Print the message of a stopped command."""
        self.status(message)

    def done(self, **fields: Any) -> None:
        """Print the final figures, and text and path fields on lines of their own."""
        self.close()
        figures = _figures(fields)
        self._print("Done" + (f": {', '.join(figures)}" if figures else "."), self.stream)
        for name, value in fields.items():
            if isinstance(value, str | Path):
                self._print(f"  {name}: {value}", self.stream)

    def close(self) -> None:
        """End the bar, so that other text can follow; later progress starts a new one."""
        self._end_bar()
        self._last_line = -SECONDS_BETWEEN_LINES
        self._kept = {}

    def _text(self) -> str:
        """Return the time left, counted down since the last event, and the figures."""
        passed = time.monotonic() - self._last_line
        left = [] if self._left is None else [time_left(counted_down(self._left, passed))]
        return ", ".join(left + _figures(self._kept))

    def _draw_bar(self) -> None:
        """Draw the bar, at intervals also without an event, until it ends."""
        with self._lock:
            text = self._text()
            columns = shutil.get_terminal_size().columns - 1
            width = min(BAR_COLUMNS, max(5, columns - 11 - len(text)))
            filled = round(width * min(max(self._done, 0.0), 1.0))
            line = f"  {100 * self._done:3.0f}% |{(_block(self.stream) * filled).ljust(width)}| {text}"[:columns]
            # Spaces overwrite the rest of a longer previous line.
            self.stream.write("\r" + line.ljust(len(self._bar)))
            self.stream.flush()
            if not self._bar:
                self._ended = threading.Event()
                threading.Thread(target=self._redraw, args=(self._ended,), daemon=True).start()
            self._bar = line

    def _redraw(self, ended: threading.Event) -> None:
        """Count the time left down until the bar ends."""
        with contextlib.suppress(OSError, ValueError):  # The stream is closed.
            while not ended.wait(SECONDS_BETWEEN_COUNTS):
                with self._lock:
                    if not ended.is_set():
                        self._draw_bar()

    def _end_bar(self) -> None:
        """Keep the bar on screen and move to the next line."""
        with self._lock:
            if self._bar:
                self._ended.set()
                print(file=self.stream, flush=True)
                self._bar = ""

    def _print(self, text: str, stream: TextIO) -> None:
        """Print a line; a bar on screen is erased and redrawn below it."""
        with self._lock:
            if self._bar:
                self.stream.write("\r" + " " * len(self._bar) + "\r")
                self.stream.flush()
            print(text, file=stream, flush=True)
            if self._bar:
                self.stream.write(self._bar)
                self.stream.flush()
