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
from backend.shared.durations import Limit
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
    assert all(seconds is None or seconds >= 0 for seconds in left)


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


PREPARES = {"read": 5.0, "compile": 60.0, "fit": Limit(90.0), "write": 10.0}
MATCHES = {"read": 2.0, "find": 30.0, "match": 40.0, "skipped": 5.0, "map": 30.0, "dense": 40.0}


@pytest.mark.parametrize("expected", [PREPARES, MATCHES], ids=["with a limit", "without"])
@pytest.mark.parametrize("slow", [1 / 3, 1, 3, 10])
def test_time_left_learns_how_slow_a_computer_is(expected, slow):
    """Of a command whose parts take `slow` times as long as expected; "map" reports no progress."""
    now, recorder = [0.0], Recorder()
    staged = StagedReporter(recorder, lambda: now[0])
    staged.expect({part: ("", seconds) for part, seconds in expected.items()})
    take = {part: seconds if isinstance(seconds, Limit) else slow * seconds for part, seconds in expected.items()}
    take.pop("skipped", None)
    total, ends, shown = sum(take.values()), 0.0, []
    for part, seconds in take.items():
        staged.begin(part, "")
        for tick in range(200):
            now[0] = ends + seconds * tick / 200
            staged.progress(0 if part == "map" else tick, 200)
            event = recorder.events[-1]
            shown.append((seconds, now[0], event["done"], event["seconds_left"]))
        ends += seconds
    weights, times, done, left = np.array(shown, float).T
    known = ~np.isnan(left)
    assert np.average(known, weights=weights) > 0.75
    error = np.abs(left + times - total)[known]
    assert np.average(error, weights=weights[known]) < 0.2 * total
    assert (np.diff(done) >= 0).all() and done[0] == 0 and done[-1] > 0.7
    by_time = times[known] / (times + left)[known]
    assert (done[known] > 0.98 * by_time).all(), "the percentage is not behind the time left"
    assert np.average(np.abs(done - times / total), weights=weights) < 0.15


def test_time_left_is_told_once_it_is_known():
    now, recorder = [0.0], Recorder()
    staged = StagedReporter(recorder, lambda: now[0])
    staged.expect({"a": ("First", 100.0), "b": ("Second", 100.0)})

    def left(seconds, done, **fields):
        now[0] = seconds
        staged.progress(done, 100, **fields)
        return recorder.events[-1]["seconds_left"]

    staged.begin("a", "Reading")
    assert recorder.events[-1] == {"type": "progress", "done": 0.0, "total": 1.0, "seconds_left": None}
    assert left(1, 0) is None
    assert left(40, 20) == pytest.approx(360, rel=0.15), "it takes twice as long as expected"
    assert left(50, 20) == pytest.approx(350, rel=0.15), "the time falls with the clock"
    staged.begin("b", "Working")
    assert left(51, 50, seconds_left=7.0) == 7.0
    assert left(52, 100) == 0.0
    assert recorder.events[-1]["done"] == 0.99
    assert left(62, 100) == 2.5, "it may not end at once"
    assert left(112, 100) is None


def test_later_parts_of_a_fixed_length_are_not_scaled():
    now, recorder = [0.0], Recorder()
    staged = StagedReporter(recorder, lambda: now[0])
    staged.expect({"a": ("", 50.0), "b": ("", Limit(600.0)), "c": ("", 10.0)})
    staged.begin("a", "")
    now[0] = 200.0
    staged.begin("b", "")
    assert 620 < recorder.events[-1]["seconds_left"] < 650
    now[0] = 800.0
    staged.expect({"c": ("", 100.0)})
    staged.begin("c", "")
    assert 300 < recorder.events[-1]["seconds_left"] < 400


def test_passes_of_a_part_are_no_steps_backward():
    now, recorder = [0.0], Recorder()
    staged = StagedReporter(recorder, lambda: now[0])
    staged.expect({"a": ("", 20.0), "b": ("", Limit(80.0))})
    staged.begin("a", "")
    for tick in range(40):
        now[0] += 0.5
        staged.progress(tick % 10, 10)
        event = recorder.events[-1]
        assert event["seconds_left"] is None or 80 <= event["seconds_left"] < 110
        assert event["done"] <= 0.25


def test_commands_without_parts_report_as_before():
    recorder = Recorder()
    staged = StagedReporter(recorder)
    staged.status("Reading")
    staged.progress(1, 2, what="files")
    assert json.loads(json.dumps(recorder.events)) == [
        {"type": "status", "message": "Reading"},
        {"type": "progress", "done": 1, "total": 2, "what": "files"},
    ]
