"""Runs backend commands in forks of one process that has imported the backend, so that they start in milliseconds.

    python -m tests.fuzz.server

Reads one JSON object a line from stdin, {"arguments": [...], "cwd": "...", "seconds": 60, "largest_file": null}, and
answers each with
{"code": 2, "out": "...", "err": "...", "seconds": 0.1, "peak_mb": 310.0, "ended": "exit" | "timeout" | "memory"}.
The code is negative if a signal ended the command.
"""

from __future__ import annotations

import importlib
import json
import os
import pkgutil
import resource
import signal
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

KILL_MB = 4000
"""Memory at which a command is ended, to protect the machine; the limit that is reported on is lower."""
_LONGEST = 200_000
"""Number of characters of a command's output that are kept."""
_PAGE = os.sysconf("SC_PAGE_SIZE")


def main() -> None:
    """Serve requests until stdin ends."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    import backend.cli.main

    for module in pkgutil.walk_packages(backend.__path__, "backend."):
        if not module.name.endswith("__main__"):
            importlib.import_module(module.name)
    for line in sys.stdin:
        answers.write(json.dumps(_run(**json.loads(line))) + "\n")
        answers.flush()


def _run(arguments: list[str], cwd: str, seconds: float, largest_file: int | None = None) -> dict[str, Any]:
    with _Output(largest_file is not None) as out, _Output(largest_file is not None) as err:
        began = time.monotonic()
        child = os.fork()
        if child == 0:
            if largest_file is not None:
                # Like a full disk, for which no privilege is needed: writing beyond this size fails.
                signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
                resource.setrlimit(resource.RLIMIT_FSIZE, (largest_file, largest_file))
            _command(arguments, cwd, out.descriptor, err.descriptor)
        status, peak_mb, ended = _wait(child, began + seconds)
        return {
            "code": os.waitstatus_to_exitcode(status),
            "out": out.text(),
            "err": err.text(),
            "seconds": round(time.monotonic() - began, 2),
            "peak_mb": round(peak_mb, 1),
            "ended": ended,
        }


class _Output:
    """Receives the output of a command: a file, or a pipe, which has no limit of file sizes but holds little."""

    def __init__(self, is_pipe: bool) -> None:
        if is_pipe:
            self._source, self.descriptor = os.pipe()
        else:
            self._source = self.descriptor = os.memfd_create("output") if hasattr(os, "memfd_create") else _nameless()

    def text(self) -> str:
        """Return what was written; call this once the command has ended."""
        if self._source == self.descriptor:
            os.lseek(self._source, 0, os.SEEK_SET)
        else:
            os.set_blocking(self._source, False)
        try:
            return os.read(self._source, _LONGEST).decode("utf-8", "backslashreplace")
        except BlockingIOError:
            return ""

    def __enter__(self) -> _Output:
        return self

    def __exit__(self, *_: object) -> None:
        for descriptor in {self._source, self.descriptor}:
            os.close(descriptor)


def _nameless() -> int:
    descriptor, name = tempfile.mkstemp()
    Path(name).unlink()
    return descriptor


def _command(arguments: list[str], cwd: str, out: int, err: int) -> None:
    """Run one command in this new process; does not return."""
    code = 1
    try:
        os.setsid()
        os.chdir(cwd)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        os.dup2(out, 1)
        os.dup2(err, 2)
        sys.stdout, sys.stderr = os.fdopen(1, "w", encoding="utf-8"), os.fdopen(2, "w", encoding="utf-8")
        from backend.cli.main import main as run

        code = run(arguments)
    except SystemExit as error:
        code = error.code if isinstance(error.code, int) else 0 if error.code is None else 1
    except BaseException:
        import traceback

        traceback.print_exc()
    finally:
        try:
            sys.stdout.flush()
            sys.stderr.flush()
        finally:
            os._exit(code)


def _wait(child: int, until: float) -> tuple[int, float, str]:
    """Wait for a process; returns its status, its largest memory in MB, and what ended it."""
    ended, pause, peak_mb = "exit", 0.002, 0.0
    while True:
        pid, status, usage = os.wait4(child, os.WNOHANG)
        if pid:
            return status, max(peak_mb, usage.ru_maxrss / (1e6 if sys.platform == "darwin" else 1e3)), ended
        peak_mb = max(peak_mb, _memory_mb(child))
        if ended == "exit" and (time.monotonic() > until or peak_mb > KILL_MB):
            ended = "memory" if peak_mb > KILL_MB else "timeout"
            os.kill(child, signal.SIGKILL)
        time.sleep(pause)
        pause = min(pause * 1.3, 0.05)


def _memory_mb(pid: int) -> float:
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * _PAGE / 1e6
    except (OSError, ValueError, IndexError):
        return 0.0  # Not Linux, or the process has ended.


if __name__ == "__main__":
    main()
