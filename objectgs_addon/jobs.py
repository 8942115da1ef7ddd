# SPDX-License-Identifier: GPL-3.0-or-later
"""Jobs of the backend, one after another: what they do now, what they found, and why they failed.

No bpy. In a window a timer calls `JobQueue.poll`; without one `run_blocking` does.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

from ..backend.protocol import EXIT_BAD_INPUT, EXIT_CANCELLED, EXIT_DONE, EXIT_FAILED
from .backend_process import BackendProcess

GRACE_SECONDS = 10.0
"""How long a job that was told twice to stop may still take to save, counted from the first time."""

_WARNINGS = 50
_ESTIMATE_FROM = 0.02
_ESTIMATE_AFTER = 1.0
_SECONDS_BETWEEN_LINES = 5.0
_ENDING_SECONDS = 3.0


class State(StrEnum):
    """Where a job stands; DONE, STOPPED and FAILED are final."""

    WAITING = "waiting"
    RUNNING = "running"
    PAUSED = "paused"
    STOPPING = "stopping"
    DONE = "done"
    STOPPED = "stopped"
    FAILED = "failed"


FINISHED = (State.DONE, State.STOPPED, State.FAILED)


@dataclass(eq=False)
class Job:
    """One command of the backend, or another program that speaks as it does.

    title: what the user reads. kind: import, vote, train, mesh, evaluate, film, fill, demo, setup, doctor. folder: the
    reconstruction's, or None. environment: extra variables. if_silent: the sentence where the program ends without any
    event, which means that it is not what it was taken for.

    What comes after is live: progress 0..1, seconds_left where known or estimated, message (what it does now),
    warnings and error (sentences), the figures of the training, preview (the newest picture), curve (quality events:
    seconds, step, psnr, miou, mbiou), result (fields of the last event), exit_code, log (last lines that were no
    events).
    """

    title: str
    kind: str
    folder: Path | None
    command: list[str]
    cwd: Path
    environment: dict[str, str] = field(default_factory=dict)
    if_silent: str | None = None

    state: State = State.WAITING
    progress: float = 0.0
    seconds_left: float | None = None
    message: str = ""
    warnings: list[str] = field(default_factory=list)
    error: str | None = None
    step: int | None = None
    splats: int | None = None
    anchors: int | None = None
    psnr: float | None = None
    miou: float | None = None
    preview: Path | None = None
    curve: list[dict[str, Any]] = field(default_factory=list)
    result: dict[str, Any] = field(default_factory=dict)
    exit_code: int | None = None
    log: list[str] = field(default_factory=list)

    _process: BackendProcess | None = field(default=None, repr=False)
    _changed: bool = field(default=False, repr=False)
    _new_preview: bool = field(default=False, repr=False)
    _answered: bool = field(default=False, repr=False)
    _done: bool = field(default=False, repr=False)
    _killed: bool = field(default=False, repr=False)
    _phase_began: float = field(default=0.0, repr=False)
    _paused_at: float | None = field(default=None, repr=False)
    _stop_asked: float | None = field(default=None, repr=False)
    _kill_at: float | None = field(default=None, repr=False)

    @property
    def is_finished(self) -> bool:
        """Whether it has ended, in whatever way."""
        return self.state in FINISHED

    @property
    def can_pause(self) -> bool:
        """Whether `pause` does something: only training knows how to wait."""
        return self.kind == "train" and self.state is State.RUNNING

    def pause(self) -> None:
        """Let a running training wait without using the processor."""
        if self.can_pause and self._process.send("pause"):
            self._paused_at = time.monotonic()
            self._set(State.PAUSED)

    def resume(self) -> None:
        """Go on with a paused training."""
        if self.state is State.PAUSED and self._process.send("resume"):
            self._shift_clock()
            self._set(State.RUNNING)

    def stop(self) -> None:
        """Ask to save and end; a waiting job ends at once. Asked again, it is ended by force after a grace period."""
        if self.state is State.WAITING:
            self._set(State.STOPPED, "Stopped before it began")
        elif self.state is State.STOPPING:
            self._kill_at = self._stop_asked + GRACE_SECONDS
        elif not self.is_finished:
            self._process.stop()
            self._stop_asked = time.monotonic()
            self._shift_clock()
            self._set(State.STOPPING, "Stopping")

    def kill(self) -> None:
        """End it at once; what it saved last is kept."""
        if self.state is State.WAITING:
            self.stop()
        elif not self.is_finished:
            self._killed = True
            self._process.kill()

    def start(self, in_background: bool = True) -> None:
        """Start the process of a waiting job; where that fails, the job has failed and says why.

        in_background: as for `BackendProcess`.
        """
        self._changed = True
        try:
            self._process = BackendProcess(self.command, self.cwd, self.environment, in_background)
        except (OSError, ValueError) as error:
            why = getattr(error, "strerror", None) or error
            self.error = f"{self.command[0]} could not be started ({why}); choose another Python for the backend."
            if not os.path.isdir(self.cwd):
                self.error = f"The folder {self.cwd} is gone; install the extension again."
            self._set(State.FAILED, self.error)
            return
        self._phase_began = time.monotonic()
        self._set(State.RUNNING)

    def poll(self) -> bool:
        """Take in what the process said since the last call; whether anything changed. Never waits."""
        if self._process is not None and not self.is_finished:
            for event in self._process.poll():
                self._take(event)
            code = self._process.exit_code
            if code is not None:
                self._finish(code)
            elif self._kill_at is not None and time.monotonic() >= self._kill_at and not self._killed:
                self.kill()
        changed, self._changed = self._changed, False
        return changed

    def take_preview(self) -> bool:
        """Whether a preview was written since this was last asked."""
        new, self._new_preview = self._new_preview, False
        return new

    def _set(self, state: State, message: str | None = None) -> None:
        self.state = state
        self._changed = True
        if message is not None:
            self.message = message

    def _shift_clock(self) -> None:
        """Take the pause out of the time that the estimate goes by."""
        if self._paused_at is not None:
            self._phase_began += time.monotonic() - self._paused_at
            self._paused_at = None

    def _take(self, event: dict[str, Any]) -> None:
        """Note what an event says; what is not as agreed is ignored."""
        self._answered = self._changed = True
        kind, message = event["type"], str(event.get("message", ""))
        if kind == "status":
            if self.state is State.RUNNING:
                self._phase_began = time.monotonic()
                self.seconds_left = None
                if self.progress == 1.0:  # The phase before is over, not the job.
                    self.progress = 0.0
            if self.state is not State.STOPPING:
                self.message = message
        elif kind == "progress":
            self._take_progress(event)
        elif kind == "quality":
            self.curve.append({name: value for name, value in event.items() if name not in ("type", "time")})
            self._take_figures(event)
        elif kind == "preview":
            self.preview = Path(str(event.get("path", "")))
            self._new_preview = True
        elif kind == "warning":
            if message not in self.warnings and len(self.warnings) < _WARNINGS:
                self.warnings.append(message)
        elif kind == "error":
            self.error = message
        elif kind == "done":
            self._done = True
            self.result = {name: value for name, value in event.items() if name not in ("type", "time")}
            self._take_figures(event)

    def _take_progress(self, event: dict[str, Any]) -> None:
        done, total = _number(event.get("done")), _number(event.get("total"))
        self._take_figures(event)
        if done is None or not total or total < 0:
            return
        now = time.monotonic()
        share = min(max(done / total, 0.0), 1.0)
        if share < self.progress:
            self._phase_began = now
        self.progress = share
        self.seconds_left = _number(event.get("seconds_left"))
        elapsed = now - self._phase_began
        if self.seconds_left is None and share >= _ESTIMATE_FROM and elapsed >= _ESTIMATE_AFTER:
            self.seconds_left = elapsed * (1 - share) / share

    def _take_figures(self, event: dict[str, Any]) -> None:
        for name in ("step", "splats", "anchors", "psnr", "miou"):
            value = _number(event.get(name))
            if value is not None:
                setattr(self, name, value)

    def _finish(self, code: int) -> None:
        """Settle how it ended, from its exit code and its last event."""
        self.exit_code = code
        self.log = self._process.log
        self.seconds_left = None
        if self._done and not self.result.get("stopped"):
            if code != EXIT_DONE and not self._killed:
                self.warnings.append(f"It {_how_it_ended(code)} when all was done already.")
            self.progress = 1.0
            self._set(State.DONE, str(self.result.get("message", "Done")))
        elif self._killed:
            self._set(State.STOPPED, "Ended by force; what was saved last is kept")
        elif code == EXIT_CANCELLED or self.result.get("stopped"):
            self._set(State.STOPPED, str(self.result.get("message", "Stopped")))
        else:
            if self.error is None:
                self.error = self._crash(code)
            self._set(State.FAILED, self.error)

    def _crash(self, code: int) -> str:
        """One sentence for an end that the program did not explain, and its last words."""
        if self.if_silent is not None and not self._answered and code >= 0:
            return self.if_silent
        words = _last_words(self.log)
        how = "ended without a result" if code == EXIT_DONE else _how_it_ended(code)
        return f"The backend {how}" + (f"; its last message: {words}" if words else ".")


def _number(value: Any) -> float | int | None:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return value if is_number and abs(value) < float("inf") else None


def _how_it_ended(code: int) -> str:
    """An exit code as a predicate: signals by name on POSIX, exceptions as numbers on Windows."""
    if code < 0:
        if -code == getattr(signal, "SIGKILL", None):
            return "was ended by the system, as happens when memory runs out"
        try:
            return f"crashed ({signal.strsignal(-code) or signal.Signals(-code).name})"
        except ValueError:
            return f"crashed (signal {-code})"
    if sys.platform == "win32" and code >= 0xC0000000:
        return f"crashed (Windows error 0x{code:08X})"
    return f"ended unexpectedly (exit code {code})"


def _last_words(log: list[str]) -> str:
    """The line that says most about a crash: the interpreter's own name for it, or else the last one."""
    named = [line for line in log if line.startswith("Fatal Python error")]
    return (named or log or [""])[-1].strip()


