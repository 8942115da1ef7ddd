"""Events of a command as a person in a terminal wants to see them."""

from __future__ import annotations

import shutil
import sys
import time
from pathlib import Path
from typing import Any, TextIO

from tqdm import tqdm

from .protocol import Reporter

SECONDS_BETWEEN_LINES = 5.0


def clock(seconds: float) -> str:
    """Seconds as m:ss, or h:mm:ss from an hour on."""
    whole = max(0, round(seconds))
    hours, minutes = divmod(whole // 60, 60)
    return f"{hours}:{minutes:02d}:{whole % 60:02d}" if hours else f"{minutes}:{whole % 60:02d}"


def _figures(fields: dict[str, Any]) -> list[str]:
    """The figures among an event's fields, with units, in a fixed order; what is None or unknown is left out."""
    formats = {
        "loss": "loss {:.4f}",
        "splats": "{:,.0f} splats",
        "psnr": "PSNR {:.1f} dB",
        "ssim": "SSIM {:.3f}",
        "miou": "mIoU {:.3f}",
        "mbiou": "mBIoU {:.3f}",
    }
    return [text.format(fields[name]) for name, text in formats.items() if isinstance(fields.get(name), int | float)]


class ConsoleReporter(Reporter):
    """A progress bar with time left where there is a terminal; elsewhere plain lines, at most one every 5 seconds.

    Progress, status and results go to `stream` (stdout), warnings and errors to `errors` (stderr).
    """

    def __init__(self, stream: TextIO | None = None, errors: TextIO | None = None) -> None:
        self.stream = stream or sys.stdout
        self.errors = errors or sys.stderr
        self.on_terminal = self.stream.isatty()
        self._bar: tqdm | None = None
        self._started = time.monotonic()
        self._last_line = -SECONDS_BETWEEN_LINES
        self._kept: dict[str, Any] = {}
        self._preview_folder: Path | None = None

    def status(self, message: str) -> None:
        """Say what is being done now; progress that follows belongs to it."""
        self.close()
        self._print(message, self.stream)

    def progress(self, done: float, total: float, **fields: Any) -> None:
        """Move the bar; figures that come only now and then (psnr, miou) stay on show until they change."""
        self._kept.update({name: value for name, value in fields.items() if value is not None})
        seconds_left = fields.get("seconds_left")
        if seconds_left is None and 0 < done <= total:
            seconds_left = (time.monotonic() - self._started) * (total - done) / done
        left = [] if seconds_left is None or done >= total else [f"{clock(seconds_left)} left"]
        text = ", ".join(left + _figures(self._kept))
        if self.on_terminal:
            self._move_bar(done, total, text)
            return
        now = time.monotonic()
        if now - self._last_line >= SECONDS_BETWEEN_LINES or done >= total:
            self._last_line = now
            share = f"{100 * done / total:3.0f}%" if total else "    "
            self._print(f"  {share}  {text}".rstrip(), self.stream)

    def _move_bar(self, done: float, total: float, text: str) -> None:
        if self._bar is not None and self._bar.total != total:
            self._close_bar()
        columns, rows = shutil.get_terminal_size()
        width = min(30, max(5, columns - 12 - len(text)))
        form = f"  {{percentage:3.0f}}% |{{bar:{width}}}| {{desc}}"
        if self._bar is None:
            self._bar = tqdm(desc=text, total=total, file=self.stream, leave=True, nrows=rows, bar_format=form)
        self._bar.ncols, self._bar.bar_format = columns - 1, form
        self._bar.set_description_str(text, refresh=False)
        self._bar.update(done - self._bar.n)
        if done >= total:
            self._close_bar()

    def preview(self, path: Path, **fields: Any) -> None:
        """Name the folder of the pictures, once; they come too often to name each."""
        folder = Path(path).parent
        if folder != self._preview_folder:
            self._preview_folder = folder
            self._print(f"  previews in {folder}", self.stream)

    def warning(self, message: str) -> None:
        self._print(f"warning: {message}", self.errors)

    def error(self, message: str) -> None:
        self.close()
        self._print(f"error: {message}", self.errors)

    def stopped(self, message: str) -> None:
        """Say that it was stopped, and what becomes of it."""
        self.status(message)

    def done(self, **fields: Any) -> None:
        """Close with the figures, and with every other field as a line of its own."""
        self.close()
        figures = _figures(fields)
        self._print("Done" + (f": {', '.join(figures)}" if figures else "."), self.stream)
        for name, value in fields.items():
            if isinstance(value, str | Path):
                self._print(f"  {name}: {value}", self.stream)

    def close(self) -> None:
        """End the bar, so that other text can follow; progress after this starts a new one."""
        self._close_bar()
        self._started = time.monotonic()
        self._last_line = -SECONDS_BETWEEN_LINES
        self._kept = {}

    def _close_bar(self) -> None:
        if self._bar is not None:
            self._bar.refresh()
            self._bar.close()
            self._bar = None

    def _print(self, text: str, stream: TextIO) -> None:
        if self._bar is not None:
            tqdm.write(text, file=stream)
        else:
            print(text, file=stream, flush=True)
