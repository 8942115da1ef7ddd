# SPDX-License-Identifier: GPL-3.0-or-later
"""Background jobs, with small programs in place of the backend that report, wait, crash, hang and print garbage."""

import io
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from objectgs.backend.shared.console import ConsoleReporter
from objectgs.backend.shared.events import Reporter
from objectgs.objectgs_addon.blender import messages
from objectgs.objectgs_addon.panels.jobs import JobsPanel
from objectgs.objectgs_addon.panels.tab import draw_job
from objectgs.objectgs_addon.process import jobs
from objectgs.objectgs_addon.process.backend_process import BackendProcess, backend_command, backend_environment
from objectgs.objectgs_addon.process.blocking import run_blocking
from objectgs.objectgs_addon.process.jobs import Job, JobQueue, State
from objectgs.objectgs_addon.running import background, job_display, results, wording
from objectgs.objectgs_addon.running.wording import in_blender

from .drawn import texts_of

posix = pytest.mark.skipif(os.name != "posix", reason="signals and niceness are POSIX's")
WAIT = 30.0

PRELUDE = """
import json, os, signal, sys, time
def say(kind, **fields):
    print(json.dumps({"type": kind, "time": 0, **fields}), flush=True)
def read_line():
    return sys.stdin.readline().strip()
"""

TRAINS = """
assert read_line() == "attached"
say("status", message="Training")
say("progress", done=0.25, total=1.0, step=10, seconds_left=30.0, splats=5000, anchors=500, psnr=None)
while (word := read_line()) != "stop":
    say("status", message={"pause": "Paused", "resume": "Resumed", "": "Nobody there"}[word])
    if not word:
        sys.exit(3)
say("done", stopped=True, message="Saved at step 10.")
sys.exit(130)
"""

UNRESPONSIVE = """
signal.signal(signal.SIGTERM, signal.SIG_IGN)
say("status", message="Busy")
time.sleep(60)
"""


@pytest.fixture
def make(tmp_path):
    """Function (code, **fields) that returns a job that runs the Python `code`; it is killed at the end of the test."""
    made = []

    def one(code, kind="train", **fields):
        script = tmp_path / f"fake{len(made)}.py"
        script.write_text(PRELUDE + code, encoding="utf-8")
        fields = {"title": "Fake", "folder": None, "cwd": tmp_path, "command": [sys.executable, str(script)]} | fields
        made.append(Job(kind=kind, **fields))
        return made[-1]

    yield one
    for job in made:
        job.kill()


def until(condition, look=lambda: None):
    """Call `look` until `condition()` holds."""
    deadline = time.monotonic() + WAIT
    while not condition():
        assert time.monotonic() < deadline, "condition timed out"
        look()
        time.sleep(0.01)


def run(job):
    """Run a job to its end in a new queue."""
    queue = JobQueue()
    queue.add(job)
    until(lambda: job.is_finished, queue.poll)
    return job


def started(job, queue=None):
    """Start a job and return the queue once the job has sent a message."""
    queue = queue or JobQueue()
    queue.add(job)
    until(lambda: job.statuses or job.is_finished, queue.poll)
    return queue


def test_job_collects_figures_of_run(make, tmp_path):
    job = run(
        make("""
say("status", message="Reading the capture")
say("progress", done=5, total=10)
say("status", message="Training")
say("warning", message="3 images have no pose.")
say("warning", message="3 images have no pose.")
say("progress", done=0.5, total=1.0, step=7, seconds_left=12.5, splats=100, anchors=10, psnr=25.5, miou=None)
say("preview", path="latest.png")
say("quality", seconds=3.0, step=9, psnr=26.5, miou=0.75, mbiou=0.5)
say("done", steps=12, splats="splats.ply", anchors=11, psnr=27.0)
""")
    )
    assert job.state is State.DONE and job.exit_code == 0 and job.error is None
    assert job.progress == 1 and job.seconds_left is None
    assert job.warnings == ["3 images have no pose."]
    assert (job.step, job.splats, job.anchors, job.psnr, job.miou) == (9, 100, 11, 27.0, 0.75)
    assert job.quality == {"psnr": 27.0, "miou": 0.75}
    assert job.preview == Path("latest.png")
    assert job.curve == [{"seconds": 3.0, "step": 9, "psnr": 26.5, "miou": 0.75, "mbiou": 0.5}]
    assert job.result == {"steps": 12, "splats": "splats.ply", "anchors": 11, "psnr": 27.0}