class JobQueue:
    """Jobs in the order they were added; one runs, the others wait."""

    def __init__(self) -> None:
        self.jobs: list[Job] = []

    @property
    def running(self) -> Job | None:
        """The job whose process is there: running, paused or stopping."""
        return next((job for job in self.jobs if job.state is not State.WAITING and not job.is_finished), None)

    def add(self, job: Job) -> None:
        """Put a new job at the end; `poll` starts it when its turn comes."""
        job._changed = True
        self.jobs.append(job)

    def poll(self) -> list[Job]:
        """The jobs that changed since the last call. Starts the next one where none runs; never waits."""
        if self.running is None:
            waiting = next((job for job in self.jobs if job.state is State.WAITING), None)
            if waiting is not None:
                waiting.start()
        changed = [job for job in self.jobs if job.poll()]
        # A job that never began left nothing to tell.
        self.jobs = [job for job in self.jobs if job._process or job.state is not State.STOPPED]
        return changed

    def of_folder(self, folder: str | Path) -> Job | None:
        """The latest job of a reconstruction folder, however its path is written."""
        wanted = _resolved(folder)
        return next((job for job in reversed(self.jobs) if job.folder and _resolved(job.folder) == wanted), None)

    def clear_finished(self) -> None:
        """Forget the jobs that have ended."""
        self.jobs = [job for job in self.jobs if not job.is_finished]

    def stop_all(self, timeout: float) -> None:
        """Stop every job; waits at most `timeout` seconds for the running one to save, then ends it by force."""
        for job in self.jobs:
            job.stop()
        deadline = time.monotonic() + timeout
        running = self.running
        while running is not None and not running.is_finished:
            running.poll()
            if time.monotonic() >= deadline:
                if running._killed:
                    break
                running.kill()
                deadline = time.monotonic() + _ENDING_SECONDS
            time.sleep(0.02)
        for job in self.jobs:
            job._changed = True
        self.poll()


