"""Tests of the GPU renderer alone, on an emulated GPU; test_gpu_kernels.py runs them."""

import gc
import itertools
import shutil
import weakref

import numpy as np
import pytest
import torch

from backend.gpu import kernel as kernels
from backend.gpu.emulator import emulated
from backend.model.anchors import Layout, new_rows
from backend.model.generate import generate
from backend.model.heads import Heads
from backend.raster.cpu import renderer as cpu
from backend.raster.gpu import binning
from backend.raster.gpu.kernels import STAGED
from tests.backend.test_raster import NAMES, as_float32, camera, random_scene, rasterize
from tests.backend.test_raster_stiff import assert_same_bits, draw

PLANES = ("want_depth", "want_median", "want_surface", "want_normals", "want_distortion")

TURN_AROUND = """#include "platform.h"
KERNEL(64, 1) turn_around(float *values, int with_barrier) {
    SHARED(float, shared, [64]);
    shared[THREAD] = values[THREAD];
    if (with_barrier) sync_block();
    values[THREAD] = shared[63 - THREAD];
}
"""
PART_OF_BLOCK = """#include "platform.h"
KERNEL(64, 1) part_of_block(int with_exit) {
    if (THREAD < 5) {
        if (with_exit) return;
        sync_warp();
    }
    sync_block();
}
"""
ADD_ONE = """#include "platform.h"
KERNEL(128, 1) add_one(float *values, int count) {
    int i = BLOCK * THREADS_OF_BLOCK + THREAD;
    bool last = any_in_warp(THREAD == THREADS_OF_BLOCK - 1);
    if (i < count) values[i] += last ? 1.0f : 1000.0f;
}
"""


@pytest.fixture
def kernel_of(tmp_path, monkeypatch):
    """A function that returns the kernel `name` of a source text."""
    shutil.copytree(kernels.SOURCE, tmp_path / "source")
    monkeypatch.setattr(kernels, "SOURCE", tmp_path / "source")

    def make(name, text):
        (tmp_path / "source" / f"{name}.cu").write_text(text)
        return kernels.Kernel(name, {})

    return make


def test_a_gpu_is_emulated():
    assert emulated()


def test_missing_barrier_gives_wrong_result(kernel_of):
    turn_around = kernel_of("turn_around", TURN_AROUND)
    right, wrong = (torch.arange(64.0) for _ in range(2))
    turn_around(1, 64, right, 1)
    assert torch.equal(right, torch.arange(64.0).flip(0))
    turn_around(1, 64, wrong, 0)
    assert not torch.equal(wrong, right)


def test_barrier_that_only_some_threads_reach_is_an_error(kernel_of):
    part_of_block = kernel_of("part_of_block", PART_OF_BLOCK)
    with pytest.raises(RuntimeError, match="not all threads of a block of part_of_block"):
        part_of_block(3, 64, 0)
    part_of_block(3, 64, 1)  # Threads that have ended do not count.


