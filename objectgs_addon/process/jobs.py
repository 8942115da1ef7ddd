# SPDX-License-Identifier: GPL-3.0-or-later
"""Queue of backend jobs, with their progress, results and errors; one job runs at a time.

With a window, a timer calls `JobQueue.poll`; without a window, `blocking.run_blocking` polls a single job.
"""

from __future__ import annotations

import itertools
import math
import signal
import sys
import time
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

from ...backend.shared.durations import counted_down
from ...backend.shared.errors import EXIT_CANCELLED, EXIT_DONE
from ...backend.shared.formats.regular_file import resolved
from .backend_process import BackendProcess

GRACE_SECONDS = 10.0
"""Time in seconds that a job has to save after the first request to stop, before a second request kills it."""

_WARNINGS = 50
_LARGEST_NUMBER = 1e15
"""Largest number of an event that is taken as one; integers in JSON can be too large to convert or to show."""
_MOST = 0.99
"""Progress of a job that has not ended."""
_ENDING_SECONDS = 3.0
_SETTLING = 0.1
_SETTLING_AT_MOST = 10.0
"""How fast the shown time left follows the estimates: the time constant, relative to the time left and in seconds."""


class State(StrEnum):
    """State of a job; DONE, STOPPED and FAILED are final."""

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
    """Backend command, or another program that writes the same events.

    Attributes:
        title: name shown to the user.
        kind: sfm, import, masks, import-splats, plan, vote, train, label, mesh, export, film, fill, demo, setup,
            packages or doctor.
        folder: the reconstruction folder, or None.
        command: program and arguments.
        cwd: working directory.
        environment: additional environment variables.
        if_silent: error message if the program ends without any event, because it is not the expected program.

    The other attributes change while the job runs: progress from 0 to 1, which never decreases, seconds_left (None as
    long as it is not known), stage (such as "Preparing (1 of 3)", or empty), message (the current step),
    statuses (all messages so far), warnings and error (sentences), lacks (a missing package and the option that needs
    it), nothing_made (the input was valid, but the command could make nothing of it), in_use (another process uses the
    folder), training figures (step, splats, anchors, psnr, miou, miou_all, zero_is_background), preview (path of the
    newest image), curve (quality events: seconds, step, psnr, miou, miou_all, mbiou), result (fields of the `done`
    event), exit_code and log (most recent lines that are not events). number identifies the job in this process.
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
    stage: str = ""
    message: str = ""
    statuses: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    error: str | None = None
    lacks: tuple[str, str] | None = None
    nothing_made: bool = False
    in_use: bool = False
    step: int | None = None
    splats: int | None = None
    anchors: int | None = None
    psnr: float | None = None
    miou: float | None = None
    miou_all: float | None = None
    zero_is_background: bool = False
    preview: Path | None = None
    curve: list[dict[str, Any]] = field(default_factory=list)
    result: dict[str, Any] = field(default_factory=dict)
    exit_code: int | None = None
    log: list[str] = field(default_factory=list)
    number: int = field(default_factory=itertools.count(1).__next__)

    _process: BackendProcess | None = field(default=None, repr=False)
    _changed: bool = field(default=False, repr=False)
    _new_preview: bool = field(default=False, repr=False)
    _answered: bool = field(default=False, repr=False)
    _done: bool = field(default=False, repr=False)
    _killed: bool = field(default=False, repr=False)
    _left: float | None = field(default=None, repr=False)
    _estimated_at: float = field(default=0.0, repr=False)
    _paused_at: float | None = field(default=None, repr=False)
    _stop_asked: float | None = field(default=None, repr=False)
    _kill_at: float | None = field(default=None, repr=False)

    def again(self, python: Path | None) -> Job:
        """Return a new job of the same program, where a training goes on from its last checkpoint.

        Args:
            python: the backend's present Python, or None.
        """
        command = list(self.command)
        if python is not None and command[1:3] == ["-m", "backend"]:
            command[0] = str(python)
        if self.kind == "train" and self.step is not None:
            command = [word for word in command if word != "--restart"]
        return Job(self.title, self.kind, self.folder, command, self.cwd, self.environment, self.if_silent)

    @property
    def _child(self) -> BackendProcess:
        """The process of a started job."""
        assert self._process is not None
        return self._process

    @property
    def is_finished(self) -> bool:
        """Whether the job has ended."""
        return self.state in FINISHED

    @property
    def seconds_left(self) -> float | None:
        """The time left as reported, but without its jumps, and counted down since then; None if it is not known."""
        return None if self._left is None else counted_down(self._left, time.monotonic() - self._estimated_at)

    @property
    def can_pause(self) -> bool:
        """Whether the job can be paused: a running training, of labels too, or a computation of poses."""
        return self.kind in ("train", "label", "sfm") and self.state is State.RUNNING

    @property
    def quality(self) -> dict[str, float]:
        """The metrics on held-out views that were measured: psnr, miou and miou_all."""
        found = {"psnr": self.psnr, "miou": self.miou, "miou_all": self.miou_all}
        return {name: value for name, value in found.items() if value is not None}

    def pause(self) -> None:
        """Pause a running job that can be paused."""
        if self.can_pause and self._child.send("pause"):
            self._paused_at = time.monotonic()
            self._set(State.PAUSED)

    def resume(self) -> None:
        """Resume a paused job."""
        if self.state is State.PAUSED and self._child.send("resume"):
            self._shift_clock()
            self._set(State.RUNNING)

    def stop(self) -> None:
        """Request the job to save and end; a waiting job ends immediately.

        A second call kills the job `GRACE_SECONDS` after the first.
        """
        if self.state is State.WAITING:
            self._set(State.STOPPED, "Stopped before it began")
        elif self.state is State.STOPPING:
            self._kill_at = (self._stop_asked or time.monotonic()) + GRACE_SECONDS
        elif not self.is_finished:
            self._child.stop()
            self._stop_asked = time.monotonic()
            self._shift_clock()
            self._set(State.STOPPING, "Stopping")
            self.statuses.append(self.message)

    def kill(self) -> None:
        """End the job immediately; its last checkpoint is kept."""
        if self.state is State.WAITING:
            self.stop()
        elif not self.is_finished:
            self._killed = True
            self._child.kill()

    def start(self, in_background: bool = True) -> None:
        """Start the process of a waiting job; on failure, set `error` and the state FAILED.

        Args:
            in_background: run with lower priority, so that a window stays responsive.
        """
        self._changed = True
        try:
            self._process = BackendProcess(self.command, self.cwd, self.environment, in_background)
        except (OSError, ValueError) as error:
            why = getattr(error, "strerror", None) or error
            self.error = f"{self.command[0]} could not be started ({why}); choose another Python for the backend."
            if not self.cwd.is_dir():
                self.error = f"The folder {self.cwd} is missing; install the extension again."
            self._set(State.FAILED, self.error)
            return
        self._set(State.RUNNING, "Starting")

    def poll(self) -> bool:
        """Process the events since the last call without blocking; return whether anything changed."""
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
        """Return whether a preview was written since the last call."""
        new, self._new_preview = self._new_preview, False
        return new

    def _set(self, state: State, message: str | None = None) -> None:
        self.state = state
        self._changed = True
        if message is not None:
            self.message = message

    def _shift_clock(self) -> None:
        """Exclude the pause from the time in which the time left is counted down."""
        if self._paused_at is not None:
            self._estimated_at += time.monotonic() - self._paused_at
            self._paused_at = None

    def _take(self, event: dict[str, Any]) -> None:
        """Apply an event; ignore unexpected fields."""
        self._answered = self._changed = True
        kind, message = event["type"], str(event.get("message", ""))
        if kind == "status":
            if self.state is not State.STOPPING:
                self.stage = _stage_of(event)
                self.message = message
                self.statuses.append(message)
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
            self.nothing_made = event.get("nothing_made") is True
            self.in_use = event.get("in_use") is True
            if "lacks" in event:
                self.lacks = str(event["lacks"]), str(event.get("option", ""))
        elif kind == "done":
            self._done = True
            self.result = {name: value for name, value in event.items() if name not in ("type", "time")}
            self._take_figures(event)

    def _take_progress(self, event: dict[str, Any]) -> None:
        done, total = _number(event.get("done")), _number(event.get("total"))
        self._take_figures(event)
        if done is None or not total or total < 0:
            return
        self.progress = max(self.progress, min(max(done / total, 0.0), _MOST))
        left = _number(event.get("seconds_left"))
        if left is None:
            self._left = None
        else:
            self._left, self._estimated_at = self._steady(max(left, 0.0)), time.monotonic()

    def _steady(self, left: float) -> float:
        """Return the time left without jumps: it counts down, and is drawn to the estimates, faster near the end."""
        expected = self.seconds_left
        if expected is None:
            return left
        passed = max(time.monotonic() - self._estimated_at, 0.0)
        constant = min(max(_SETTLING * (left + expected) / 2, 1.0), _SETTLING_AT_MOST)
        return left + (expected - left) * math.exp(-passed / constant)

    def _take_figures(self, event: dict[str, Any]) -> None:
        for name in ("step", "splats", "anchors", "psnr", "miou", "miou_all"):
            value = _number(event.get(name))
            if value is not None:
                setattr(self, name, value)
        if isinstance(event.get("zero_is_background"), bool):
            self.zero_is_background = event["zero_is_background"]

    def _finish(self, code: int) -> None:
        """Set the final state from the exit code and the last event."""
        self.exit_code = code
        self.stage = ""
        self.log = self._child.log
        self._left = None
        if self._done and not self.result.get("stopped"):
            if code != EXIT_DONE and not self._killed:
                self.warnings.append(f"The backend {_how_it_ended(code)} after it was done.")
            self.progress = 1.0
            self._set(State.DONE, str(self.result.get("message", "Done")))
        elif self._killed:
            self._set(State.STOPPED, "Ended by force; the last checkpoint is kept")
        elif code == EXIT_CANCELLED or self.result.get("stopped"):
            self._set(State.STOPPED, str(self.result.get("message", "Stopped")))
        else:
            if self.error is None:
                self.error = self._crash(code)
            self._set(State.FAILED, self.error)

    def _crash(self, code: int) -> str:
        """Describe an unexpected end in one sentence, with the last message of the program."""
        if self.if_silent is not None and not self._answered and not _is_crash(code):
            return self.if_silent
        text = _last_message(self.log)
        how = "ended without a result" if code == EXIT_DONE else _how_it_ended(code)
        return f"The backend {how}" + (f"; its last message: {text}" if text else ".")


def _stage_of(event: dict[str, Any]) -> str:
    """Return the stage of a status: its name, with its place if there are several."""
    name, number, of = event.get("stage"), _number(event.get("number")), _number(event.get("of"))
    if not isinstance(name, str):
        return ""
    return f"{name} ({number} of {of})" if number and of else name


def _number(value: Any) -> float | int | None:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return value if is_number and abs(value) <= _LARGEST_NUMBER else None


def _is_crash(code: int) -> bool:
    """Return whether an exit code is that of a signal, or of an exception on Windows."""
    return code < 0 or (sys.platform == "win32" and code >= 0xC0000000)


def _how_it_ended(code: int) -> str:
    """Describe an exit code: signals by name on POSIX, exceptions by number on Windows."""
    if code < 0:
        if -code == getattr(signal, "SIGKILL", None):
            return "was ended by the system, as happens when memory runs out"
        try:
            return f"crashed ({signal.strsignal(-code) or signal.Signals(-code).name})"
        except ValueError:
            return f"crashed (signal {-code})"
    if _is_crash(code):
        return f"crashed (Windows error 0x{code:08X})"
    return f"ended unexpectedly (exit code {code})"


_FATAL = ("Fatal Python error", "Windows fatal exception")


def _last_message(log: list[str]) -> str:
    """Return the most informative line about a crash: the interpreter's fatal error, or else the last line."""
    named = [line for line in log if line.startswith(_FATAL)]
    return (named or log or [""])[-1].strip()


