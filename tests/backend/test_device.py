"""GPU code paths against CPU code paths on the same data, and the choice of the device.

Without a GPU, the torch versions run on CPU tensors with the CPU renderer.
"""

import dataclasses
import math
import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from backend.evaluation.metrics import psnr
from backend.model.anchors import Anchors, Layout
from backend.model.draw import draw
from backend.model.generate import generate
from backend.model.growth import GrowthStatistics, grow_and_prune
from backend.model.heads import Heads
from backend.model.object_model import anchors_in_view, first_anchors_in_view
from backend.raster import Camera, devices, rasterize
from backend.shared.errors import EXIT_BAD_INPUT, InputError
from backend.shared.events import Reporter
from backend.training import step
from backend.training.budget import Budget
from backend.training.losses.on_cpu import image_loss, normal_loss, volume_loss
from backend.training.optimizer.adam import step_rows, take_rows
from backend.training.settings import Settings
from backend.training.step import strips
from backend.training.trainer import Trainer
from tests.gpu import test_training as gpu_tests

ROOT = Path(__file__).resolve().parents[2]
SMALL = Settings(offsets=4, sh_degree=1)
FLAT = dataclasses.replace(SMALL, primitive="2d", distortion_weight=0.1)


@pytest.fixture
def both(emulate_gpu):
    """Function that calls another one with the CPU path and then with the GPU path, and returns both results."""

    def call(function):
        found = []
        for on_gpu in (False, True):
            emulate_gpu(on_gpu)
            found.append(function())
        return found

    return call


def close(got, want, relative=2e-4, absolute=2e-5):
    """Check that values are equal within float32 accuracy; `absolute` is relative to the largest value."""
    got, want = torch.as_tensor(got).detach(), torch.as_tensor(want).detach()
    assert got.shape == want.shape
    largest = float(want.abs().max()) if want.numel() else 0.0
    np.testing.assert_allclose(got, want, rtol=relative, atol=absolute * largest)


def some_anchors(n=300, spread=3.0):
    layout, rng = Layout(4, 8), np.random.default_rng(5)
    rows = torch.tensor(rng.normal(0, 0.5, (n, layout.columns)), dtype=torch.float32)
    rows[:, layout.extent_columns] = torch.tensor(rng.normal(-2, 0.7, (n, 6)), dtype=torch.float32)
    positions = torch.tensor(rng.normal(0, spread, (n, 3)), dtype=torch.float32)
    return Anchors(layout, 0.1, positions, rows, torch.tensor(rng.integers(0, 3, n), dtype=torch.int32))


CAMERA = Camera(np.eye(4), np.array([[50.0, 0, 30], [0, 60, 20], [0, 0, 1]]), 64, 48)
FRUSTUM = (*CAMERA.arrays(), CAMERA.width, CAMERA.height, CAMERA.near)


# --- one function at a time ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", ["explicit", "view"])
def test_generated_gaussians_match(both, mode):
    anchors = some_anchors(200)
    heads = Heads(anchors.layout, mode, 2, torch.Generator().manual_seed(1))
    rng = np.random.default_rng(0)
    weights = [torch.tensor(rng.normal(size=(800, w)), dtype=torch.float32) for w in (3, 4, 3, 1, 27)]

    def generated():
        rows = anchors.rows.clone().requires_grad_()
        g = generate(
            anchors.layout, anchors.positions, rows, anchors.ids, heads, np.array([0.1, 0.2, -9.0])
        ).only_valid()
        parts = (g.means, g.quats, g.scales, g.opacities, g.sh)
        total = sum((p.reshape(len(p), -1) * w[g.source][:, : p[0].numel()]).sum() for p, w in zip(parts, weights))
        return g, torch.autograd.grad(total, [rows, *heads.parameters()])

    (want, want_gradients), (got, gradients) = both(generated)
    assert 100 < len(want.source) < 800
    for name in ("source", "ids"):
        assert torch.equal(getattr(got, name), getattr(want, name)), name
    for name in ("means", "quats", "scales", "opacities", "sh"):
        close(getattr(got, name), getattr(want, name), 1e-5, 1e-6)
    for a, b in zip(gradients, want_gradients, strict=True):
        close(a, b)