def _resolved(folder: str | Path) -> str:
    return os.path.normcase(os.path.realpath(folder))


def run_blocking(job: Job, echo: Callable[[str], None] = print) -> int:
    """Run a job to its end, telling `echo` line by line; returns the exit code (0, 1, 2 or 130).

    Ctrl-C or a termination signal asks the job to stop and save; a second one ends it by force.
    """
    asked = [0]

    def on_signal(number, frame):
        asked[0] += 1

    main = threading.current_thread() is threading.main_thread()
    numbers = (signal.SIGINT, signal.SIGTERM) if main else ()
    before = {number: signal.signal(number, on_signal) for number in numbers}
    try:
        job.start(in_background=False)
        _watch(job, echo, asked)
    finally:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
        job.kill()
    if job.state is State.DONE:
        return EXIT_DONE
    if job.state is State.STOPPED:
        return EXIT_CANCELLED
    return EXIT_BAD_INPUT if job.exit_code in (EXIT_BAD_INPUT, None) else EXIT_FAILED


def _watch(job: Job, echo: Callable[[str], None], asked: list[int]) -> None:
    """Poll until the end; says new messages and warnings at once, progress every few seconds."""
    handled, told, warned, last_line, share = 0, "", 0, time.monotonic(), -1.0
    while not job.is_finished:
        if asked[0] > handled:
            handled += 1
            job.stop() if handled == 1 else job.kill()
        job.poll()
        if job.message != told and not job.is_finished:
            told = job.message
            echo(told)
        for warning in job.warnings[warned:]:
            echo(f"warning: {warning}")
        warned = len(job.warnings)
        now = time.monotonic()
        if job.progress != share and now - last_line >= _SECONDS_BETWEEN_LINES:
            share, last_line = job.progress, now
            echo(f"  {_figures(job)}")
        time.sleep(0.02)
    echo(f"error: {job.error}" if job.state is State.FAILED else job.message)


