# SPDX-License-Identifier: GPL-3.0-or-later
"""A command of the backend as a child process: JSON lines come out, single words go in, and nothing here ever waits.

Standard library alone, no bpy: the same class serves a window's timer and a blocking run.
"""

from __future__ import annotations

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
from typing import Any, BinaryIO

LOG_LINES = 40
"""How many of the last lines that are no events are kept, for the report of a crash."""

_LINE_BYTES = 1 << 20
_LOG_CHARACTERS = 500
_WAITING_EVENTS = 1000
_EVENTS_A_POLL = 200
_PIPES_STAY_OPEN = 2.0
"""Seconds that the pipes may stay open after the process ended: a process of its own may have inherited them."""
_NICENESS = 10


def backend_command(python: str | Path, *arguments: str | Path) -> list[str]:
    """The command line of the backend's command `arguments`, with JSON events; it runs in the folder of backend/."""
    return [str(python), "-m", "backend", *map(str, arguments), "--json"]


def backend_environment(cache_folder: str | Path) -> dict[str, str]:
    """Extra variables for the backend; compiled kernels go to `cache_folder`, which updates of the extension keep."""
    return {"NUMBA_CACHE_DIR": str(cache_folder), "PYTHONUTF8": "1", "PYTHONFAULTHANDLER": "1"}


def child_environment(extra: Mapping[str, str]) -> dict[str, str]:
    """This process's variables without those that steer its own Python (home, paths, options), and `extra`."""
    kept = {
        name: value for name, value in os.environ.items()
        if not name.upper().startswith("PYTHON") and name != "__PYVENV_LAUNCHER__"
    }
    return {**kept, **extra}


class BackendProcess:
    """One child process, in a process group of its own and with lower priority.

    The first line that it gets is `attached`: from then on the end of its input means that nobody drives it any more.
    in_background: give way to everything else on this machine, so that a window stays responsive. Raises OSError where
    it cannot be started.
    """

    def __init__(self, command: Sequence[str], cwd: str | Path, environment: Mapping[str, str] | None = None,
                 in_background: bool = True) -> None:
        _ignore_broken_pipes()
        self._events: queue.Queue[dict[str, Any]] = queue.Queue(_WAITING_EVENTS)
        self._log: deque[str] = deque(maxlen=LOG_LINES)
        self._ended_at: float | None = None
        # A process group, so that Ctrl-C in Blender's terminal reaches Blender alone. No session of its own: Linux
        # would then share the processor between the two sessions and not heed the lower priority.
        if sys.platform == "win32":
            apart: dict[str, Any] = {
                "creationflags": subprocess.CREATE_NO_WINDOW
                | subprocess.CREATE_NEW_PROCESS_GROUP
                | (subprocess.BELOW_NORMAL_PRIORITY_CLASS if in_background else 0)
            }
        else:
            apart = {"process_group": 0}
        self._process = subprocess.Popen(
            list(command), cwd=cwd, env=child_environment(environment or {}), bufsize=0,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, **apart)
        if in_background:
            self._give_way()
        self._readers = [
            threading.Thread(target=self._read, args=(stream,), daemon=True)
            for stream in (self._process.stdout, self._process.stderr)
        ]
        for reader in self._readers:
            reader.start()
        self.send("attached")

    def _give_way(self) -> None:
        """Let the child run when nothing else wants the processor, or seldom, as far as the system knows how to."""
        try:
            if hasattr(os, "SCHED_IDLE"):
                os.sched_setscheduler(self.pid, os.SCHED_IDLE, os.sched_param(0))
            elif sys.platform != "win32":
                os.setpriority(os.PRIO_PROCESS, self.pid, _NICENESS)
        except OSError:
            pass  # It has ended already, or the system forbids it: then it runs as it is.

    @property
    def pid(self) -> int:
        """The child's process ID."""
        return self._process.pid

    @property
    def log(self) -> list[str]:
        """The last lines, oldest first, that the child wrote to either pipe and that are no events."""
        return list(self._log)

    def send(self, line: str) -> bool:
        """Write a line to the child; False where it listens no more."""
        try:
            self._process.stdin.write(line.encode() + b"\n")
        except (OSError, ValueError):
            return False
        return True

    def stop(self) -> bool:
        """Ask the child to save and end."""
        return self.send("stop")

    def kill(self) -> None:
        """End the child and its own children at once; harmless where it has ended."""
        if self._process.poll() is not None:
            return
        try:
            if sys.platform == "win32":
                # Windows knows no groups to end; the parent goes with its tree, or alone where that fails.
                subprocess.run(["taskkill", "/F", "/T", "/PID", str(self.pid)], capture_output=True, timeout=5,
                               creationflags=subprocess.CREATE_NO_WINDOW, check=False)
                self._process.kill()
            else:
                os.killpg(self.pid, signal.SIGKILL)
        except (OSError, subprocess.SubprocessError):
            self._process.kill()

    def poll(self) -> list[dict[str, Any]]:
        """The events that came since the last call, oldest first; at most some hundreds at a time. Never waits."""
        events = []
        while len(events) < _EVENTS_A_POLL:
            try:
                events.append(self._events.get_nowait())
            except queue.Empty:
                break
        return events

    @property
    def exit_code(self) -> int | None:
        """The child's exit code once it has ended and `poll` has handed out all it said; negative for a signal."""
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
        self._process.stdin.close()
        return code

    def _read(self, stream: BinaryIO) -> None:
        """Sort what comes out of a pipe; a full queue holds the child up, so that no flood fills the memory."""
        with io.BufferedReader(stream) as lines:
            while line := lines.readline(_LINE_BYTES):
                event = _event(line) if stream is self._process.stdout else None
                if event is not None:
                    self._events.put(event)
                elif text := line.decode("utf-8", errors="replace").rstrip():
                    self._log.append(text[:_LOG_CHARACTERS])


def _ignore_broken_pipes() -> None:
    """Blender leaves SIGPIPE as the system has it: a word to a child that has just ended would end Blender too."""
    if hasattr(signal, "SIGPIPE") and threading.current_thread() is threading.main_thread():
        if signal.getsignal(signal.SIGPIPE) == signal.SIG_DFL:
            signal.signal(signal.SIGPIPE, signal.SIG_IGN)


def _event(line: bytes) -> dict[str, Any] | None:
    """A line as an event, or None where it is something else."""
    if not line.startswith(b"{"):
        return None
    try:
        event = json.loads(line)
    except ValueError:
        return None
    return event if isinstance(event, dict) and isinstance(event.get("type"), str) else None