def test_absent_anchors_generate_no_gaussians(emulate_gpu):
    emulate_gpu(True)
    anchors = some_anchors(50)
    heads = Heads(anchors.layout, "explicit", 0, torch.Generator())
    present = torch.arange(50) < 30
    g = generate(anchors.layout, anchors.positions, anchors.rows, anchors.ids, heads, present=present)
    assert len(g.source) == 200 and (g.valid == (g.opacities > 0)).all()
    assert g.only_valid().source.max() < 120 and g.only_valid().valid is None


def test_clamped_extent_keeps_gradient(both):
    anchors = some_anchors(6)
    anchors.rows[:, anchors.layout.extent_columns] = 25.0
    heads = Heads(anchors.layout, "explicit", 0, torch.Generator())

    def gradient():
        rows = anchors.rows.clone().requires_grad_()
        generate(anchors.layout, anchors.positions, rows, anchors.ids, heads).only_valid().scales.sum().backward()
        return rows.grad[:, anchors.layout.extent_columns]

    want, got = both(gradient)
    close(got, want)
    assert (got[:, 3:] > 0).all()


def test_anchors_in_view_match(both, emulate_gpu):
    anchors = some_anchors(4000, spread=4.0)
    want, got = both(lambda: anchors_in_view(anchors, *FRUSTUM))
    assert torch.equal(got, want) and 100 < len(want) < 3900
    emulate_gpu(True)
    for limit in (4000, len(want) + 7, len(want) - 5):
        index, present, count = first_anchors_in_view(anchors, *FRUSTUM, limit)
        assert len(index) == limit == len(index.unique()) and int(count) == len(want)
        assert torch.equal(index[present], want[:limit])


@pytest.mark.parametrize("size", [(1, 1), (7, 5), (40, 33)])
@pytest.mark.parametrize("weights", [(0.2, 0.1), (0.0, 0.0)])
def test_image_loss_matches(both, size, weights):
    rng = np.random.default_rng(3)
    h, w = size
    base = [torch.tensor(rng.uniform(0, 1, s), dtype=torch.float32) for s in ((3, h, w), (h, w), (h, w), (3,))]
    target = torch.tensor(rng.uniform(0, 1, (3, h, w)), dtype=torch.float32)
    labels = torch.tensor(rng.integers(-1, 3, (h, w)), dtype=torch.int32)

    def loss():
        leaves = [v.clone().requires_grad_() for v in base]
        color, alpha, label_probability, background = leaves
        if not weights[1]:
            label_probability = None
        value = image_loss(color, alpha, label_probability, background, target, labels, *weights)
        (3 * value).backward()
        return value, [leaf.grad for leaf in leaves if leaf.grad is not None]

    (want, want_gradients), (got, gradients) = both(loss)
    close(got, want, 1e-5)
    for a, b in zip(gradients, want_gradients, strict=True):
        close(a, b, 2e-3)


@pytest.mark.parametrize("flat", [False, True])
def test_volume_loss_matches(both, emulate_gpu, flat):
    scales = torch.rand(2500, 3)

    def loss(valid=None):
        leaf = scales.clone().requires_grad_()
        value = volume_loss(leaf, flat, valid)
        value.backward()
        return value, leaf.grad

    (want, want_gradient), (got, gradient) = both(loss)
    close(got, want, 1e-5)
    close(gradient, want_gradient, 1e-5)
    emulate_gpu(True)
    valid = torch.rand(2500) < 0.4
    value, gradient = loss(valid)
    close(value, scales[valid][:, : 2 if flat else 3].prod(1).mean(), 1e-5)
    assert (gradient[~valid] == 0).all()


def test_normal_loss_matches(both):
    rng = np.random.default_rng(0)
    h, w = 19, 31
    x, y = np.meshgrid(np.arange(w), np.arange(h))
    alpha = rng.uniform(0.45, 1, (h, w))
    alpha[:4, :4] = 0
    depth = (3 + 0.03 * x + 0.02 * y + rng.normal(0, 0.02, (h, w))) * alpha
    base = [torch.tensor(v, dtype=torch.float32) for v in (rng.normal(size=(3, h, w)) * 0.4, depth, alpha)]

    def loss():
        leaves = [v.clone().requires_grad_() for v in base]
        value = normal_loss(*leaves, np.array([20.0, 22.0, 15.3, 8.2]))
        value.backward()
        return value, [leaf.grad for leaf in leaves]

    (want, want_gradients), (got, gradients) = both(loss)
    close(got, want, 1e-4)
    for a, b in zip(gradients, want_gradients, strict=True):
        close(a, b, 1e-3, 1e-4)


