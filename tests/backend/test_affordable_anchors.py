"""Short trainings on the CPU begin with as many anchors as they have time for."""

from __future__ import annotations

import re
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from backend.capture import load_capture
from backend.commands.training import train
from backend.shared.errors import EXIT_DONE
from backend.shared.events import Reporter
from backend.training import initial_model
from backend.training.budget import Budget
from backend.training.initial_model import FEWEST_ANCHORS, affordable_anchors
from backend.training.settings import Settings
from backend.training.step import ViewStep
from backend.training.trainer import Trainer

SMALL = Settings(offsets=2)


def many_points(write_capture, count=11_000):
    """A capture in which `count` points, far apart, would each get an anchor."""
    scene = write_capture(views=9, size=(64, 48))
    scene.xyz = np.random.default_rng(0).uniform(-1.0, 1.0, (count, 3))
    scene.rgb = np.zeros((count, 3), np.uint8)
    scene.seen, scene.pixels = [np.zeros(0, int)] * 9, [np.zeros((0, 2))] * 9
    write_capture.write_model(scene, scene.folder / "sparse/0", ".bin")
    return scene.folder


def test_number_follows_the_passes_over_the_views():
    assert affordable_anchors(60_000, 8 * 100, 100) == affordable_anchors(60_000, 10_000, 100) == 60_000
    assert affordable_anchors(60_000, 400, 100) == 30_000 == affordable_anchors(60_000, 200, 50)
    assert affordable_anchors(60_000, 1, 100) == FEWEST_ANCHORS
    assert affordable_anchors(10_000, 1, 100) == 10_000


def test_points_are_thinned_evenly_and_cells_stay_fine(write_capture, tmp_path):
    capture = load_capture(many_points(write_capture), tmp_path / "cache")
    count = len(capture.points.xyz)
    ids = np.where(np.arange(count) < 3, [7, 8, 9] * (count // 3) + [7] * (count % 3), 0)
    every, some, fewest = (
        Trainer.start(capture, ids, SMALL, most_anchors=most).model.anchors for most in (None, 3000, 1)
    )
    assert len(every) > 9000 and 1500 < len(some) <= 3000 and len(fewest) == 4, "each object keeps a point"
    assert every.voxel == some.voxel == fewest.voxel
    assert len(np.unique(some.ids)) == 4
    extents = SMALL.layout.extent_columns
    assert some.rows[:, extents].median() > every.rows[:, extents].median(), "fewer anchors are larger"
    octants = np.unique(some.positions.numpy() > 0, axis=0, return_counts=True)[1]
    assert len(octants) == 8 and octants.min() > 0.7 * octants.mean()


def test_thinning_keeps_the_first_point_of_an_object_in_each_cell():
    rows = np.random.default_rng(0).integers(-3, 3, (2000, 4))
    assert np.array_equal(initial_model._first_of_each(rows), np.unique(rows, axis=0, return_index=True)[1])


def test_detail_that_is_known_is_not_measured_again(tiny, monkeypatch):
    capture, ids = tiny()
    seeds, checks = np.ones(len(ids), bool), []
    known = initial_model.measure_detail(capture, seeds, check=lambda: checks.append(0))
    assert len(checks) == len(capture.views)
    first = Trainer.start(capture, ids, SMALL, most_anchors=50).model.anchors
    monkeypatch.delattr(initial_model, "measure_detail")
    checks.clear()
    again = Trainer.start(
        capture, ids, SMALL, most_anchors=50, detail=known, check=lambda: checks.append(0)
    ).model.anchors  # fmt: skip
    assert torch.equal(first.rows, again.rows) and torch.equal(first.positions, again.positions)
    assert checks


def test_measuring_a_step_changes_nothing(tiny):
    capture, ids = tiny()
    trainer, same = (Trainer.start(capture, ids, Settings(offsets=2, fit_colors=True)) for _ in range(2))
    assert all(trainer.view_step.measure_seconds(index) > 0 for index in capture.train_indices[:3])
    for _ in range(3):
        assert torch.equal(trainer.step(0.5), same.step(0.5))
    assert torch.equal(trainer.model.anchors.rows, same.model.anchors.rows)
    pairs = zip(trainer.model.heads.parameters(), same.model.heads.parameters(), strict=True)
    assert all(torch.equal(a, b) for a, b in pairs)


def test_steps_may_take_no_time(monkeypatch):
    monkeypatch.setattr(train, "ensure_kernels", lambda *_: None)
    trainer = SimpleNamespace(
        scene=SimpleNamespace(capture=SimpleNamespace(train_indices=range(9))),
        model=SimpleNamespace(anchors=range(2 * FEWEST_ANCHORS), device=None),
        view_step=SimpleNamespace(measure_seconds=lambda index: 0.0),
    )
    assert train._affordable(trainer, None, 0, Budget(seconds=60.0), Reporter()) is trainer


@pytest.mark.parametrize(
    ("length", "fewer"),
    [
        (("--minutes", 0.02), True), (("--minutes", 600), False), (("--steps", 2), False),
        (("--minutes", 0.02, "--voxel", 0.001), False), (("--minutes", 0.02, "--mode", "paper"), False),
    ],
    ids=["short", "long", "steps", "voxel given", "paper"],
)  # fmt: skip
@pytest.mark.long
def test_only_short_trainings_begin_with_fewer(write_capture, tmp_path, run_command, monkeypatch, length, fewer):
    for module in (initial_model, train):
        monkeypatch.setattr(module, "FEWEST_ANCHORS", 2000)
    monkeypatch.setattr(ViewStep, "measure_seconds", lambda self, index: 1.0)
    if 600 in length:
        monkeypatch.setattr(Trainer, "run", lambda *args, **options: None)
    folder = many_points(write_capture)
    result = run_command(
        "train", folder, "--out", tmp_path / "out", *length, "--offsets", 2, "--device", "cpu", "--json"
    )
    messages = result.messages("status")
    begun = next(found for message in messages if (found := re.fullmatch(r"Training ([\d,]+) anchors", message)))
    anchors = int(begun[1].replace(",", ""))
    assert (anchors <= 2000) is fewer and (anchors > 9000) is not fewer
    assert any("more grow where they are missing" in message for message in messages) is fewer
    assert 600 in length or result.code == EXIT_DONE
