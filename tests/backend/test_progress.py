"""Progress of whole commands: named stages, never backwards, and complete only at the end."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from itertools import takewhile
from pathlib import Path

import numpy as np
import pytest

from backend.commands.setup import kernels
from backend.shared import events
from backend.shared.events import Reporter, StagedReporter
from backend.shared.reconstruction.shot import Frame, Placed, Sample, Shot, write_shot

from .conftest import write_scene

ROOT = Path(__file__).resolve().parents[2]
STAGES = {
    "check": [""],
    "import": ["Preparing (1 of 2)", "Planning (2 of 2)"],
    "plan": ["Preparing (1 of 2)", "Planning (2 of 2)"],
    "vote": ["Preparing (1 of 3)", "Voting (2 of 3)", "Planning (3 of 3)"],
    "train": ["Preparing (1 of 3)", "Training (2 of 3)", "Saving (3 of 3)"],
    "evaluate": ["Preparing (1 of 3)", "Measuring the views (2 of 3)"],
    "render": ["Preparing (1 of 2)", "Rendering (2 of 2)"],
    "mesh": ["Preparing (1 of 3)", "Fitting discs (2 of 3)", "Meshing (3 of 3)"],
    "report": ["Preparing (1 of 3)", "Drawing (2 of 3)", "Saving (3 of 3)"],
    "film": ["Preparing (1 of 2)", "Rendering (2 of 2)"],
    "fill": ["Reading (1 of 2)", "Filling (2 of 2)"],
    "export": ["Reading (1 of 3)", "Editing (2 of 3)", "Saving (3 of 3)"],
    "import-splats": ["Reading (1 of 4)", "Preparing (2 of 4)", "Voting (3 of 4)", "Saving (4 of 4)"],
}
"""The stages of each kind of job on the small capture, in order."""


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """A capture, and a reconstruction of it that the jobs fill in the order of `STAGES`, with a shot for the film."""
    place = tmp_path_factory.mktemp("progress")
    write_scene(place / "capture", views=9, size=(64, 48))
    camera = Sample(1.0, np.eye(4), np.array([[64.0, 0, 32], [0, 64, 24], [0, 0, 1]]), (0.01, 100.0), {1: Placed()})
    write_shot(place / "shot.json", Shot(64, 48, [Frame(number, (number, number), [camera]) for number in (1, 2, 3)]))
    return place


@pytest.fixture(scope="module")
def done():
    """The kinds of jobs that were run in `folders`; another process may have run the tests of the others."""
    return set()


def words_of(kind: str, place: Path) -> list[str | Path]:
    """Return the command line of a kind of job."""
    capture, out = place / "capture", place / "out"
    return {
        "check": ["check", capture],
        "import": ["import", capture, "--out", out],
        "plan": ["plan", capture, "--out", out],
        "vote": ["vote", capture, "--out", out],
        "train": ["train", capture, "--out", out, "--steps", "40"],
        "evaluate": ["evaluate", out],
        "render": ["render", out],
        "mesh": ["mesh", out, "--faces", "500", "--objects", "1", "--texture-size", "256"],
        "report": ["report", out],
        "film": ["film", out, "--shot", place / "shot.json", "--out", place / "film"],
        "fill": ["edit", out, "--remove", "1", "--fill"],
        "export": ["export", out, "--out", place / "export.ply"],
        "import-splats": ["import-splats", place / "export.ply", "--out", place / "again", "--capture", capture],
    }[kind]


@pytest.mark.parametrize("kind", STAGES)
@pytest.mark.long
def test_progress_of_each_kind_of_job(folders, done, run_command, kind):
    for earlier in takewhile(lambda each: each != kind, STAGES):
        if earlier not in done:
            assert run_command(*words_of(earlier, folders), "--json").code == 0
            done.add(earlier)
    done.add(kind)
    began = time.time()
    result = run_command(*words_of(kind, folders), "--json")
    assert result.code == 0, result
    first = result.events[0]
    assert first["type"] == "status" and first["time"] - began < 2, "the user is told at once what is done"
    check_events(result.events)
    assert stages_of(result.events)[: len(STAGES[kind])] == STAGES[kind]


def check_events(found: list[dict]) -> None:
    """Check that progress never decreases, starts near 0 and is complete only when the command is."""
    shares = [event["done"] / event["total"] for event in found if event["type"] == "progress"]
    assert shares and shares == sorted(shares)
    assert shares[0] == 0 and 0.2 < shares[-1] < 1
    left = [event["seconds_left"] for event in found if event["type"] == "progress"]
    assert all(seconds >= 0 for seconds in left)


def stages_of(found: list[dict]) -> list[str]:
    """Return the stages of status events, in order and once each."""
    names = [
        f"{event['stage']} ({event['number']} of {event['of']})" if "stage" in event else ""
        for event in found
        if event["type"] == "status"
    ]
    return list(dict.fromkeys(names))


@pytest.mark.long
def test_compilation_is_a_part_of_its_own(folders, run_command, monkeypatch):
    """A job in a new Python compiles first, as preparation, and training does not begin at 0 again."""
    monkeypatch.setattr(kernels, "_are_ready", lambda _device: False)
    result = run_command("train", folders / "capture", "--out", folders / "new", "--steps", "20", "--json")
    assert result.code == 0, result
    check_events(result.events)
    said = [event for event in result.events if event["type"] == "status"]
    compiling = next(event for event in said if event["message"].startswith("Compiling kernels"))
    assert (compiling["stage"], compiling["number"], compiling["of"]) == ("Preparing", 1, 3)
    later = result.events[result.events.index(compiling) :]
    training = next(place for place, event in enumerate(later) if event.get("stage") == "Training")
    shares = {event["done"] for event in later[:training] if event["type"] == "progress"}
    assert len(shares) > 8 and max(shares) - min(shares) > 0.3, "the compilation has progress of its own"


@pytest.mark.long
def test_set_up_compiles_what_jobs_need(folders, run_command):
    """After `doctor`, which Set Up Backend runs, the kernels of all jobs are in the cache."""
    assert run_command("doctor", "--json").code == 0
    # Other tests fill the same cache at the same time, so each process says what it saves there itself.
    environment = {**os.environ, "NUMBA_DEBUG_CACHE": "1"}
    for words in (
        ["train", folders / "capture", "--out", folders / "other", "--steps", "120"],
        ["mesh", folders / "other", "--faces", "500", "--texture-size", "256"],
        ["film", folders / "other", "--shot", folders / "shot.json", "--out", folders / "other-film"],
    ):
        command = [sys.executable, "-m", "backend", *words, "--json"]
        ran = subprocess.run(command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
        assert ran.returncode == 0, ran.stdout
        assert b"[cache] data loaded" in ran.stdout
        saved = [line for line in ran.stdout.splitlines() if b"[cache] data saved" in line]
        assert not saved
        assert b"Compiling" not in ran.stdout


class Recorder(Reporter):
    def __init__(self):
        self.events = []

    def status(self, message, **stage):
        self.events.append({"type": "status", "message": message, **stage})

    def progress(self, done, total, **fields):
        self.events.append({"type": "progress", "done": done, "total": total, **fields})


def test_time_left_follows_the_pace_and_expects_later_parts(monkeypatch):
    clock = [0.0]
    monkeypatch.setattr(events.time, "monotonic", lambda: clock[0])
    recorder = Recorder()
    staged = StagedReporter(recorder)
    staged.expect({"a": ("First", 10.0), "skipped": ("First", 50.0), "b": ("Second", 30.0)})
    staged.begin("a", "Reading")
    assert recorder.events[-1] == {"type": "progress", "done": 0.0, "total": 1.0, "seconds_left": 90.0}
    clock[0] = 20.0
    staged.progress(1, 2)
    assert recorder.events[-1]["seconds_left"] == 100.0
    staged.progress(0, 2)
    assert recorder.events[-1]["done"] == recorder.events[-2]["done"]
    staged.expect({"b": ("Second", 60.0)})
    staged.begin("b", "Working")
    assert recorder.events[-1]["seconds_left"] == 60.0
    staged.progress(1, 2, seconds_left=7.0)
    clock[0] = 30.0
    staged.progress(5, 2)
    assert [event["seconds_left"] for event in recorder.events[-2:]] == [7.0, 0.0]
    assert recorder.events[-1]["done"] == 0.99


def test_commands_without_parts_report_as_before():
    recorder = Recorder()
    staged = StagedReporter(recorder)
    staged.status("Reading")
    staged.progress(1, 2, what="files")
    assert json.loads(json.dumps(recorder.events)) == [
        {"type": "status", "message": "Reading"},
        {"type": "progress", "done": 1, "total": 2, "what": "files"},
    ]
