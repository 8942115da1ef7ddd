"""Losses against autograd, growth rules, checkpoints, and whole trainings on tiny captures."""

import copy
import dataclasses
import functools
import math
import os
import signal
import subprocess
import sys
import time
import tracemalloc
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import safetensors.numpy
import torch
from scipy.spatial import cKDTree

from backend.commands.setup import machine
from backend.commands.training import memory
from backend.model import checkpoint
from backend.model.anchors import Anchors, Layout, cell_keys, median_spacing, seed_anchors
from backend.model.checkpoint import CURRENT, PREVIOUS, load_checkpoint, save_checkpoint, seconds_to_next
from backend.model.draw import draw
from backend.model.generate import generate
from backend.model.growth import MIN_VISITS, GrowthStatistics, grow_and_prune
from backend.model.heads import Heads
from backend.model.object_model import Normalization, anchors_in_view
from backend.raster import Camera, rasterize
from backend.shared.class_table import ClassTable
from backend.shared.errors import Cancelled, InputError
from backend.shared.events import Reporter
from backend.shared.formats import atomic
from backend.shared.splats.blending import EPS_2D, USUAL_EPS_2D
from backend.shared.stopping import StopRequest
from backend.training.budget import Budget
from backend.training.cells.region import EVERYWHERE, Region
from backend.training.extent import pixel_size
from backend.training.fine_tuning.fit_discs import begin_discs
from backend.training.initial_model import initial_model
from backend.training.losses.on_cpu import PROBABILITY_FLOOR, image_loss, normal_loss, volume_loss
from backend.training.optimizer.adam import BETA1, BETA2, step_rows
from backend.training.optimizer.average import EVERY, FRACTION, MAX_STEPS, Average
from backend.training.scene import Scene
from backend.training.settings import Settings
from backend.training.state import blur_warning, load_model
from backend.training.step import ViewStep
from backend.training.trainer import Trainer

ROOT = Path(__file__).resolve().parents[2]


# --- losses ----------------------------------------------------------------------------------------------------------


def slow_ssim(a, b):
    x = torch.arange(-5, 6, dtype=a.dtype)
    window = torch.exp(-0.5 * (x / 1.5) ** 2)
    window = window / window.sum()
    kernel = (window[:, None] * window[None, :])[None, None].repeat(3, 1, 1, 1)

    def blur(v):
        return torch.nn.functional.conv2d(v[None], kernel, padding=5, groups=3)[0]

    m1, m2 = blur(a), blur(b)
    s11, s22, s12 = blur(a * a) - m1 * m1, blur(b * b) - m2 * m2, blur(a * b) - m1 * m2
    top = (2 * m1 * m2 + 0.01**2) * (2 * s12 + 0.03**2)
    return (top / ((m1 * m1 + m2 * m2 + 0.01**2) * (s11 + s22 + 0.03**2))).mean()


@pytest.mark.parametrize("size", [(1, 1), (7, 5), (40, 33), (24, 50)])
def test_image_loss_and_gradients_match_autograd(size):
    rng = np.random.default_rng(3)
    h, w = size
    base = [rng.uniform(0, 1, s) for s in ((3, h, w), (h, w), (h, w), (3,))]
    target = torch.tensor(rng.uniform(0, 1, (3, h, w)))
    labels = torch.tensor(rng.integers(-1, 3, (h, w)), dtype=torch.int32)
    fast = [torch.tensor(v, dtype=torch.float32, requires_grad=True) for v in base]
    slow = [torch.tensor(np.float32(v), dtype=torch.float64, requires_grad=True) for v in base]
    got = image_loss(*fast, target.float(), labels, 0.2, 0.1)
    color, alpha, weight, background = slow
    shown = color + (1 - alpha) * background[:, None, None]
    labeled = labels >= 0
    semantic = -torch.log((weight[labeled] + PROBABILITY_FLOOR) / (1 + PROBABILITY_FLOOR)).mean()
    want = 0.8 * (shown - target).abs().mean() + 0.2 * (1 - slow_ssim(shown, target))
    if labeled.any():
        want = want + 0.1 * semantic
    assert float(got.detach()) == pytest.approx(float(want.detach()), rel=1e-4)
    got.backward()
    want.backward()
    for a, b in zip(fast, slow):
        reference = b.grad if b.grad is not None else torch.zeros_like(b)
        np.testing.assert_allclose(a.grad.numpy(), reference.numpy(), rtol=2e-3, atol=2e-5 * reference.abs().max())


@pytest.mark.parametrize("axes", [2, 3])
def test_volume_loss_is_mean_product_of_scales(axes):
    fast = torch.rand(2500, 3, requires_grad=True)
    slow = fast.detach().double().requires_grad_()
    got, want = volume_loss(fast, flat=axes == 2), slow[:, :axes].prod(1).mean()
    assert float(got.detach()) == pytest.approx(float(want.detach()), rel=1e-5)
    (3 * got).backward()
    (3 * want).backward()
    np.testing.assert_allclose(fast.grad, slow.grad, rtol=1e-5)


def slow_normal_loss(normals, depth, alpha, intrinsics):
    fx, fy, cx, cy = intrinsics
    h, w = alpha.shape
    x, y = torch.meshgrid((torch.arange(w) + 0.5 - cx) / fx, (torch.arange(h) + 0.5 - cy) / fy, indexing="xy")
    rays = torch.stack([x, y, torch.ones_like(x)], -1)
    points = rays * (depth / alpha)[..., None]
    across, down = points[1:-1, 2:] - points[1:-1, :-2], points[2:, 1:-1] - points[:-2, 1:-1]
    normal = torch.nn.functional.normalize(torch.linalg.cross(down, across), dim=-1)
    middle = rays[1:-1, 1:-1]
    counted = -(normal * middle).sum(-1) > 0.1 * middle.norm(dim=-1)
    a = alpha.detach()
    for part in (a[1:-1, 1:-1], a[1:-1, 2:], a[1:-1, :-2], a[2:, 1:-1], a[:-2, 1:-1]):
        counted &= part > 0.5
    loss = alpha[1:-1, 1:-1] - (normals.permute(1, 2, 0)[1:-1, 1:-1] * normal).sum(-1)
    return torch.where(counted, loss, 0).sum() / (h * w), counted


def test_normal_loss_and_gradients_match_autograd():
    rng = np.random.default_rng(0)
    h, w = 19, 31
    x, y = np.meshgrid(np.arange(w), np.arange(h))
    alpha = rng.uniform(0.45, 1, (h, w))
    depth = (3 + 0.03 * x + 0.02 * y + rng.normal(0, 0.02, (h, w))) * alpha
    base = [rng.normal(size=(3, h, w)) * 0.4, depth, alpha]
    intrinsics = np.array([20.0, 22.0, 15.3, 8.2])
    fast = [torch.tensor(v, dtype=torch.float32, requires_grad=True) for v in base]
    slow = [torch.tensor(np.float32(v), dtype=torch.float64, requires_grad=True) for v in base]
    got = normal_loss(*fast, intrinsics)
    want, counted = slow_normal_loss(*slow, intrinsics)
    assert 100 < counted.sum() < counted.numel() - 20
    assert float(got.detach()) == pytest.approx(float(want.detach()), rel=1e-5)
    (3 * got).backward()
    (3 * want).backward()
    for a, b in zip(fast, slow, strict=True):
        np.testing.assert_allclose(a.grad, b.grad, rtol=1e-4, atol=1e-5 * b.grad.abs().max().item())