def test_adam_updates_seen_usable_finite_rows(both, emulate_gpu):
    rng = np.random.default_rng(0)
    base = torch.tensor(rng.normal(size=(20, 7)), dtype=torch.float32)
    seen = torch.tensor([1, 4, 7, 9, 12, 19])
    g = torch.tensor(rng.normal(size=(6, 7)), dtype=torch.float32)
    g[2, 3] = math.inf

    def step(usable=None):
        values, exp_avg, exp_avg_sq = base.clone(), base * 0.1, base.abs() * 0.01
        rates = np.linspace(0.01, 0.02, 7).astype(np.float32)
        skipped = step_rows(values, exp_avg, exp_avg_sq, seen, g, rates, 0.5, 0.02, usable)
        return int(skipped), values, exp_avg, exp_avg_sq

    want, got = both(step)
    assert want[0] == got[0] == 1
    for a, b in zip(got[1:], want[1:], strict=True):
        close(a, b, 3e-5, 1e-7)
    assert torch.equal(got[1][7], base[7]) and not torch.equal(got[1][9], base[9])
    emulate_gpu(True)
    skipped, values, exp_avg, _ = step(torch.tensor([True, False, False, True, True, True]))
    assert skipped == 0 and torch.equal(values[4], base[4]) and torch.equal(exp_avg[4], base[4] * 0.1)
    assert torch.equal(values[9], got[1][9])


def test_take_rows_matches(both):
    values = torch.rand(9, 5)
    want, got = both(lambda: take_rows(values, torch.tensor([3, 1, 8])))
    assert torch.equal(got, want) and torch.equal(want, values[[3, 1, 8]])


def test_growth_and_statistics_match(both, emulate_gpu):
    rng = np.random.default_rng(2)
    anchors = some_anchors(60)
    heads = Heads(anchors.layout, "explicit", 1, torch.Generator().manual_seed(0))
    camera = dataclasses.replace(CAMERA, viewmat=np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 6], [0, 0, 0, 1]]))

    def grown():
        statistics = GrowthStatistics.zeros(60, 4)
        copy = Anchors(anchors.layout, 0.1, anchors.positions, anchors.rows, anchors.ids)
        for seed in range(12):
            seen = torch.tensor(np.random.default_rng(seed).permutation(60)[:25])
            rows = copy.rows[seen].requires_grad_()
            g = generate(copy.layout, copy.positions[seen], rows, copy.ids[seen], heads)
            drawn = rasterize(*g[:6], camera)
            (drawn.color * torch.tensor(rng_planes[seed])).sum().backward()
            frame = drawn.frame
            statistics.add(seen, 4, g.source, g.opacities.detach(), frame.seen, frame.screen_gradient, 64, 48)
        growth = grow_and_prune(copy, statistics, np.random.default_rng(0), min_opacity=0.2)
        return statistics.after(growth, 4), statistics, copy, growth

    rng_planes = rng.normal(size=(12, 3, 48, 64)).astype(np.float32)
    (want_left, want, want_anchors, want_growth), (left, got, got_anchors, growth) = both(grown)
    assert torch.equal(got.visits, want.visits) and torch.equal(got.views, want.views)
    assert want.visits.max() > 3
    close(got.gradient, want.gradient, 1e-3)
    close(got.opacity, want.opacity, 1e-5)
    assert want_growth.added > 20 and 0 < want_growth.pruned < 60
    assert growth.added == want_growth.added and torch.equal(growth.kept, want_growth.kept)
    close(got_anchors.positions, want_anchors.positions, 1e-6)
    assert torch.equal(got_anchors.ids, want_anchors.ids)
    assert torch.equal(left.visits, want_left.visits) and 0 < want_left.visits.count_nonzero() < want.visits.numel()


