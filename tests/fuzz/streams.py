"""Output that cannot be written, and signals at any moment, imports included; with real processes."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from backend.shared.errors import EXIT_BAD_INPUT, EXIT_CANCELLED, EXIT_DONE, EXIT_FAILED

from .running import ROOT
from .templates import Templates

_BAD_SIGNS = ("Traceback", "Exception ignored", "Fatal Python error", "    @ ")
_SECONDS = 60


def run_streams(templates: Templates, folder: Path) -> tuple[int, list[str]]:
    """Run commands whose output is closed, full, of another encoding or a broken pipe; return their number, faults."""
    good = ["check", templates.captures[0]]
    bad = ["check", folder / "g\u00e4rten \U0001f33b"]
    cases = [
        (words, json, redirection)
        for words in (good, bad, ["--help"])
        for json in (False, True)
        for redirection in (">&-", "2>&-", ">&- 2>&-", "> /dev/full", "2> /dev/full", "> /dev/full 2>&1", "| true")
        if not (json and words == ["--help"])
    ]
    found = []
    for words, json, redirection in cases:
        result = _shell(words, json, redirection)
        failed = "/dev/full" in redirection and "2> " not in redirection
        expected = {EXIT_BAD_INPUT if words is bad else EXIT_DONE}
        if failed or redirection == "| true":
            expected |= {EXIT_FAILED, EXIT_CANCELLED}
        found += _judge(f"{words[0]}{' --json' * json} {redirection}", result, expected)
    for encoding in ("ascii", "latin-1", "cp1252", "utf-16"):
        result = _shell(bad, False, "", {"PYTHONIOENCODING": encoding})
        found += _judge(f"check with {encoding}", result, {EXIT_BAD_INPUT})
    return len(cases) + 4, found


def _shell(words: list[Any], json: bool, redirection: str, extra: dict[str, str] | None = None) -> Any:
    command = 'program=$1; shift; "$program" -m backend "$@" ' + redirection
    # The exit code of the first command of a pipe.
    script = f"set -o pipefail; {command}"
    return subprocess.run(
        ["bash", "-c", script, "bash", sys.executable, *map(str, words), *(["--json"] if json else [])],
        cwd=ROOT, capture_output=True, env={**os.environ, **(extra or {})}, timeout=_SECONDS, check=False,
    )  # fmt: skip


def run_signals(count: int, seed: int, templates: Templates) -> list[str]:
    """Send SIGINT or SIGTERM to commands at random moments; return a sentence for each fault."""
    rng = random.Random(seed)
    command = [sys.executable, "-m", "backend", "check", str(templates.captures[0])]
    began = time.monotonic()
    subprocess.run(command, cwd=ROOT, capture_output=True, check=True)
    longest = time.monotonic() - began
    found = []
    for _ in range(count):
        number, moment = rng.choice((signal.SIGINT, signal.SIGTERM)), rng.uniform(0.1, longest)
        with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
            time.sleep(moment)
            process.send_signal(number)
            out, err = process.communicate(timeout=_SECONDS)
        result = subprocess.CompletedProcess(command, process.returncode, out, err)
        # Before Python has read the first lines of the program, it handles signals itself.
        is_early = process.returncode in (-number, 130) and moment < 0.35
        if not is_early:
            found += _judge(f"{number.name} after {moment:.2f} s", result, {EXIT_CANCELLED, EXIT_DONE})
        if process.returncode == EXIT_DONE and b"Stopped" in out:
            found.append(f"{number.name} after {moment:.2f} s: stopped, but exit 0")
    return found


def _judge(what: str, result: Any, expected: set[int]) -> list[str]:
    text = (result.stdout + result.stderr).decode("utf-8", "replace")
    found = [f"{what}: {sign.strip()}" for sign in _BAD_SIGNS if sign in text]
    if result.returncode not in expected:
        found.append(f"{what}: exit {result.returncode}, expected {sorted(expected)}: {text[-300:]}")
    return found