def test_normal_loss_of_plane_is_zero():
    """Rendered discs of one plane have the plane's normal and depth."""
    camera = Camera(np.eye(4), np.array([[40.0, 0, 16], [0, 40, 12], [0, 0, 1]]), 32, 24)
    spread = torch.linspace(-1, 1, 12)
    x, y = (v.reshape(-1) for v in torch.meshgrid(spread, spread, indexing="xy"))
    half = 0.25
    means = torch.stack([x, y * np.cos(2 * half), 2 + y * np.sin(2 * half)], 1).float()
    n = len(means)
    quats = torch.tensor([[np.cos(half), np.sin(half), 0, 0]]).float().repeat(n, 1)
    drawn = rasterize(
        means, quats, torch.full((n, 3), 0.2), torch.full((n,), 0.9), torch.zeros(n, 1, 3),
        torch.zeros(n, dtype=torch.int32), camera, want_depth=True, want_normals=True, primitive="2d",
    )  # fmt: skip
    assert (drawn.alpha > 0.9).all()
    assert abs(float(normal_loss(drawn.normals, drawn.depth, drawn.alpha, camera.arrays()[1]))) < 1e-4
    assert float(normal_loss(-drawn.normals, drawn.depth, drawn.alpha, camera.arrays()[1])) > 1


def test_image_loss_without_labels_has_no_semantic_term():
    color, target = torch.rand(3, 8, 9), torch.rand(3, 8, 9)
    labels = torch.full((8, 9), -1, dtype=torch.int32)
    weight = torch.zeros(8, 9, requires_grad=True)
    loss = image_loss(color, torch.ones(8, 9), weight, torch.zeros(3), target, labels, 0.2, 0.1)
    loss.backward()
    assert torch.isfinite(loss)
    assert (weight.grad == 0).all()


def test_zero_probability_gives_finite_loss():
    weight = torch.zeros(4, 4, requires_grad=True)
    labels = torch.zeros(4, 4, dtype=torch.int32)
    loss = image_loss(
        torch.zeros(3, 4, 4), torch.zeros(4, 4), weight, torch.zeros(3), torch.zeros(3, 4, 4), labels, 0, 1
    )
    loss.backward()
    assert torch.isfinite(loss) and torch.isfinite(weight.grad).all() and (weight.grad < 0).all()


def test_adam_matches_torch_and_updates_only_seen_rows():
    rng = np.random.default_rng(0)
    values = torch.tensor(rng.normal(size=(20, 7)), dtype=torch.float32)
    before = values.clone()
    exp_avg, exp_avg_sq = torch.zeros_like(values), torch.zeros_like(values)
    seen = torch.tensor([1, 4, 19])
    parameter = values[seen].requires_grad_()
    optimizer = torch.optim.Adam([parameter], lr=0.01, eps=1e-15)
    rates = np.full(7, 0.01, np.float32)
    for step in range(1, 6):
        g = torch.tensor(rng.normal(size=(3, 7)), dtype=torch.float32)
        step_rows(values, exp_avg, exp_avg_sq, seen, g, rates, 1 - BETA1**step, 1 - BETA2**step)
        parameter.grad = g
        optimizer.step()
    np.testing.assert_allclose(values[seen], parameter.detach(), rtol=1e-5, atol=1e-6)
    others = np.setdiff1d(np.arange(20), seen)
    assert (values[others] == before[others]).all()


def test_adam_skips_nonfinite_row():
    values = torch.ones(3, 4)
    exp_avg, exp_avg_sq = torch.zeros_like(values), torch.zeros_like(values)
    g = torch.ones(3, 4)
    g[1, 2] = np.nan
    skipped = step_rows(values, exp_avg, exp_avg_sq, torch.arange(3), g, np.full(4, 0.1, np.float32), 0.1, 0.001)
    assert skipped == 1 and (values[1] == 1).all() and (values[[0, 2]] < 1).all()


# --- anchors, heads, growth ------------------------------------------------------------------------------------------


def test_seeding_gives_one_anchor_per_voxel_with_majority_id():
    xyz = np.array([[0.1, 0, 0], [0.2, 0, 0], [-0.1, 0, 0], [3, 0, 0], [3.2, 0.1, 0]])
    ids = np.array([2, 2, 1, 3, 1])
    anchors = seed_anchors(xyz, np.zeros((5, 3)), ids, 1.0, Layout(4, 8), np.random.default_rng(0))
    assert len(anchors) == 2
    assert anchors.ids.tolist() == [2, 3]  # majority; in a tie, the point nearest to the cell center
    assert len(np.unique(cell_keys(anchors.positions, 1.0), axis=0)) == 2


@pytest.mark.parametrize("count", [1, 2, 5])
def test_coincident_points_give_one_finite_anchor(count):
    xyz = np.zeros((count, 3))
    voxel = median_spacing(xyz)
    anchors = seed_anchors(xyz, np.ones((count, 3)), np.zeros(count, int), voxel, Layout(), np.random.default_rng(0))
    assert len(anchors) == 1 and anchors.rows.isfinite().all() and voxel > 0


@pytest.mark.parametrize(
    ("mode", "sh_degree", "layout", "n"),
    [
        ("explicit", 1, Layout(3, 5), 6),
        ("view", 1, Layout(3, 5), 6),
        ("explicit", 0, Layout(1, 8), 50),
        ("explicit", 3, Layout(20, 16), 40),
        ("view", 1, Layout(), 1500),
        ("explicit", 2, Layout(), 1500),
    ],
)
def test_generated_gaussians_match_equations_and_gradients(mode, sh_degree, layout, n):
    rng = np.random.default_rng(1)
    rows = torch.tensor(rng.normal(0, 0.5, (n, layout.columns)), dtype=torch.float32, requires_grad=True)
    positions = torch.tensor(rng.normal(size=(n, 3)), dtype=torch.float32)
    ids = torch.arange(n, dtype=torch.int32)
    heads = Heads(layout, mode, sh_degree, torch.Generator().manual_seed(0))
    k = layout.offsets
    camera_center = np.array([0.1, 0.2, -3.0])
    g = generate(layout, positions, rows, ids, heads, camera_center)
    assert 0 < len(g.source) < n * k and (g.ids == g.source // k).all()

    again = rows.detach().clone().requires_grad_()
    features = again[:, layout.feature_columns]
    if mode == "view":
        to_anchor = positions - torch.tensor(camera_center, dtype=torch.float32)
        distance = to_anchor.norm(dim=1, keepdim=True)
        features = torch.cat([features, distance, to_anchor / distance], 1)
    raw_o, raw_s, raw_c = heads(features)
    extent = torch.exp(again[:, layout.extent_columns])
    opacity = torch.tanh(raw_o + again[:, layout.opacity_columns]).reshape(-1)
    shape = (raw_s + again[:, layout.shape_columns]).reshape(-1, 7)
    offsets = again[:, layout.offset_columns].reshape(n, k, 3)
    want = {
        "means": (positions[:, None] + offsets * extent[:, None, :3]).reshape(-1, 3),
        "quats": shape[:, 3:],
        "scales": (extent[:, 3:].repeat_interleave(k, 0)) * torch.sigmoid(shape[:, :3]),
        "opacities": opacity,
        "sh": raw_c.reshape(n * k, heads.coefficients, 3),
    }
    dc = again[:, layout.color_columns].reshape(n * k, 1, 3)
    want["sh"] = torch.cat([want["sh"][:, :1] + dc, want["sh"][:, 1:]], 1)
    loss = loss_want = 0
    for name, value in want.items():
        value = value[g.source]
        got = getattr(g, name)
        np.testing.assert_allclose(got.detach(), value.detach(), rtol=1e-5, atol=1e-6)
        weights = torch.tensor(rng.normal(size=tuple(value.shape)), dtype=torch.float32)
        loss = loss + (got * weights).sum()
        loss_want = loss_want + (value * weights).sum()
    head_gradients = torch.autograd.grad(loss, [rows, *heads.parameters()], retain_graph=True)
    want_gradients = torch.autograd.grad(loss_want, [again, *heads.parameters()])
    for a, b in zip(head_gradients, want_gradients):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-5 * float(b.abs().max()))


