"""Non-finite values in training: reported, skipped, counted, and kept from spreading."""

import math

import numpy as np
import pytest
import torch

from backend.model.growth import GrowthStatistics
from backend.shared.events import Reporter
from backend.training import check_finite, step
from backend.training import trainer as trainer_module
from backend.training.budget import Budget
from backend.training.optimizer.adam import LARGEST_GRADIENT, step_rows
from backend.training.settings import Settings
from backend.training.trainer import Trainer

SMALL = Settings(offsets=4)
FLAT = Settings(offsets=4, primitive="2d")


class RecordingReporter(Reporter):
    def __init__(self):
        self.warnings = []

    def warning(self, message):
        self.warnings.append(message)


@pytest.fixture
def trainer(tiny):
    def make(settings=SMALL):
        capture, ids = tiny()
        return Trainer.start(capture, ids, settings)

    return make


def numbers(trainer):
    return [trainer.model.anchors.rows, trainer.model.background, *trainer.model.heads.parameters()]


def poisoned(wrapped, gradient, value):
    """Wrap a function so that its result or its gradient is multiplied by `value`."""
    if not gradient:
        return lambda *a, **k: wrapped(*a, **k) * value

    def call(*arguments, **options):
        result = wrapped(*arguments, **options)
        result.register_hook(lambda g: g * value)
        return result

    return call


@pytest.mark.parametrize("value", [math.nan, math.inf])
@pytest.mark.parametrize(
    ("name", "named"),
    [
        ("image_loss", "the image loss"), ("volume_loss", "the volume loss"), ("normal_loss", "the normal loss"),
    ],
)  # fmt: skip
def test_nonfinite_loss_is_reported_and_skipped(trainer, tmp_path, monkeypatch, name, named, value):
    trained = trainer(FLAT)
    trained.step(0.6)
    before = [t.detach().clone() for t in numbers(trained)]
    monkeypatch.setattr(step, name, poisoned(getattr(step, name), False, value))
    assert trained.step(0.6).isnan() and trained.step(0.6).isnan()
    assert all(torch.equal(a, b) for a, b in zip(numbers(trained), before, strict=True))
    assert trained.progress.faults == {named: 2}
    monkeypatch.undo()
    assert trained.step(0.6).isfinite()
    reporter = RecordingReporter()
    trained.run(Budget(steps=5), tmp_path, reporter)
    view = {v.name for v in trained.scene.capture.views}
    first, last = reporter.warnings
    assert first.startswith("Step 2, ") and first.endswith(f": {named} is not finite; the update was skipped.")
    assert first.split(", ")[1].split(": ")[0] in view
    assert last == f"2 updates were not finite and were skipped: {named} (2 steps)."
    again, _ = Trainer.resume(trained.scene.capture, tmp_path)
    assert again.progress.faults == {named: 2} and again.progress.skipped == 2


def test_label_loss_is_distinguished_from_image_loss(trainer, monkeypatch):
    trained = trainer()
    inner = step.image_loss
    monkeypatch.setattr(step, "image_loss", lambda *a: inner(*a) * (1 if a[2] is None else math.nan))
    assert trained.step(0.6).isnan()
    assert trained.progress.faults == {"the label loss": 1}


@pytest.mark.parametrize("value", [1e30, math.nan])
def test_unrecoverable_splat_is_reported_and_removed(trainer, monkeypatch, value):
    """1e30: the color of an anchor's third splat overflows in SSIM. NaN: the size of the anchor is NaN."""
    trained = trainer()
    anchors, layout = trained.model.anchors, SMALL.layout
    index = trained.scene.capture.train_indices
    trained.progress.queue = [index[0], index[0]]
    trained.step(0.6)
    camera = trained.scene.camera(index[0])
    seen = step.anchors_in_view(anchors, *step.frustum(camera))
    trained.progress.queue = [index[0]]
    near = seen[(anchors.positions[seen] @ torch.tensor(camera.viewmat[2, :3]).float()).argmin()]
    assert anchors.ids[near] > 0
    name = trained.scene.capture.names[int(trained.model.classes.ids_of(int(anchors.ids[near])))]
    column = layout.extent_columns.start + 4 if math.isnan(value) else layout.color_columns.start + 2 * 3
    anchors.rows[near, column] = value
    count = len(anchors)
    kept = torch.cat([anchors.positions[:near], anchors.positions[near + 1 :]])
    assert trained.step(0.6).isnan()
    assert len(anchors) == len(trained.optimizer.rows.exp_avg) == count - 1 and torch.equal(anchors.positions, kept)
    assert all(t.isfinite().all() for t in numbers(trained))
    what = "the volume loss" if math.isnan(value) else "the image loss"
    splat = 0 if math.isnan(value) else 2
    (sentence,) = trained._warnings
    assert f"{what} is not finite, because of splat {splat} of anchor {int(near)} ({name})" in sentence
    assert sentence.endswith("it was removed from the model.")
    for progress in (0.3, 0.6):
        assert trained.step(progress).isfinite()
    assert trained.progress.faults == {what: 1}


def corrupted(rasterize, splat, value):
    """Wrap `rasterize` so that the gradient of one splat's mean along y is `value`."""

    def call(means, *others, **options):
        def corrupt(g):
            g = g.clone()
            g[splat, 1] = value
            return g

        if means.requires_grad:
            means = means * 1.0
            means.register_hook(corrupt)
        return rasterize(means, *others, **options)

    return call


