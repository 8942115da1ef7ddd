"""Detection of overfitting on spared views, and dropout of splats."""

from __future__ import annotations

import pytest
import torch

from backend.model.generate import Generated
from backend.shared.errors import Cancelled
from backend.shared.stopping import StopRequest
from backend.training import overfitting
from backend.training import trainer as trainer_module
from backend.training.budget import Budget, TrainingProgress
from backend.training.overfitting import Dropout, choose_watched_views, dropout_at, watch
from backend.training.settings import Settings
from backend.training.trainer import Trainer


def splats(count: int) -> Generated:
    """Return Gaussians whose opacities are 0.5."""
    of = torch.zeros(count)
    return Generated(of, of, of, torch.full((count,), 0.5), of, of, of)


def test_few_views_with_few_points_spare_some() -> None:
    training = [1, 2, 3, 4, 6, 7, 8, 9, 10, 11, 12]
    watched = choose_watched_views(training, 400)
    assert len(watched) == 3 and set(watched) < set(training)
    assert watched[0] <= 3 and watched[-1] >= 9
    assert choose_watched_views(training, 100 * len(training)) == []
    assert choose_watched_views(training[:8], 100) == []
    assert choose_watched_views(range(61), 100) == []


@pytest.mark.parametrize(
    ("psnr", "overfits"),
    [([20.0, 22.0, 22.5], False), ([20.0, 22.0, 21.9], False), ([20.0, 22.0, 21.7], True), ([None], False)],
)
def test_dropout_begins_where_spared_views_become_worse(psnr: list[float | None], overfits: bool) -> None:
    p = TrainingProgress(step=30, watched=[3, 5], curve=[{"watched_psnr": value} for value in psnr])
    assert watch(p, Budget(steps=100)) is overfits
    assert p.watched == ([] if overfits else [3, 5])
    dropout = dropout_at(p, 0.4, 7)
    assert (dropout is not None) is overfits and dropout_at(p, 0.99, 7) is None
    assert watch(p, Budget(steps=100)) is False


@pytest.mark.parametrize(
    ("budget", "released"), [(Budget(steps=100), 35), (Budget(until_converged=True), 1800)], ids=("steps", "converged")
)
def test_spared_views_join_the_others(budget: Budget, released: int) -> None:
    p = TrainingProgress(step=released - 1, watched=[3, 5])
    watch(p, budget)
    assert p.watched == [3, 5]
    p.step = released
    watch(p, budget)
    assert p.watched == [] and dropout_at(p, 0.5, 7) is None


def test_spared_views_join_where_a_training_ends_early() -> None:
    p = TrainingProgress(step=700, watched=[3, 5], converged_at=700)
    watch(p, Budget(until_converged=True, seconds=60.0))
    assert p.watched == []


def test_dropout_leaves_out_its_share_of_the_splats() -> None:
    before = splats(10_000)
    after = Dropout(0.3, 7)(before)
    assert set(after.opacities.tolist()) == {0.0, 0.5}
    assert float((after.opacities == 0).float().mean()) == pytest.approx(0.3, abs=0.02)
    assert torch.equal(after.opacities, Dropout(0.3, 7)(before).opacities)
    assert not torch.equal(after.opacities, Dropout(0.3, 8)(before).opacities)


class Silent:
    """A reporter that keeps what it is told."""

    def __init__(self) -> None:
        self.said: list[str] = []

    def status(self, text: str) -> None:
        self.said.append(text)

    def quality(self, *progress: object, **figures: object) -> None:
        pass

    progress = warning = quality


def test_training_spares_views_and_then_drops_splats(tiny, tmp_path, monkeypatch) -> None:
    """A training whose spared views become worse drops splats, also after it was stopped and resumed."""
    capture, point_ids = tiny()
    monkeypatch.setattr(overfitting, "FEWEST", 2)
    monkeypatch.setattr(overfitting, "WATCHED", 1)
    monkeypatch.setattr(overfitting, "POINTS_PER_VIEW", 10**6)
    trainer = Trainer.start(capture, point_ids, Settings(offsets=2))
    trained, rates, begun, reporter = [], [], [], Silent()
    monkeypatch.setattr(trainer_module, "begin_colors", lambda colors, model, scene, indices: begun.extend(indices))
    measured, compute = iter([20.0, 21.0, 20.0]), trainer.view_step.compute

    def recorded(index, progress, dropout=None, **options):
        trained.append(index)
        rates.append(0.0 if dropout is None else dropout.rate)
        return compute(index, progress, dropout, **options)

    def evaluate(model, scene, progress):
        return {"watched_psnr": next(measured)} if progress.watched else {}

    def stops(model, scene, progress):
        if progress.step >= 30:
            monkeypatch.setattr(StopRequest, "__call__", lambda _: True)
        return evaluate(model, scene, progress)

    trainer.view_step.compute = recorded
    with pytest.raises(Cancelled):
        trainer.run(Budget(steps=60), tmp_path / "checkpoint", reporter, stops)
    spared = set(choose_watched_views(capture.train_indices, 0))
    first = rates.index(overfitting.DROPPED)
    assert len(spared) == 1 and not spared & set(trained[:first])
    assert set(rates[first:]) == {overfitting.DROPPED} and reporter.said == [overfitting.OVERFITS]
    assert spared < set(trained[first:]) and begun == list(spared)
    monkeypatch.undo()
    resumed, _ = Trainer.resume(capture, tmp_path / "checkpoint")
    assert resumed.progress.dropped == overfitting.DROPPED and resumed.progress.watched == []
    resumed.run(Budget(steps=60), tmp_path / "checkpoint", reporter, evaluate)
    assert resumed.progress.step == 60