@pytest.mark.parametrize(("is_background", "shown"), [(True, "mIoU (all) 0.950"), (False, "mIoU (labeled) 0.970")])
def test_figures_lead_with_miou_all_where_zero_is_background(make, monkeypatch, is_background, shown):
    figures = f"psnr=30.0, miou=0.97, miou_all=0.95, zero_is_background={is_background}"
    job = run(make(f'say("quality", {figures})\nsay("done")'))
    written = []
    monkeypatch.setattr(job_display, "write", lambda _layout, text: written.append(text))
    job_display.draw_figures(None, job.quality, job.zero_is_background, 1200)
    assert written == [f"PSNR 30.0 dB   {shown}   1,200 splats"]


def test_job_knows_which_package_is_missing(make):
    job = run(
        make("""
say("error", message="--text needs the package transformers; run x.", lacks="transformers", option="--text")
sys.exit(2)
""")
    )
    assert job.state is State.FAILED and job.lacks == (wording.TRANSFORMERS, "--text")
    assert wording.lacking(*job.lacks) == "Names needs the package transformers, which is not installed yet"
    assert run(make('say("error", message="Other.")\nsys.exit(2)')).lacks is None


def test_jobs_run_in_order_and_changes_are_reported(make):
    queue, order = JobQueue(), []
    first, second = make('say("done")', title="first"), make('say("done")', title="second")
    queue.add(first)
    queue.add(second)

    def look():
        order.extend((job.title, job.state) for job in queue.poll())
        assert not (first.state is State.RUNNING and second.state is not State.WAITING)

    until(lambda: second.is_finished, look)
    assert [title for title, state in order if state is State.DONE] == ["first", "second"]
    assert not queue.poll() and queue.running is None
    queue.remove_finished()
    assert queue.jobs == []


def test_job_pauses_resumes_and_stops(make):
    job = make(TRAINS)
    queue = started(job)
    until(lambda: job.step, queue.poll)
    assert (job.progress, job.psnr) == (0.25, None) and 0 < job.seconds_left <= 30
    job.pause()
    assert job.state is State.PAUSED and queue.running is job
    until(lambda: job.message == "Paused", queue.poll)
    job.resume()
    until(lambda: job.message == "Resumed", queue.poll)
    assert job.state is State.RUNNING
    job.pause()
    job.stop()
    assert job.state is State.STOPPING
    until(lambda: job.is_finished, queue.poll)
    assert job.state is State.STOPPED and job.message == "Saved at step 10." and job.exit_code == 130


def test_only_training_jobs_pause(make):
    job = make(TRAINS, kind="import")
    started(job)
    assert not job.can_pause
    job.pause()
    assert job.state is State.RUNNING


def test_stopping_waiting_job_removes_it(make):
    busy, waiting = make(TRAINS), make(TRAINS)
    queue = started(busy)
    queue.add(waiting)
    waiting.stop()
    assert waiting in queue.poll() and waiting.state is State.STOPPED
    assert queue.jobs == [busy] and not queue.poll()
    busy.stop()
    until(lambda: busy.is_finished, queue.poll)
    assert queue.jobs == [busy]


def test_second_stop_kills_unresponsive_job(make, monkeypatch):
    monkeypatch.setattr(jobs, "GRACE_SECONDS", 0.5)
    job = make(UNRESPONSIVE)
    queue = started(job)
    job.stop()
    time.sleep(0.7)
    queue.poll()
    assert job.state is State.STOPPING
    job.stop()
    until(lambda: job.is_finished, queue.poll)
    assert job.state is State.STOPPED and "force" in job.message