# --- whole trainings -------------------------------------------------------------------------------------------------


def trained(capture, ids, settings, steps=150):
    trainer = Trainer.start(capture, ids, settings)
    for i in range(steps):
        trainer.step(i / steps)
    return trainer


def quality(trainer):
    """Return PSNR in the training views, and the fraction of object pixels with the right ID."""
    capture = trainer.scene.capture
    found, right = [], []
    for index in capture.train_indices:
        rendered = draw(trainer.shown, trainer.scene.camera(index))
        truth = capture.mask(index)
        found.append(psnr(rendered.image, capture.image(index) / 255.0))
        right.append((rendered.ids[truth > 0] == truth[truth > 0]).mean())
    return float(np.mean(found)), float(np.mean(right))


@pytest.mark.slow
@pytest.mark.parametrize("settings", [SMALL, FLAT], ids=["3d", "2d"])
def test_training_quality_matches(tiny, both, settings):
    """On average over seeds, since rounding changes which anchors grow, and then the order of the views."""
    capture, ids = tiny()
    settings = [dataclasses.replace(settings, seed=seed) for seed in range(4)]
    of_cpu, of_gpu = both(lambda: [quality(trained(capture, ids, each)) for each in settings])
    (want, want_right), (got, right) = np.mean(of_cpu, 0), np.mean(of_gpu, 0)
    assert want > 20 and got > want - 1.5
    assert right > 0.95 and right > want_right - 0.02


def test_first_losses_match(tiny, both):
    capture, ids = tiny()

    def losses():
        trainer = Trainer.start(capture, ids, SMALL)
        return [float(trainer.step(0.3)) for _ in range(5)]

    want, got = both(losses)
    np.testing.assert_allclose(got, want, rtol=2e-3)


@pytest.mark.parametrize("first", [False, True])
def test_checkpoint_resumes_on_other_device(tiny, tmp_path, emulate_gpu, first):
    capture, ids = tiny()
    emulate_gpu(first)
    Trainer.start(capture, ids, SMALL).run(Budget(steps=70), tmp_path, Reporter())
    emulate_gpu(not first)
    trainer, warning = Trainer.resume(capture, tmp_path, SMALL)
    assert warning is None and trainer.progress.step == 70
    begun = trainer.model.anchors.rows.clone()
    trainer.run(Budget(steps=150), tmp_path, Reporter())
    assert not torch.equal(begun, trainer.model.anchors.rows[: len(begun)])
    found, right = quality(trainer)
    assert found > 20 and right > 0.9


class SyncRecorder(TorchDispatchMode):
    """Recorder of operations that make the CPU wait for a value from the device."""

    def __init__(self):
        super().__init__()
        self.found = []

    def __torch_dispatch__(self, function, types, arguments=(), options=None):
        name = function.overloadpacket.__name__
        masks = [
            index for argument in arguments if isinstance(argument, list | tuple) for index in argument
            if isinstance(index, torch.Tensor) and index.dtype == torch.bool and name.startswith("index")
        ]  # fmt: skip
        if name in ("_local_scalar_dense", "nonzero", "masked_select", "is_nonzero", "equal", "unique") or masks:
            self.found.append(name)
        return function(*arguments, **(options or {}))


@pytest.mark.parametrize("settings", [SMALL, FLAT, dataclasses.replace(SMALL, mode="view")], ids=["3d", "2d", "view"])
def test_gpu_step_does_not_synchronize(tiny, emulate_gpu, settings):
    emulate_gpu(True)
    capture, ids = tiny()
    trainer = Trainer.start(capture, ids, settings)
    for progress in (0.3, 0.3, 0.8):
        trainer.step(progress)
    trainer.progress.last_growth = trainer.progress.step
    with SyncRecorder() as recorder:
        for progress in (0.3, 0.8):
            trainer.step(progress)
    assert not recorder.found
    with SyncRecorder() as recorder:
        float(trainer.step(0.8))
    assert recorder.found == ["_local_scalar_dense"]


