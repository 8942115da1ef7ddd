"""Depth maps of photos with known poses: exact planes, occlusion, what is left out, and points for training."""

from __future__ import annotations

import itertools
from types import SimpleNamespace

import numba
import numpy as np
import pycolmap
import pytest
from PIL import Image
from scipy.spatial import cKDTree

from backend.capture.capture import Points, View
from backend.raster import Camera
from backend.shared.errors import EXIT_DONE
from backend.stereo import depth_maps
from backend.stereo.dense_points import _thinned, find_dense_points
from backend.stereo.depth_maps import AGREES, NEIGHBORS, DepthMap, balance, find_depth_maps
from backend.stereo.patch_match import Matches, Others, match_planes, packed
from backend.stereo.scene_planes import find_planes, sides_of_planes
from backend.stereo.surface_normals import bending, concavity, measure_normals, normals_of_depth
from backend.training.state import model_from_checkpoint, read_checkpoint

SIZE = (160, 120)
FLOOR, BOX = 0.0, 0.5
"""Height of the floor, and of the top of the box on it, which spans -0.6 .. 0.6."""


def texture(x, y, seed):
    """Return gray levels of a smooth texture at positions on a plane."""
    rng = np.random.default_rng(seed)
    total = np.zeros(np.shape(x))
    for scale in (3.0, 7.0, 15.0):
        for _ in range(6):
            angle, phase = rng.uniform(0, 2 * np.pi, 2)
            total += np.sin(scale * (np.cos(angle) * x + np.sin(angle) * y) + phase) / np.sqrt(scale)
    return 128 + 25 * total


def shot(viewmat, K):
    """Return a photo (h, w, 3) uint8 of a box on a floor, its exact depth (h, w), and where the box is."""
    u, v = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], -1) @ viewmat[:3, :3]
    center = -viewmat[:3, :3].T @ viewmat[:3, 3]
    top = (BOX - center[2]) / rays[..., 2]
    at = center + top[..., None] * rays
    on_box = (np.abs(at[..., :2]) <= 0.6).all(-1)
    depth = np.where(on_box, top, (FLOOR - center[2]) / rays[..., 2])
    at = center + depth[..., None] * rays
    gray = np.where(on_box, texture(at[..., 0], at[..., 1], 1), texture(at[..., 0], at[..., 1], 2))
    return np.repeat(np.clip(gray, 0, 255).round().astype(np.uint8)[..., None], 3, 2), depth, on_box


@pytest.fixture(scope="module")
def scene():
    """A capture of a box on a floor in 9 photos that look down at it aslant, with points on both."""
    K = np.array([[150.0, 0, SIZE[0] / 2], [0, 150.0, SIZE[1] / 2], [0, 0, 1]])
    views, photos, depths, masks = [], [], [], []
    for i in range(9):
        angle = 2 * np.pi * i / 9
        center = np.array([1.6 * np.cos(angle), 1.6 * np.sin(angle), 2.6])
        forward = np.array([0, 0, 0.2]) - center
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        viewmat = np.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ center
        views.append(View(f"{i}.png", None, None, K, viewmat, *SIZE, 1))
        photo, depth, on_box = shot(viewmat, K)
        photos.append(photo)
        depths.append(depth)
        masks.append(on_box)
    rng = np.random.default_rng(0)
    xyz = np.concatenate([
        np.column_stack([rng.uniform(-0.5, 0.5, (10, 2)), np.full(10, BOX)]),
        np.column_stack([rng.uniform(0.8, 1.2, (10, 2)), np.full(10, FLOOR)]),
        [[0.1, 0.1, 1.0], [0.3, -0.9, 1.2]],  # In the air.
    ])  # fmt: skip
    count = len(xyz)
    points = Points(xyz, np.zeros((count, 3), np.uint8), np.zeros(count, np.float32), np.arange(count))
    return SimpleNamespace(
        views=views, points=points, image=lambda i: photos[i], observed=lambda i: np.arange(count), depths=depths,
        on_box=masks,
    )  # fmt: skip


@pytest.fixture(scope="module")
def maps(scene):
    return find_depth_maps(scene, range(9))


def test_depths_are_exact_on_slanted_planes(scene, maps):
    known = total = 0
    errors = []
    for index, found in maps.items():
        truth = scene.depths[index][found.pixels[:, 1], found.pixels[:, 0]]
        good = found.depths > 0
        errors.append(np.abs(found.depths[good] / truth[good] - 1))
        known, total = known + good.sum(), total + len(good)
    errors = np.concatenate(errors)
    assert known > 0.6 * total
    assert np.median(errors) < 0.002 and (errors < AGREES).mean() > 0.98


