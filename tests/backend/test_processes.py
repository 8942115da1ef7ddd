"""Tests of trainings that several processes share."""

import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from backend.model.checkpoint import load_checkpoint
from backend.shared.errors import EXIT_CANCELLED, EXIT_DONE, EXIT_FAILED, InputError
from backend.training.check_finite import Fault
from backend.training.optimizer.row_adam import RowAdam
from backend.training.processes.shared_views import Outcome, SharedViews
from backend.training.processes.team import Team, choose_gpu, processes_here
from backend.training.settings import Settings
from backend.training.trainer import Trainer

ROOT = Path(__file__).resolve().parents[2]

TRAIN = """
import sys
from pathlib import Path
import numpy as np, torch
from backend.capture import load_capture
from backend.labels import vote
from backend.raster import devices
from backend.shared.events import Reporter
from backend.training.budget import Budget
from backend.training.processes.team import connect
from backend.training.settings import Settings
from backend.training.trainer import Trainer

torch.set_num_threads(1)
out = Path(sys.argv[2])
team = connect(devices.CPU)
capture = load_capture(Path(sys.argv[1]), out / f"cache{team.rank}")
trainer = Trainer.start(capture, vote(capture).ids, Settings(offsets=2, fit_colors=True))
if team.rank:
    trainer.follow(team)
else:
    trainer.work_with(team)
    evaluated = []
    trainer.run(Budget(steps=120), out / "checkpoint", Reporter(), lambda *_: evaluated.append(0) or {})
    team.close()
anchors, p = trainer.model.anchors, trainer.progress
heads = torch.cat([value.flatten() for value in trainer.model.heads.state_dict().values()])
colors = trainer.view_step.colors.values
np.savez(out / f"{team.rank}.npz", positions=anchors.positions, rows=anchors.rows, heads=heads, colors=colors,
         mean=trainer.shown.anchors.rows, growth=trainer.optimizer.growth.statistics.gradient,
         queue=p.queue, state=[p.step, p.last_growth])
"""