def test_stop_all_waits_for_saving_and_kills_unresponsive_jobs(make):
    for code, how in (TRAINS, "Saved at step 10."), (UNRESPONSIVE, "Ended by force; the last checkpoint is kept"):
        job, waiting = make(code), make(code)
        queue = started(job)
        queue.add(waiting)
        queue.stop_all(timeout=WAIT if code is TRAINS else 0.3)
        assert job.state is State.STOPPED and job.message == how
        assert waiting.state is State.STOPPED and waiting.exit_code is None
        assert queue.running is None


def test_stop_all_waits_for_a_job_that_was_stopped_long_ago(make, monkeypatch):
    monkeypatch.setattr(jobs, "GRACE_SECONDS", 0.1)
    job = make("""
say("status", message="Training")
while read_line() != "stop":
    pass
time.sleep(1.0)
say("done", stopped=True, message="Saved")
sys.exit(130)
""")
    queue = started(job)
    job.stop()
    time.sleep(0.3)
    queue.stop_all(timeout=WAIT)
    assert job.state is State.STOPPED and job.message == "Saved"


@posix
@pytest.mark.long
def test_crash_reports_last_message(make):
    job = run(
        make("""
print("reading", file=sys.stderr)
print("terminate called: out of cheese", file=sys.stderr, flush=True)
os.abort()
""")
    )
    assert job.state is State.FAILED and job.exit_code == -signal.SIGABRT
    assert job.error == "The backend crashed (Aborted); its last message: terminate called: out of cheese"
    assert job.log == ["reading", "terminate called: out of cheese"]
    job = run(make("os.kill(os.getpid(), signal.SIGKILL)"))
    assert "memory" in job.error


@posix
def test_segfault_is_reported(make, tmp_path):
    job = run(make("import ctypes; ctypes.string_at(0)", environment=backend_environment(tmp_path)))
    assert job.state is State.FAILED and "Segmentation fault" in job.error.split(";")[0]
    assert job.error.endswith("Fatal Python error: Segmentation fault")


def test_errors_and_exit_codes_are_reported(make):
    job = run(make('say("error", message="garden has no images."); sys.exit(2)'))
    assert (job.state, job.error, job.message) == (State.FAILED, "garden has no images.", "garden has no images.")
    job = run(make("sys.exit(130)"))
    assert job.state is State.STOPPED
    job = run(make("raise ValueError('no such thing')"))
    assert job.state is State.FAILED
    assert job.error == "The backend ended unexpectedly (exit code 1); its last message: ValueError: no such thing"
    job = run(make("say('status', message='Hello')"))
    assert job.state is State.FAILED and job.error == "The backend ended without a result."
    job = run(make("say('done', message='All there.'); sys.exit(3)"))
    assert job.state is State.DONE and job.message == "All there." and "exit code 3" in job.warnings[0]


def test_invalid_lines_between_events_are_ignored(make):
    job = run(
        make(r"""
out = sys.stdout.buffer
out.write(b"\xff\xfe not text\n{ broken\n[1]\n{\"no\": \"type\"}\n\n" + b"x" * 3_000_000 + b"\n")
for i in range(100):
    out.write(b"line %d\n" % i)
out.write('{"type": "status", "message": "Größe"}\r\n'.encode())
out.write(b'{"type": "progress", "done": "much", "total": null}\n{"type": "progress", "done": 1, "total": 0}\n')
out.write(b'{"type": "progress", "done": NaN, "total": 1, "step": true}\n{"type": "unheard-of"}\n')
out.write(b'{"type": "done", "message": "without an end of line"}')
""")
    )
    assert job.state is State.DONE and job.message == "without an end of line"
    assert len(job.log) == 40 and job.log[-1] == "line 99" and job.step is None


@pytest.mark.long
def test_many_events_are_processed_in_parts(make):
    job = make('[say("progress", done=i, total=5000, step=i) for i in range(5000)]; say("done")')
    queue, longest = started(make('say("done", message="first")')), 0.0
    queue.add(job)
    while not job.is_finished:
        before = job.step or 0
        queue.poll()
        longest = max(longest, (job.step or 0) - before)
    assert job.state is State.DONE and job.step == 4999
    assert longest <= 200