def test_nonfinite_gradient_affects_only_its_anchor():
    layout, n = Layout(4, 8), 40
    rng = np.random.default_rng(2)
    rows = torch.tensor(rng.normal(0, 0.5, (n, layout.columns)), dtype=torch.float32, requires_grad=True)
    rows.data[7, layout.feature_columns] = math.nan  # generates no splat, so it must have no effect
    positions, ids = torch.zeros(n, 3), torch.zeros(n, dtype=torch.int32)
    heads = Heads(layout, "explicit", 1, torch.Generator().manual_seed(0))
    g = generate(layout, positions, rows, ids, heads)
    at_fault = int(g.source[10]) // layout.offsets
    others = (g.source // layout.offsets != at_fault).float()
    assert 7 not in g.source // layout.offsets
    of_others = torch.autograd.grad((g.scales.sum(1) * others).sum(), [*heads.parameters()], retain_graph=True)
    g_scales = torch.ones_like(g.scales)
    g_scales[10, 1] = math.inf
    found, *of_heads = torch.autograd.grad(g.scales, [rows, *heads.parameters()], g_scales)
    for got, want in zip(of_heads, of_others):
        np.testing.assert_allclose(got, want, rtol=1e-4, atol=1e-6)
    assert found[at_fault, layout.feature_columns].isnan().all()
    assert found[[i for i in range(n) if i != at_fault]].isfinite().all()


@pytest.mark.parametrize(("extent", "blur"), [(-2, 0.05), (-7, 0.3)])
def test_anchors_in_view_include_all_drawn_anchors(extent, blur):
    """Also opaque points, which are drawn as wide as the low-pass filter."""
    rng = np.random.default_rng(5)
    layout = Layout(4, 8)
    n = 400
    rows = torch.tensor(rng.normal(0, 0.5, (n, layout.columns)), dtype=torch.float32)
    rows[:, layout.extent_columns] = torch.tensor(rng.normal(extent, 0.7, (n, 6)), dtype=torch.float32)
    rows[:, layout.opacity_columns] = 6.0
    positions = torch.tensor(rng.normal(0, 3, (n, 3)), dtype=torch.float32)
    anchors = Anchors(layout, 0.1, positions, rows, torch.zeros(n, dtype=torch.int32))
    heads = Heads(layout, "explicit", 0, torch.Generator().manual_seed(1))
    camera = Camera(np.eye(4), np.array([[50.0, 0, 30], [0, 60, 20], [0, 0, 1]]), 64, 48, blur=blur)
    with torch.no_grad():
        g = generate(layout, positions, rows, anchors.ids, heads)
        drawn = rasterize(*g[:6], camera)
    needed = np.unique(g.source.numpy()[drawn.frame.seen] // 4)
    seen = anchors_in_view(anchors, *camera.arrays(), camera.width, camera.height, camera.near)
    assert set(needed.tolist()) <= set(seen.tolist())
    assert len(seen) < n


def grown(gradient, ids=(1, 2), positions=((0.0, 0, 0), (8.0, 0, 0)), offset=(0.0, 0.0, 0.0), opacity=1.0):
    layout = Layout(1, 4)
    rows = torch.zeros(2, layout.columns)
    rows[:, layout.offset_columns] = torch.tensor(offset)
    anchors = Anchors(layout, 1.0, torch.tensor(positions), rows, torch.tensor(ids, dtype=torch.int32))
    return anchors, grow_and_prune(anchors, statistics_of(gradient, opacity), np.random.default_rng(0))


def statistics_of(gradient, opacity=1.0):
    """Return growth statistics of ten steps with this gradient and opacity."""
    visits = torch.full((2,), 10, dtype=torch.int32)
    return GrowthStatistics(torch.tensor(gradient) * 10, visits, torch.full((2,), opacity * 10), visits)


def test_new_anchor_inherits_id_and_uses_free_cell():
    anchors, growth = grown([1.0, 0.0], offset=(2.2, 0, 0))
    assert growth.added >= 1 and growth.pruned == 0
    assert set(anchors.ids[2:].tolist()) == {1}
    assert len(np.unique(cell_keys(anchors.positions, 1.0), axis=0)) == len(anchors)


@pytest.mark.parametrize("far", [(0.0, 8, 0), (-8.0, 0, -8), (1e9, -1e9, 1e9), (1e18, 1e18, 1e18)])
def test_growth_is_independent_of_distant_anchors(far):
    anchors, growth = grown([1.0, 0.0], positions=((0.0, 0, 0), far), offset=(2.2, 0, 0))
    near, alone = grown([1.0, 0.0], offset=(2.2, 0, 0))
    assert growth.added == alone.added > 0
    assert anchors.positions[2:].tolist() == near.positions[2:].tolist()


def test_larger_gradient_wins_shared_cell():
    positions = ((0.0, 0, 0), (4.0, 0, 0))
    layout = Layout(1, 4)
    for gradient, winner in (([1.0, 2.0], 2), ([2.0, 1.0], 1)):
        rows = torch.zeros(2, layout.columns)
        rows[:, 0] = torch.tensor([2.1, -2.1])
        anchors = Anchors(layout, 1.0, torch.tensor(positions), rows, torch.tensor([1, 2], dtype=torch.int32))
        grow_and_prune(anchors, statistics_of(gradient), np.random.default_rng(0))
        place = np.flatnonzero((cell_keys(anchors.positions, 1.0) == [2, 0, 0]).all(1))
        assert len(place) == 1 and anchors.ids[place[0]] == winner


def test_transparent_anchors_are_pruned():
    anchors, growth = grown([0.0, 0.0], opacity=0.001)
    assert growth.pruned == 2 and len(anchors) == 0


def test_growth_statistics_of_rarely_seen_anchors_are_kept():
    layout = Layout(2, 4)

    def anchors():
        positions, ids = torch.tensor([[0.0, 0, 0], [8, 0, 0], [16, 0, 0]]), torch.ones(3, dtype=torch.int32)
        rows = torch.zeros(3, layout.columns)
        rows[:, layout.offset_columns] = 2.2
        return Anchors(layout, 1.0, positions, rows, ids)

    # The first anchor is transparent and pruned; of the four splats of the others, one was seen often enough.
    often, seldom = MIN_VISITS, MIN_VISITS - 1
    visits = torch.tensor([0, 0, often, seldom, seldom, 0], dtype=torch.int32)
    views = torch.tensor([often, often, seldom], dtype=torch.int32)
    statistics = GrowthStatistics(1.0 * visits, visits, torch.tensor([0.0, 1, 1]), views)
    of = anchors()
    growth = grow_and_prune(of, statistics, np.random.default_rng(0))
    assert growth.pruned == 1 and growth.added == len(of) - 2 > 0
    left = statistics.after(growth, 2)
    none = [0] * growth.added
    assert left.visits.tolist() == [0, seldom, seldom, 0] + 2 * none and left.views.tolist() == [0, seldom, *none]
    assert left.gradient.tolist() == left.visits.tolist() and left.opacity.tolist() == [0, 1, *none]
    assert len(left.visits) == 2 * len(of)


# --- checkpoints -----------------------------------------------------------------------------------------------------


def test_truncated_checkpoint_falls_back_with_warning(tmp_path):
    for step in (1, 2):
        save_checkpoint(tmp_path, {"x": np.full(1000, step, np.float32)}, {"step": step})
    assert load_checkpoint(tmp_path)[1]["step"] == 2
    data = (tmp_path / CURRENT).read_bytes()
    for cut in (0, 5, 100, len(data) - 1):
        (tmp_path / CURRENT).write_bytes(data[:cut])
        tensors, state, warning = load_checkpoint(tmp_path)
        assert state["step"] == 1 and tensors["x"][0] == 1
        assert CURRENT in warning and PREVIOUS in warning
    (tmp_path / PREVIOUS).unlink()
    with pytest.raises(InputError, match="truncated"):
        load_checkpoint(tmp_path)


def test_tensors_are_those_that_were_written(tmp_path):
    written = {
        "x": np.arange(6, dtype=np.float32).reshape(2, 3), "former": np.arange(3), "none": np.zeros((0, 4), np.int32),
        "one": np.array([0.5]),
    }  # fmt: skip
    save_checkpoint(tmp_path, written, {})
    of_package = safetensors.numpy.load_file(tmp_path / CURRENT)
    tensors, _, _ = load_checkpoint(tmp_path, former={"former": "present"})
    assert set(tensors) == {"x", "present", "none", "one"}
    for name, values in of_package.items():
        read = tensors[{"former": "present"}.get(name, name)]
        assert read.dtype == values.dtype and np.array_equal(read, values) and np.array_equal(read, written[name])

    def fail(*_):
        raise ValueError("of the caller")

    with pytest.raises(ValueError, match="of the caller"):
        load_checkpoint(tmp_path, take=fail)
    only_x = load_checkpoint(tmp_path, take=lambda stored, state: {"x": stored["x"]})[0]
    assert set(only_x) == {"x"}


def test_tensor_beyond_the_file_is_damage(tmp_path):
    save_checkpoint(tmp_path, {"x": np.zeros(4, np.float32), "y": np.zeros(4, np.float32)}, {})
    whole = (tmp_path / CURRENT).read_bytes()
    for old, new in ((b'"shape": [4]', b'"shape": [5]'), (b"[16, 32]", b"[17, 33]"), (b"F32", b"F16")):
        (tmp_path / CURRENT).write_bytes(whole.replace(old, new))
        with pytest.raises(InputError, match="damaged"):
            load_checkpoint(tmp_path)


def test_model_is_not_read_from_a_checkpoint_with_damaged_moments(tiny, tmp_path):
    capture, ids = tiny()
    Trainer.start(capture, ids, SMALL).run(Budget(steps=2), tmp_path, Reporter())
    tensors, state, _ = load_checkpoint(tmp_path)
    tensors["adam.exp_avg"][0, 0] = np.nan
    save_checkpoint(tmp_path, tensors, state)
    _, _, warning = load_model(tmp_path)
    assert "damaged" in warning
    (tmp_path / PREVIOUS).unlink()
    with pytest.raises(InputError, match="damaged"):
        load_model(tmp_path)


@pytest.mark.parametrize("has_links", [True, False])
def test_process_killed_while_it_saves_leaves_a_complete_checkpoint(tmp_path, monkeypatch, has_links):
    """With hard links, the current one is never missing; other commands refuse to work without it."""
    steps = []

    def watched(module, name):
        whole = getattr(module, name)

        def call(*args, **options):
            assert (tmp_path / CURRENT).exists() or not has_links
            steps.append(load_checkpoint(tmp_path)[1]["step"])
            if name == "link" and not has_links:
                raise OSError(95, "Operation not supported")
            return whole(*args, **options)

        monkeypatch.setattr(module, name, call)

    save_checkpoint(tmp_path, {"x": np.zeros(3)}, {"step": 1})
    for module, name in ((os, "fsync"), (os, "link"), (Path, "replace"), (Path, "unlink")):
        watched(module, name)
    for step in (2, 3):
        save_checkpoint(tmp_path, {"x": np.zeros(3)}, {"step": step})
    assert steps == sorted(steps) and set(steps) == {1, 2} and len(steps) >= 2 * 4
    assert load_checkpoint(tmp_path)[1]["step"] == 3
    (tmp_path / CURRENT).unlink()
    assert load_checkpoint(tmp_path)[1]["step"] == 2
    assert [path.name for path in tmp_path.iterdir()] == [PREVIOUS]


def test_full_disk_keeps_previous_checkpoint(tmp_path, monkeypatch):
    save_checkpoint(tmp_path, {"x": np.zeros(3)}, {"step": 1})

    def full(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(InputError, match="No space left"):
        save_checkpoint(tmp_path, {"x": np.ones(3)}, {"step": 2})
    assert [p.name for p in tmp_path.iterdir()] == [CURRENT]
    assert load_checkpoint(tmp_path)[1]["step"] == 1


# --- whole trainings -------------------------------------------------------------------------------------------------


SMALL = Settings(offsets=4, sh_degree=1)


def mean_loss(trainer, steps, progress=0.3):
    return float(np.mean([trainer.step(progress) for _ in range(steps)]))


FLAT = dataclasses.replace(SMALL, primitive="2d")


def test_finest_cells_are_no_larger_than_two_pixels(tiny):
    """Where points are farther apart than that; else as large as the points are apart."""
    capture, ids = tiny()
    xyz, finest = capture.points.xyz, 2 * pixel_size(capture)
    few = np.arange(len(ids)) % (len(ids) // 6) == 0
    assert median_spacing(xyz) < finest < median_spacing(xyz[few])
    for seeds, expected in ((np.ones(len(ids), bool), median_spacing(xyz)), (few, finest)):
        model = initial_model(capture, ids, SMALL, np.random.default_rng(0), seeds)
        assert model.anchors.voxel / model.normalization.scale == pytest.approx(expected)


def test_spacing_of_many_points_is_that_of_a_sample(monkeypatch):
    xyz = np.random.default_rng(0).normal(size=(20_000, 3))
    queried, query = [], cKDTree.query

    class Counting(cKDTree):
        def query(self, points, k):
            queried.append(len(points))
            return query(self, points, k)

    monkeypatch.setattr("backend.model.anchors.cKDTree", Counting)
    monkeypatch.setattr("backend.model.anchors._QUERIED", 20_000)
    whole = median_spacing(xyz)
    monkeypatch.setattr("backend.model.anchors._QUERIED", 3000)
    assert median_spacing(xyz) == pytest.approx(whole, rel=0.03)
    assert queried == [20_000, 20_000 // 7 + 1]


def test_pixels_are_measured_where_they_show_points(tiny):
    capture, _ = tiny()
    view = capture.views[0]
    pixel = dataclasses.replace(view, viewmat=np.eye(4), K=np.array([[50.0, 0, 8], [0, 50.0, 6], [0, 0, 1]]))
    at = np.array([[0, 0, 2.0], [0, 0, 4.0], [0, 0, 6.0], [0, 0, -1.0], [90.0, 0, 9.0], [0, -9.0, 9.0]])
    assert pixel_size(SimpleNamespace(views=[pixel], points=SimpleNamespace(xyz=at))) == pytest.approx(4.0 / 50.0)
    assert pixel_size(SimpleNamespace(views=[pixel], points=SimpleNamespace(xyz=at[3:]))) == np.inf


def test_pixels_are_measured_at_some_of_many_points(tiny, monkeypatch):
    capture, _ = tiny()
    at = np.random.default_rng(0).normal(0, 0.5, (100_000, 3))
    many = SimpleNamespace(views=capture.views, points=SimpleNamespace(xyz=at))
    whole = pixel_size(many)
    monkeypatch.setattr("backend.training.extent._POINTS", 10_000)
    tracemalloc.start()
    try:
        assert pixel_size(many) == pytest.approx(whole, rel=0.01)
        assert tracemalloc.get_traced_memory()[1] < 10_000 * (len(capture.views) * 3 + 20) * 8
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("settings", [SMALL, FLAT], ids=["3d", "2d"])
def test_training_lowers_loss_and_learns_ids(tiny, settings):
    capture, ids = tiny()
    trainer = Trainer.start(capture, ids, settings)
    before = mean_loss(trainer, 8)
    for i in range(150):
        trainer.step(i / 150)
    assert mean_loss(trainer, 8, 1.0) < 0.5 * before
    # The cameras are 40 degrees apart, too far for held-out views, so a training view is checked.
    index = capture.train_indices[0]
    rendered = draw(trainer.shown, trainer.scene.camera(index))
    truth = capture.mask(index)
    assert (rendered.ids[truth > 0] == truth[truth > 0]).mean() > 0.95
    assert rendered.probability[truth > 0].mean() > 0.85


def test_checkpoints_that_take_long_are_rare(tiny, tmp_path, monkeypatch):
    trainer, saved = Trainer.start(*tiny(), SMALL), []

    def save(folder):
        saved.append(trainer.progress.step)
        time.sleep(0.5)

    monkeypatch.setattr(trainer, "save", save)
    trainer.run(Budget(steps=6), tmp_path, Reporter(), checkpoint_seconds=0.0)
    assert saved == [1, 6]
    assert [seconds_to_next(30.0, seconds) for seconds in (0.1, 10.0, 100.0)] == [30.0, 200.0, 600.0]
    assert seconds_to_next(1000.0, 100.0) == 1000.0


@pytest.mark.parametrize("failing", [1, 2])
def test_one_checkpoint_at_an_interval_may_fail(tiny, tmp_path, monkeypatch, failing):
    """But not two in a row."""
    trainer, saved, warnings, reporter = Trainer.start(*tiny(), SMALL), [], [], Reporter()

    def replace(part, path):
        saved.append(trainer.progress.step)
        if len(saved) in (5, 5 + failing - 1):
            raise PermissionError(13, "It is being used by another process")
        part.replace(path)

    def step(_):
        trainer.progress.step += 1
        return torch.tensor(1.0)

    monkeypatch.setattr(atomic, "replace_file", replace)
    monkeypatch.setattr(trainer, "step", step)
    monkeypatch.setattr(checkpoint, "seconds_to_next", lambda *_: 0.0)
    reporter.warning = warnings.append
    run = functools.partial(trainer.run, Budget(steps=6), tmp_path, reporter, checkpoint_seconds=0.0)
    if failing == 1:
        run()
    else:
        with pytest.raises(InputError, match="close programs that use it"):
            run()
    assert len(warnings) == 1 and str(tmp_path) in warnings[0] and "used by another process" in warnings[0]
    assert load_checkpoint(tmp_path)[1]["progress"]["step"] == trainer.progress.step == 6


@pytest.mark.parametrize("photos", [True, False])
def test_folder_that_is_gone_is_not_made_again(tiny, tmp_path, monkeypatch, photos):
    """A disk may be unplugged, with the photos or without; the next one at its place is to get its name."""
    trainer, folder, warnings, reporter = Trainer.start(*tiny(), SMALL), tmp_path / "disk" / "rec", [], Reporter()
    folder.mkdir(parents=True)
    trainer.save(folder / "checkpoint")

    def step(_):
        trainer.progress.step += 1
        if trainer.progress.step == 2:
            (tmp_path / "disk").rename(tmp_path / "away")
            if photos:
                raise InputError("a photo cannot be read")
        return torch.tensor(1.0)

    monkeypatch.setattr(trainer, "step", step)
    monkeypatch.setattr(checkpoint, "seconds_to_next", lambda *_: 0.0)
    reporter.warning = warnings.append
    with pytest.raises(InputError, match="rec is gone; connect its disk"):
        trainer.run(Budget(steps=6), folder / "checkpoint", reporter, checkpoint_seconds=0.0)
    assert not (tmp_path / "disk").exists() and all("rec is gone)" in sentence for sentence in warnings)
    assert load_checkpoint(tmp_path / "away" / "rec" / "checkpoint")[1]["progress"]["step"] == 1


@pytest.mark.parametrize("where", ["a view", "growth"])
def test_steps_before_a_lack_of_memory_are_saved(tiny, tmp_path, monkeypatch, where):
    """But not a model whose anchors have changed in part."""
    trainer = Trainer.start(*tiny(), SMALL)
    trainer.save(tmp_path)
    compute = trainer.view_step.compute

    def computing(*args, **options):
        if trainer.progress.step < 3:
            return compute(*args, **options)
        if where == "growth":
            anchors = trainer.model.anchors
            anchors.positions, anchors.rows, anchors.ids = anchors.positions[1:], anchors.rows[1:], anchors.ids[1:]
        raise MemoryError("Unable to allocate 450 MiB")

    monkeypatch.setattr(trainer.view_step, "compute", computing)
    with pytest.raises(MemoryError):
        trainer.run(Budget(steps=6), tmp_path, Reporter())
    resumed, warning = Trainer.resume(trainer.scene.capture, tmp_path)
    assert warning is None and resumed.progress.step == (0 if where == "growth" else 3)


def test_stop_during_an_evaluation_saves_the_step(tiny, tmp_path):
    trainer, evaluated = Trainer.start(*tiny(), SMALL), []

    def evaluate(model, scene, progress):
        evaluated.append(progress.step)
        if progress.step >= 3:
            raise Cancelled
        return {}

    with pytest.raises(Cancelled, match="run the same command again to resume") as stopped:
        trainer.run(Budget(steps=20), tmp_path, Reporter(), evaluate)
    assert Trainer.resume(trainer.scene.capture, tmp_path)[0].progress.step == evaluated[-1] >= 3
    assert str(stopped.value).startswith(f"Stopped after {evaluated[-1]} steps")


def test_training_is_bitwise_reproducible_and_resumable(tiny, tmp_path):
    capture, ids = tiny()
    whole = Trainer.start(capture, ids, SMALL)
    whole.run(Budget(steps=40), tmp_path / "a", Reporter())
    again = Trainer.start(capture, ids, SMALL)
    again.run(Budget(steps=40), tmp_path / "b", Reporter())
    assert (whole.model.anchors.rows == again.model.anchors.rows).all()

    parts = Trainer.start(capture, ids, SMALL)
    calls = iter(range(1000))

    class StopLater(StopRequest):
        def __call__(self):
            return next(calls) >= 17

    with pytest.raises(Cancelled):
        parts.run(Budget(steps=40), tmp_path / "c", Reporter(), stop=StopLater())
    resumed, warning = Trainer.resume(capture, tmp_path / "c", SMALL)
    assert warning is None and resumed.progress.step == 17
    resumed.run(Budget(steps=40), tmp_path / "c", Reporter())
    assert (whole.model.anchors.rows == resumed.model.anchors.rows).all()
    assert whole.progress.smooth_loss == resumed.progress.smooth_loss is not None
    for a, b in zip(whole.model.heads.parameters(), resumed.model.heads.parameters()):
        assert (a == b).all()

    other = Trainer.start(capture, ids, Settings(offsets=4, sh_degree=1, seed=1))
    other.run(Budget(steps=40), tmp_path / "d", Reporter())
    assert not np.array_equal(whole.model.anchors.rows, other.model.anchors.rows)


def test_validation_views_are_trained_on_where_the_length_is_known(tiny, tmp_path, monkeypatch):
    """After a training until convergence that was stopped, and by its discs; not in a cell."""
    capture, ids = tiny()
    capture = capture.validating_on([capture.views[index].name for index in capture.train_indices[::3]])
    trained, compute = [], ViewStep.compute

    def computing(self, index, *args, **options):
        trained.append(index)
        return compute(self, index, *args, **options)

    class StopLater(StopRequest):
        def __call__(self):
            return len(trained) >= 8

    monkeypatch.setattr(ViewStep, "compute", computing)
    first = Trainer.start(capture, ids, dataclasses.replace(SMALL, fit_colors=True))
    with pytest.raises(Cancelled):
        first.run(Budget(until_converged=True), tmp_path, Reporter(), stop=StopLater())
    assert set(trained) == set(capture.train_indices)
    model, _, _ = load_model(tmp_path)
    discs = begin_discs(model, capture, tmp_path, 100, np.ones((len(capture), 3)))
    resumed, _ = Trainer.resume(capture, tmp_path)
    cell, _ = Trainer.resume(capture, tmp_path)
    cell.region = Region(bounds=((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)))
    for trainer, views in ((discs, capture.validation_indices), (resumed, capture.validation_indices), (cell, ())):
        trained.clear()
        trainer.run(Budget(steps=trainer.progress.step + 10), tmp_path / "out", Reporter())
        assert set(trained) == {*capture.train_indices, *views} and trainer.progress.joined is bool(views)


def test_steps_without_a_loss_do_not_change_the_smooth_loss(tiny, tmp_path, monkeypatch):
    trainer = Trainer.start(*tiny(), SMALL)
    losses = iter([math.nan, 4.0, math.nan, 2.0, math.nan])

    def step(_):
        trainer.progress.step += 1
        return torch.tensor(next(losses))

    monkeypatch.setattr(trainer, "step", step)
    trainer.run(Budget(steps=5), tmp_path, Reporter())
    assert trainer.progress.smooth_loss == pytest.approx(3.9)


def test_checkpoint_of_other_settings_is_rejected(tiny, tmp_path):
    capture, ids = tiny()
    Trainer.start(capture, ids, SMALL).run(Budget(steps=2), tmp_path / "a", Reporter())
    with pytest.raises(InputError, match="sh_degree"):
        Trainer.resume(capture, tmp_path / "a", Settings(offsets=4, sh_degree=2))
    with pytest.raises(InputError, match="primitive"):
        Trainer.resume(capture, tmp_path / "a", FLAT)


def test_checkpoint_of_3d_gaussians_ignores_disc_settings(tiny, tmp_path):
    capture, ids = tiny()
    Trainer.start(capture, ids, SMALL).run(Budget(steps=2), tmp_path, Reporter())
    trainer, _ = Trainer.resume(capture, tmp_path, dataclasses.replace(SMALL, distortion_weight=3.0, normal_weight=0.0))
    assert trainer.progress.step == 2
    with pytest.raises(InputError, match="primitive"):
        Trainer.resume(capture, tmp_path, FLAT)


def test_older_checkpoint_keeps_its_filter(tiny, tmp_path):
    capture, ids = tiny()
    trainer = Trainer.start(capture, ids, SMALL)
    trainer.run(Budget(steps=2), tmp_path, Reporter())
    assert trainer.scene.camera(0).blur == load_model(tmp_path)[0].blur == EPS_2D
    tensors, state, _ = load_checkpoint(tmp_path)
    save_checkpoint(tmp_path, tensors, {k: v for k, v in state.items() if k not in ("format", "blur")})
    trainer, _ = Trainer.resume(capture, tmp_path, SMALL)
    trainer.run(Budget(steps=4), tmp_path, Reporter())
    assert trainer.scene.camera(0, downscale=2).blur == USUAL_EPS_2D
    model = load_model(tmp_path)[0]
    assert model.blur == model.splats()[0].blur == USUAL_EPS_2D and model.splats()[0].select([0]).blur == USUAL_EPS_2D


def test_older_checkpoint_is_3d(tiny, tmp_path):
    capture, ids = tiny()
    Trainer.start(capture, ids, SMALL).run(Budget(steps=2), tmp_path, Reporter())
    tensors, state, _ = load_checkpoint(tmp_path)
    for name in ("primitive", "normal_weight", "distortion_weight"):
        del state["settings"][name]
    save_checkpoint(tmp_path, tensors, {k: v for k, v in state.items() if k != "format"})
    trainer, _ = Trainer.resume(capture, tmp_path, SMALL)
    assert trainer.model.primitive == "3d" and blur_warning(state, tmp_path) is None


def test_normals_and_distortion_are_computed_only_if_weighted(tiny, monkeypatch):
    capture, ids = tiny()
    requested = []

    def seen(*args, **kwargs):
        requested.append([kwargs[f"want_{what}"] for what in ("depth", "normals", "distortion")])
        return rasterize(*args, **kwargs)

    monkeypatch.setattr("backend.training.step.rasterize", seen)
    normals = dataclasses.replace(FLAT, distortion_weight=0.0)
    for settings, progress, wanted in (
        (SMALL, 0.9, [False] * 3), (FLAT, 0.1, [False] * 3), (FLAT, 0.9, [True] * 3),
        (normals, 0.9, [True, True, False]),
        (dataclasses.replace(FLAT, normal_weight=0.0), 0.9, [False, False, True]),
        (dataclasses.replace(normals, normal_weight=0.0), 0.9, [False] * 3),
    ):  # fmt: skip
        assert Trainer.start(capture, ids, settings).step(progress).isfinite()
        assert requested.pop() == wanted


def test_normal_loss_aligns_normals_with_depth(tiny):
    capture, ids = tiny()
    found = []
    for weight in (0.0, 0.2):
        trainer = Trainer.start(capture, ids, dataclasses.replace(FLAT, normal_weight=weight))
        for i in range(80):
            trainer.step(0.3 + i / 200)
        camera = trainer.scene.camera(capture.train_indices[0])
        g = trainer.model.generate()
        drawn = rasterize(*g[:6], camera, want_depth=True, want_normals=True, primitive="2d")
        found.append(float(normal_loss(drawn.normals, drawn.depth, drawn.alpha, camera.arrays()[1])))
    assert found[1] < 0.8 * found[0]


def test_stopped_and_finished_training_store_average_model(tiny, tmp_path, monkeypatch):
    capture, ids = tiny()
    budget, requested, seen = Budget(steps=60), [], []
    trainer = Trainer.start(capture, ids, SMALL)
    follow = Average.follow
    monkeypatch.setattr(Average, "follow", lambda own, model, step: (follow(own, model, step), seen.append(step))[0])

    class StopLater(StopRequest):
        def __call__(self):
            requested.append(trainer.progress.step)
            return len(requested) > 45

    def measure(model, scene, progress):
        return {"psnr": 0.0, "is_model": model is trainer.model}

    with pytest.raises(Cancelled):
        trainer.run(budget, tmp_path, Reporter(), measure, stop=StopLater())
    assert seen == list(range(1, 46)) and trainer.progress.last_growth > 0
    mean = trainer.shown
    assert len(mean.anchors) == len(trainer.model.anchors)
    assert not torch.equal(mean.anchors.rows, trainer.model.anchors.rows)
    stored, _, _ = load_model(tmp_path)
    resumed, _ = Trainer.resume(capture, tmp_path, SMALL)
    assert torch.equal(resumed.model.anchors.rows, trainer.model.anchors.rows), (
        "training resumes from the model, not from its average"
    )
    for other in (stored, resumed.shown):
        assert torch.equal(other.anchors.rows, mean.anchors.rows) and torch.equal(other.background, mean.background)
        pairs = zip(other.heads.parameters(), mean.heads.parameters(), strict=True)
        assert all(torch.equal(a, b) for a, b in pairs)
    resumed.run(budget, tmp_path, Reporter(), measure)
    assert not torch.equal(resumed.shown.anchors.rows, resumed.model.anchors.rows)
    assert torch.equal(load_model(tmp_path)[0].anchors.rows, resumed.shown.anchors.rows)
    assert not any(entry["is_model"] for entry in trainer.progress.curve)


def test_average_model_follows_values_and_reduces_noise(tiny):
    capture, ids = tiny()
    model = Trainer.start(capture, ids, SMALL).model
    average, rows, rng = Average(model), model.anchors.rows, np.random.default_rng(0)
    expected, bias = rows.clone().double(), model.heads.opacity.bias
    for step in range(1, 1001):
        rows[:] = 3.0 + torch.from_numpy(rng.normal(size=rows.shape))
        with torch.no_grad():
            bias.fill_(float(step))
        average.follow(model, step)
        if step % EVERY == 0:
            weight = EVERY / max(min(FRACTION * step, MAX_STEPS), EVERY)
            expected += weight * (rows - expected)
        if step == EVERY:
            assert torch.equal(average.of(model).anchors.rows, rows), "the average of one step is that step"
    mean = average.of(model)
    assert torch.allclose(mean.anchors.rows.double(), expected, atol=1e-4)
    assert (mean.anchors.rows - 3).std() < 0.25 and 880 < float(mean.heads.opacity.bias.detach().mean()) < 930

    kept = torch.arange(len(rows)) % 2 == 0
    before = mean.anchors.rows[kept]
    average.take(kept.nonzero()[:, 0], rows[:3])
    assert torch.equal(average.of(model).anchors.rows, torch.cat([before, rows[:3]]))


def test_time_budget_ends_training(tiny, tmp_path):
    capture, ids = tiny()
    trainer = Trainer.start(capture, ids, SMALL)
    started = time.monotonic()
    trainer.run(Budget(seconds=2.0), tmp_path / "a", Reporter())
    assert time.monotonic() - started < 4.0
    assert trainer.progress.step > 1


def test_capture_without_masks_trains_as_one_class(tiny):
    capture, ids = tiny(masks=False)
    trainer = Trainer.start(capture, ids, SMALL)
    before = mean_loss(trainer, 8)
    for i in range(60):
        trainer.step(i / 60)
    assert mean_loss(trainer, 8, 1.0) < before
    assert trainer.model.classes.ids.tolist() == [0]


def test_targets_are_held_in_a_quarter_of_their_size(tiny, monkeypatch):
    capture, _ = tiny()
    megabytes = 4 * sum(view.width * view.height for view in capture.views) / 1e6
    gains = np.linspace(0.5, 2.0, 3 * len(capture)).reshape(-1, 3)
    classes = ClassTable(capture.object_ids)
    normalization = Normalization.of(capture.points.xyz, capture.points.xyz)
    scene = Scene(capture, classes, normalization, memory_mb=megabytes, gains=gains)
    read, image_of = [], capture.image
    monkeypatch.setattr(capture, "image", lambda *key: read.append(key) or image_of(*key))
    for index in (*range(len(capture)), *range(len(capture))):
        image, labels = scene.target(index)
        mask, true = capture.mask(index), image_of(index) / (255 * gains[index])
        assert np.allclose(image.permute(1, 2, 0), true, atol=1e-6)
        assert np.array_equal(labels, np.where(mask > 0, classes.classes_of(mask), -1))
    assert len(read) == len(capture)


def test_unlabeled_pixels_are_supervised_if_many_points_are_unlabeled(tiny):
    capture, ids = tiny()
    gaps = Trainer.start(capture, ids, SMALL)
    bare = ids.copy()
    bare[: len(ids) // 4] = 0
    rest = Trainer.start(capture, bare, SMALL)
    index = capture.train_indices[0]
    nothing = torch.from_numpy(capture.mask(index) == 0)
    assert (gaps.scene.target(index)[1][nothing] == -1).all()
    assert (rest.scene.target(index)[1][nothing] == 0).all()
    for trainer in (gaps, rest):
        for i in range(120):
            trainer.step(i / 120)
    drawn = [(draw(t.model, t.scene.camera(index)).ids[nothing.numpy()] > 0).mean() for t in (gaps, rest)]
    assert drawn[1] < 0.5 * drawn[0]


@pytest.mark.parametrize("settings", [SMALL, FLAT], ids=["3d", "2d"])
def test_explicit_splats_match_model_render(tiny, settings):
    capture, ids = tiny()
    trainer = Trainer.start(capture, ids, settings)
    for i in range(20):
        trainer.step(i / 20)
    index = capture.test_indices[0]
    shown = draw(trainer.model, trainer.scene.camera(index))
    splats, _ = trainer.model.splats()
    view = capture.views[index]
    camera = Camera(view.viewmat, view.K, view.width, view.height, near=0.01 / trainer.model.normalization.scale)
    tensors = [torch.from_numpy(np.asarray(a, np.float32)) for a in
               (splats.means, splats.quats, splats.scales, splats.opacities, splats.sh)]  # fmt: skip
    drawn = rasterize(
        *tensors, torch.from_numpy(splats.object_ids.astype(np.int32)), camera, primitive=settings.primitive
    )
    image = drawn.color + (1 - drawn.alpha) * trainer.model.background.detach()[:, None, None]
    image = image * torch.tensor(trainer.scene.gains[index], dtype=torch.float32)[:, None, None]
    if settings.primitive == "2d":
        thin, wide = splats.scales.min(1), np.sort(splats.scales, axis=1)[:, 1]
        assert (splats.scales[:, 2] == thin).all() and np.allclose(thin, 1e-3 * wide, rtol=1e-4)
    np.testing.assert_allclose(image.clamp(0, 1).permute(1, 2, 0), shown.image, atol=1e-3)


@pytest.mark.parametrize(("scale", "offset"), [(1e-4, 0.0), (1e4, 0.0), (1.0, 1e6)])
def test_normalization_is_invariant_to_scale_and_offset(scale, offset):
    rng = np.random.default_rng(0)
    points, camera_centers = rng.normal(size=(500, 3)), rng.normal(size=(9, 3)) * 4
    a = Normalization.of(camera_centers, points)
    b = Normalization.of(camera_centers * scale + offset, points * scale + offset)
    np.testing.assert_allclose(a.to_scene(points), b.to_scene(points * scale + offset), atol=1e-6)
    viewmat = np.eye(4)
    viewmat[:3, 3] = -camera_centers[0]
    moved = np.eye(4)
    moved[:3, 3] = -(camera_centers[0] * scale + offset)
    np.testing.assert_allclose(a.viewmat(viewmat), b.viewmat(moved), atol=1e-6)


@pytest.mark.long
def test_killed_training_resumes_to_same_model(write_capture, tmp_path):
    """A run that is killed between two checkpoints and resumed gives the same model as an uninterrupted run."""
    scene = write_capture(views=9, size=(64, 48))
    common = ["--steps", "260", "--offsets", "4", "--threads", "1"]

    def command(out, *more):
        return [sys.executable, "-m", "backend", "train", str(scene.folder), "--out", str(out), *common, *more]

    subprocess.run(command(tmp_path / "whole"), cwd=ROOT, check=True, capture_output=True, timeout=240)
    killed = subprocess.Popen(
        command(tmp_path / "killed", "--checkpoint-seconds", "0.2"), cwd=ROOT, stdout=subprocess.DEVNULL
    )
    current = tmp_path / "killed" / "checkpoint" / CURRENT
    deadline = time.monotonic() + 120
    while not current.exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    time.sleep(0.3)
    killed.send_signal(signal.SIGKILL)
    killed.wait()
    assert load_checkpoint(current.parent)[1]["progress"]["step"] < 260
    subprocess.run(command(tmp_path / "killed"), cwd=ROOT, check=True, capture_output=True, timeout=240)
    whole, _, _ = load_checkpoint(tmp_path / "whole" / "checkpoint")
    resumed, state, _ = load_checkpoint(current.parent)
    assert state["progress"]["step"] == 260
    assert np.array_equal(whole["anchors.rows"], resumed["anchors.rows"])


def test_paper_mode_has_no_residuals(tiny, tmp_path):
    capture, ids = tiny()
    trainer = Trainer.start(capture, ids, Settings(mode="paper", offsets=4))
    assert not trainer.model.explicit
    first = [float(trainer.step(0.2)) for _ in range(10)]
    losses = [float(trainer.step(0.2 + i / 200)) for i in range(120)]
    for columns in ("opacity_columns", "shape_columns", "color_columns"):
        assert not trainer.model.anchors.rows[:, getattr(trainer.settings.layout, columns)].any(), columns
    assert np.mean(losses[-10:]) < 0.7 * np.mean(first)
    trainer.save(tmp_path / "checkpoint")
    again, _ = Trainer.resume(capture, tmp_path / "checkpoint")
    assert again.settings.mode == "paper" and torch.equal(again.model.anchors.rows, trainer.model.anchors.rows)


def test_training_that_may_take_more_memory_than_is_free_says_what_fits(tiny, monkeypatch):
    capture, ids = tiny()
    trainer = Trainer.start(capture, ids, Settings(offsets=4, max_anchors=3_000_000))
    free, warnings = 1 << 44, []
    reporter = SimpleNamespace(warning=warnings.append)
    monkeypatch.setattr(memory, "free_memory", lambda: free)
    memory.warn_of_memory(trainer, 2000, reporter)
    assert not warnings
    free = 8e9
    memory.warn_of_memory(trainer, 2000, reporter)
    fits = int(warnings[0].split("--max-anchors ")[1].split()[0])
    assert "3,000,000 anchors" in warnings[0] and 0 < fits < 3_000_000
    roomy = Trainer.start(capture, ids, Settings(offsets=4, max_anchors=fits))
    memory.warn_of_memory(roomy, 2000, reporter)
    assert len(warnings) == 1, "what is said to fit does"
    photos = tuple(dataclasses.replace(view, width=6000, height=4000) for view in capture.views)
    roomy.scene.capture = copy.copy(capture)
    roomy.scene.capture.views = photos
    memory.warn_of_memory(roomy, 2000, reporter)
    assert warnings.pop() and len(warnings) == 1, "large photos take memory, too"
    trainer.progress.step = 5
    memory.warn_of_memory(trainer, 2000, reporter)
    assert f"--restart with --max-anchors {fits}" in warnings[1], "a training goes on with the same settings"
    trainer.region = Region(10, EVERYWHERE)
    memory.warn_of_memory(trainer, 2000, reporter)
    assert "more --cells" in warnings[2]
    free = 2e9
    memory.warn_of_memory(trainer, 2000, reporter)
    assert "close other programs" in warnings[3] and "--max-anchors" not in warnings[3]


def test_free_memory_is_limited_by_control_groups(tmp_path, monkeypatch):
    monkeypatch.setattr(machine, "CGROUPS", tmp_path)
    for limit in (None, "max\n"):
        if limit is not None:
            (tmp_path / "memory.max").write_text(limit)
        assert machine.free_memory() > 1e8
    (tmp_path / "memory.max").write_text("1000000\n")
    assert machine.free_memory() == 1e6


def test_training_begins_with_no_more_anchors_than_allowed(tiny):
    capture, ids = tiny()
    every, some = (Trainer.start(capture, ids, Settings(offsets=4, max_anchors=most)) for most in (10_000, 100))
    assert len(every.model.anchors) > 150 and 40 < len(some.model.anchors) <= 100
    assert set(some.model.anchors.ids.tolist()) == set(every.model.anchors.ids.tolist()), "each object keeps some"


def test_next_photos_are_read_ahead_and_their_errors_raised_when_asked_for(tiny, monkeypatch):
    capture, ids = tiny()
    trainer = Trainer.start(capture, ids, Settings(offsets=4))
    scene, read = trainer.scene, []

    def recording(index, downscale=1):
        read.append(index)
        if index == 5:
            raise InputError("no photo 5")
        return type(capture).image(capture, index, downscale)

    monkeypatch.setattr(capture, "image", recording)
    scene.expect([(2, 1)])
    scene.expect([(2, 1), (5, 1)])
    expected = scene.target(2)
    assert read.count(2) == 1, "it is not read twice"
    assert torch.equal(scene.target(2)[0], expected[0]) and read.count(2) == 1
    with pytest.raises(InputError, match="no photo 5"):
        scene.target(5)
    scene.expect([])
    assert scene.target(3)[0].shape == expected[0].shape and read.count(3) == 1
    del read[:]
    trainer.progress.queue = [1, 4, 6, 7]
    for _ in range(3):
        trainer.step(0.8)
    scene.target(1)
    assert sorted(read) == [1, 4, 6, 7], "each is read once, before it is asked for"