@pytest.mark.parametrize("value", [math.nan, -math.inf, 1e25])
def test_nonfinite_gradient_affects_only_its_anchor(trainer, monkeypatch, value):
    """All other anchors and the heads get the same update as if that anchor had no gradient."""
    results = []
    for given in (0.0, value):
        trained = trainer()
        index = trained.scene.capture.train_indices[0]
        before, trained.progress.step = trained.model.anchors.rows.clone(), 1
        monkeypatch.setattr(step, "rasterize", corrupted(step.rasterize, 41, given))
        learned = trained.view_step.compute(index, 0.6)
        monkeypatch.undo()
        trained.optimizer.update(learned, 0.6, 1)
        results.append((trained, before))
    (clean, _), (hurt, before) = results
    if value == 1e25:  # finite, so only Adam's step overflows
        assert all(t.isfinite().all() for t in numbers(hurt))
    fault = hurt.optimizer.check.fault
    assert clean.optimizer.check.fault is None and int(hurt.optimizer.check.skipped) >= 1
    anchor = int(fault.anchors[0])
    assert len(fault.anchors) == 1 and fault.splat is not None and not len(fault.unrecoverable)
    assert torch.equal(hurt.model.anchors.rows[anchor], before[anchor])
    others = torch.arange(len(before)) != anchor
    assert torch.equal(hurt.model.anchors.rows[others], clean.model.anchors.rows[others])
    assert fault.what.startswith("the gradient of the offsets")
    hurt._note(fault, hurt.scene.capture.train_indices[0])
    (sentence,) = hurt._warnings
    assert f"because of splat {fault.splat} of anchor {anchor} (" in sentence and sentence.endswith("was skipped.")


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_heads_learn_from_finite_anchors(trainer, monkeypatch, value):
    """A rotation's gradient passes through the heads; if it is not finite, the other anchors still train the heads."""
    trained = trainer()
    trained.step(0.6)  # at first, features are zero, and the hidden layer's weights have no gradient
    index = trained.scene.capture.train_indices[0]
    inner = step.rasterize

    def call(means, quats, *others, **options):
        quats = quats * 1.0
        quats.register_hook(lambda g: torch.where(torch.arange(len(g))[:, None] == 41, value, g))
        return inner(means, quats, *others, **options)

    monkeypatch.setattr(step, "rasterize", call)
    before = [p.detach().clone() for p in trained.model.heads.parameters()]
    learned = trained.view_step.compute(index, 0.6)
    trained.optimizer.update(learned, 0.6, 1)
    assert all(p.isfinite().all() for p in trained.model.heads.parameters())
    assert all(not torch.equal(a, b) for a, b in zip(before, trained.model.heads.parameters(), strict=True))
    assert int(trained.optimizer.check.skipped) == 1 and "scales and rotations" in trained.optimizer.check.fault.what


def test_nonfinite_head_gradient_is_reported(trainer, monkeypatch):
    trained = trainer()
    before = [p.detach().clone() for p in trained.model.heads.parameters()]
    trained.model.background.register_hook(lambda g: g * math.nan)
    trained.step(0.6)
    assert trained.progress.faults == {"the gradient of the background": 1}
    assert all(torch.equal(a, b) for a, b in zip(before, trained.model.heads.parameters(), strict=True))
    assert trained.model.background.isfinite().all()


def test_overflowing_squared_gradient_is_skipped():
    values, g = torch.ones(2, 3), torch.ones(2, 3)
    exp_avg, exp_avg_sq = torch.zeros_like(values), torch.zeros_like(values)
    g[1, 1] = 2 * LARGEST_GRADIENT
    rates = np.full(3, 0.1, np.float32)
    assert step_rows(values, exp_avg, exp_avg_sq, torch.arange(2), g, rates, 0.1, 0.001) == 1
    assert (exp_avg_sq[1] == 0).all() and (values[1] == 1).all()
    g[1, 1] = 0.5 * LARGEST_GRADIENT
    assert step_rows(values, exp_avg, exp_avg_sq, torch.arange(2), g, rates, 0.1, 0.001) == 0
    assert exp_avg_sq.isfinite().all() and (values[1] < 1).all()


@pytest.mark.parametrize("on_gpu", [False, True])
def test_growth_statistics_ignore_nonfinite_gradients(emulate_gpu, on_gpu):
    emulate_gpu(on_gpu)
    statistics = GrowthStatistics.zeros(2, 2)
    gradient = torch.tensor([[1.0, 0.0], [math.nan, 1.0], [math.inf, 0.0], [2.0, 0.0]])
    ones = torch.ones(4)
    statistics.add(torch.arange(2), 2, torch.arange(4), ones, ones.bool(), gradient, 2, 2)
    assert statistics.gradient.tolist() == [1.0, 0.0, 0.0, 2.0] and statistics.visits.tolist() == [1, 0, 0, 1]


def test_faults_are_not_searched_while_values_are_finite(trainer, monkeypatch):
    def called(*arguments):
        raise AssertionError("searched for a fault")

    for name in ("find_fault_of_loss", "find_fault_of_rows", "find_fault_of_heads"):
        monkeypatch.setattr(check_finite, name, called)
    trained = trainer()
    for i in range(4):
        assert trained.step(i / 4).isfinite()


def test_gpu_searches_fault_after_skipped_updates(trainer, tmp_path, monkeypatch, emulate_gpu):
    emulate_gpu()
    monkeypatch.setattr(trainer_module, "_REPORT_SECONDS", 0.0)
    trained = trainer()
    monkeypatch.setattr(step, "volume_loss", poisoned(step.volume_loss, False, math.nan))
    reporter = RecordingReporter()
    trained.run(Budget(steps=3), tmp_path, reporter)
    assert trained.progress.faults == {"the volume loss": 2}
    assert reporter.warnings[0].startswith("Step 2, ") and "the volume loss is not finite" in reporter.warnings[0]
    assert all(t.isfinite().all() for t in numbers(trained))