def test_anchor_limit_shrinks_for_known_views(tiny, emulate_gpu, monkeypatch):
    emulate_gpu(True)
    capture, ids = tiny()
    monkeypatch.setattr(step._Limits, "_STEP", 8)
    trainer = Trainer.start(capture, ids, SMALL)
    anchors = trainer.model.anchors
    anchors.positions[: len(anchors) // 2] += 1000.0  # out of view
    taken = []

    def limited(*args):
        index, present, count = first_anchors_in_view(*args)
        taken.append((len(index), int(count)))
        return index, present, count

    monkeypatch.setattr(step, "first_anchors_in_view", limited)
    views = len(capture.train_indices)
    for _ in range(2 * views):
        trainer.step(0.9)
    assert all(limit == len(anchors) for limit, _ in taken[:views])
    assert all(count <= limit < 0.8 * len(anchors) for limit, count in taken[views:])


def test_nonfinite_image_loss_changes_nothing(tiny, emulate_gpu, monkeypatch):
    emulate_gpu(True)
    capture, ids = tiny()
    trainer = Trainer.start(capture, ids, SMALL)
    trainer.step(0.9)
    rows, head = trainer.model.anchors.rows.clone(), trainer.model.heads.hidden.weight.detach().clone()
    monkeypatch.setattr(step, "image_loss", lambda *args: image_loss(*args) * math.nan)
    assert trainer.step(0.9).isnan()
    assert torch.equal(trainer.model.anchors.rows, rows) and torch.equal(trainer.model.heads.hidden.weight, head)
    monkeypatch.undo()


@pytest.mark.parametrize("on_gpu", [False, True])
def test_a_photo_that_shows_no_anchor_is_no_fault(tiny, tmp_path, emulate_gpu, on_gpu):
    emulate_gpu(on_gpu)
    trainer = Trainer.start(*tiny(), dataclasses.replace(SMALL, fit_colors=True))
    camera_of, (away, *others) = trainer.scene.camera, trainer.scene.capture.train_indices

    def camera(index, downscale=1):
        found = camera_of(index, downscale)
        behind = found.viewmat - np.diag([0, 0, 1000.0, 0])[:, [0, 1, 3, 2]]
        return dataclasses.replace(found, viewmat=behind) if index == away else found

    trainer.scene.camera = camera
    reporter = Messages()
    trainer.run(Budget(steps=1 + len(others)), tmp_path, reporter)
    assert not reporter.warnings and not trainer.progress.skipped
    steps = trainer.view_step.colors.steps
    assert steps[away] == 0 and (steps[others] == 1).all()


LOSSES = """
import sys
from backend.capture import load_capture
from backend.labels import vote
from backend.model.draw import draw
from backend.training.trainer import Trainer
from backend.training.settings import Settings
capture = load_capture(sys.argv[1], sys.argv[2])
for primitive in ("3d", "2d"):
    trainer = Trainer.start(capture, vote(capture).ids, Settings(offsets=1, primitive=primitive, voxel=0.3))
    print(*(float(trainer.step(progress)) for progress in (0.3, 0.8)))
    print(draw(trainer.model, trainer.scene.camera(0)).image.mean())
"""


def test_training_on_an_emulated_gpu_matches_cpu(write_capture, tmp_path, emulate_gpu):
    """With the GPU kernels, losses and images equal those of the CPU."""
    folder = write_capture(views=3, size=(24, 18), points=20).folder
    found = []
    for emulate in ("0", "1"):
        command = [sys.executable, "-c", LOSSES, str(folder), str(tmp_path / "cache")]
        environment = {**os.environ, "OBJECTGS_EMULATE_GPU": emulate}
        done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=240)
        assert done.returncode == 0, done.stderr
        found.append([float(word) for word in done.stdout.split()])
    assert len(found[0]) == 6
    np.testing.assert_allclose(found[1], found[0], rtol=1e-4)


# --- out of memory ---------------------------------------------------------------------------------------------------


