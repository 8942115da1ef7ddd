"""Output to a terminal and to a log file."""

from __future__ import annotations

import io
import re
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from backend.shared import console
from backend.shared.console import ConsoleReporter
from backend.shared.durations import clock, counted_down, time_left


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture
def now(monkeypatch):
    """A clock that the test sets."""
    seconds = [100.0]
    monkeypatch.setattr(console, "time", SimpleNamespace(monotonic=lambda: seconds[0]))
    return seconds


def reporter(stream=None):
    return ConsoleReporter(stream or io.StringIO(), io.StringIO())


def test_clock_formats_seconds():
    assert [clock(s) for s in (0, 9.4, 59.6, 754, 3600, 3725)] == [
        "0:00",
        "0:09",
        "1:00",
        "12:34",
        "1:00:00",
        "1:02:05",
    ]


def test_log_file_gets_few_plain_lines(now):
    out = reporter()
    out.status("Training")
    for i in range(1000):
        now[0] += 0.02
        out.progress(i + 1, 1000, loss=0.5, splats=12_345, seconds_left=90)
    out.done()
    text = out.stream.getvalue()
    lines = text.splitlines()
    assert "\r" not in text and "\x1b" not in text
    assert lines[0] == "Training" and lines[-1] == "Done."
    assert 4 <= len(lines) - 2 <= 6
    assert lines[1] == "    0%  1:30 left, loss 0.5000, 12,345 splats"
    assert lines[-2] == "  100%  loss 0.5000, 12,345 splats"


def test_time_left_is_not_shown_until_it_is_known(now):
    out = reporter()
    out.status("Evaluating")
    now[0] += 10
    out.progress(1, 4)
    assert out.stream.getvalue().splitlines()[-1] == "   25%"


def test_bar_counts_down_between_events(now, monkeypatch):
    monkeypatch.setattr(console, "SECONDS_BETWEEN_COUNTS", 0.01)
    out = reporter(Terminal())
    out.progress(1, 4, seconds_left=120)
    now[0] += 30
    deadline = time.monotonic() + 30
    while "1:30 left" not in out.stream.getvalue() and time.monotonic() < deadline:
        time.sleep(0.01)
    assert "2:00 left" in out.stream.getvalue() and "1:30 left" in out.stream.getvalue()
    out.close()
    ended = out.stream.getvalue()
    now[0] += 30
    time.sleep(0.05)
    assert out.stream.getvalue() == ended


def test_time_left_is_rounded_to_what_it_is_worth():
    assert [time_left(seconds) for seconds in (0, 59, 61, 352, 601, 1234, 3700, 8000)] == [
        "less than a minute", "less than a minute", "1:00 left", "5:45 left", "10:00 left", "21:00 left",
        "1:00:00 left", "2:15:00 left",
    ]  # fmt: skip
    assert [counted_down(100, passed) for passed in (0, 30, 80, 400)] == [100, 70, 20, 100]


def test_occasional_figures_stay_displayed(now):
    out = reporter()
    out.status("Training")
    for fields in ({"psnr": 30.04, "miou": 0.9}, {"psnr": None}, {"loss": 0.1}):
        now[0] += 6
        out.progress(1, 10, seconds_left=5, **fields)
    figures = "less than a minute, loss 0.1000, PSNR 30.0 dB, mIoU (labeled) 0.900"
    assert out.stream.getvalue().splitlines()[-1] == f"   10%  {figures}"
    out.status("Meshing")
    out.progress(1, 10, seconds_left=5)
    assert out.stream.getvalue().splitlines()[-1] == "   10%  less than a minute"


def test_warnings_and_errors_use_error_stream():
    out = reporter()
    out.warning("2 images have no pose.")
    out.error("a.png does not exist.")
    assert out.stream.getvalue() == ""
    assert out.errors.getvalue() == "warning: 2 images have no pose.\nerror: a.png does not exist.\n"


def test_done_lists_figures_and_files():
    out = reporter()
    out.done(psnr=31.24, miou=0.97, ssim=None, report=Path("out/report.md"))
    assert out.stream.getvalue().splitlines() == [
        "Done: PSNR 31.2 dB, mIoU (labeled) 0.970",
        f"  report: {Path('out/report.md')}",
    ]


def test_leading_miou_depends_on_meaning_of_zero():
    for background, shown in ((True, "mIoU (all) 0.950"), (False, "mIoU (labeled) 0.967")):
        out = reporter()
        out.done(miou=0.967, miou_all=0.95, zero_is_background=background)
        assert out.stream.getvalue() == f"Done: {shown}\n"


def test_preview_folder_is_printed_once():
    out = reporter()
    for i in range(5):
        out.preview(Path("out/previews") / f"{i}.png")
    assert out.stream.getvalue().splitlines() == [f"  previews in {Path('out/previews')}"]


def test_zero_total_is_handled():
    out = reporter()
    out.progress(0, 0)
    out.done()
    assert out.stream.getvalue().splitlines()[-1] == "Done."


def test_terminal_bar_fits_width(monkeypatch):
    monkeypatch.setenv("COLUMNS", "60")
    out = reporter(Terminal())
    out.status("Training")
    for i in range(5):
        out.progress(i, 4, loss=0.25, splats=1000, seconds_left=61 - i)
    out.warning("careful")
    out.done()
    text = out.stream.getvalue()
    drawn = text.replace("\n", "\r").split("\r")
    assert any(line.startswith("    0% |") and "1:00 left, loss 0.2500, 1,000 splats" in line for line in drawn)
    assert any(re.fullmatch(r"  100% \|[█#]+\| loss 0.2500, 1,000 splats *", line) for line in drawn)
    assert all(len(line) <= 60 for line in drawn)
    assert text.endswith("\nDone.\n")
    assert out.errors.getvalue() == "warning: careful\n"


def test_warning_starts_new_line_after_bar(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    stream = Terminal()
    out = ConsoleReporter(stream, stream)
    out.progress(1, 4)
    out.warning("careful")
    out.progress(4, 4)
    before = stream.getvalue().split("warning: careful\n")[0]
    assert before.endswith("\r") or before.endswith("\n")