def _figures(job: Job) -> str:
    """Progress, time left and quality in one line."""
    parts = [f"{100 * job.progress:3.0f}%"]
    if job.seconds_left is not None:
        minutes, seconds = divmod(round(job.seconds_left), 60)
        parts.append(f"{minutes}:{seconds:02d} left")
    if job.splats is not None:
        parts.append(f"{job.splats:,} splats")
    if job.psnr is not None:
        parts.append(f"PSNR {job.psnr:.1f} dB")
    if job.miou is not None:
        parts.append(f"mIoU {job.miou:.3f}")
    return ", ".join(parts)


def lock_holder(folder: str | Path) -> int | None:
    """The process ID of the training that holds a reconstruction folder, or None where none does."""
    try:
        pid = int((Path(folder) / ".lock").read_text())
    except (OSError, ValueError):
        return None
    # A process ID comes again after a restart: this process does not train, so its own is an old one.
    return pid if pid > 0 and pid != os.getpid() and _lives(pid) else None


def _lives(pid: int) -> bool:
    if sys.platform == "win32":
        import ctypes

        # SYNCHRONIZE is all that waiting for the end of a process needs; a wait of 0 ms says whether it has ended.
        synchronize, wait_timeout = 0x00100000, 0x102
        kernel = ctypes.WinDLL("kernel32")
        kernel.OpenProcess.restype = ctypes.c_void_p
        handle = kernel.OpenProcess(synchronize, False, pid)
        if not handle:
            return False
        try:
            return kernel.WaitForSingleObject(ctypes.c_void_p(handle), 0) == wait_timeout
        finally:
            kernel.CloseHandle(ctypes.c_void_p(handle))
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    return True