def test_strips_cover_image(tiny):
    camera = dataclasses.replace(CAMERA, gain=(1.0, 1.1, 1.2))
    image, labels = torch.rand(3, 48, 64), torch.randint(-1, 3, (48, 64))
    for count in (1, 2, 3):
        found = strips(camera, image, labels, count)
        assert torch.equal(torch.cat([part for _, part, _ in found], 2), image)
        assert torch.equal(torch.cat([part for _, _, part in found], 1), labels)
        assert all((c.width, c.height) == (p.shape[2], p.shape[1]) for c, p, _ in found)
    anchors = some_anchors(100)
    heads = Heads(anchors.layout, "explicit", 1, torch.Generator().manual_seed(0))
    with torch.no_grad():
        g = generate(anchors.layout, anchors.positions, anchors.rows, anchors.ids, heads)
        whole = rasterize(*g[:6], camera).color
        upright = dataclasses.replace(camera, width=48)
        parts = [rasterize(*g[:6], c).color for c, _, _ in strips(camera, image, labels, 2)]
        lower = [rasterize(*g[:6], c).color for c, _, _ in strips(upright, image[..., :48], labels[:, :48], 2)]
    close(torch.cat(parts, 2), whole, 1e-4, 1e-5)
    assert lower[0].shape == (3, 48, 24)


def test_strips_give_same_gradients(tiny, emulate_gpu):
    """Except SSIM beside the cuts, and the volume loss (a mean over each part's splats)."""
    emulate_gpu(True)
    capture, ids = tiny()
    settings = dataclasses.replace(SMALL, ssim_weight=0.0, volume_weight=0.0)
    found = []
    for parts in (1, 2, 4):
        trainer = Trainer.start(capture, ids, settings)
        trainer.view_step.parts = parts
        learned = trainer.view_step.compute(capture.train_indices[0], 0.09)
        full = torch.zeros_like(trainer.model.anchors.rows)
        usable = learned.usable[:, None]
        full.index_add_(0, learned.seen, torch.where(usable, learned.rows, 0.0))
        trainer._grow([learned], 0.09)
        statistics = trainer.optimizer.growth.statistics
        found.append((learned.loss, full, trainer.model.heads.opacity.weight.grad, statistics))
    for loss, rows, head, statistics in found[1:]:
        close(loss, found[0][0], 1e-5)
        for got, want in ((rows, found[0][1]), (head, found[0][2]), (statistics.gradient, found[0][3].gradient)):
            assert (got - want).norm() < 0.01 * want.norm()
        assert (statistics.visits != found[0][3].visits).float().mean() < 0.01


class Messages(Reporter):
    def __init__(self):
        self.warnings = []

    def warning(self, message):
        self.warnings.append(message)


FULL = [
    torch.cuda.OutOfMemoryError("CUDA out of memory."),
    RuntimeError("CUDA error: out of memory"),
]


@pytest.mark.slow
@pytest.mark.parametrize("error", FULL, ids=["torch", "driver"])
def test_out_of_memory_warns_once_and_continues_in_parts(tiny, tmp_path, emulate_gpu, monkeypatch, error):
    emulate_gpu(True)
    capture, ids = tiny()

    def full(*args, **options):
        if args[6].width > 40:
            raise error
        return rasterize(*args, **options)

    monkeypatch.setattr(step, "rasterize", full)
    trainer, reporter = Trainer.start(capture, ids, SMALL), Messages()
    trainer.run(Budget(steps=120), tmp_path, reporter)
    assert trainer.parts == 2 and trainer.progress.step == 120 and trainer.progress.skipped == 0
    assert len(reporter.warnings) == 1 and "in 2 parts" in reporter.warnings[0]
    monkeypatch.undo()
    found, right = quality(trainer)
    assert found > 20 and right > 0.9


def test_persistent_out_of_memory_ends_with_checkpoint(tiny, tmp_path, emulate_gpu, monkeypatch):
    emulate_gpu(True)
    capture, ids = tiny()
    trainer = Trainer.start(capture, ids, SMALL)
    calls = iter(range(1000))

    def full(*args, **options):
        if next(calls) >= 3:
            raise torch.cuda.OutOfMemoryError("CUDA out of memory.")
        return rasterize(*args, **options)

    monkeypatch.setattr(step, "rasterize", full)
    with pytest.raises(InputError, match="GPU's memory is too small"):
        trainer.run(Budget(steps=20), tmp_path, Reporter())
    resumed, _ = Trainer.resume(capture, tmp_path, SMALL)
    assert resumed.progress.step == 3


