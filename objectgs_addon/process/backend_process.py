# SPDX-License-Identifier: GPL-3.0-or-later
"""Child process that runs a backend command.

It writes events as JSON lines and reads one word per line. No call blocks.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO, cast

LOG_LINES = 40
"""Number of most recent lines that are not events, kept to describe a crash."""

_LINE_BYTES = 1 << 20
_LOG_CHARACTERS = 500
_WAITING_EVENTS = 1000
_EVENTS_A_POLL = 200
_PIPES_STAY_OPEN = 2.0
"""Time in seconds to wait for the pipes to close after the process ends; its children may have inherited them."""
_NICENESS = 10


def backend_command(python: str | Path, *arguments: str | Path) -> list[str]:
    """Return the command line of a backend command with JSON events; run it in the folder that contains backend/."""
    return [str(python), "-m", "backend", *map(str, arguments), "--json"]


def backend_environment(cache_folder: str | Path) -> dict[str, str]:
    """Return additional environment variables for the backend.

    Args:
        cache_folder: folder for compiled kernels, which the backend creates and uses only if nobody else can write it;
            it should survive updates of the extension.
    """
    return {"NUMBA_CACHE_DIR": str(cache_folder), "PYTHONUTF8": "1", "PYTHONFAULTHANDLER": "1"}


def child_environment(extra: Mapping[str, str]) -> dict[str, str]:
    """Return the environment variables of this process, without those that configure its Python, plus `extra`."""
    kept = {
        name: value
        for name, value in os.environ.items()
        if not name.upper().startswith("PYTHON") and name != "__PYVENV_LAUNCHER__"
    }
    return {**kept, **extra}


class BackendProcess:
    """Child process in its own process group.

    Its first input line is `attached`; after that line, the end of its input means that its parent has ended.

    Args:
        command: program and arguments.
        cwd: working directory.
        environment: additional environment variables.
        in_background: run with lower priority, so that a window stays responsive.

    Raises:
        OSError: the program cannot be started.
    """

    def __init__(
        self,
        command: Sequence[str],
        cwd: str | Path,
        environment: Mapping[str, str] | None = None,
        in_background: bool = True,
    ) -> None:
        _ignore_broken_pipes()
        self._events: queue.Queue[dict[str, Any]] = queue.Queue(_WAITING_EVENTS)
        self._log: deque[str] = deque(maxlen=LOG_LINES)
        self._lines: list[tuple[bytes, bool]] = []
        self._lines_changed = threading.Condition()
        self._input_ends = False
        self._ended_at: float | None = None
        # With a separate process group, Ctrl-C in Blender's terminal reaches only Blender. A separate session would
        # also do that, but Linux divides CPU time equally between sessions and would ignore the lower priority.
        options: dict[str, Any]
        if sys.platform == "win32":
            options = {
                "creationflags": subprocess.CREATE_NO_WINDOW
                | subprocess.CREATE_NEW_PROCESS_GROUP
                | (subprocess.BELOW_NORMAL_PRIORITY_CLASS if in_background else 0)
            }
        else:
            options = {"process_group": 0}
        self._process: subprocess.Popen[bytes] = subprocess.Popen(
            list(command),
            cwd=cwd,
            env=child_environment(environment or {}),
            bufsize=0,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            **options,
        )
        self._input = cast(BinaryIO, self._process.stdin)
        if in_background:
            self._lower_priority()
        self._readers = [
            threading.Thread(target=self._read, args=(stream,), daemon=True)
            for stream in (self._process.stdout, self._process.stderr)
        ]
        for reader in self._readers:
            reader.start()
        threading.Thread(target=self._write, daemon=True).start()
        self.send("attached")

    def _lower_priority(self) -> None:
        """Give the child the lowest priority that the system supports."""
        try:
            if hasattr(os, "SCHED_IDLE"):
                os.sched_setscheduler(self.pid, os.SCHED_IDLE, os.sched_param(0))
            elif sys.platform != "win32":
                os.setpriority(os.PRIO_PROCESS, self.pid, _NICENESS)
        except OSError:
            pass  # The child has ended, or the system denies the change.

    @property
    def pid(self) -> int:
        """The child's process ID."""
        return self._process.pid

    @property
    def log(self) -> list[str]:
        """The most recent lines from both pipes that are not events, oldest first."""
        return list(self._log)

    def send(self, line: str, replaces: bool = False) -> bool:
        """Write a line to the child as soon as it can be written; return False if the child no longer reads its input.

        replaces: drop earlier lines of this kind that the child has not taken yet.
        """
        if self._process.poll() is not None:
            return False
        with self._lines_changed:
            if self._input_ends:
                return False
            if replaces:
                self._lines = [each for each in self._lines if not each[1]]
            self._lines.append((line.encode() + b"\n", replaces))
            self._lines_changed.notify()
        return True

    def _write(self) -> None:
        """Write the lines that are sent; in a thread of its own, since a child that computes may not read for long."""
        try:
            while True:
                with self._lines_changed:
                    self._lines_changed.wait_for(lambda: self._lines or self._input_ends)
                    if self._input_ends:
                        break
                    line, _ = self._lines.pop(0)
                self._input.write(line)
        except (OSError, ValueError):
            self._end_input()
        with contextlib.suppress(OSError):
            self._input.close()

    def _end_input(self) -> None:
        with self._lines_changed:
            self._input_ends = True
            self._lines_changed.notify()

    def stop(self) -> bool:
        """Request the child to save and end; return False if it no longer reads its input."""
        return self.send("stop")

    def kill(self) -> None:
        """End the child and its children immediately; do nothing if the child has ended."""
        self._end_input()
        if self._process.poll() is not None:
            return
        try:
            if sys.platform == "win32":
                # Windows has no process groups; end the process tree or, if that fails, the process alone.
                subprocess.run(
                    ["taskkill", "/F", "/T", "/PID", str(self.pid)],
                    capture_output=True,
                    timeout=5,
                    creationflags=subprocess.CREATE_NO_WINDOW,
                    check=False,
                )
                self._process.kill()
            else:
                os.killpg(self.pid, signal.SIGKILL)
        except (OSError, subprocess.SubprocessError):
            self._process.kill()

    def poll(self) -> list[dict[str, Any]]:
        """Return the events since the last call, oldest first, at most `_EVENTS_A_POLL`; do not block."""
        events: list[dict[str, Any]] = []
        while len(events) < _EVENTS_A_POLL:
            try:
                events.append(self._events.get_nowait())
            except queue.Empty:
                break
        return events

    @property
    def exit_code(self) -> int | None:
        """The child's exit code (negative for a signal), or None until `poll` has returned all events."""
        code = self._process.poll()
        if code is None:
            return None
        if self._ended_at is None:
            self._ended_at = time.monotonic()
        reading = any(reader.is_alive() for reader in self._readers)
        if reading and time.monotonic() - self._ended_at < _PIPES_STAY_OPEN:
            return None
        if not self._events.empty():
            return None
        self._end_input()
        return code

    def _read(self, stream: Any) -> None:
        """Sort the lines of a pipe into events and log; a full queue blocks the child, which limits memory use."""
        with io.BufferedReader(stream) as lines:
            while line := lines.readline(_LINE_BYTES):
                event = _event(line) if stream is self._process.stdout else None
                if event is not None:
                    self._events.put(event)
                elif text := line.decode("utf-8", errors="replace").rstrip():
                    self._log.append(text[:_LOG_CHARACTERS])


def _ignore_broken_pipes() -> None:
    """Ignore SIGPIPE, which by default ends Blender on a write to a child that has ended."""
    is_main = threading.current_thread() is threading.main_thread()
    if hasattr(signal, "SIGPIPE") and is_main and signal.getsignal(signal.SIGPIPE) == signal.SIG_DFL:
        signal.signal(signal.SIGPIPE, signal.SIG_IGN)


def _event(line: bytes) -> dict[str, Any] | None:
    """Parse a line as an event; return None if it is not one."""
    if not line.startswith(b"{"):
        return None
    try:
        event = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return event if isinstance(event, dict) and isinstance(event.get("type"), str) else None
