"""Stopping and pausing a command from the program that drives it."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import psutil
import pytest

from backend.cli import main as arguments
from backend.model.checkpoint import load_checkpoint
from backend.shared.errors import EXIT_BAD_INPUT, EXIT_CANCELLED, EXIT_DONE, Cancelled
from backend.shared.events import Reporter
from backend.shared.stopping import StoppingReporter, StopRequest

ROOT = Path(__file__).resolve().parents[2]


class Driven:
    """A command in a child process, driven through its standard input and output."""

    def __init__(self, *words: object) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "backend", *map(str, words), "--threads", "1", "--json"],
            cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, bufsize=1,
        )  # fmt: skip
        self.events: list[dict] = []

    def say(self, word: str) -> None:
        self.process.stdin.write(word + "\n")
        self.process.stdin.flush()

    def until(self, kind: str, message: str = "") -> dict:
        """Read events up to one of this kind whose message contains `message`."""
        for line in self.process.stdout:
            self.events.append(json.loads(line))
            if self.events[-1]["type"] == kind and message in self.events[-1].get("message", ""):
                return self.events[-1]
        raise AssertionError(
            f"the command ended without {kind} {message}: {self.events[-3:]} {self.process.stderr.read()}"
        )

    def until_it_trains(self) -> dict:
        """Read events up to the first progress of the training."""
        while "step" not in (event := self.until("progress")):
            pass
        return event

    def end(self) -> int:
        """Wait for the end, check that there is no error output, and return the exit code."""
        out, err = self.process.communicate(timeout=60)
        self.events += [json.loads(line) for line in out.splitlines()]
        assert err == ""
        return self.process.returncode


@pytest.fixture
def drive(request):
    """Function that starts a `Driven`; it is killed at the end of the test."""

    def start(*words):
        driven = Driven(*words)
        # Reading events would block forever if the expected event never came and the process did not end.
        timer = threading.Timer(120, driven.process.kill)
        timer.start()
        request.addfinalizer(timer.cancel)
        request.addfinalizer(driven.process.kill)
        return driven

    return start


@pytest.fixture
def endless(write_capture, tmp_path):
    """Command of a training that does not end and saves only when it is stopped; and its folder."""
    scene, out = write_capture(views=9, size=(240, 180)), tmp_path / "out"
    train = ("train", scene.folder, "--out", out, "--offsets", 4, "--minutes", 1000, "--checkpoint-seconds", 1000)
    return train, out


def progress_of(out: Path) -> dict:
    return load_checkpoint(out / "checkpoint")[1]["progress"]


@pytest.mark.long
def test_closed_stdin_stops_attached_training(drive, endless):
    train, out = endless
    driven = drive(*train)
    driven.say("attached")
    driven.until_it_trains()
    driven.process.stdin.close()
    driven.process.stdin = None
    assert driven.end() == EXIT_CANCELLED
    assert driven.events[-1]["type"] == "done" and driven.events[-1]["stopped"] is True
    assert progress_of(out)["step"] > 0


@pytest.mark.parametrize("paused", [False, True])
@pytest.mark.long
def test_closed_pipes_stop_training_with_checkpoint(drive, endless, paused):
    train, out = endless
    driven = drive(*train)
    driven.say("attached")
    driven.until_it_trains()
    if paused:
        driven.say("pause")
        driven.until("status", "Paused")
    driven.process.stdout.close()
    driven.process.stdin.close()
    assert driven.process.wait(timeout=60) == EXIT_CANCELLED
    assert driven.process.stderr.read() == "" and progress_of(out)["step"] > 0
    assert not list(out.rglob("*.part")) and not (out / ".lock").exists()


@pytest.mark.skipif(os.name != "posix", reason="kills a process group's leader")
@pytest.mark.long
def test_killed_parent_stops_training_with_checkpoint(endless, tmp_path):
    train, out = endless
    driver = tmp_path / "driver.py"
    command = [sys.executable, "-m", "backend", *map(str, train), "--threads", "1", "--json"]
    driver.write_text(
        "import subprocess, sys\n"
        f"p = subprocess.Popen({command!r}, cwd={str(ROOT)!r}, stdin=-1, stdout=-1, text=True)\n"
        "p.stdin.write('attached\\n'); p.stdin.flush()\n"
        "for line in p.stdout:\n"
        "    if '\"progress\"' in line and '\"step\"' in line: print(p.pid, flush=True)\n"
    )
    with subprocess.Popen([sys.executable, str(driver)], stdout=subprocess.PIPE, text=True) as process:
        backend = psutil.Process(int(process.stdout.readline()))
        process.kill()
    psutil.wait_procs([backend], timeout=60)
    assert not backend.is_running() or backend.status() == psutil.STATUS_ZOMBIE
    assert progress_of(out)["step"] > 0


@pytest.mark.parametrize("attached", [True, False])
@pytest.mark.long
def test_command_ends_with_open_stdin(drive, endless, attached):
    train, out = endless
    driven = drive(*train[:6], "--steps", 5)
    if attached:
        driven.say("attached")
    driven.until("done")
    assert driven.process.wait(timeout=60) == EXIT_DONE
    assert driven.end() == EXIT_DONE and progress_of(out)["step"] == 5


@pytest.mark.long
def test_closed_stdin_without_attaching_is_ignored(drive, endless):
    train, out = endless
    driven = drive(*train[:6], "--steps", 5)
    driven.say("hello")
    assert driven.end() == EXIT_DONE and progress_of(out)["step"] == 5


@pytest.mark.long
def test_pause_saves_and_excludes_time(drive, endless):
    train, out = endless
    driven = drive(*train)
    driven.until_it_trains()
    driven.say("pause")
    driven.until("status", "Paused")
    saved = progress_of(out)
    process = psutil.Process(driven.process.pid)
    cpu, begun = sum(process.cpu_times()[:2]), time.monotonic()
    time.sleep(3)
    assert sum(process.cpu_times()[:2]) - cpu < 0.5, "waiting uses no CPU time"
    driven.say("resume")
    idle = time.monotonic() - begun
    before = len(driven.events)
    driven.until("status", "Resumed")
    assert len(driven.events) == before + 1, "no events while paused"
    after = driven.until_it_trains()
    assert after["step"] > saved["step"] and after["seconds"] - saved["seconds"] < idle
    driven.say("stop")
    assert driven.end() == EXIT_CANCELLED
    times = [event["time"] for event in driven.events if event["type"] in ("progress", "done")]
    assert progress_of(out)["seconds"] < times[-1] - times[0] - 0.9 * idle + 3, "paused time is not counted"
    assert progress_of(out)["step"] > saved["step"]


@pytest.mark.parametrize("how", ["stop", "one signal", "two signals"])
@pytest.mark.long
def test_paused_training_can_be_stopped(drive, endless, how):
    train, out = endless
    driven = drive(*train)
    driven.until_it_trains()
    driven.say("pause")
    driven.until("status", "Paused")
    step = progress_of(out)["step"]
    if how == "stop":
        driven.say("stop")
    else:
        for _ in range(1 if how == "one signal" else 2):
            driven.process.send_signal(signal.SIGINT)
    assert driven.end() == EXIT_CANCELLED
    assert driven.events[-1]["stopped"] is True and progress_of(out)["step"] == step > 0
    assert not any(event.get("message") == "Resumed" for event in driven.events)


def test_other_commands_can_be_paused(monkeypatch):
    """Pause before the first progress, resume, pause again, and stop while paused."""
    requested, read = threading.Event(), threading.Event()
    messages: list[str] = []

    class Typed:
        def __iter__(self):
            yield "pause\n"
            read.set()
            for word in ("resume\n", "pause\n", "stop\n"):
                requested.wait(60)
                requested.clear()
                yield word
                read.set()

    class RecordingReporter(Reporter):
        def progress(self, done, total, **fields):
            messages.append(f"progress {done}")

    stop = StopRequest(announce=messages.append)
    monkeypatch.setattr(sys, "stdin", Typed())

    def later(wait=0.3):
        threading.Timer(wait, requested.set).start()

    with stop.listening(read_stdin=True):
        assert read.wait(60)
        read.clear()
        reporter = StoppingReporter(RecordingReporter(), stop)
        later()
        reporter.progress(1, 3)
        assert messages == ["progress 1", "Paused", "Resumed"] and not stop.paused
        assert 0.1 < stop.paused_seconds < 60
        read.clear()
        requested.set()
        assert read.wait(60)
        later()
        with pytest.raises(Cancelled):
            reporter.progress(2, 3)
        assert messages[3:] == ["progress 2", "Paused"]


@pytest.mark.parametrize("masks", [True, False])
@pytest.mark.long
def test_deleted_capture_ends_training_with_checkpoint(drive, endless, masks):
    train, out = endless
    driven = drive(*train, "--memory-mb", 1)
    capture = Path(train[1])
    driven.until_it_trains()
    shutil.move(capture / ("masks" if masks else "images"), capture / "gone")
    driven.until("error")
    assert driven.end() == EXIT_BAD_INPUT
    sentence = driven.events[-1]["message"]
    assert str(capture) in sentence and "cannot be read (No such file" in sentence and "\n" not in sentence
    step = progress_of(out)["step"]
    assert step > 0 and not list(out.rglob("*.part"))
    shutil.move(capture / "gone", capture / ("masks" if masks else "images"))
    assert arguments.main([*map(str, train[:6]), "--steps", str(step + 2)]) == EXIT_DONE
    assert progress_of(out)["step"] == step + 2


def test_children_have_no_input():
    """Lines on standard input reach the command alone; on Windows, children that look at it would hang."""
    program = (
        "import subprocess, sys, time\n"
        "from backend.shared.stopping import StopRequest\n"
        "stop = StopRequest()\n"
        "with stop.listening(read_stdin=True):\n"
        "    print(subprocess.run([sys.executable, '-c', 'input()'], stderr=-3).returncode, flush=True)\n"
        "    while not stop():\n"
        "        time.sleep(0.01)\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program], cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout.readline() == "1\n", "it has read nothing"
        process.stdin.write("stop\n")
        process.stdin.flush()
        assert process.wait(timeout=30) == 0