@pytest.mark.parametrize(("platform", "limits"), [("win32", [0.95 * 0.75]), ("linux", [])])
def test_the_memory_of_windows_is_not_taken_for_the_gpus(monkeypatch, platform, limits):
    found, gpu = [], torch.device("cuda", 0)
    monkeypatch.setattr(devices.sys, "platform", platform)
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda _: (5e9, 8e9))
    monkeypatch.setattr(torch.cuda, "memory_reserved", lambda _: 1e9)
    monkeypatch.setattr(torch.cuda, "set_per_process_memory_fraction", lambda most, _: found.append(most))
    devices.limit_memory.cache_clear()
    for _ in range(2):
        devices.limit_memory(gpu)
    devices.limit_memory.cache_clear()
    assert found == pytest.approx(limits)


def test_views_are_drawn_in_parts_where_the_memory_is_full(tiny, monkeypatch):
    capture, ids = tiny()
    trainer = Trainer.start(capture, ids, SMALL)
    camera, heights = trainer.scene.camera(0), []
    whole = draw(trainer.model, camera, want_depth=True)

    def full(*args, **options):
        heights.append(args[6].height)
        if args[6].height > 30:
            raise torch.cuda.OutOfMemoryError("CUDA out of memory.")
        return rasterize(*args, **options)

    monkeypatch.setattr("backend.model.draw.rasterize", full)
    parts = draw(trainer.model, camera, want_depth=True)
    assert heights == [48, 24, 24]
    for plane, right in zip(parts, whole, strict=True):
        assert plane.shape == right.shape
        np.testing.assert_allclose(plane, right, atol=1e-4)
    assert draw(trainer.model, camera, want_ids=False).ids is None
    tall = SimpleNamespace(height=99)
    monkeypatch.setattr("backend.model.draw.rasterize", lambda *args, **_: full(*args[:6], tall))
    with pytest.raises(torch.cuda.OutOfMemoryError):
        draw(trainer.model, camera)


def test_other_errors_are_not_treated_as_out_of_memory(tiny, emulate_gpu, monkeypatch):
    emulate_gpu(True)
    capture, ids = tiny()

    def broken(*args, **options):
        raise RuntimeError("something else")

    monkeypatch.setattr(step, "rasterize", broken)
    trainer = Trainer.start(capture, ids, SMALL)
    with pytest.raises(RuntimeError, match="something else"):
        trainer.step(0.5)
    assert trainer.parts == 1 and trainer.progress.step == 0


# --- the choice ------------------------------------------------------------------------------------------------------

without_cuda = pytest.mark.skipif(devices.why_not_cuda() is None, reason="CUDA works here")


@without_cuda
@pytest.mark.parametrize("command", ["train", "render", "evaluate", "mesh", "report", "doctor"])
def test_unavailable_cuda_is_rejected(run_command, write_capture, tmp_path, command):
    arguments = {"train": [write_capture().folder, "--out", tmp_path / "out"], "doctor": []}.get(command, [tmp_path])
    result = run_command(command, *map(str, arguments), "--device", "cuda", "--json")
    assert result.code == 2
    message = result.events[-1]["message"]
    assert message == devices.why_not_cuda() and message.endswith(".") and "\n" not in message
    assert not (tmp_path / "out").exists()


@without_cuda
def test_auto_selects_cpu_without_cuda():
    assert devices.pick("auto") == devices.pick("cpu") == torch.device("cpu")
    with pytest.raises(InputError):
        devices.pick("cuda")


@pytest.mark.parametrize(("error", "part"), [
    ("Found no NVIDIA driver on your system. Please check that you have an NVIDIA GPU", "no NVIDIA driver"),
    ("The NVIDIA driver on your system is too old (found version 11040).", "too old for CUDA 13.0"),
    ("CUDA driver version is insufficient for CUDA runtime version", "too old for CUDA 13.0"),
    ("No CUDA GPUs are available", "shows no GPU"),
    ("CUDA unknown error - this may be due to an incorrectly set up environment", "does not start"),
])  # fmt: skip
def test_torch_errors_are_explained(error, part):
    sentence = devices.explain_cuda_error(error, "13.0")
    assert part in sentence and sentence.endswith(".") and "\n" not in sentence