def test_closed_pipes_do_not_end_job(make):
    job = make("""
os.close(0)
say("status", message="Closed")
time.sleep(0.3)
say("done")
""")
    queue = started(job)
    job.pause()
    job.stop()
    until(lambda: job.is_finished, queue.poll)
    assert job.state is State.DONE


def test_grandchild_with_open_pipes_does_not_block_job(make, monkeypatch):
    monkeypatch.setattr("objectgs.objectgs_addon.process.backend_process._PIPES_STAY_OPEN", 0.2)
    job = make("""
import subprocess
child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(20)"])
say("done", child=child.pid)
""")
    run(job)
    assert job.state is State.DONE
    os.kill(job.result["child"], getattr(signal, "SIGKILL", signal.SIGTERM))


@posix
def test_kill_ends_child_processes(make):
    job = make("""
import subprocess
child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
say("status", message=str(child.pid))
time.sleep(60)
""")
    queue = started(job)
    child = int(job.message)
    job.kill()
    until(lambda: job.is_finished, queue.poll)
    assert job.state is State.STOPPED

    def gone():
        result = subprocess.run(["ps", "-o", "stat=", "-p", str(child)], capture_output=True, text=True)
        return result.stdout.strip()[:1] in ("", "Z")

    until(gone)


@posix
def test_child_has_own_group_low_priority_and_clean_environment(make, monkeypatch, tmp_path):
    monkeypatch.setenv("PYTHONHOME", "/nowhere")
    monkeypatch.setenv("PYTHONPATH", "/nowhere")
    monkeypatch.setenv("OBJECTGS_TEST", "stays")
    job = run(
        make(
            """
way = os.sched_getscheduler(0) == os.SCHED_IDLE if hasattr(os, "SCHED_IDLE") else os.nice(0) > 0
say("done", group=os.getpgid(0), pid=os.getpid(), gives_way=way, variables=dict(os.environ))
""",
            environment=backend_environment(tmp_path / "cache"),
        )
    )
    assert job.state is State.DONE
    found, variables = job.result, job.result["variables"]
    assert found["group"] == found["pid"] and found["gives_way"]
    assert "PYTHONHOME" not in variables and "PYTHONPATH" not in variables and variables["OBJECTGS_TEST"] == "stays"
    assert variables["NUMBA_CACHE_DIR"] == str(tmp_path / "cache") and variables["PYTHONUTF8"] == "1"


def test_blocking_jobs_keep_priority(make):
    job = make("""say("done", policy=os.sched_getscheduler(0) if hasattr(os, "SCHED_IDLE") else os.nice(0))""")
    run_blocking(job, Reporter())
    assert job.result["policy"] == (os.sched_getscheduler(0) if hasattr(os, "SCHED_IDLE") else os.nice(0))


@posix
def test_sending_to_ended_process_is_safe(tmp_path):
    """With the system's default for SIGPIPE, as in Blender."""
    before = signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    try:
        process = BackendProcess([sys.executable, "-c", "pass"], tmp_path)
        until(lambda: process.exit_code == 0)
        assert process.send("stop") is False
    finally:
        signal.signal(signal.SIGPIPE, before)


def test_sending_does_not_wait_for_a_busy_process(tmp_path):
    """A request that waits is dropped for a newer one, and other lines are kept in order."""
    script, go = tmp_path / "fake.py", tmp_path / "go"
    script.write_text(
        PRELUDE
        + f"""
while not os.path.exists({str(go)!r}):
    time.sleep(0.01)
for line in sys.stdin:
    say("read", words=[line[:9].strip(), len(line)])
    if line.startswith("last"):
        break
"""
    )
    process = BackendProcess([sys.executable, str(script)], tmp_path)
    began = time.monotonic()
    for number in range(50):
        assert process.send(f"{number:02} " + 100_000 * "x", replaces=True)
        assert process.send(f"other {number:02}")
    assert process.send("last")
    assert time.monotonic() - began < 5.0
    go.touch()
    words = []
    until(lambda: process.exit_code == 0, lambda: words.extend(event["words"][0] for event in process.poll()))
    requests = [word for word in words if word[0].isdigit()]
    assert len(requests) < 5 and requests[-1] == "49 xxxxxx"
    others = [f"other {number:02}" for number in range(50)]
    assert [word for word in words if word not in requests] == ["attached", *others, "last"]


