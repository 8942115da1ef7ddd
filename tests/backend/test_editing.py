"""Edits of objects on plain splats, checked with the reference renderer."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from backend.editing import apply_edits, compute_fill, fill, recolored, transformed
from backend.editing.floaters import inside_hull
from backend.model.splats import Splats, concatenate
from backend.raster.camera import Camera
from backend.raster.reference import rasterize_reference
from backend.shared.color.recolor import Recolor
from backend.shared.errors import Cancelled
from backend.shared.events import Reporter
from backend.shared.reconstruction.objects import SceneObject
from backend.shared.splats.convex_hull import points_inside
from backend.shared.splats.spherical_harmonics import C0


def some_splats(n=30, degree=3, seed=0, ids=(0, 1, 2), dtype=np.float64):
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(n, 4))
    return Splats(
        means=rng.normal(0, 0.5, (n, 3)).astype(dtype),
        quats=(quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(dtype),
        scales=np.exp(rng.normal(-2, 0.7, (n, 3))).astype(dtype),
        opacities=rng.uniform(0.2, 0.95, n).astype(dtype),
        sh=(rng.normal(size=(n, (degree + 1) ** 2, 3)) * 0.1).astype(dtype),
        object_ids=np.resize(ids, n),
    )


def camera(moved=None):
    """Return a camera at z = -4, optionally moved by a rigid map (4, 4) of the scene."""
    viewmat = np.eye(4)
    viewmat[2, 3] = 4.0
    if moved is not None:
        viewmat = viewmat @ np.linalg.inv(moved)
    return Camera(viewmat, np.array([[40.0, 0, 20], [0, 40, 15], [0, 0, 1]]), 40, 30)


def render(splats, view):
    """Render color and alpha, (30, 40, 4) float64."""
    arrays = (splats.means, splats.quats, splats.scales, splats.opacities, splats.sh)
    tensors = (torch.from_numpy(np.asarray(array, np.float64)) for array in arrays)
    drawn = rasterize_reference(*tensors, torch.zeros(len(splats), dtype=torch.int64), view)
    return np.concatenate([drawn.color.numpy().transpose(1, 2, 0), drawn.alpha.numpy()[..., None]], 2)


def affine(linear, translation=(0.0, 0.0, 0.0)):
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = linear, translation
    return matrix


def rows(matrix):
    return tuple(tuple(row) for row in np.asarray(matrix, float).tolist())


def scene_object(object_id, **edits):
    return SceneObject(object_id, f"object {object_id}", (1, 2, 3), 10, **edits)


def covariances(splats):
    axes = Rotation.from_quat(splats.quats, scalar_first=True).as_matrix() * splats.scales[:, None]
    return axes @ axes.transpose(0, 2, 1)


def same(a, b):
    return all(np.array_equal(getattr(a, field.name), getattr(b, field.name)) for field in fields(Splats))


TURN = Rotation.from_euler("xyz", [0.4, -1.1, 2.0]).as_matrix()


def test_rigid_move_with_camera_keeps_image():
    splats, move = some_splats(), affine(TURN, (0.3, -2.0, 5.0))
    before = render(splats, camera())
    assert before[..., 3].max() > 0.5
    np.testing.assert_allclose(render(transformed(splats, move), camera(move)), before, atol=1e-10)


def test_scaling_about_camera_keeps_image():
    splats = some_splats()
    camera_center = np.array([0, 0, -4.0])
    scaled = transformed(splats, affine(2.5 * np.eye(3), camera_center - 2.5 * camera_center))
    np.testing.assert_allclose(render(scaled, camera()), render(splats, camera()), atol=1e-10)


SHEAR = np.array([[1, 0.5, 0], [0, 1, 0], [0, 0.2, -2.0]])


@pytest.mark.parametrize("linear", [3.0 * TURN, np.diag([1.0, 1.0, -1.0]), TURN @ np.diag([1.0, 2.0, 0.3]), SHEAR])
def test_covariances_follow_affine_map(linear):
    splats = some_splats()
    moved = transformed(splats, affine(linear, (1, 2, 3)))
    np.testing.assert_allclose(covariances(moved), linear @ covariances(splats) @ linear.T, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(moved.means, splats.means @ linear.T + (1, 2, 3), atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(moved.quats, axis=1), 1, atol=1e-12)
    assert np.array_equal(moved.opacities, splats.opacities)


@pytest.mark.parametrize("linear", [TURN, TURN @ np.diag([1.0, 2.0, 0.5])])
def test_discs_stay_flat_along_third_axis(linear):
    splats = some_splats()
    splats.scales[:, 2] = 1e-6
    moved = transformed(splats, affine(linear))
    assert (moved.scales[:, 2] < 1e-5).all() and (moved.scales[:, :2] > 1e-3).all()


def test_edits_keep_float32():
    moved = transformed(recolored(some_splats(dtype=np.float32), Recolor(hue=0.3)), affine(TURN))
    assert {getattr(moved, name).dtype for name in ("means", "quats", "scales", "opacities", "sh")} == {np.dtype("f4")}


def test_recolored_splats_match_recolored_image():
    splats, recolor = some_splats(), Recolor(hue=0.3, saturation=0.5, value=0.8, contrast=0.9, tint=(1, 0.9, 0.8))
    splats.sh *= 0.3  # so that no color is clamped
    before, after = render(splats, camera()), render(recolored(splats, recolor), camera())
    matrix, offset = recolor.affine()
    np.testing.assert_allclose(after[..., :3], before[..., :3] @ matrix.T + before[..., 3:] * offset, atol=1e-12)
    assert np.array_equal(after[..., 3], before[..., 3]) and np.abs(after - before).max() > 0.01


def test_no_edits_change_nothing():
    splats = some_splats(dtype=np.float32)
    assert same(apply_edits(splats, []), splats)
    assert same(apply_edits(splats, [scene_object(1), scene_object(2)]), splats)


def test_unedited_splats_stay_identical():
    splats = some_splats(dtype=np.float32)
    objects = [scene_object(1, recolor=Recolor(hue=0.2), transform=rows(affine(TURN))), scene_object(2, removed=True)]
    edited = apply_edits(splats, objects)
    assert edited.object_ids.tolist() == [i for i in splats.object_ids.tolist() if i != 2]
    assert same(edited.select(edited.object_ids == 0), splats.select(splats.object_ids == 0))
    own = splats.select(splats.object_ids == 1)
    assert same(edited.select(edited.object_ids == 1), transformed(recolored(own, Recolor(hue=0.2)), affine(TURN)))


def test_copies_are_appended_from_captured_pose():
    splats, away, further = some_splats(), affine(np.eye(3), (1, 0, 0)), affine(2 * TURN, (0, 3, 0))
    recolor = Recolor(value=0.5)
    edited = apply_edits(
        splats, [scene_object(1, recolor=recolor, transform=rows(away), copies=(rows(further), rows(away)))]
    )
    own = recolored(splats.select(splats.object_ids == 1), recolor)
    assert len(edited) == len(splats) + 2 * len(own)
    assert same(edited.select(np.arange(len(splats), len(edited))),
                concatenate([transformed(own, further), transformed(own, away)]))  # fmt: skip
    assert same(edited.select(np.flatnonzero(edited.object_ids == 1)[: len(own)]), transformed(own, away))


def test_merged_object_follows_target():
    splats = some_splats(ids=(0, 1, 2, 3))
    objects = [
        scene_object(1, merged_into=2, recolor=Recolor(value=0.1), removed=True),
        scene_object(2, transform=rows(affine(TURN))),
        scene_object(3, left_out=True),
    ]
    edited = apply_edits(splats, objects)
    assert set(edited.object_ids.tolist()) == {0, 2}
    pair = splats.select(np.isin(splats.object_ids, (1, 2)))
    moved = edited.select(edited.object_ids == 2)
    np.testing.assert_array_equal(moved.means, transformed(pair, affine(TURN)).means)
    gone = apply_edits(splats, [objects[0], scene_object(2, removed=True), scene_object(9, removed=True)])
    assert set(gone.object_ids.tolist()) == {0, 3}
    assert set(apply_edits(splats, [scene_object(1, left_out=True, merged_into=2), scene_object(2)])
               .object_ids.tolist()) == {0, 2, 3}  # fmt: skip


def test_removed_object_has_no_copies():
    assert 1 not in apply_edits(some_splats(), [scene_object(1, removed=True, copies=(rows(np.eye(4)),))]).object_ids


def test_box_of_a_hull_is_tested_before_its_faces():
    corners = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 2.0) for z in (0.0, 3.0)])
    points = np.array([[0.5, 1.5, 2.5], [1.5, 1, 1], [0.5, -0.1, 1], [0.5, 1, 3.1], [1, 2, 3], [np.nan, 1, 1]])
    everything = np.array([[0.0, 0, 0, -1]])
    assert points_inside(points, corners, everything).tolist() == [True, False, False, False, True, False]


def test_floaters_inside_hull_are_removed_on_request():
    rng = np.random.default_rng(0)
    ball = rng.normal(size=(300, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    stray, faint = np.array([[50.0, 0, 0]]), np.array([[0, 50.0, 0]])
    means = np.concatenate([ball, stray, faint]) + 1e6
    opacities = np.r_[np.ones(301), 0.01]
    points = np.array([[0, 0, 0], [0.8, 0, 0], [1.1, 0, 0], [20, 0, 0], [0, 20, 0]]) + 1e6
    assert inside_hull(points, means, opacities).tolist() == [True, True, False, False, False]
    assert not inside_hull(points, means[:3], opacities[:3]).any()
    assert not inside_hull(points, np.ones((20, 3)), np.ones(20)).any()

    both = some_splats(n=305, ids=(1,))
    both.means, both.opacities = np.concatenate([means[:300], points]), np.ones(305)
    both.object_ids[300:] = [0, 2, 0, 0, 0]
    kept = apply_edits(both, [scene_object(1, removed=True, floaters=True), scene_object(2)])
    assert kept.object_ids.tolist() == [2, 0, 0, 0]
    assert len(apply_edits(both, [scene_object(1, removed=True)])) == 5
    assert len(apply_edits(both, [scene_object(1, floaters=True)])) == 305


def surface(rng, n, axes, at, colors, object_id, thin=0.002):
    """Return flat splats in a square of side 2 around `at`, spanned by the first two rows of `axes` (3, 3); `colors`
    maps positions in the square to colors."""
    flat = rng.uniform(-1, 1, (n, 2))
    quats = Rotation.from_matrix(axes.T).as_quat(scalar_first=True)
    return Splats(
        means=(flat @ axes[:2] + at).astype(np.float32), quats=np.tile(quats, (n, 1)).astype(np.float32),
        scales=np.tile([0.02, 0.02, thin], (n, 1)), opacities=np.full(n, 0.8),
        sh=((colors(flat) - 0.5) / C0)[:, None].astype(np.float32), object_ids=np.full(n, object_id),
    )  # fmt: skip


def stripes(flat):
    """Return colors with dark and light stripes along x, and red increasing along x."""
    light = np.where(np.floor(flat[:, 1] / 0.08) % 2 == 0, 0.35, 0.65)
    return np.stack([light + 0.2 * flat[:, 0], light, light], 1)


def box(rng, low, high, object_id, n=3000):
    """Return splats on the sides of a box."""
    low, high = np.array(low), np.array(high)
    points = rng.uniform(low, high, (n, 3))
    side = rng.integers(3, size=n)
    points[np.arange(n), side] = np.where(rng.random(n) < 0.5, low[side], high[side])
    splats = some_splats(n, 0, ids=(object_id,), dtype=np.float32)
    splats.means, splats.scales = points.astype(np.float32), np.full((n, 3), 0.01)
    return splats


HERE = np.eye(4)


def with_box_on_ground(place=HERE):
    """Return a striped ground with a hole, a box over the hole and another box; and the ground's splats in the hole."""
    rng = np.random.default_rng(0)
    ground = surface(rng, 12000, np.eye(3), np.zeros(3), stripes, 5)
    hidden = (np.abs(ground.means[:, :2]) < 0.15).all(1)
    obj = box(rng, (0.6, 0.6, 0), (0.8, 0.8, 0.2), 6)
    whole = concatenate([ground.select(~hidden), box(rng, (-0.15, -0.15, 0), (0.15, 0.15, 0.3), 1), obj])
    return transformed(whole, place), transformed(ground.select(hidden), place)