@pytest.mark.parametrize("error", ["CUDA error: out of memory", "CUBLAS_STATUS_ALLOC_FAILED when calling cublasCreate"])
def test_out_of_memory_errors_are_recognized(error):
    assert devices.is_out_of_memory(RuntimeError(error))
    assert not devices.is_out_of_memory(RuntimeError("CUDA error: an illegal memory access was encountered"))


def test_a_gpu_that_fails_ends_a_command_with_a_sentence(run_command, monkeypatch, tmp_path):
    def fail(*_):
        raise RuntimeError("CUDA error: an illegal memory access was encountered\nCompile with ...")

    monkeypatch.setattr("backend.commands.capture.check.check", fail)
    result = run_command("check", tmp_path)
    assert result.code == EXIT_BAD_INPUT
    assert "The GPU failed (CUDA error: an illegal memory access was encountered); the same" in result.err


def test_only_a_gpu_that_is_there_is_refused_with_a_reason(monkeypatch):
    monkeypatch.setattr(devices, "emulated", lambda: False)
    monkeypatch.setattr(devices, "_problem_with_build", lambda: None)
    for text, is_there in (
        ("No CUDA GPUs are available", False),
        ("Found no NVIDIA driver on your system.", False),
        ("The NVIDIA driver on your system is too old", True),
    ):
        reason = devices.explain_cuda_error(text, "13.0")
        monkeypatch.setattr(devices, "why_not_cuda", lambda reason=reason: reason)
        assert devices.refused_gpu() == (reason if is_there else None)
    monkeypatch.setattr(devices, "_problem_with_build", lambda: "built without CUDA")
    assert devices.refused_gpu() is None


def test_low_memory_is_explained_with_figures():
    assert devices.explain_low_memory("GPU", 3e9, 8e9) is None
    assert "0.3 GB of memory free" in devices.explain_low_memory("GPU", 0.3e9, 8e9)
    assert "has 0.5 GB of memory," in devices.explain_low_memory("GPU", 0.4e9, 0.5e9)


def test_why_kernels_do_not_run_is_told(monkeypatch):
    def broken(name):
        raise RuntimeError(
            f"the kernel {name} cannot be compiled:\nnvrtc: error: failed to open libnvrtc-builtins.so.13.0."
        )

    full, zeros = torch.full, torch.zeros
    monkeypatch.setattr(torch, "full", lambda *arguments, device: full(*arguments))
    monkeypatch.setattr(torch, "zeros", lambda *arguments, device, **options: zeros(*arguments, **options))
    monkeypatch.setattr("backend.raster.gpu.kernels.raster_kernel", broken)
    reason = devices._problem_with_kernels()
    assert "cannot be compiled: nvrtc: error: failed to open libnvrtc-builtins.so.13.0);" in reason


@without_cuda
@pytest.mark.skipif(shutil.which("make") is None or shutil.which("nvidia-smi") is not None, reason="no make, or a GPU")
def test_make_gpu_reports_missing_gpu():
    done = subprocess.run(
        ["make", "--no-print-directory", "gpu", f"PYTHON={sys.executable}"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0
    assert done.stdout.strip().splitlines() == [
        "There is no NVIDIA GPU here, so nothing was run, and nothing counts as passed."
    ]


def test_training_imports_no_capture_packages():
    """A machine that has only torch and numba can benchmark the training."""
    absent = ("pycolmap", "xatlas", "manifold3d", "fast_simplification", "skimage", "matplotlib")
    code = (
        f"import sys; sys.modules.update(dict.fromkeys({absent})); import backend.training.trainer, backend.model.draw"
    )
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True, timeout=120)


def test_the_capture_of_the_gpu_tests_can_be_trained_on(tmp_path):
    """Those tests run only where there is a GPU."""
    spheres = gpu_tests.Spheres()
    Trainer.start(spheres, spheres.ids, gpu_tests.SETTINGS).run(Budget(steps=2), tmp_path, Reporter())
    resumed, _ = Trainer.resume(spheres, tmp_path, gpu_tests.SETTINGS)
    resumed.run(Budget(steps=3), tmp_path, Reporter())
    assert resumed.progress.step == 3 and gpu_tests.quality(resumed)[0] > 5