def start(command: list, count: int, **options) -> list[subprocess.Popen]:
    """Start a command in several processes, with the environment that torchrun gives them."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    common = {"WORLD_SIZE": count, "LOCAL_WORLD_SIZE": count, "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port}
    return [
        subprocess.Popen(
            [sys.executable, *map(str, command)], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            env={**os.environ, **{name: str(value) for name, value in {**common, "RANK": i, "LOCAL_RANK": i}.items()}},
            **options,
        )
        for i in range(count)
    ]  # fmt: skip


def test_growth_is_as_frequent_with_several_views_a_step(tiny):
    capture, ids = tiny()
    growth = Trainer.start(capture, ids, Settings(offsets=2)).optimizer.growth
    rounds = {}
    for views in (1, 4, 7):
        last, rounds[views] = 0, []
        for step in range(views, 4000, views):
            if growth.is_due(step / 4000, step, last):
                last = growth.counted_from(step, last, views)
                rounds[views].append(step)
    due = np.array(rounds[1])
    assert np.diff(due).min() >= 25 and len(due) > 80
    for views in (4, 7):
        assert abs(len(rounds[views]) - len(due)) <= 2


def test_late_views_are_computed_at_the_expected_heads(tiny, monkeypatch):
    capture, ids = tiny()
    trainer = Trainer.start(capture, ids, Settings(offsets=2))
    for step in range(20):
        trainer.step(step / 40)

    def heads():
        return torch.cat([value.detach().flatten() for value in trainer.optimizer.heads.parameters])

    team, used = Team(), []
    team.rank, team.size = 2, 3
    trainer.work_with(team)
    trainer.progress.queue = list(capture.train_indices)
    monkeypatch.setattr(trainer.view_step, "compute", lambda *_, **__: used.append(heads()))
    before = heads()
    trainer._compute(0.5)
    assert torch.equal(heads(), before) and not torch.equal(used[0], before)
    with trainer.optimizer.heads_ahead(2, 0.5):
        assert torch.equal(heads(), used[0])

    team.size = 4
    trainer.progress.step, trainer.progress.last_growth = 103, 75
    trainer._grow([], 0.5)
    assert trainer.progress.last_growth == 100, "growth was due three steps before"


def ended(processes: list[subprocess.Popen]) -> list[tuple[int, str, str]]:
    """Wait for processes; returns exit code, output and errors of each."""
    found = []
    try:
        for process in processes:
            out, err = process.communicate(timeout=200)
            found.append((process.returncode, out, err))
    finally:
        for process in processes:
            process.kill()
    return found


class Echo(Team):
    """A team whose other processes send the same."""

    size = 3

    def exchange(self, tensors):
        received = [torch.from_numpy(tensor.numpy().copy()) for tensor in tensors]
        return [tensors, received, tensors]


def test_gradients_arrive_as_they_were_sent(tiny) -> None:
    capture, ids = tiny()
    trainer = Trainer.start(capture, ids, Settings(offsets=2, fit_colors=True))
    gradients = trainer.view_step.compute(capture.train_indices[0], 0.1)
    gradients = gradients._replace(heads=[None, *gradients.heads[1:]], in_view=torch.tensor(7))
    shared = SharedViews(Echo(), trainer.settings.layout.columns, trainer.optimizer.heads.parameters)
    anchors = len(trainer.model.anchors)
    _, got, _ = shared.exchange(Outcome(gradients, None), None, anchors)
    assert got.fault is None and got.gradients.size == gradients.size and got.gradients.loss == gradients.loss
    for name in ("seen", "rows", "colors", "in_view"):
        assert torch.equal(getattr(got.gradients, name), getattr(gradients, name)), name
    (none, *heads), (_, *wanted) = got.gradients.heads, gradients.heads
    assert none is None and all(torch.equal(have, want) for have, want in zip(heads, wanted, strict=True))
    for have, want in zip(got.gradients.statistics[:5], gradients.statistics[:5], strict=True):
        assert np.array_equal(np.asarray(have), np.asarray(want))
    fault = Fault("the image loss", torch.tensor([3]), 1, torch.tensor([3]))
    _, (nothing, of_other), _ = shared.exchange(Outcome(None, fault), None, anchors)
    assert nothing is None and of_other.sentence(5, "a.png", "mug") == fault.sentence(5, "a.png", "mug")
    with pytest.raises(InputError, match=r"cannot be read\.$"):
        shared.exchange(Outcome(None, None), OSError("a.png cannot be read."), anchors)


def test_changes_are_expected_from_steady_gradients() -> None:
    """Then they are the learning rate times the sign of the gradient."""
    rows, seen = torch.zeros((3, 2)), torch.tensor([0, 2])
    optimizer, rates = RowAdam(rows, 0), np.array([0.1, 0.2], np.float32)
    assert not optimizer.expected_change(seen, rates, 0).any()
    for number in range(1, 4):
        optimizer.step(rows, seen, torch.tensor([[3.0, -2.0], [0.0, 5.0]]), rates, number, None)
    before = rows.clone()
    expected = optimizer.expected_change(seen, rates, 3)
    torch.testing.assert_close(expected, torch.tensor([[-0.1, 0.2], [0.0, -0.2]]))
    optimizer.step(rows, seen, torch.tensor([[3.0, -2.0], [0.0, 5.0]]), rates, 4, None)
    torch.testing.assert_close((rows - before)[seen], expected)


def test_each_process_needs_a_gpu(monkeypatch) -> None:
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "4")
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    assert processes_here() == 4
    with pytest.raises(InputError, match="2 GPUs for 4 processes; use torchrun with --nproc-per-node 2"):
        choose_gpu()


@pytest.mark.long
def test_all_processes_have_the_same_model(write_capture, tmp_path) -> None:
    """Bit for bit, after growth; and no view is left out in a pass over the views."""
    scene = write_capture(views=10, size=(64, 48))
    results = ended(start(["-c", TRAIN, scene.folder, tmp_path], 3))
    assert [code for code, _, _ in results] == [0, 0, 0], results
    first, *others = (dict(np.load(tmp_path / f"{rank}.npz")) for rank in range(3))
    assert first["state"].tolist()[0] == 120 and first["state"][1] > 0
    for other in others:
        for name, values in first.items():
            assert np.array_equal(values, other[name]), name


@pytest.mark.long
def test_lost_process_ends_the_training_which_can_be_resumed(write_capture, tmp_path, run_command) -> None:
    capture, out = write_capture(views=9, size=(64, 48)).folder, tmp_path / "out"
    train = ("train", capture, "--out", out, "--offsets", "2", "--steps", "100000")
    lost = start(["-m", "backend", *train, "--json"], 2)
    assert any('"step"' in line for line in lost[0].stdout)
    lost[1].send_signal(signal.SIGKILL)
    (code, said, _), _ = ended(lost)
    assert code == EXIT_FAILED and "Another process of the training has ended; run the same command" in said
    step = load_checkpoint(out / "checkpoint")[1]["progress"]["step"]
    assert step > 0
    stopped = start(["-m", "backend", *train], 2)
    assert any("Resuming" in line for line in stopped[0].stdout)
    for process in stopped:
        process.send_signal(signal.SIGTERM)
    (code, said, _), (of_other, nothing, nor_errors) = ended(stopped)
    assert code == EXIT_CANCELLED and "run the same command again to resume" in said
    assert of_other == EXIT_DONE and nothing == nor_errors == ""
    later = load_checkpoint(out / "checkpoint")[1]["progress"]["step"]
    assert later >= step
    result = run_command(*train[:-1], later + 4)
    assert result.code == EXIT_DONE
    assert load_checkpoint(out / "checkpoint")[1]["progress"]["step"] == later + 4