@pytest.mark.parametrize("place", [HERE, affine(3 * TURN, (50, -20, 9))])
@pytest.mark.long
def test_fill_continues_ground_under_removed_object(place):
    splats, hidden = with_box_on_ground(place)
    objects = [scene_object(1, removed=True, fill=True), scene_object(5), scene_object(6)]
    edited = apply_edits(splats, objects)
    unobserved = edited.select(edited.unobserved)
    assert len(unobserved) > 0.7 * len(hidden) and set(unobserved.object_ids.tolist()) == {5}
    back = transformed(unobserved, np.linalg.inv(place))
    assert np.abs(back.means[:, :2]).max() < 0.2 and np.abs(back.means[:, 2]).max() < 0.005
    # The new splats continue the stripes and the red gradient.
    truth = stripes(back.means[:, :2].astype(np.float64))
    found = 0.5 + C0 * back.sh[:, 0]
    assert np.median(np.abs(found - truth)) < 0.04 and (np.abs(found - truth).max(1) < 0.1).mean() > 0.75
    # Seen straight from above, the hole is as opaque as its surroundings.
    down = np.diag([1.0, -1, -1, 1])
    down[2, 3] = 2.0
    view = Camera(down, np.array([[100.0, 0, 12], [0, 100, 12], [0, 0, 1]]), 24, 24)
    alphas = []
    for shown in (apply_edits(splats, [replace(objects[0], fill=False)]), edited):
        shown = transformed(shown, np.linalg.inv(place))
        alphas.append(render(shown.select((np.abs(shown.means[:, :2]) < 0.3).all(1)), view)[..., 3])
    assert alphas[0][8:16, 8:16].max() < 0.1
    in_hole = np.zeros((24, 24), bool)
    in_hole[8:16, 8:16] = True
    lowest = [np.percentile(alphas[1][there], 5) for there in (in_hole, ~in_hole)]
    assert lowest[0] > lowest[1] - 0.01 and alphas[1][in_hole].min() > 0.85
    # Splats away from the rim stay the same, in the same order.
    kept = edited.select(~edited.unobserved)
    others = splats.select(splats.object_ids != 1)
    there = np.isin(others.means, kept.means).all(1)
    gone = transformed(others.select(~there), np.linalg.inv(place)).means
    assert same(kept, others.select(there)) and len(gone) < 400
    assert (np.abs(gone[:, :2]).max(1) < 0.2).all() and (np.abs(gone[:, :2]).max(1) > 0.1).all()