def test_killed_process_leaves_no_thread(tmp_path):
    before = threading.active_count()
    process = BackendProcess([sys.executable, "-c", "import time; time.sleep(60)"], tmp_path)
    process.send(1_000_000 * "x")
    process.kill()
    until(lambda: threading.active_count() <= before)
    assert process.send("stop") is False


def test_failed_starts_are_reported(make, tmp_path):
    job = run(make("", command=[str(tmp_path / "no-python"), "-m", "backend"]))
    assert job.state is State.FAILED and "no-python could not be started" in job.error
    job = run(make("", cwd=tmp_path / "gone"))
    assert job.state is State.FAILED and "gone is missing" in job.error
    (tmp_path / "text").write_text("no program")
    job = run(make("", command=[str(tmp_path / "text")]))
    assert job.state is State.FAILED and "could not be started" in job.error
    job = run(make("print('usage: tar'); sys.exit(64)", if_silent="tar is no Python."))
    assert job.error == "tar is no Python."


def test_child_detects_closed_stdin(tmp_path):
    script = tmp_path / "fake.py"
    script.write_text(PRELUDE + TRAINS)
    process = BackendProcess([sys.executable, str(script)], tmp_path)
    until(lambda: any(event["type"] == "progress" for event in process.poll()))
    process._process.stdin.close()
    until(lambda: any(event.get("message") == "Nobody there" for event in process.poll()))
    until(lambda: (process.poll(), process.exit_code)[1] == 3)
    assert not process.send("pause")


def test_time_left_falls_with_the_clock(monkeypatch):
    clock = [100.0]
    monkeypatch.setattr(jobs.time, "monotonic", lambda: clock[0])
    job = Job(title="Train", kind="train", folder=None, command=[], cwd=Path(), state=State.RUNNING)
    job._take({"type": "progress", "done": 1, "total": 4})
    assert job.seconds_left is None and job_display.summary(job) == "Train: , 25 %"
    job._take({"type": "progress", "done": 1, "total": 4, "seconds_left": 120})
    shown = []
    for _ in range(5):
        shown.append(job_display.summary(job).removeprefix("Train: , 25 %, "))
        clock[0] += 30
    assert shown == ["2:00 left", "1:30 left", "1:00 left", "less than a minute", "less than a minute"]
    job._take({"type": "progress", "done": 1, "total": 4, "seconds_left": None})
    assert job.seconds_left is None


def test_panels_are_redrawn_as_the_time_left_falls(monkeypatch):
    clock, drawn = [100.0], []
    monkeypatch.setattr(background.time, "monotonic", lambda: clock[0])
    monkeypatch.setattr(background, "redraw", lambda: drawn.append(clock[0]))
    job = Job(title="Train", kind="train", folder=None, command=[], cwd=Path(), state=State.RUNNING)
    monkeypatch.setattr(background, "queue", JobQueue())
    background.queue.add(job)
    job._take({"type": "progress", "done": 1, "total": 4, "seconds_left": 120})
    while clock[0] < 160:
        background._tick.__wrapped__()
        clock[0] += 1
    assert drawn[0] == 100 and 4 <= len(drawn) <= 6, "for each time that is written, of 2:00 to 1:00 left"


