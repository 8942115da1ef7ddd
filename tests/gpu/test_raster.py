"""The GPU renderer on a real GPU: the tests of all renderers, larger scenes against the CPU renderer, and tests that
require a GPU."""

import gc

import numpy as np
import pytest
import torch

from backend import raster
from backend.raster import Camera
from backend.raster.gpu import renderer
from tests.backend import test_raster, test_raster_stiff
from tests.backend.test_raster import *  # noqa: F403
from tests.backend.test_raster import NAMES, as_float32, random_scene
from tests.backend.test_raster_stiff import *  # noqa: F403

# These test only the reference, and CPU threads.
del test_reference_passes_gradcheck, test_thread_count_does_not_change_bits  # noqa: F821

GPU = torch.device("cuda")
KINDS = pytest.mark.parametrize("primitive", ["3d", "2d"])


@pytest.fixture(autouse=True)
def on_the_gpu(monkeypatch):
    monkeypatch.setattr(test_raster, "DEVICE", GPU)


def large_camera(width=640, height=480):
    return Camera(np.eye(4), np.array([[500.0, 0, width / 2], [0, 500.0, height / 2], [0, 0, 1]]), width, height)


def step(scene, cam, primitive, device):
    """Return all planes and the gradients of a random loss as NumPy arrays, and the frame."""
    flat = primitive == "2d"
    rng = np.random.default_rng(0)
    labels = torch.tensor(rng.integers(0, 5, (cam.height, cam.width)), dtype=torch.int32).to(device)
    leaves = {k: v.detach().to(device).requires_grad_(k != "ids") for k, v in scene.items()}
    rendered = raster.rasterize(
        **leaves, camera=cam, labels=labels, want_depth=True, want_median=True, want_surface=True, want_normals=flat,
        want_distortion=flat, primitive=primitive,
    )  # fmt: skip
    planes = {name: p for name, p in zip(rendered._fields[:-1], rendered[:-1], strict=True) if p is not None}
    loss = 0
    for name, plane in planes.items():
        if name not in ("median", "surface"):
            loss = loss + (plane * torch.tensor(rng.normal(size=plane.shape), dtype=torch.float32).to(device)).sum()
    loss.backward()
    ids, probability = (torch.as_tensor(a) for a in raster.object_map(rendered))
    arrays = {name: p.detach() for name, p in planes.items()}
    arrays |= {"ids": ids, "probability": probability} | {name: leaves[name].grad for name in NAMES}
    arrays["screen"] = torch.as_tensor(rendered.frame.screen_gradient)
    return {name: a.cpu().numpy() for name, a in arrays.items()}, rendered.frame


@KINDS
@pytest.mark.parametrize(("count", "size"), [(5_000, 0.03), (60_000, 0.01)])
def test_large_scenes_match_cpu_renderer(count, size, primitive):
    scene = as_float32(random_scene(1, count=count, size=size))
    cam = large_camera()
    here, _ = step(scene, cam, primitive, GPU)
    there, _ = step(scene, cam, primitive, torch.device("cpu"))
    for name, expected in there.items():
        got = here[name]
        assert np.isfinite(got).all(), name
        if name in ("ids", "median", "surface"):
            # Where two objects or splats are almost equal, rounding decides.
            assert (np.abs(got - expected) > 1e-4).mean() < 1e-3, name
        elif name in (*NAMES, "screen"):
            difference = np.linalg.norm(got - expected) / np.linalg.norm(expected)
            assert difference < 1e-3, (name, difference)
            norms = [np.linalg.norm(a.reshape(len(a), -1), axis=1) for a in (got, expected)]
            counted = norms[1] > 1e-2 * norms[1].max()
            ratio = norms[0][counted] / norms[1][counted]
            assert counted.any() and (np.abs(ratio - 1) < 1e-2).mean() > 0.999, name
        else:
            # A pixel whose transmittance is almost exactly at the threshold may blend one splat more.
            close = np.isclose(got, expected, rtol=1e-3, atol=1e-3 * np.abs(expected).max())
            assert close.mean() > 0.9999, (name, close.mean())


@KINDS
def test_results_are_bitwise_reproducible(primitive):
    scene = as_float32(random_scene(2, count=50_000, size=0.01))
    first, _ = step(scene, large_camera(), primitive, GPU)
    for _ in range(5):
        again, _ = step(scene, large_camera(), primitive, GPU)
        for name in first:
            assert np.array_equal(first[name].view(np.uint8), again[name].view(np.uint8)), name


@KINDS
def test_memory_is_released(primitive):
    scene = as_float32(random_scene(3, count=20_000, size=0.02))
    sizes = []
    for _ in range(4):
        step(scene, large_camera(), primitive, GPU)
        gc.collect()
        torch.cuda.synchronize()
        sizes.append(torch.cuda.memory_allocated())
    assert sizes[1] == sizes[2] == sizes[3]


@KINDS
def test_torch_operations_do_not_synchronize(primitive):
    """No torch operation of a step waits for the GPU, except for the object map, which is copied to the host."""
    scene = {k: v.to(GPU).requires_grad_(k != "ids") for k, v in as_float32(random_scene(3, count=2_000)).items()}
    cam = large_camera()
    labels = torch.zeros((cam.height, cam.width), dtype=torch.int32, device=GPU)
    before = torch.cuda.get_sync_debug_mode()
    try:
        for mode in ("default", "error"):
            torch.cuda.set_sync_debug_mode(mode)
            rendered = raster.rasterize(**scene, camera=cam, labels=labels, want_depth=True, primitive=primitive)
            (
                rendered.color.sum() + rendered.alpha.sum() + rendered.label_probability.sum() + rendered.depth.sum()
            ).backward()
    finally:
        torch.cuda.set_sync_debug_mode(before)


def test_kernels_use_current_stream():
    """Kernels run in torch's current stream, also if it is not the default one."""
    scene = {k: v.to(GPU) for k, v in as_float32(random_scene(3, count=5_000)).items()}
    expected = raster.rasterize(**scene, camera=large_camera()).color
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        got = raster.rasterize(**scene, camera=large_camera()).color
    stream.synchronize()
    assert torch.equal(got, expected)


def test_image_is_independent_of_object_count():
    """The blending kernels do not depend on the number of objects, so the image is the same for any IDs."""
    scene = as_float32(random_scene(4, count=20_000, size=0.02, objects=1_000))
    many, _ = step(scene, large_camera(), "3d", GPU)
    scene["ids"][:] = 0
    one, _ = step(scene, large_camera(), "3d", GPU)
    assert np.array_equal(many["color"], one["color"]) and np.array_equal(many["depth"], one["depth"])
    assert set(np.unique(one["ids"])) <= {-1, 0} and len(np.unique(many["ids"])) > 100


def test_frames_are_on_gpu():
    _, frame = step(as_float32(random_scene(3, count=100)), large_camera(64, 48), "3d", GPU)
    assert isinstance(frame, renderer.Frame)
    assert frame.seen.device.type == frame.screen_gradient.device.type == "cuda"


assert test_raster_stiff.rasterize is test_raster.rasterize