def test_fill_continues_both_sides_of_corner():
    rng = np.random.default_rng(1)
    walls = [
        surface(rng, 12000, np.eye(3), (0, 0, 0), stripes, 5),
        surface(rng, 12000, np.eye(3)[[1, 2, 0]], (-0.15, 0, 1), stripes, 7),
    ]
    both = concatenate(walls)
    hidden = (np.abs(both.means[:, :2]) < 0.16).all(1) & (both.means[:, 2] < 0.28)
    splats = concatenate([both.select(~hidden), box(rng, (-0.14, -0.15, 0), (0.15, 0.15, 0.3), 1)])
    edited = apply_edits(splats, [scene_object(1, removed=True, fill=True)])
    unobserved = edited.select(edited.unobserved)
    assert (unobserved.object_ids == 5).sum() > 100 and (unobserved.object_ids == 7).sum() > 100


def test_fill_continues_each_surface_to_its_edge():
    splats, hidden = with_box_on_ground()
    for part in (splats, hidden):
        part.object_ids[(part.object_ids == 5) & (part.means[:, 0] > 0.02)] = 8
    edited = apply_edits(splats, [scene_object(1, removed=True, fill=True)])
    unobserved = edited.select(edited.unobserved)
    assert len(unobserved) > 0.7 * len(hidden)
    assert ((unobserved.object_ids == 8) == (unobserved.means[:, 0] > 0.02)).mean() > 0.85


