"""Stiff and extreme scenes: images and gradients are finite and equal to the float64 reference."""

import dataclasses

import numba
import numpy as np
import pytest
import torch

from backend.raster import Camera
from backend.raster.cpu import renderer as cpu
from backend.raster.reference import rasterize_reference
from backend.raster.settings import ALPHA_MAX, ALPHA_MIN, NEAR
from tests.backend.test_raster import (
    EMULATED,
    FOCAL,
    HEIGHT,
    NAMES,
    WIDTH,
    as_float32,
    camera,
    compare,
    mapped,
    random_scene,
    ranked,
    rasterize,
)


def straight(width=WIDTH, height=HEIGHT, focal=FOCAL, **kwargs):
    """Return a camera along +z that projects (0, 0, z) to the center of the middle pixel."""
    K = np.array([[focal, 0, width // 2 + 0.5], [0, focal, height // 2 + 0.5], [0, 0, 1]])
    return Camera(np.eye(4), K, width, height, **kwargs)


def one(
    mean=(0.0, 0.0, 2.0), quat=(1.0, 0.0, 0.0, 0.0), scale=(0.1, 0.1, 0.1), opacity=0.7, color=(0.9, 0.2, 0.4), id=0
):
    dc = (np.array(color) - 0.5) / 0.28209479177387814
    sh = np.zeros((1, 4, 3))
    sh[0, 0] = dc
    sh[0, 1:] = 0.05
    return {
        "means": torch.tensor([mean], dtype=torch.float64),
        "quats": torch.tensor([quat], dtype=torch.float64),
        "scales": torch.tensor([scale], dtype=torch.float64),
        "opacities": torch.tensor([opacity], dtype=torch.float64),
        "sh": torch.tensor(sh),
        "ids": torch.tensor([id], dtype=torch.int32),
    }


def join(*scenes):
    return {k: torch.cat([s[k] for s in scenes]) for k in scenes[0]}


OTHERS = 25


def among_others(scene, seed=0):
    """Add ordinary splats, whose gradients must not suffer from the stiff ones."""
    return join(scene, random_scene(seed, count=OTHERS))


@pytest.fixture(params=["3d", "2d"])
def primitive(request):
    return request.param


def draw(scene, cam, labels=None, seed=0, primitive="3d"):
    """Return the image and the gradients of a random loss as NumPy arrays."""
    leaves = {k: v.clone() if k == "ids" else v.clone().requires_grad_() for k, v in scene.items()}
    flat = primitive == "2d"
    rendered = rasterize(
        **leaves, camera=cam, labels=labels, want_depth=True, want_normals=flat, want_distortion=flat,
        primitive=primitive,
    )  # fmt: skip
    planes = [p for p in rendered[:8] if p is not None]
    rng = np.random.default_rng(seed)
    sum((p * torch.tensor(rng.normal(size=tuple(p.shape)), dtype=p.dtype)).sum() for p in planes).backward()
    arrays = {f"plane {i}": p.detach().numpy() for i, p in enumerate(planes)}
    arrays |= {name: leaves[name].grad.numpy() for name in NAMES}
    arrays["object"], arrays["probability"] = mapped(rendered)
    return arrays


def assert_same_bits(a, b):
    for name in a:
        assert np.array_equal(a[name].view(np.uint8), b[name].view(np.uint8)), name


def assert_dropped_without_effect(bad, seed=1, primitive="3d"):
    """Check that a dropped splat has no gradient and changes no bit of the others' image and gradients."""
    others = as_float32(random_scene(seed, count=OTHERS))
    bad = as_float32(bad)
    alone, together = (
        draw(others, camera(), primitive=primitive),
        draw(join(bad, others), camera(), primitive=primitive),
    )
    count = bad["means"].shape[0]
    for name in NAMES:
        assert not together[name][:count].any(), name
        together[name] = together[name][count:]
    assert_same_bits(alone, together)


# Shapes


def test_zero_quaternion_is_dropped(primitive):
    assert_dropped_without_effect(one(quat=(0, 0, 0, 0)), primitive=primitive)
    assert_dropped_without_effect(one(quat=(1e-5, 0, 0, 0)), primitive=primitive)
    compare(among_others(one(quat=(0, 0, 0, 0))), camera(), primitive=primitive)


BEHIND_OPAQUE = 5e-4
"""Tolerance of gradients behind nearly opaque splats: small differences of two float32 sums, divided by 1 - alpha."""

ACROSS_NEEDLES = 3e-5
"""Tolerance of gradients of needles: distances from the axis in float32, divided by the low-pass filter's variance."""


@pytest.mark.parametrize("length", [1e-3, 1e3, 1e9])
def test_quaternion_of_any_length(length, primitive):
    q = np.array([0.3, -0.5, 0.7, 0.2]) * length
    compare(one(quat=tuple(q), scale=(0.2, 0.05, 0.1)), camera(), primitive=primitive)


@pytest.mark.parametrize("axis", range(3))
def test_one_zero_scale(axis, primitive):
    scale = [0.2, 0.2, 0.2]
    scale[axis] = 0.0
    compare(among_others(one(quat=(0.9, 0.3, -0.2, 0.1), scale=scale)), camera(), primitive=primitive)


def test_edge_on_disc(primitive):
    compare(among_others(one(scale=(0.0, 0.3, 0.3))), straight(), primitive=primitive)


def test_zero_scales_give_blurred_point(primitive):
    got, _ = compare(among_others(one(scale=(0, 0, 0))), straight(), primitive=primitive)
    assert got.alpha[HEIGHT // 2, WIDTH // 2] > 0.5


def test_scales_whose_determinant_underflows_float32(primitive):
    compare(among_others(one(scale=(1e-22, 1e-22, 1e-22))), camera(), primitive=primitive)
    compare(among_others(one(scale=(1e-30, 0.3, 1e-30), quat=(0.9, 0.3, 0.2, 0.4))), camera(), primitive=primitive)


@pytest.mark.parametrize("ratio", [1e3, 1e4, 1e5, 1e6])
@pytest.mark.parametrize("angle", [0.0, 90.0, 45.0, 30.0, 89.999])
@pytest.mark.parametrize("thin", [1e-6, 1e-3])
def test_needle(ratio, angle, thin, primitive):
    if primitive == "2d" and thin > 1e-6:
        thin *= 10  # wide enough for its plane to be drawn
    half = np.deg2rad(angle) / 2
    needle = one(quat=(np.cos(half), 0, 0, np.sin(half)), scale=(thin * ratio, thin, thin), mean=(0.013, -0.021, 2.0))
    compare(needle, camera(), gradient_tolerance=ACROSS_NEEDLES, primitive=primitive)
    compare(among_others(needle), camera(), gradient_tolerance=ACROSS_NEEDLES, primitive=primitive)


@pytest.mark.parametrize("seed", range(5))
def test_needles_in_random_directions(seed, primitive):
    rng = np.random.default_rng(seed)
    scene = random_scene(seed, count=20)
    scene["scales"] = torch.tensor(10.0 ** rng.uniform(-6, 1, (20, 3)))
    compare(scene, camera(), seed=seed, primitive=primitive)


def test_huge_splat_outside_image(primitive):
    for mean in ((300.0, 0, 2.0), (-250.0, 180.0, 2.0), (0, 1e4, 2.0)):
        scale = np.linalg.norm(mean) / 2
        compare(among_others(one(mean=mean, scale=(scale, scale / 3, scale))), straight(), primitive=primitive)


def test_long_needle_centered_outside_image(primitive):
    half = np.pi / 8
    quat = (np.cos(half), 0, 0, np.sin(half))
    for distance in (10.0, 1e3, 1e5):
        compare(
            one(mean=(distance, distance, 2.0), scale=(distance, 1e-3, 1e-3), quat=quat),
            straight(),
            gradient_tolerance=1e-2,  # In float32, the axis is exact to 1e-4 pixels here.
            primitive=primitive,
        )


def test_splat_outside_image_has_no_gradient(primitive):
    assert_dropped_without_effect(one(mean=(50.0, 0, 2.0)), primitive=primitive)


@pytest.mark.parametrize("scale", [np.inf, 3e38, 1e20, 1e9])
def test_overflowing_scale(scale, primitive):
    """The exponential of a diverged log scale."""
    for scales in ((scale, 0.1, 0.1), (0.1, scale, 0.1), (scale, scale, scale)):
        compare(among_others(one(scale=scales, quat=(0.9, 0.3, -0.2, 0.1))), camera(), primitive=primitive)


# Opacity


def test_opaque_splat_on_a_pixel_center_is_drawn(primitive):
    for opacity in (0.999, 1.0, 1.7):
        got, _ = compare(one(opacity=opacity, scale=(1e-4,) * 3), straight(), primitive=primitive)
        assert got.alpha[HEIGHT // 2, WIDTH // 2].item() == pytest.approx(0.99)


@pytest.mark.parametrize("scale", [1e-4, 0.1, 1.0])
@pytest.mark.parametrize("opacity", [0.98, ALPHA_MAX - 1e-4, ALPHA_MAX + 1e-4, 1.0])
def test_sixteen_opaque_splats_stacked(scale, opacity, primitive):
    layers = [one(mean=(0, 0, 1 + 0.1 * i), opacity=opacity, scale=(scale,) * 3, id=i % 5) for i in range(16)]
    compare(join(*layers), straight(), gradient_tolerance=BEHIND_OPAQUE, primitive=primitive)


def test_many_layers_stop_like_reference(primitive):
    rng = np.random.default_rng(0)
    scene = random_scene(0, count=400)
    scene["opacities"] = torch.tensor(rng.uniform(0.3, 1.0, 400))
    compare(scene, camera(), gradient_tolerance=BEHIND_OPAQUE, primitive=primitive)


@pytest.mark.parametrize("opacity", [0.0, -1.0, ALPHA_MIN * 0.999])
def test_invisible_splats_give_empty_image(opacity, primitive):
    scene = random_scene(0)
    scene["opacities"] = torch.full_like(scene["opacities"], opacity)
    got, _ = compare(scene, camera(), primitive=primitive)
    assert not got.color.any() and not got.alpha.any() and not got.label_probability.any() and not got.depth.any()
    ids, probability = mapped(got)
    assert (ids == -1).all() and not probability.any()


def test_empty_scene(primitive):
    scene = {k: v[:0] for k, v in random_scene(0).items()}
    got, _ = compare(scene, camera(), primitive=primitive)
    assert not got.alpha.any()
    assert (mapped(got)[0] == -1).all()


# Depth


@pytest.mark.parametrize("near", [NEAR, 0.2])
def test_depths_around_near_plane(near, primitive):
    edge = np.float32(near)
    depths = (0.0, np.nextafter(edge, np.float32(0)), edge, np.nextafter(edge, np.float32(1)), -2.0, -near)
    for z in depths:
        scene = among_others(one(mean=(0, 0, float(z)), scale=(0.001,) * 3))
        got, _ = compare(scene, straight(near=near), primitive=primitive)
        assert got.frame.seen[0] == (float(z) > near)


def test_splat_at_the_camera_center_is_dropped(primitive):
    viewmat = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    cam = camera()
    pose = np.eye(4)
    pose[:3, :3] = viewmat * np.sign(np.linalg.det(viewmat))
    pose[:3, 3] = pose[:3, :3] @ [-0.5, 0.25, 2.0]
    cam = dataclasses.replace(cam, viewmat=pose)
    scene = among_others(one(mean=(0.5, -0.25, -2.0)))
    got, _ = compare(scene, cam, primitive=primitive)
    assert not got.frame.seen[0]


def test_coincident_points(primitive):
    scene = random_scene(0, count=40)
    scene["means"] = scene["means"][:1].expand(40, 3).contiguous()
    scene["opacities"] *= 0.3
    scene["quats"] = scene["quats"][:1].expand(40, 4).contiguous()
    scene["scales"] = scene["scales"][:1].expand(40, 3).contiguous()
    scene["opacities"] = scene["opacities"][:1].expand(40).contiguous()
    scene["sh"] = scene["sh"][:1].expand(40, 4, 3).contiguous()
    scene["ids"] = torch.zeros(40, dtype=torch.int32)
    compare(scene, camera(), primitive=primitive)


@pytest.mark.parametrize("same", ["depth", "everything but the id"])
def test_equal_depths_are_independent_of_input_order(same, primitive):
    count = 80
    scene = as_float32(random_scene(3, count=count))
    if same == "depth":
        scene["means"][:, 2] = 2.0
    else:
        scene = {k: v if k == "ids" else v[:1].expand_as(v).clone() for k, v in scene.items()}
    labels = torch.tensor(np.random.default_rng(0).integers(0, 5, (HEIGHT, WIDTH)), dtype=torch.int32)
    cam = camera()
    first = draw(scene, cam, labels, primitive=primitive)
    for seed in range(3):
        mixed = torch.tensor(np.random.default_rng(seed).permutation(count))
        again = draw({k: v[mixed] for k, v in scene.items()}, cam, labels, primitive=primitive)
        if same == "depth":
            for name in NAMES:
                first_mixed = first[name][mixed.numpy()]
                assert np.array_equal(again[name], first_mixed), name
        assert_same_bits({k: v for k, v in first.items() if k not in NAMES}, again)


# Not a number


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_nonfinite_splat_is_dropped(name, value, primitive):
    bad = one()
    bad[name].view(-1)[0] = value
    if name == "opacities" and value == -np.inf:
        bad = join(bad, bad)
    assert_dropped_without_effect(bad, primitive=primitive)
    compare(among_others(bad), camera(), primitive=primitive)


# Labels


def test_no_labeled_pixel(primitive):
    cam = camera()
    scene = {k: v.requires_grad_(k != "ids") for k, v in as_float32(random_scene(0)).items()}
    labels = torch.full((cam.height, cam.width), -1, dtype=torch.int32)
    rendered = rasterize(**scene, camera=cam, labels=labels, primitive=primitive)
    assert not rendered.label_probability.any()
    rendered.label_probability.sum().backward()
    assert not any(scene[name].grad.any() for name in NAMES)


def test_one_object_probability_equals_alpha(primitive):
    """With one object, the label probability equals alpha."""
    cam = camera()
    scene = as_float32(random_scene(0, objects=1))
    labels = torch.zeros(cam.height, cam.width, dtype=torch.int32)
    rendered = rasterize(**scene, camera=cam, labels=labels, primitive=primitive)
    np.testing.assert_allclose(rendered.label_probability, rendered.alpha, atol=1e-6)
    compare(random_scene(0, objects=1), cam, objects=1, primitive=primitive)


def test_probability_zero_under_the_logarithm(primitive):
    cam = camera()
    scene = random_scene(0, count=30)
    labels = torch.full((cam.height, cam.width), 4, dtype=torch.int32)
    labels[:, :20] = 77
    fast = {k: v.clone().requires_grad_(k != "ids") for k, v in as_float32(scene).items()}
    slow = {k: v if k == "ids" else v.double().requires_grad_() for k, v in as_float32(scene).items()}
    floor = 1e-6
    rendered = rasterize(**fast, camera=cam, labels=labels, primitive=primitive)
    assert not rendered.label_probability[:, :20].any()
    loss = -torch.log(rendered.label_probability.clamp(min=floor)).mean()
    loss.backward()
    want = rasterize_reference(**slow, camera=cam, objects=5, primitive=primitive).probabilities[..., 4].clone()
    want = torch.where(labels == 4, want, torch.zeros(()).double())
    reference = -torch.log(want.clamp(min=floor)).mean()
    reference.backward()
    assert loss.item() == pytest.approx(reference.item(), rel=1e-4)
    for name in ("means", "quats", "scales", "opacities"):
        a, b = fast[name].grad.double(), slow[name].grad
        assert torch.isfinite(a).all()
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-4 * b.abs().max().item(), err_msg=name)


def dense_probabilities(scene, cam, values, primitive="3d"):
    """Return the probabilities (H, W, n) of the n IDs in `values`, from the kernels' label probability of each ID."""
    planes = []
    for value in values:
        labels = torch.full((cam.height, cam.width), int(value), dtype=torch.int32)
        planes.append(rasterize(**scene, camera=cam, labels=labels, primitive=primitive).label_probability.numpy())
    return np.stack(planes, -1)


@pytest.mark.parametrize("seed", range(4))
def test_object_map_matches_dense_probabilities(seed, primitive):
    rng = np.random.default_rng(seed)
    count, objects, cam = 300, 40, camera(150, 71)
    scene = as_float32(random_scene(seed, count=count))
    values = np.unique(rng.integers(-(2**31), 2**31, objects)).astype(np.int32)
    scene["ids"] = torch.tensor(rng.choice(values, count))
    ids, probability = mapped(rasterize(**scene, camera=cam, primitive=primitive))
    dense = dense_probabilities(scene, cam, values, primitive)
    np.testing.assert_allclose(probability, dense.max(-1), rtol=1e-5, atol=1e-7)
    drawn = dense.max(-1) > 0
    assert not (ids[~drawn] + 1).any()
    picked = dense[(*np.nonzero(drawn), np.searchsorted(values, ids[drawn]))]
    np.testing.assert_allclose(picked, dense.max(-1)[drawn], rtol=1e-5, atol=1e-7)


def test_object_map_resolves_ties_to_smallest_id():
    """Two objects with equal probability, in both orders of input."""
    cam = straight(65, 33)
    left, right = (one(mean=(x, 0, 2.0), scale=(0.5, 0.5, 0.1), opacity=0.2) for x in (-0.1, 0.1))
    for a, b in ((70_000, 9), (9, 70_000)):
        left["ids"][0], right["ids"][0] = a, b
        right["means"] = left["means"].clone()
        # The splat behind gets the same weight as the one in front: (1 - 0.2) * 0.25 = 0.2.
        right["opacities"][0] = 0.25
        ids, probability = mapped(rasterize(**as_float32(join(left, right)), camera=cam))
        dense = dense_probabilities(as_float32(join(left, right)), cam, [9, 70_000])
        expected = np.where(dense.max(-1) > 0, np.array([9, 70_000])[dense.argmax(-1)], -1)
        assert np.array_equal(ids, expected)
        assert np.array_equal(probability, dense.max(-1))
        both = (dense > 0).all(-1)
        ids, probabilities = ranked(rasterize(**as_float32(join(left, right)), camera=cam), 2)
        equal = dense[..., 0] == dense[..., 1]
        assert (ids[0] == expected).all() and (ids[1] != expected)[both].all()
        assert (ids[:, both & equal] == [[9], [70_000]]).all() and (both & equal).any()
        assert np.array_equal(probabilities.sum(0)[both], dense.sum(-1)[both])


@pytest.mark.parametrize(
    ("objects", "count", "size", "faint", "cam"),
    [(10_000, 12_000, 0.02, 1.0, (97, 71)), (200, 240, 0.2, 0.1, (WIDTH, HEIGHT))],
)
def test_many_objects_and_large_ids(objects, count, size, faint, cam, primitive):
    """With 200 faint objects, there are more per pixel than the GPU sums up at once."""
    rng, cam = np.random.default_rng(0), camera(*cam)
    scene = as_float32(random_scene(0, count=count, size=size))
    scene["opacities"] *= faint
    names = rng.choice(2**31 - 1, objects, replace=False).astype(np.int32)
    assert (names > 65_535).mean() > 0.99
    which = np.concatenate([np.arange(objects), rng.integers(0, objects, count - objects)])
    scene["ids"] = torch.tensor(names[which])
    rendered = rasterize(**scene, camera=cam, primitive=primitive)
    ids, probability = mapped(rendered)
    labels = torch.tensor(ids)
    again = rasterize(**scene, camera=cam, labels=labels, primitive=primitive)
    np.testing.assert_allclose(again.label_probability, probability, rtol=1e-5, atol=1e-6)
    assert np.isin(ids[ids >= 0], names).all()
    # Renumbering the objects in the same order renumbers the map and changes nothing else.
    small = {**scene, "ids": torch.tensor(np.argsort(np.argsort(names)).astype(np.int32)[which])}
    ids_small, probability_small = mapped(rasterize(**small, camera=cam, primitive=primitive))
    assert np.array_equal(ids, np.where(ids_small >= 0, np.sort(names)[ids_small], -1))
    assert np.array_equal(probability, probability_small)


# Sizes and coordinates


SIZES = [(1, 1), (1, 40), (67, 1), (15, 15), (16, 16), (17, 33), (63, 31), (64, 32), (65, 33), (129, 65), (127, 3)]


@pytest.mark.parametrize("size", SIZES)
def test_unusual_image_sizes(size, primitive):
    compare(random_scene(0, count=40), camera(*size), gradient_tolerance=2e-5, primitive=primitive)


def test_scene_far_from_origin(primitive):
    """Georeferenced float64 means are made relative to the camera before conversion to float32."""
    offset = torch.tensor([4.6e6, -1.2e6, 3.1e6], dtype=torch.float64)
    scene = {k: v if k in ("ids", "means") else v.float() for k, v in random_scene(0).items()}
    cam = camera()
    viewmat = cam.viewmat.copy()
    viewmat[:3, 3] = -viewmat[:3, :3] @ offset.numpy()
    far = dataclasses.replace(cam, viewmat=viewmat)
    labels = torch.zeros(cam.height, cam.width, dtype=torch.int32)
    here = draw(scene, cam, labels, primitive=primitive)
    there = draw({**scene, "means": scene["means"] + offset}, far, labels, primitive=primitive)
    assert there["means"].dtype == np.float64
    for name in here:
        # At this offset, float64 itself is accurate to 1e-9.
        np.testing.assert_allclose(
            there[name], here[name], rtol=1e-4, atol=1e-4 * np.abs(here[name]).max(), err_msg=name
        )


@pytest.mark.parametrize("size", [1e-4, 1e-2, 1e4])
def test_scene_of_another_size(size, primitive):
    scene = random_scene(0)
    scene["means"] *= size
    scene["scales"] *= size
    compare(scene, dataclasses.replace(camera(), near=NEAR * size), primitive=primitive)


# Determinism


def dense_scene():
    return as_float32(random_scene(5, count=3000, size=0.05)), camera(200, 133)


def test_same_input_gives_identical_bits(primitive):
    scene, cam = dense_scene()
    labels = torch.zeros(cam.height, cam.width, dtype=torch.int32)
    assert_same_bits(draw(scene, cam, labels, primitive=primitive), draw(scene, cam, labels, primitive=primitive))


@pytest.mark.skipif(EMULATED or numba.config.NUMBA_NUM_THREADS < 2, reason="one thread only")
def test_thread_count_does_not_change_bits(primitive):
    scene, cam = dense_scene()
    labels = torch.zeros(cam.height, cam.width, dtype=torch.int32)
    before = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        single = draw(scene, cam, labels, primitive=primitive)
        numba.set_num_threads(2)
        double = draw(scene, cam, labels, primitive=primitive)
    finally:
        numba.set_num_threads(before)
    assert_same_bits(single, double)


# Discs


def tilted(angle, scale=(0.5, 0.3, 1.0), **kwargs):
    """Return a disc rotated about the x axis: 0 faces the camera of `straight`, pi / 2 is edge-on."""
    return one(quat=(np.cos(angle / 2), np.sin(angle / 2), 0, 0), scale=scale, **kwargs)


def render_all_planes(scene, cam):
    """Render discs with all planes."""
    return rasterize(
        **as_float32(scene), camera=cam, want_depth=True, want_median=True, want_surface=True, want_normals=True,
        want_distortion=True, primitive="2d",
    )  # fmt: skip


@pytest.mark.parametrize("turn", [1e-6, 1e-4, 1e-3, 1e-2, 0.1])
def test_disc_seen_almost_edge_on(turn):
    # Not at a pixel center, where plane and spot are equal and gradients depend on only one of them.
    for mean in ((0.003, 0.002, 2.0), (0.011, -0.023, 2.0), (0.403, 0.001, 2.0)):
        scene = tilted(np.pi / 2 - turn, mean=mean)
        got, _ = compare(scene, straight(), primitive="2d")
        # Its footprint is never smaller than its spot.
        u, v = int(FOCAL / 2 * mean[0] + WIDTH / 2), int(FOCAL / 2 * mean[1] + HEIGHT / 2)
        assert got.alpha[v, u] > 0.2
        compare(among_others(scene), straight(), primitive="2d")


def test_disc_seen_exactly_edge_on():
    """Its visible side is undefined, but it is drawn and everything is finite."""
    arrays = draw(as_float32(among_others(tilted(np.pi / 2))), straight(), primitive="2d")
    assert all(np.isfinite(array).all() for array in arrays.values())
    assert draw(as_float32(tilted(np.pi / 2)), straight(), primitive="2d")["plane 1"].max() > 0.5


@pytest.mark.parametrize("turn", [0.0, 1e-6, 1e-3, 0.1])
def test_disc_plane_through_camera(turn):
    """The distance along the ray to the plane is zero or nearly zero in some or all pixels."""
    lying = (np.cos(np.pi / 4 + turn), np.sin(np.pi / 4 + turn), 0, 0)
    for mean in ((0.001, 0.003, 0.5), (0.001, 1e-4, 0.5), (0.1, 0.01, 0.02), (0.001, 0.02, 2.0)):
        for scale in ((0.2, 0.3, 1), (5.0, 8.0, 1)):
            scene = among_others(one(mean=mean, quat=lying, scale=scale))
            compare(scene, straight(), gradient_tolerance=5e-5, value_tolerance=1e-4, primitive="2d")


def test_disc_reaching_behind_camera():
    """A floor below the camera is drawn up to its end, but not above the horizon, where its plane is behind."""
    floor = one(mean=(0.003, 0.302, 1.0), quat=(np.sqrt(0.5), np.sqrt(0.5), 0, 0), scale=(4, 4, 1), opacity=0.9)
    got, _ = compare(floor, straight(), primitive="2d")
    assert (got.alpha[-1] > 0.5).all() and not got.alpha[: HEIGHT // 2].any()
    compare(among_others(floor), straight(), gradient_tolerance=2e-5, primitive="2d")


def test_disc_is_clipped_at_near_plane():
    floor = one(mean=(0.003, 0.052, 1.0), quat=(np.sqrt(0.5), np.sqrt(0.5), 0, 0), scale=(4, 4, 1), opacity=0.9)
    got, _ = compare(floor, straight(near=0.2), primitive="2d")
    assert not got.alpha[-1].any() and got.alpha[HEIGHT // 2 + int(FOCAL * 0.052 / 0.22)].all()
    drawn = got.alpha > 0
    assert (got.depth[drawn] / got.alpha[drawn] > 0.2).all()


@pytest.mark.parametrize("angle", [0.0, 0.6, -1.2, np.pi])
def test_disc_depth_and_normal_match_plane(angle):
    got = render_all_planes(tilted(angle, scale=(0.8, 0.8, 1), opacity=0.9), straight())
    inside = got.alpha.numpy() > 0.5
    normal = np.array([0, np.sin(angle), -np.cos(angle)])
    normal *= -np.sign(normal[2])
    y, _ = np.mgrid[:HEIGHT, :WIDTH]
    wanted = 2 / (1 + (y + 0.5 - HEIGHT // 2 - 0.5) / FOCAL * normal[1] / normal[2])
    np.testing.assert_allclose((got.depth / got.alpha).numpy()[inside], wanted[inside], rtol=1e-5)
    np.testing.assert_allclose(got.median.numpy()[inside], wanted[inside], rtol=1e-5)
    for i in range(3):
        np.testing.assert_allclose((got.normals[i] / got.alpha).numpy()[inside], normal[i], atol=1e-5)
    assert inside.sum() > 20 and got.distortion.abs().max() < 1e-7


def test_distortion_of_two_discs():
    got = render_all_planes(join(*(one(mean=(0, 0, z), scale=(9, 9, 1), opacity=0.5) for z in (1.0, 2.0))), straight())
    middle = got.distortion[HEIGHT // 2, WIDTH // 2].item()
    assert middle == pytest.approx(0.5 * 0.25 * (1 - 0.5) ** 2, rel=1e-4)


def test_third_scale_of_disc_has_no_effect():
    scene = random_scene(1, count=30)
    cam = camera()
    first = draw(as_float32(scene), cam, primitive="2d")
    for value in (0.0, 1e30, np.nan):
        scene["scales"][:, 2] = value
        assert_same_bits(first, draw(as_float32(scene), cam, primitive="2d"))
    assert not first["scales"][:, 2].any()


def test_disc_outputs_are_rejected_for_3d_gaussians():
    scene = as_float32(one())
    for wanted in ({"want_normals": True}, {"want_distortion": True}, {"primitive": "4d"}):
        with pytest.raises(ValueError, match=r"3D Gaussians have no|expected '2d' or '3d'"):
            rasterize(**scene, camera=straight(), **wanted)


def test_screen_gradient_matches_moving_footprint():
    """Growth uses this gradient, so it must include the plane's part, not only the spot's."""
    scene = as_float32(tilted(0.7, scale=(6 / FOCAL, 8 / FOCAL, 1)))
    leaves = {k: v.requires_grad_(k != "ids") for k, v in scene.items()}
    width = WIDTH
    rendered = rasterize(**leaves, camera=straight(width), primitive="2d")
    pattern = torch.sin(torch.arange(width) / 5.0)[None, :].expand(HEIGHT, width)
    (rendered.alpha * pattern).sum().backward()
    columns = torch.arange(width) + 0.5
    # d/du of sum alpha(x - u) pattern(x) is sum alpha pattern'.
    wanted = (rendered.alpha * (torch.cos((columns - 0.5) / 5.0) / 5.0)[None, :]).sum()
    assert float(rendered.frame.screen_gradient[0, 0]) == pytest.approx(wanted.item(), rel=0.03)


# The reference itself


@pytest.mark.skipif(EMULATED, reason="tests only the reference")
@pytest.mark.parametrize(("primitive", "coefficients"), [("3d", 1), ("3d", 16), ("2d", 4)])
@pytest.mark.long
def test_reference_passes_gradcheck(primitive, coefficients):
    scene = random_scene(2, count=4, coefficients=coefficients, size=0.3)
    scene["opacities"] *= 0.8
    cam = straight(7, 5, focal=6.0)
    ids = scene.pop("ids")

    def render(*leaves):
        out = rasterize_reference(*leaves, ids, cam, 5, primitive)
        discs = (out.normals, out.distortion) if primitive == "2d" else ()
        return out.color, out.alpha, out.depth, out.probabilities, *discs

    assert torch.autograd.gradcheck(render, [scene[name].requires_grad_() for name in NAMES], eps=1e-7, atol=1e-5)


def test_unused_planes_have_zero_gradient():
    """Planes without a gradient (None from autograd) count as zero."""
    scene = {k: v.requires_grad_(k != "ids") for k, v in as_float32(random_scene(0)).items()}
    cam = camera()
    rasterize(**scene, camera=cam, want_depth=True).color.sum().backward()
    assert all(torch.isfinite(scene[name].grad).all() for name in NAMES)
    frame = cpu.forward(
        cpu.Gaussians(*(scene[n].detach().numpy() for n in (*NAMES, "ids"))),
        cam,
        np.zeros((cam.height, cam.width), np.int32),
    )
    out = cpu.backward(frame, np.ones_like(frame.color), np.zeros_like(frame.transmittance))
    for name in NAMES:
        found = scene[name].grad.numpy()
        np.testing.assert_allclose(getattr(out, name), found, rtol=1e-5, atol=1e-6 * np.abs(found).max())