def test_points_that_no_photo_shows_do_not_matter(scene):
    """As those of another storey, below the floor."""
    rng = np.random.default_rng(0)
    hidden = np.column_stack([rng.uniform(-3, 3, (1000, 2)), rng.uniform(-10, -8, 1000)])
    xyz = np.concatenate([scene.points.xyz, hidden])
    count = len(xyz)
    points = Points(xyz, np.zeros((count, 3), np.uint8), np.zeros(count, np.float32), np.arange(count))
    capture = SimpleNamespace(**{**vars(scene), "points": points})
    seen = find_depth_maps(capture, range(4))
    assert sum((found.depths > 0).sum() for found in seen.values()) > 0.4 * sum(len(m.depths) for m in seen.values())


def test_planes_follow_the_surface(scene, maps):
    found = maps[0]
    truth = 1 / scene.depths[0]
    x, y = found.pixels.T
    box = (np.abs(x - SIZE[0] / 2) < 15) & (np.abs(y - SIZE[1] / 2) < 10) & (found.depths > 0)
    down = truth[y + 1, x] - truth[y, x]
    assert box.sum() > 20
    assert np.median(np.abs(found.planes[box, 2] / down[box] - 1)) < 0.1


def test_large_planes_are_found_among_points():
    """A floor and a wall with noise, and a ball, on which no plane has as many points."""
    rng = np.random.default_rng(0)
    flat = rng.uniform(-1, 1, (2000, 3))
    normals = rng.normal(size=(2000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    ball = normals + np.array([5.0, 0, 0])
    for axis, rows in ((2, slice(0, 1000)), (0, slice(1000, 1600))):
        flat[rows, axis] = rng.normal(0.5, 0.005, len(flat[rows]))
        normals[rows] = np.eye(3)[axis] * rng.choice([-1, 1], len(flat[rows]))[:, None]
    xyz = np.concatenate([flat[:1600], ball[1600:]])
    floor, wall, *others = find_planes(xyz, normals, np.full(2000, 2.0))
    for plane, axis in ((floor, 2), (wall, 0)):
        sign = np.sign(plane.normal[axis])
        np.testing.assert_allclose(sign * plane.normal, np.eye(3)[axis], atol=0.01)
        assert sign * plane.offset == pytest.approx(0.5, abs=0.01) and 1.2 < plane.reach < 1.5
    assert all(plane.reach < 0.5 for plane in others)
    assert find_planes(xyz[:0], normals[:0], np.zeros(0)) == []


@pytest.mark.parametrize("seen", [1.0, 0.0])
def test_things_are_in_front_of_a_large_plane_or_behind_it(seen):
    """A table top, a ball on it, and its side, seen from above or below; planes that few pixels show do not count."""
    rng = np.random.default_rng(0)
    top = np.column_stack([rng.uniform(-1, 1, (600, 2)), rng.normal(0, 0.002, 600)])
    around = rng.normal(size=(300, 3))
    around /= np.linalg.norm(around, axis=1, keepdims=True)
    side = np.column_stack([rng.uniform(-1, 1, 100), np.ones(100), rng.uniform(-0.5, -0.1, 100)])
    xyz = np.concatenate([top, 0.2 * around + [0, 0, 0.25], side])
    normals = np.concatenate([np.tile([0, 0, 1.0], (600, 1)), around, np.tile([0, 1.0, 0], (100, 1))])
    beside, tilted = 600 + np.argsort(-normals[600:900, 2])[[-1, 0]]  # The normal of the second is almost the table's.
    pairs = np.array([(0, 1), (0, beside), (beside, 0), (0, tilted), (0, 950), (950, 951)]).T
    pixels = np.repeat([seen, 1.0, seen], [600, 300, 100])
    for wanted in ([1, -1, -1, 0, 0, 1], [1, 0, 0, 0, -1, 1]):
        found = sides_of_planes(xyz, normals, np.full(1000, 3.0), pixels, (pairs[0], pairs[1]))
        assert found.tolist() == (wanted if seen else [0] * 6)
        normals[:600] *= -1


@pytest.mark.parametrize(("bent", "on"), [(0.0, True), (0.06, True), (1.0, False)])
def test_a_table_that_is_a_little_bent_is_one_plane(bent, on):
    """Its edges are higher than its middle, as in reconstructions by inexact lenses; a bowl is no plane."""
    rng = np.random.default_rng(0)
    flat = rng.uniform(-1, 1, (2000, 2))
    top = np.column_stack([flat, bent * (flat**2).sum(1) + rng.normal(0, 0.002, 2000)])
    normals = np.column_stack([-2 * bent * flat, np.ones(2000)])
    thing = np.column_stack([np.full(200, 0.5), rng.uniform(0.4, 0.6, 200), rng.uniform(0.1, 0.5, 200)])
    xyz = np.concatenate([top, thing])
    normals = np.concatenate([normals, np.tile([1.0, 0, 0], (200, 1))])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    middle, edge = np.argsort(np.linalg.norm(flat, axis=1))[[0, 1000]]
    first, second = np.array([(middle, edge), (edge, 2000), (middle, 2000)]).T
    found = sides_of_planes(xyz, normals, np.full(2200, 3.0), np.ones(2200), (first, second), may_be_bent=True)
    assert (found.tolist() == [1, -1, -1]) == on


def test_normals_of_depth_are_exact_on_planes_and_missing_at_gaps():
    K = np.array([[150.0, 0, 80], [0, 140.0, 60], [0, 0, 1]])
    forward = np.array([0.5, -0.4, -1.0]) / np.linalg.norm([0.5, -0.4, -1.0])
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    viewmat = np.eye(4)
    viewmat[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    viewmat[:3, 3] = -viewmat[:3, :3] @ [-0.8, 0.6, 2.4]
    _, depth, on_box = shot(viewmat, K)
    alpha = np.full(depth.shape, 0.9)
    alpha[:20] = 0.2
    found = normals_of_depth((depth * alpha).astype(np.float32), alpha, Camera(viewmat, K, *SIZE))
    known = (found != 0).any(0)
    inside = np.zeros_like(known)
    inside[22:-2, 2:-2] = True
    for dx, dy in ((2, 0), (-2, 0), (0, 2), (0, -2)):
        inside &= np.roll(on_box, (dy, dx), (0, 1)) == on_box
    assert on_box.any() and inside.any() and known[inside].all() and not known[:20].any()
    np.testing.assert_allclose(found[:, inside].T, np.tile([0, 0, 1.0], (inside.sum(), 1)), atol=2e-3)
    np.testing.assert_allclose(np.linalg.norm(found[:, known], axis=0), 1, atol=1e-5)
    assert not normals_of_depth(depth[:4, :4], alpha[:4, :4], Camera(viewmat, K, 4, 4)).any(), "too small"


def test_a_gap_has_no_normal():
    K, (width, height) = np.array([[150.0, 0, 80], [0, 150.0, 60], [0, 0, 1]]), SIZE
    depth = np.where(np.arange(width) < 80, 1.0, 2.0) * np.ones((height, 1))
    found = normals_of_depth(depth, np.ones_like(depth), Camera(np.eye(4), K, width, height))
    known = (found != 0).any(0)[2:-2, 2:-2]
    assert not known[:, 76:80].any() and known[:, :76].all() and known[:, 80:].all()
    np.testing.assert_allclose(found[2, 2:-2, 2:-2][known], -1, atol=1e-6)


@pytest.mark.parametrize("slope", [-1.0, 1.0])
def test_valleys_are_concave_and_ridges_are_not(slope):
    rng = np.random.default_rng(0)
    xy = rng.uniform(-1, 1, (4000, 2))
    xyz = np.column_stack([xy, slope * np.abs(xy[:, 0])])
    _, near = cKDTree(xyz).query(xyz, k=12)
    normal = measure_normals(xyz[near], np.tile([0, 0, 1.0], (len(xyz), 1)))
    away = np.abs(xy[:, 0]) > 0.2
    expected = np.column_stack([-slope * np.sign(xy[:, 0]), np.zeros(len(xy)), np.ones(len(xy))]) / np.sqrt(2)
    np.testing.assert_allclose(normal[away], expected[away], atol=1e-6)
    left, right = np.flatnonzero(xy[:, 0] < -0.2)[:500], np.flatnonzero(xy[:, 0] > 0.2)[:500]
    assert (np.sign(bending(xyz, normal, left, right)) == -slope).all()
    assert (concavity(xyz, normal, left, right) > 0).all() == (slope > 0)
    assert np.abs(bending(xyz, normal, left[:-1], left[1:])).max() < 1e-6, "flat"


@pytest.mark.long
def test_floor_goes_on_where_few_photos_show_it(scene, maps, monkeypatch):
    monkeypatch.setattr(depth_maps, "find_planes", lambda *_: [])
    before = find_depth_maps(scene, range(9))
    errors = []
    for index, found in maps.items():
        known = before[index].depths > 0
        assert np.array_equal(found.depths[known], before[index].depths[known])
        added = (found.depths > 0) & ~known
        truth = scene.depths[index][found.pixels[added, 1], found.pixels[added, 0]]
        errors.append(np.abs(found.depths[added] / truth - 1))
    errors = np.concatenate(errors)
    assert len(errors) > 0.02 * sum(len(found.depths) for found in maps.values())
    assert (errors < AGREES).mean() > 0.95


def test_packed_pixels_have_their_neighbors():
    image = np.arange(20, dtype=np.float32).reshape(4, 5) * 13.4
    levels = np.pad(np.minimum(np.rint(image), 255), ((0, 1), (0, 1)), "edge")
    four = packed(image)
    for place, (down, right) in enumerate(((0, 0), (0, 1), (1, 0), (1, 1))):
        assert np.array_equal(four >> 8 * place & 255, levels[down : down + 4, right : right + 5])


def test_smooth_shades_do_not_match_on_planes():
    """The shade of a sky correlates with itself at any depth, a texture at its own alone."""
    shade = np.tile(np.linspace(0, 255, SIZE[0], dtype=np.float32), (SIZE[1], 1))
    grain = np.random.default_rng(0).uniform(0, 255, SIZE[::-1]).astype(np.float32)
    pixels = np.stack(np.meshgrid(np.arange(40, 120, 10), np.arange(30, 90, 10)), -1).reshape(-1, 2)
    steps = np.array([[10, 0, 0], [0, 10, 0]], np.float32)
    for image, matches in ((shade, False), (grain, True)):
        moved = np.stack([packed(np.roll(image, 10, 1)), packed(np.roll(image, 10, 0))])
        others = Others(np.tile(np.eye(3, dtype=np.float32), (2, 1, 1)), steps, moved, np.tile(SIZE[::-1], (2, 1)))
        found = match_planes(packed(image), pixels, others, np.array([[0, 0, 1.0]]), np.ones((len(pixels), 1), bool))
        assert ((found.scores > 0.9) == matches).all()
        none = match_planes(packed(image), pixels, others, np.array([[0, 0, 1.0]]), np.zeros((len(pixels), 1), bool))
        assert (none.scores == -1).all()


@pytest.mark.long
def test_threads_do_not_matter(scene, maps):
    before = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        alone = find_depth_maps(scene, range(9))
    finally:
        numba.set_num_threads(before)
    assert all(np.array_equal(alone[index].depths, found.depths) for index, found in maps.items())


def test_balance_tells_surfaces_from_the_air(scene, maps):
    score = balance(scene, maps, scene.points.xyz)
    assert (score[:20] > 0).mean() > 0.8 and (score[20:] < 0).all()
    below = balance(scene, maps, np.array([[0.0, 0.0, 0.2], [0.0, 0.0, -1.0]]))
    assert (below == 0).all(), "what is behind a surface is not known"


def test_points_are_on_the_surfaces_and_evenly_spread(scene):
    steps = []
    found = find_dense_points(scene, range(9), lambda done, total: steps.append((done, total)))
    fractions = [done / total for done, total in steps]
    assert fractions == sorted(fractions) and fractions[0] == 0 and fractions[-1] == 1
    assert len(set(fractions)) > 9 and fractions[len(steps) // 2] < 1
    assert found.in_front.tolist() == [False] * 20 + [True] * 2
    assert len(found.xyz) == len(found.rgb) > 1000
    height = found.xyz[:, 2]
    off = np.minimum(np.abs(height - FLOOR), np.abs(height - BOX))
    assert (off < 0.03).mean() > 0.97
    on_box = np.abs(height - BOX) < 0.02
    assert 0.05 < on_box.mean() < 0.6
    gray = texture(found.xyz[on_box, 0], found.xyz[on_box, 1], 1)
    assert np.median(np.abs(found.rgb[on_box, 0] - gray)) < 4


def test_points_are_as_far_apart_as_the_pixels_that_show_them():
    """Without points near others that are finer, or known."""
    rng = np.random.default_rng(0)
    near, far = rng.uniform(0, 1, (20000, 3)) * [1, 1, 0], rng.uniform(0, 8, (20000, 3)) * [1, 1, 0]
    xyz, size = np.concatenate([near, far]), np.repeat([0.1, 0.8], 20000)
    kept = _thinned(xyz, size, np.zeros((0, 3)))
    assert 80 < (kept < 20000).sum() < 250 and 80 < (kept >= 20000).sum() < 250
    inside = (xyz[kept[kept >= 20000]] < 0.5).all(1)
    assert not inside.any(), "a coarse point beside fine ones"
    assert len(_thinned(xyz, size, xyz[kept])) == 0, "where points are known"


def test_many_views_are_thinned(scene, monkeypatch):
    monkeypatch.setattr("backend.stereo.dense_points.MOST_VIEWS", 5)
    steps = []
    found = find_dense_points(scene, range(9), lambda done, total: steps.append((done, total)))
    assert {total for _, total in steps} == {5 * 4, 1} and len(found.xyz) > 300


def test_it_stops_before_each_photo_and_each_map(scene, monkeypatch):
    """Matching is replaced by the true depths."""
    log, compare = [], DepthMap.compare
    numbers = itertools.cycle(range(9))

    def match(_image, pixels, *_):
        depths = scene.depths[next(numbers)][pixels[:, 1], pixels[:, 0]]
        planes = np.column_stack([1 / depths, 0 * depths, 0 * depths]).astype(np.float32)
        return Matches(planes, np.ones(len(depths), np.float32))

    monkeypatch.setattr(depth_maps, "match", match)
    monkeypatch.setattr(DepthMap, "compare", lambda *args: log.append("map") or compare(*args))
    capture = SimpleNamespace(**{**vars(scene), "image": lambda i: log.append("photo") or scene.image(i)})
    find_dense_points(capture, range(9), lambda *_: log.append("check"))
    between = " ".join(log).split("check")
    assert max(part.count("photo") for part in between) == 1
    # A map is first compared with those of its neighbors alone.
    assert max(part.count("map") for part in between) <= NEIGHBORS
    assert sum(part.count("map") == 1 for part in between) > 9 * 8


def test_views_alone_find_nothing(scene):
    for views in ([], [3], [0, 5]):
        assert not any((found.depths > 0).any() for found in find_depth_maps(scene, views).values())
        found = find_dense_points(scene, views)
        assert len(found.xyz) == 0 and not found.in_front.any()


def write_capture(folder, scene):
    """Write the scene's photos, masks of the box (ID 4) and a text model of COLMAP."""
    model = folder / "sparse" / "0"
    for part in (folder / "images", folder / "masks", model):
        part.mkdir(parents=True)
    K = scene.views[0].K
    (model / "cameras.txt").write_text(f"1 PINHOLE {SIZE[0]} {SIZE[1]} {K[0, 0]} {K[1, 1]} {K[0, 2]} {K[1, 2]}\n")
    lines = []
    for number, view in enumerate(scene.views):
        x, y, z, w = pycolmap.Rotation3d(view.viewmat[:3, :3]).quat
        lines += [f"{number + 1} {w} {x} {y} {z} {' '.join(map(str, view.viewmat[:3, 3]))} 1 {view.name}", ""]
        Image.fromarray(scene.image(number)).save(folder / "images" / view.name)
        Image.fromarray(np.where(scene.on_box[number], 4, 0).astype(np.uint8)).save(folder / "masks" / view.name)
    (model / "images.txt").write_text("\n".join(lines) + "\n")
    points = scene.points
    (model / "points3D.txt").write_text(
        "".join(f"{i} {' '.join(map(str, at))} 9 9 9 0.5\n" for i, at in zip(points.ids, points.xyz, strict=True))
    )


@pytest.mark.long
def test_training_begins_with_them(scene, tmp_path, run_command):
    """Through the command: the points that float are left out, and those found on surfaces have their objects."""
    folder = tmp_path / "capture"
    write_capture(folder, scene)
    begun = {}
    for name, words in (("with", ()), ("without", ("--leave-out", "dense-points"))):
        out = tmp_path / name
        result = run_command("train", folder, "--out", out, "--steps", 1, "--offsets", 2, *words)
        assert result.code == EXIT_DONE
        begun[name] = model_from_checkpoint(*read_checkpoint(out / "checkpoint")[:2]), result.out + result.err
    model, said = begun["with"]
    assert "points added on surfaces without features; 2 of the capture's left out" in said
    height = model.normalization.to_world(model.anchors.positions.numpy())[:, 2]
    ids = model.classes.ids_of(model.anchors.ids.numpy())
    for level, expected in ((BOX, 4), (FLOOR, 0)):
        assert (ids[np.abs(height - level) < 0.05] == expected).mean() > 0.9
    few, unsaid = begun["without"]
    assert len(model.anchors) > 8 * len(few.anchors) and "points added" not in unsaid