def test_time_left_is_steady_but_follows_the_truth(monkeypatch):
    clock = [0.0]
    monkeypatch.setattr(jobs.time, "monotonic", lambda: clock[0])
    job = Job(title="", kind="train", folder=None, command=[], cwd=Path(), state=State.RUNNING)

    def run(seconds, left):
        """Return what is shown in each second; left: what is reported, by the seconds of this run."""
        shown = []
        for second in range(seconds):
            job._take({"type": "progress", "done": 0.5, "total": 1.0, "seconds_left": left(second)})
            shown.append(job.seconds_left)
            clock[0] += 1
        return np.array(shown)

    jumping = run(100, lambda second: (200 - second) * (1.0 + (0.4, -0.4)[second % 2]))
    assert np.abs(np.diff(jumping[20:])).max() < 15, "reported are jumps of 80 to 160 seconds"
    assert abs(jumping[-1] - 101) < 15
    longer = run(40, lambda second: 400 - second)
    assert abs(longer[-1] - 361) < 361 * 0.05, "a job that takes longer than expected is said to"
    ending = run(40, lambda second: 40 - second)
    assert abs(ending[-10:] - np.arange(10, 0, -1)).max() < 2, "near the end it is exact"
    job.state, job._paused_at = State.PAUSED, clock[0]
    clock[0] += 1000
    job._shift_clock()
    assert run(1, lambda _second: 60)[0] < 20, "the pause is not a time in which the estimates are followed"


def test_stages_are_named_and_progress_only_rises():
    job = Job(title="", kind="train", folder=None, command=[], cwd=Path(), state=State.RUNNING)
    job._take({"type": "status", "message": "Reading the COLMAP model", "stage": "Preparing", "number": 1, "of": 3})
    assert job.stage == "Preparing (1 of 3)" and job.message == "Reading the COLMAP model"
    job._take({"type": "progress", "done": 4, "total": 4})
    assert job.progress == 0.99, "a job that works is not complete"
    job._take({"type": "progress", "done": 1, "total": 4})
    assert job.progress == 0.99
    job._take({"type": "status", "message": "Paused"})
    assert job.stage == ""
    job._take({"type": "status", "message": "Odd", "stage": 7, "number": "a", "of": None})
    assert job.stage == ""


def test_job_of_folder_is_found_by_equivalent_paths(make, tmp_path):
    (tmp_path / "a").mkdir()
    queue = JobQueue()
    older, newer = make("", folder=tmp_path / "a"), make("", folder=tmp_path / "b" / ".." / "a")
    queue.add(older)
    queue.add(newer)
    queue.add(make("", folder=None))
    assert queue.of_folder(tmp_path / "a" / ".") is newer
    assert queue.of_folder(tmp_path / "b") is None
    older.state = State.PAUSED
    assert queue.of_folder(tmp_path / "a") is older, "a waiting job does not hide the one that runs"
    older.state = State.WAITING


@pytest.mark.parametrize(("code", "text"), [(0xC0000005, "0xC0000005"), (1, "choose another")])
def test_crashes_on_windows_are_told_from_programs_that_are_no_backend(monkeypatch, code, text):
    monkeypatch.setattr(jobs.sys, "platform", "win32")
    job = Job(title="", kind="train", folder=None, command=[], cwd=Path(), if_silent="No backend; choose another.")
    job.log = ["Windows fatal exception: access violation", '  File "x.py"']
    found = job._crash(code)
    assert text in found and (code == 1 or "access violation" in found)


class Recorder(Reporter):
    """Reporter that stores messages and warnings."""

    def __init__(self):
        self.messages, self.warnings = [], []

    def status(self, message):
        self.messages.append(message)

    def warning(self, message):
        self.warnings.append(message)


def test_run_blocking_reports_every_message(make):
    reporter = Recorder()
    job = make("for n in range(100): say('status', message=f'object {n}')\nsay('done', message='Voted.')")
    assert run_blocking(job, reporter) == 0
    assert reporter.messages == [*(f"object {n}" for n in range(100)), "Voted."]


def test_run_blocking_leaves_the_end_to_its_caller(make):
    reporter = Recorder()
    assert run_blocking(make("say('status', message='Voting')\nsay('done')"), reporter) == 0
    assert reporter.messages == ["Voting"]


