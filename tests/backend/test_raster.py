"""The kernels against the float64 reference: CPU kernels here, GPU kernels in test_gpu_kernels.py and tests/gpu."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from backend import raster
from backend.gpu.emulator import emulated
from backend.raster import Camera, object_map, object_ranks
from backend.raster.reference import rasterize_reference

NAMES = ("means", "quats", "scales", "opacities", "sh")
DEVICE = torch.device("cpu")
EMULATED = emulated()
WIDTH, HEIGHT, FOCAL = 45, 33, 40.0


def rasterize(**arguments):
    """Run `backend.raster.rasterize` on DEVICE with CPU tensors as input and output."""
    moved = {k: v.to(DEVICE) if isinstance(v, torch.Tensor) else v for k, v in arguments.items()}
    *planes, frame = raster.rasterize(**moved)
    return raster.Rendered(*(p if p is None else p.cpu() for p in planes), frame)


def camera(width=WIDTH, height=HEIGHT, z=0.0):
    viewmat = np.eye(4)
    viewmat[2, 3] = z
    K = np.array([[FOCAL, 0, width / 2 + 1.3], [0, 1.05 * FOCAL, height / 2 - 0.7], [0, 0, 1]])
    return Camera(viewmat, K, width, height)


def random_scene(seed, count=60, coefficients=4, objects=5, size=0.12):
    rng = np.random.default_rng(seed)
    z = rng.uniform(1.0, 4.0, count)
    means = np.stack([rng.uniform(-0.6, 0.6, count) * z, rng.uniform(-0.5, 0.5, count) * z, z], 1)
    return {
        "means": torch.tensor(means),
        "quats": torch.tensor(rng.normal(size=(count, 4))),
        "scales": torch.tensor(np.exp(rng.normal(np.log(size), 0.6, (count, 3)))),
        "opacities": torch.tensor(rng.uniform(0.05, 0.97, count)),
        "sh": torch.tensor(rng.normal(0, 0.4, (count, coefficients, 3))),
        "ids": torch.tensor(rng.integers(0, objects, count), dtype=torch.int32),
    }


def as_float32(scene):
    """Convert to float32, so that both renderers get the same rounded input."""
    return {k: v if k == "ids" else v.float() for k, v in scene.items()}


def mapped(rendered):
    """Return the object map as NumPy arrays, for any renderer."""
    return tuple(torch.as_tensor(a).cpu().numpy() for a in object_map(rendered))


def ranked(rendered, ranks):
    """Return the object ranks as NumPy arrays, for any renderer."""
    return tuple(torch.as_tensor(a).cpu().numpy() for a in object_ranks(rendered, ranks))


def compare_ranks(ids, probabilities, dense, **tolerance):
    """Compare the result of `object_ranks` with all probabilities `dense` (H, W, n) of the IDs 0 .. n - 1."""
    ranks, objects = len(ids), dense.shape[-1]
    largest = np.zeros((ranks, *dense.shape[:2]))
    largest[:objects] = -np.sort(-np.moveaxis(dense, -1, 0), axis=0)[:ranks]
    np.testing.assert_allclose(probabilities, largest, **tolerance)
    assert ((ids >= 0) == (probabilities > 0)).all()
    picked = np.take_along_axis(np.moveaxis(dense, -1, 0), np.maximum(ids, 0).astype(np.int64), 0)
    np.testing.assert_allclose(np.where(ids >= 0, picked, 0), probabilities, **tolerance)
    for a in range(ranks):
        for b in range(a):
            assert ((ids[a] != ids[b]) | (ids[a] < 0)).all()


def compare(scene, cam, objects=5, seed=0, value_tolerance=2e-5, gradient_tolerance=1e-5, primitive="3d"):
    """Compare image and gradients of a random loss between both renderers; "2d" includes normals and distortion."""
    scene = as_float32(scene)
    flat = primitive == "2d"
    rng = np.random.default_rng(seed)
    shape = (cam.height, cam.width)
    labels = torch.tensor(rng.integers(-1, objects, shape), dtype=torch.int32)
    fast = {k: v.clone().requires_grad_(k != "ids") for k, v in scene.items()}
    slow = {k: v.clone() if k == "ids" else v.double().requires_grad_() for k, v in scene.items()}
    got = rasterize(
        **fast, camera=cam, labels=labels, want_depth=True, want_median=True, want_surface=True, want_normals=flat,
        want_distortion=flat, primitive=primitive,
    )  # fmt: skip
    want = rasterize_reference(**slow, camera=cam, objects=objects, primitive=primitive)
    index = labels.long().clamp(min=0)[..., None]
    want_label_probability = torch.where(
        labels >= 0, want.probabilities.gather(-1, index)[..., 0], torch.zeros(()).double()
    )
    pairs = [
        (got.color, want.color),
        (got.alpha, want.alpha),
        (got.label_probability, want_label_probability),
        (got.depth, want.depth),
    ]
    if flat:
        pairs += [(got.normals, want.normals), (got.distortion, want.distortion)]
    g = [torch.tensor(rng.normal(size=tuple(a.shape))) for a, _ in pairs]
    for a, b in pairs:
        assert torch.isfinite(a).all()
        np.testing.assert_allclose(a.detach().numpy(), b.detach().numpy(), rtol=1e-4, atol=value_tolerance)
    # Where the transmittance is almost exactly one half, rounding decides which of two splats is the median.
    for plane, wanted in ((got.median, want.median.numpy()), (got.surface, want.surface.numpy())):
        assert (np.abs(plane.numpy() - wanted) > 1e-4 * wanted + value_tolerance).mean() < 2e-3
        assert not plane.requires_grad
    loss = sum((a * v.float()).sum() for (a, _), v in zip(pairs, g, strict=True))
    loss64 = sum((b * v).sum() for (_, b), v in zip(pairs, g, strict=True))
    if want.color.requires_grad:
        loss.backward()
        loss64.backward()
        for name in NAMES:
            a, b = fast[name].grad.double(), slow[name].grad
            b = torch.zeros_like(a) if b is None else b
            assert torch.isfinite(a).all(), name
            largest = b.abs().max().item()
            relative = 10 * gradient_tolerance
            np.testing.assert_allclose(
                a.numpy(), b.numpy(), rtol=relative, atol=gradient_tolerance * largest, err_msg=name
            )
            # Per splat, so that a lost gradient is not hidden by the tolerance of the largest one.
            norms = [v.reshape(len(v), -1).norm(dim=1) for v in (a, b)]
            counted = norms[1] > 1e-3 * largest
            ratio = (norms[0] / norms[1])[counted].numpy()
            np.testing.assert_allclose(ratio, 1, rtol=100 * gradient_tolerance, err_msg=name)
    ids, probability = mapped(got)
    dense = want.probabilities.detach().numpy()
    np.testing.assert_allclose(probability, dense.max(-1), rtol=1e-4, atol=value_tolerance)
    picked = np.take_along_axis(dense, np.maximum(ids, 0)[..., None], -1)[..., 0]
    np.testing.assert_allclose(picked, dense.max(-1), rtol=1e-4, atol=value_tolerance)
    for ranks in (3, objects + 1):
        compare_ranks(*ranked(got, ranks), dense, rtol=1e-4, atol=value_tolerance)
    return got, want


PRIMITIVES = pytest.mark.parametrize("primitive", ["3d", "2d"])


# In scene 3, a pixel has a splat of exactly the least alpha that is drawn, so that rounding decides.
@pytest.mark.parametrize("seed", [0, 1, 2, 4])
@pytest.mark.parametrize(
    ("primitive", "coefficients"), [("3d", 1), ("3d", 4), ("3d", 9), ("3d", 16), ("2d", 1), ("2d", 4)]
)
def test_random_scenes_match_reference(seed, coefficients, primitive):
    compare(random_scene(seed, coefficients=coefficients), camera(), seed=seed, primitive=primitive)


def test_filter_of_other_programs_matches_reference():
    scene, wider = random_scene(0, size=0.01), replace(camera(), blur=0.3)
    got, _ = compare(scene, wider)
    assert not torch.allclose(got.alpha, rasterize(**as_float32(scene), camera=camera()).alpha, atol=0.1)


def broad_layers(depths):
    """Return a splat at each depth, broader than the image; the caller sets their opacities."""
    layers = random_scene(0, count=len(depths), size=30.0)
    layers["means"] = torch.tensor([[0, 0, z] for z in depths], dtype=torch.float64)
    layers["quats"] = torch.tensor([[1.0, 0, 0, 0]] * len(depths))
    layers["scales"][:] = 1e3
    return layers


def test_median_depth_is_at_half_transmittance():
    cam = camera()
    layers = broad_layers((2.0, 3.0, 4.0, 5.0))
    for opacities, depth in (
        ((0.3, 0.2, 0.2, 0.2), 4.0), ((0.3, 0.5, 0.9, 0.9), 3.0), ((0.6, 0.9, 0.9, 0.9), 2.0), ((0.1,) * 4, 0.0)
    ):  # fmt: skip
        layers["opacities"] = torch.tensor(opacities)
        median = rasterize(**as_float32(layers), camera=cam, want_median=True).median
        np.testing.assert_allclose(median, depth)


def test_surface_depth_is_the_mean_up_to_the_median():
    cam = camera()
    layers = broad_layers((2.0, 3.0, 4.0, 50.0))
    for opacities, depth in (
        ((0.4, 0.5, 0.9, 0.9), (0.4 * 2 + 0.3 * 3) / 0.7), ((0.6, 0.9, 0.9, 0.9), 2.0),
        ((0.1, 0.1, 0.1, 0.1), (0.1 * 2 + 0.09 * 3 + 0.081 * 4 + 0.0729 * 50) / 0.3439),
    ):  # fmt: skip
        layers["opacities"] = torch.tensor(opacities)
        surface = rasterize(**as_float32(layers), camera=cam, want_surface=True).surface
        np.testing.assert_allclose(surface, depth, rtol=1e-3)
    nothing = {name: value[:0] for name, value in as_float32(layers).items()}
    assert not rasterize(**nothing, camera=cam, want_surface=True).surface.any()


@PRIMITIVES
def test_crop_matches_full_image(primitive):
    """Splats far outside a narrow crop are projected as in the whole image."""
    scene, whole = as_float32(random_scene(3, size=0.4)), camera()
    want = rasterize(**scene, camera=whole, primitive=primitive).color
    x, y, width, height = whole.width // 2, 3, 4, whole.height - 5
    part = whole.crop(x + 1, y, width, height)
    compare(random_scene(3), part, primitive=primitive)
    for cut in (part, whole.crop(x, 1, width + 5, height + 3).crop(1, y - 1, width, height)):
        got = rasterize(**scene, camera=cut, primitive=primitive).color
        np.testing.assert_allclose(got, want[:, y : y + height, x + 1 : x + 1 + width], rtol=1e-4, atol=2e-5)


def test_reduced_camera_sees_the_same_directions():
    whole = camera(64, 48)
    small, part = whole.reduced(3), whole.crop(6, 9, 31, 30)
    assert (small.width, small.height) == (21, 16)
    point = np.array([0.3, -0.2, 2.0])
    (column, row, depth), (x, y, _) = whole.K @ point, small.K @ point
    assert (column / depth, row / depth) == pytest.approx((3 * x / depth, 3 * y / depth))
    one, other = part.reduced(3), small.crop(2, 3, 10, 10)
    assert np.allclose(one.K, other.K) and (one.width, one.height) == (10, 10)
    assert one.bounds == pytest.approx((-2, -3, 64 / 3 - 2, 13))