def test_fill_follows_curved_ground():
    """On a dome that is too high to count as flat, the new splats lie on the dome, not in a plane."""

    def height(flat):
        return -0.06 * (flat[:, :2] ** 2).sum(1)

    splats, hidden = with_box_on_ground()
    for part in (splats, hidden):
        ground = part.object_ids == 5
        part.means[ground, 2] += height(part.means[ground])
    edited = apply_edits(splats, [scene_object(1, removed=True, fill=True)])
    unobserved = edited.select(edited.unobserved)
    assert len(unobserved) > 0.7 * len(hidden)
    off = np.abs(unobserved.means[:, 2] - height(unobserved.means))
    assert np.median(off) < 0.006, np.median(off)
    assert np.abs(height(splats.means[splats.object_ids == 5])).mean() > 0.03


@pytest.mark.parametrize("within", [0.02, 0.04, 0.08])
def test_ridge_of_ground_is_no_further_plane(within):
    """Planes through it may be steep, but the one that fits is tilted little to the ground."""
    rng = np.random.default_rng(0)
    across, normal = np.array([0, np.cos(0.42), np.sin(0.42)]), np.array([0, -np.sin(0.42), np.cos(0.42)])
    along, wide, high = rng.uniform(-1, 1, (3, 2000, 1))
    ridge = 0.5 * along * np.array([1, 0, 0]) + 0.03 * wide * across + 0.005 * high * normal + np.array([0, -0.1, 0.06])
    standing = rng.normal((0, 0, 0.5), 0.15, (3000, 3))
    ground = fill._Plane(np.zeros(3), np.eye(3))
    arguments = ridge, np.tile(normal, (2000, 1)), standing, 1.0, within
    assert fill._plane(*arguments, [ground]) is None
    alone = fill._plane(*arguments, [])
    assert alone is not None and alone.axes[2] @ normal > 0.99