def test_run_blocking_reports_and_returns_the_exit_code(make):
    reporter = Recorder()
    code = run_blocking(
        make("""
say("status", message="Voting")
time.sleep(0.2)
say("warning", message="One mask is empty.")
say("done", message="Voted.")
"""),
        reporter,
    )
    assert code == 0 and reporter.messages == ["Voting", "Voted."] and reporter.warnings == ["One mask is empty."]
    refused = make('say("error", message="No masks."); sys.exit(2)')
    assert run_blocking(refused, Reporter()) == 2 and refused.error == "No masks."
    assert run_blocking(make("os._exit(9)"), Reporter()) == 1
    assert run_blocking(make("", command=["/no/such/python"]), Reporter()) == 2


def test_run_blocking_ends_the_bar_of_a_failed_job(make):
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    stream, before = Terminal(), threading.active_count()
    job = make('say("progress", done=0.4, total=1.0); time.sleep(0.1); sys.exit(1)')
    assert run_blocking(job, ConsoleReporter(stream)) == 1
    assert "40% |" in stream.getvalue() and stream.getvalue().endswith("\n")
    until(lambda: threading.active_count() <= before)


@posix
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_run_blocking_saves_on_a_signal(make, number):
    before = signal.getsignal(number)
    threading.Timer(0.7, os.kill, (os.getpid(), number)).start()
    reporter = Recorder()
    assert run_blocking(make(TRAINS), reporter) == 130
    assert reporter.messages[-1] == "Saved at step 10." and signal.getsignal(number) is before


@posix
def test_run_blocking_second_signal_kills_job(make):
    for seconds in (0.7, 1.0):
        threading.Timer(seconds, os.kill, (os.getpid(), signal.SIGINT)).start()
    assert run_blocking(make(UNRESPONSIVE), Reporter()) == 130


def test_backend_command_line():
    assert backend_command("/py", "train", Path("a"), "--out", "b") == [
        "/py",
        "-m",
        "backend",
        "train",
        str(Path("a")),
        "--out",
        "b",
        "--json",
    ]


def test_sentences_have_the_names_that_blender_shows():
    """Options without a name, those of other words and commands for a terminal stay."""
    assert in_blender("The folder a--out is full; choose another --out, or --restart.") == (
        "The folder a--out is full; choose another Save To, or Retrain."
    )
    assert in_blender("The folder a contains files; choose an empty or new folder, or use the option --overwrite.") == (
        "The folder a contains files; choose an empty or new folder."
    )
    assert in_blender("The GPU's memory is full; close programs that use it, or use --device cpu.") == (
        "The GPU's memory is full; close programs that use it."
    )
    assert in_blender("Train it with --mode explicit; specify more --minutes or --steps, or a smaller --set.") == (
        "Train it with the Model Plain Splats; specify more Minutes, or a smaller Set."
    )
    assert in_blender("It was trained with --max-size 800; choose a checkpoint as --segmenter.") == (
        "It was trained with Image Size 800; choose a checkpoint as Segmentation Model."
    )
    assert in_blender("There is not enough memory; try a smaller --max-size, --memory-mb or --max-anchors.") == (
        "There is not enough memory; close other programs, or use a smaller Image Size."
    )
    assert in_blender("It may take 9 GB; --max-anchors 9000 fits, and `split` divides larger models into cells.") == (
        "It may take 9 GB; close other programs, or use a smaller Image Size and Retrain."
    )
    no_model = "a has no model, which --text and --detector are for; choose a folder with one as MASKS."
    assert in_blender(no_model) == "a has no model, which Names is for; clear Names, or choose a folder with one."
    assert in_blender("It may take 9 GB; close other programs, or use a smaller --memory-mb or --max-size.") == (
        "It may take 9 GB; close other programs, or use a smaller Image Size."
    )
    masks = "`clean-labels` gives its splats their objects, and --restart trains with them."
    assert in_blender(masks) == "Clean Up Labels gives its splats their objects, and Retrain trains with them."
    assert in_blender("The GPU failed; `doctor` tests the GPU.") == "The GPU failed; Check Backend tests the GPU."
    assert in_blender("It has another plan; use the same --keep and --leave-out, or --restart to start over.") == (
        "It has another plan; set the check boxes of the panel Plan as they were, or Retrain to start over."
    )
    assert in_blender("It is of another capture; use the same one, a different --out, or --restart to start over.") == (
        "It is of another capture; use the same one, or Retrain to start over."
    )
    assert in_blender("The photos of the scene do not tell its true size.").endswith(
        "do not tell its true size; Set Distance in the panel Placement gives it."
    )
    for kept in ("--seed 3", "run pip install torch --out x", "--text-file", "--per-object"):
        assert in_blender(kept) == kept