@pytest.mark.parametrize("count", [0, 1, 31, 32, 129])
def test_one_thread_runs_for_each_element(kernel_of, count):
    values = torch.zeros(max(count, 1))
    kernel_of("add_one", ADD_ONE).for_each(count, values, count)
    # The warp of a block's last thread knows it.
    threads = min(128, -(-count // 32) * 32)
    expected = [1.0 if i % 128 // 32 == threads // 32 - 1 else 1000.0 for i in range(count)]
    assert values[:count].tolist() == expected


@pytest.mark.parametrize("primitive", ["3d", "2d"])
def test_insufficient_intersection_capacity_is_increased(primitive, monkeypatch):
    """The intersections and the image are recomputed, with the same result."""
    made = []
    tile_intersections = binning.tile_intersections
    monkeypatch.setattr(
        "backend.raster.gpu.renderer.tile_intersections", lambda *a: made.append(a[-1]) or tile_intersections(*a)
    )
    scene = as_float32(random_scene(0, count=12))
    pictures = []
    for last in (10_000, 10):
        monkeypatch.setattr(binning, "_largest_totals", {torch.device("cpu"): {9: last}})
        pictures.append(draw(scene, camera(), primitive=primitive))
    assert_same_bits(*pictures)
    needed = binning._largest_totals[torch.device("cpu")][9]
    assert 12 < needed < 10_000 and made == [int(10_000 * 1.125), int(10 * 1.125), needed]


def test_too_many_intersections_do_not_fit(monkeypatch):
    """Nor do they make images that fit later fail."""
    scene = as_float32(random_scene(0, count=12))
    monkeypatch.setattr(binning, "_largest_totals", {})
    few = draw(scene, camera())
    monkeypatch.setattr("backend.raster.gpu.renderer._MOST_INTERSECTIONS", 11)
    monkeypatch.setattr(binning, "_largest_totals", {})
    for _ in range(2):
        with pytest.raises(torch.cuda.OutOfMemoryError):
            draw(scene, camera())
    monkeypatch.setattr("backend.raster.gpu.renderer._MOST_INTERSECTIONS", 10**6)
    assert_same_bits(few, draw(scene, camera()))


def test_room_for_intersections_is_that_of_the_largest_of_the_last_images(monkeypatch):
    monkeypatch.setattr(binning, "_largest_totals", {})

    def draw_one(count, tiles=100):
        total = binning.IntersectionCount(torch.tensor([count]), tiles)
        room = total.expected_capacity()
        assert total.wait() == count
        return room

    draw_one(1000)
    assert all(draw_one(count) > 1000 for count in (10, 500, 900, 20))
    for _ in range(500):
        draw_one(10)
    assert draw_one(10) == int(10 * 1.125)
    assert draw_one(8, tiles=50) == 1, "a part needs less room than the whole, which may not fit"
    assert draw_one(12, tiles=70) == int(8 * 1.125)
    for tiles in range(1000, 2000):
        draw_one(5, tiles)
    assert len(binning._largest_totals[torch.device("cpu")]) <= binning._MOST_SIZES


@pytest.mark.parametrize(
    ("primitive", "wanted"),
    [("3d", name) for name in ("", "labels", *PLANES[:3])] + [("2d", name) for name in ("", "labels", *PLANES)],
)
def test_single_plane_matches_all_planes(wanted, primitive):
    flat = primitive == "2d"
    cam = camera()
    labels = torch.tensor(np.random.default_rng(0).integers(-1, 5, (cam.height, cam.width)), dtype=torch.int32)
    gradients = []
    planes = []
    for everything in (False, True):
        scene = {k: v.requires_grad_(k != "ids") for k, v in as_float32(random_scene(2, count=25)).items()}
        wanted_planes = {name: (everything and (flat or name in PLANES[:3])) or name == wanted for name in PLANES}
        rendered = rasterize(
            **scene, camera=cam, labels=labels if everything or wanted == "labels" else None, primitive=primitive,
            **wanted_planes,
        )  # fmt: skip
        here = [rendered.color, rendered.alpha]
        for name, plane in zip(("labels", *PLANES), rendered[2:8], strict=True):
            assert (plane is not None) == ((everything and (flat or name in ("labels", *PLANES[:3]))) or name == wanted)
            if name == wanted:
                here.append(plane)
        planes.append([plane.detach().numpy() for plane in here])
        rng = np.random.default_rng(1)
        sum(
            (p * torch.tensor(rng.normal(size=p.shape), dtype=torch.float32)).sum() for p in here if p.requires_grad
        ).backward()
        gradients.append([scene[name].grad.numpy() for name in NAMES])
    for some, all_of_them in zip(*planes, strict=True):
        assert np.array_equal(some, all_of_them)
    for some, all_of_them in zip(*gradients, strict=True):
        np.testing.assert_allclose(some, all_of_them, rtol=1e-5, atol=1e-6 * np.abs(some).max())


@pytest.mark.parametrize("flat", [False, True])
def test_tile_intersections_match_cpu_renderer(flat):
    """In an image of one CPU tile, that tile has the same splats as the 8 small tiles of the GPU together."""
    cam = camera(64, 32)
    scene = as_float32(random_scene(4, count=50))
    cpu_frame = cpu.forward(cpu.Gaussians(*(scene[n].numpy() for n in (*NAMES, "ids"))), cam, flat=flat)
    frame = rasterize(**scene, camera=cam, primitive="2d" if flat else "3d").frame
    seen = cpu_frame.seen
    np.testing.assert_allclose(frame.splats.numpy()[seen], cpu_frame.splats[seen], rtol=1e-5, atol=1e-6)
    assert np.array_equal(frame.seen.numpy(), cpu_frame.seen)
    used = frame.intersections.isect_ids[: int(frame.intersections.isect_offsets[-1])].numpy()
    assert set(used) == set(cpu_frame.isect_ids.tolist())
    boxes = np.ceil(2 * cpu_frame.splats[cpu_frame.seen][:, 10:12] / 16 + 1).prod(1).sum()
    assert used.size < boxes
    # Each tile has the CPU's order from front to back.
    rank = np.argsort(np.argsort(cpu_frame.isect_ids))
    place = dict(zip(cpu_frame.isect_ids.tolist(), range(len(rank)), strict=True))
    starts = frame.intersections.isect_offsets.tolist()
    for first, last in itertools.pairwise(starts):
        places = [place[n] for n in used[first:last].tolist()]
        assert places == sorted(places)


@pytest.fixture
def filled_uninitialized_memory():
    """Make torch fill uninitialized memory with NaN or the largest integer."""
    torch.use_deterministic_algorithms(True)
    yield
    torch.use_deterministic_algorithms(False)


@pytest.mark.parametrize("primitive", ["3d", "2d"])
def test_splats_below_the_transmittance_threshold_have_no_gradient(primitive, filled_uninitialized_memory):
    scene = as_float32(random_scene(0, count=20))
    scene["means"] = torch.tensor([[0.0, 0.0, 1.0 + 0.1 * i] for i in range(20)])
    scene["scales"][:] = 50.0
    scene["quats"] = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(20, 1)
    scene["opacities"][:] = 0.98
    leaves = {k: v.requires_grad_(k != "ids") for k, v in scene.items()}
    rendered = rasterize(**leaves, camera=camera(), want_depth=True, primitive=primitive)
    assert rendered.frame.isect_counts.tolist() == [3] * rendered.frame.isect_counts.numel()
    (rendered.color.sum() + rendered.alpha.sum() + rendered.depth.sum()).backward()
    for name in NAMES:
        gradient = leaves[name].grad
        assert torch.isfinite(gradient).all() and not gradient[3:].any(), name
    assert leaves["opacities"].grad[:2].all()


def test_tile_with_more_splats_than_shared_memory():
    """The splats are faint, so that all of them are drawn."""
    scene = as_float32(random_scene(0, count=STAGED + 600, size=0.3))
    scene["opacities"] *= 0.02
    scene["opacities"] += 0.005
    cam = camera(13, 9)
    frame = rasterize(**scene, camera=cam).frame
    assert int(frame.isect_counts[0]) > STAGED
    other = cpu.forward(cpu.Gaussians(*(scene[n].numpy() for n in (*NAMES, "ids"))), cam)
    np.testing.assert_allclose(frame.color.numpy(), other.color, atol=1e-5)
    g_color, g_alpha = torch.ones(3, 9, 13), torch.ones(9, 13)
    from backend.raster.gpu import renderer

    mine, theirs = renderer.backward(frame, g_color, g_alpha), cpu.backward(other, g_color.numpy(), g_alpha.numpy())
    for name in NAMES:
        a, b = getattr(mine, name).numpy(), getattr(theirs, name)
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-4 * np.abs(b).max(), err_msg=name)
    np.testing.assert_allclose(
        frame.screen_gradient.numpy(), other.screen_gradient, rtol=1e-3, atol=1e-4 * np.abs(other.screen_gradient).max()
    )


@pytest.mark.parametrize("primitive", ["3d", "2d"])
def test_memory_of_a_frame_is_released_without_collection(primitive):
    """Nothing that a step keeps for its gradient holds itself."""
    flat = primitive == "2d"
    scene = {k: v.requires_grad_(k != "ids") for k, v in as_float32(random_scene(0, count=12)).items()}
    cam = camera()
    labels = torch.zeros(cam.height, cam.width, dtype=torch.int32)
    gc.disable()
    try:
        drawn = rasterize(
            **scene, camera=cam, labels=labels, want_depth=True, want_median=True, want_surface=True, want_normals=flat,
            want_distortion=flat, primitive=primitive,
        )  # fmt: skip
        (drawn.color.sum() + drawn.label_probability.sum() + drawn.depth.sum()).backward()
        frame = weakref.ref(drawn.frame)
        del drawn
        assert frame() is None
    finally:
        gc.enable()


def test_memory_of_generated_splats_is_released_without_collection():
    layout = Layout(4, 8)
    rows = torch.from_numpy(new_rows(20, layout, np.random.default_rng(0))).requires_grad_()
    heads = Heads(layout, "explicit", 1, torch.Generator().manual_seed(0))
    gc.disable()
    try:
        made = generate(layout, torch.zeros(20, 3), rows, torch.zeros(20, dtype=torch.int32), heads)
        (made.scales.sum() + made.opacities.sum()).backward()
        node = weakref.ref(made.scales.grad_fn)
        del made
        assert node() is None
    finally:
        gc.enable()