class JobQueue:
    """Queue of jobs, run one at a time in the order they were added."""

    def __init__(self) -> None:
        self.jobs: list[Job] = []

    @property
    def running(self) -> Job | None:
        """The job that is running, paused or stopping, or None."""
        return next((job for job in self.jobs if job.state is not State.WAITING and not job.is_finished), None)

    def add(self, job: Job) -> None:
        """Append a job; `poll` starts it after the earlier jobs."""
        job._changed = True
        self.jobs.append(job)

    def poll(self) -> list[Job]:
        """Start the next job if none is running; return the jobs that changed since the last call. Does not block."""
        if self.running is None:
            waiting = next((job for job in self.jobs if job.state is State.WAITING), None)
            if waiting is not None:
                waiting.start()
        changed = [job for job in self.jobs if job.poll()]
        # Remove jobs that were stopped before they began.
        self.jobs = [job for job in self.jobs if job._process or job.state is not State.STOPPED]
        return changed

    def of_folder(self, folder: str | Path) -> Job | None:
        """Return the job of a reconstruction folder that runs, or else the latest one; None without any."""
        wanted = resolved(folder)
        jobs = [job for job in reversed(self.jobs) if job.folder and resolved(job.folder) == wanted]
        return next((job for job in jobs if job is self.running), jobs[0] if jobs else None)

    def remove_finished(self) -> None:
        """Remove the jobs that have ended."""
        self.jobs = [job for job in self.jobs if not job.is_finished]

    def stop_all(self, timeout: float) -> None:
        """Stop all jobs; the running job is killed if it has not saved and ended after `timeout` seconds."""
        for job in self.jobs:
            if job.state is not State.STOPPING:  # A second call would end its saving.
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