def test_names_of_options_are_those_of_blender():
    """Each name is a literal of the add-on's properties, operators or preferences."""
    root = Path(__file__).resolve().parents[2]
    paths = [path for name in ("operators", "objectgs_addon") for path in (root / name).rglob("*.py")]
    code = "".join(path.read_text() for path in paths if path.name != "wording.py")
    assert [name for name in wording._NAMES.values() if f'"{name}"' not in code] == []


def test_a_job_again_uses_the_present_python_and_keeps_its_checkpoint(tmp_path):
    command = backend_command(tmp_path / "old", "train", "capture", "--restart")
    job = Job("Train", "train", tmp_path, command, tmp_path)
    assert job.again(None).command == command
    fresh = job.again(tmp_path / "new").command
    assert fresh == backend_command(tmp_path / "new", "train", "capture", "--restart"), "nothing was trained yet"
    job.step = 10
    assert job.again(None).command == backend_command(tmp_path / "old", "train", "capture")
    other = Job("Set up", "setup", None, ["python3", "-m", "venv", "--restart"], tmp_path)
    assert other.again(tmp_path / "new").command == other.command


def test_panel_tells_warnings_of_a_running_job_and_what_others_wait_for(tmp_path, monkeypatch):
    """Both matter while a job runs: a training on the processor takes hours."""
    train, mesh = (Job(title, "train", tmp_path, ["true"], tmp_path) for title in ("Train", "Extract Meshes"))
    train.state, train.message = State.PAUSED, "Starting"
    train.warnings = ["One.", "Two.", "A smaller --max-size is faster."]
    monkeypatch.setattr(background.queue, "jobs", [train, mesh])
    told = texts_of(JobsPanel)
    assert "Two. A smaller Image Size is faster." in told and "One." not in told
    assert "Extract Meshes: waiting for Train (paused)" in told


def test_first_panel_tells_the_stage_of_a_job_but_no_step(tmp_path):
    train = Job("Train trip", "train", tmp_path, ["true"], tmp_path)
    train.state, train.message = State.PAUSED, "Reading the photos"

    class Brief:
        def draw(self, _context):
            draw_job(self.layout, train, 0, brief=True)

    assert "Train trip" in texts_of(Brief) and "Train trip:" not in texts_of(Brief)
    train.stage = "Preparing (1 of 3)"
    assert "Train trip: Preparing (1 of 3)" in texts_of(Brief) and "Reading" not in texts_of(Brief)


def test_ends_are_told_with_what_was_made(tmp_path, monkeypatch):
    told = []
    monkeypatch.setattr(messages, "show", lambda text, **more: told.append((text, more)))
    film = Job("Film", "film", tmp_path, ["true"], tmp_path)
    film.result = {"film": str(tmp_path), "frames": 12}
    results.SHOW_BY_KIND["film"](film, None)
    opens = {"operator": "wm.path_open", "label": "Open Folder", "filepath": str(tmp_path)}
    assert told == [(f"12 frames are in {tmp_path}.", opens)]
    setup = Job("Set up backend", "setup", tmp_path, ["true"], tmp_path)
    setup.message, setup.warnings = "It works; training uses the CPU.", ["PyTorch's builds could not be reached."]
    results.SHOW_BY_KIND["setup"](setup, None)
    assert told[1] == ("It works; training uses the CPU. PyTorch's builds could not be reached.", {})