def test_compute_fill_matches_applied_edits():
    splats, _ = with_box_on_ground()
    objects = [scene_object(1, removed=True, fill=True), scene_object(6, removed=True, fill=True)]
    filling = compute_fill(splats, objects)
    edited = apply_edits(splats, objects)
    assert same(filling.splats.select(filling.put), edited.select(edited.unobserved))
    assert set(filling.fills.tolist()) == {1, 6} and filling.splats.unobserved.tolist() == filling.put.tolist()
    kept = splats.select(np.isin(splats.object_ids, [1, 6], invert=True))
    taken = filling.splats.select(~filling.put)
    still = kept.select(~np.isin(kept.means, taken.means).all(1))
    assert len(taken) and same(still, edited.select(~edited.unobserved))


def test_filling_of_applied_edits_can_be_followed_and_stopped():
    splats, _ = with_box_on_ground()
    objects = [scene_object(1, removed=True, fill=True), scene_object(6, removed=True, fill=True)]
    seen, checks = [], []
    reporter = Reporter()
    reporter.progress = lambda done, total, **_: seen.append(done / total)
    reporter.check = lambda: checks.append(0)
    apply_edits(splats, [*objects, scene_object(5, recolor=Recolor(hue=0.1))], reporter)
    assert seen == sorted(seen) and seen[-1] == 1 and len(checks) == 1

    def stop(done, total, **_):
        raise Cancelled("")

    reporter.progress = stop
    with pytest.raises(Cancelled):
        apply_edits(splats, objects, reporter)


def test_no_fill_without_surrounding_surface():
    splats, _ = with_box_on_ground()
    for without in (splats.select(splats.object_ids != 5), splats.select(splats.means[:, 0] < 0.1)):
        edited = apply_edits(without, [scene_object(1, removed=True, fill=True)])
        assert same(edited, without.select(without.object_ids != 1))
    assert not apply_edits(splats, [scene_object(1, removed=True)]).unobserved.any()


def test_hole_of_moved_object_is_filled():
    """The fill is that of the removed object, and the object keeps all of its splats."""
    splats, _ = with_box_on_ground()
    removed = apply_edits(splats, [scene_object(1, removed=True, fill=True)])
    away = affine(np.eye(3), (0.5, -0.5, 0))
    edited = apply_edits(splats, [scene_object(1, transform=rows(away), fill=True)])
    assert removed.unobserved.any() and same(edited.select(edited.object_ids != 1), removed)
    own = splats.select(splats.object_ids == 1)
    assert same(edited.select(edited.object_ids == 1), transformed(own, away))


def test_empty_splats_can_be_edited():
    for edited in (transformed(Splats.empty(2), affine(TURN)), recolored(Splats.empty(2), Recolor(hue=0.1)),
                   apply_edits(Splats.empty(2), [scene_object(1, removed=True)])):  # fmt: skip
        assert len(edited) == 0 and edited.degree == 2
