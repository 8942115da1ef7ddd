"""Upright orientation of captures: randomly rotated synthetic rooms, captures with little data, and real ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from backend.capture import compute_upright, load_capture

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"


def viewmats_looking_at(camera_centers, targets, roll_degrees=0.0):
    """Return viewmats (V, 4, 4) of cameras at `camera_centers` that look at `targets`, with Z up and some roll."""
    viewmats = []
    for camera_center, target, roll in zip(camera_centers, targets, np.broadcast_to(roll_degrees, len(camera_centers))):
        forward = (target - camera_center) / np.linalg.norm(target - camera_center)
        right = np.cross(forward, [0, 0, 1])
        right /= np.linalg.norm(right)
        rotation = Rotation.from_euler("z", roll, degrees=True).as_matrix() @ [right, np.cross(forward, right), forward]
        viewmat = np.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ camera_center
        viewmats.append(viewmat)
    return np.array(viewmats)


def room(rng, arc=360.0, pitch=25.0, roll=2.0, views=40, floor=3000, ceiling=2500):
    """Return cameras on an arc around the middle of a room, the room's points with the floor at z = 0, and outliers."""
    angles = np.radians(np.linspace(0, arc, views, endpoint=False) + rng.normal(0, 2, views))
    down = np.tan(np.radians(pitch))
    camera_centers = np.stack([2 * np.cos(angles), 2 * np.sin(angles), 0.4 + 2 * down + rng.normal(0, 0.05, views)], 1)
    viewmats = viewmats_looking_at(
        camera_centers, np.tile([0, 0, 0.4], (views, 1)) + rng.normal(0, 0.1, (views, 3)), rng.normal(0, roll, views)
    )
    flat = rng.uniform(-3, 3, (floor, 3)) * [1, 1, 0]
    above = rng.uniform(-3, 3, (ceiling, 3)) * [1, 1, 0] + [0, 0, 4.5]
    wall = rng.uniform(-3, 3, (1500, 3)) * [0, 1, 0.6] + [-3, 0, 1.8]
    objs = rng.normal(0, 0.25, (1500, 3)) + rng.choice([[0.5, 0.3, 0.4], [-0.6, 0, 0.5], [0, -0.7, 0.3]], 1500)
    objs[:, 2] = np.abs(objs[:, 2])
    stray = rng.normal(0, 40, (100, 3))
    return (
        viewmats,
        np.concatenate([flat, above, wall, objs]) + rng.normal(0, 0.01, (floor + ceiling + 3000, 3)),
        stray,
    )


def moved(viewmats, xyz, turn, scale=1.0, shift=(0, 0, 0)):
    """Transform the capture to another frame: x' = scale * turn x + shift."""
    out = viewmats.copy()
    out[:, :3, :3] = viewmats[:, :3, :3] @ turn.T
    out[:, :3, 3] = scale * viewmats[:, :3, 3] - out[:, :3, :3] @ np.asarray(shift, float)
    return out, scale * xyz @ turn.T + shift


def degrees_between(a, b):
    return np.degrees(np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1, 1)))


def proper(upright):
    """Check that rotation and offsets are valid and finite; return the direction that becomes Z."""
    np.testing.assert_allclose(upright.rotation @ upright.rotation.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(upright.rotation) == pytest.approx(1)
    assert np.isfinite(upright.origin).all() and np.isfinite(upright.translation).all()
    return upright.rotation[2]


@pytest.mark.parametrize("seed", range(12))
def test_randomly_rotated_room_is_placed_on_its_floor(seed):
    rng = np.random.default_rng(seed)
    options = [{}, {"arc": 100, "pitch": 45}, {"arc": 50, "pitch": 40}, {"pitch": 70}][seed % 4]
    viewmats, xyz, stray = room(rng, **options)
    turn, scale, shift = Rotation.random(random_state=seed).as_matrix(), 10 ** rng.uniform(-4, 3), rng.normal(0, 1, 3)
    viewmats, xyz = moved(viewmats, np.concatenate([xyz, stray]), turn, scale, scale * shift)
    upright = compute_upright(viewmats, xyz)
    assert degrees_between(proper(upright), turn[:, 2]) < 0.5
    floor = xyz[:3000] @ upright.rotation.T + upright.translation
    assert (upright.origin == 0).all() and np.abs(np.median(floor[:, 2])) < 0.02 * scale
    # It is the smallest such rotation: its axis is perpendicular to Z and to the direction that becomes Z.

    angle = np.degrees(np.linalg.norm(Rotation.from_matrix(upright.rotation).as_rotvec()))
    assert angle == pytest.approx(degrees_between(proper(upright), np.array([0, 0, 1.0])), abs=1e-6)
    again = compute_upright(viewmats, xyz)
    assert all(np.array_equal(getattr(upright, name), getattr(again, name)) for name in ("rotation", "translation"))


@pytest.mark.parametrize(("tilt", "lift"), [(0, 0.0), (1.5, 0.0), (0, 0.05), (0, 3.0), (10, 0.0)])
def test_upright_capture_is_unchanged(tilt, lift):
    viewmats, xyz, _ = room(np.random.default_rng(0))
    viewmats, xyz = moved(viewmats, xyz, Rotation.from_euler("x", tilt, degrees=True).as_matrix(), 1, (5, -3, lift))
    upright = compute_upright(viewmats, xyz)
    proper(upright)
    assert (upright.rotation == np.eye(3)).all() == (tilt < 2)
    assert (upright.translation == 0).all() == (tilt < 2 and lift < 1)
    assert (upright.translation[:2] == 0).all()
    if lift == 3:
        assert upright.translation[2] == pytest.approx(-3, abs=0.02)


def test_rolled_photos_do_not_tilt_result():
    rng = np.random.default_rng(0)
    viewmats, xyz, _ = room(rng, floor=0, ceiling=0, roll=np.where(np.arange(40) % 5 == 0, 90.0, 1.0))
    turn = Rotation.random(random_state=5).as_matrix()
    upright = compute_upright(*moved(viewmats, xyz, turn))
    assert degrees_between(proper(upright), turn[:, 2]) < 4


def test_nadir_photos_have_up_behind_camera():
    rng = np.random.default_rng(0)
    camera_centers = rng.uniform(-5, 5, (40, 3)) * [1, 1, 0] + [0, 0, 8]
    roll = np.where(np.arange(40) % 3 == 0, 180.0, 0.0)
    viewmats = viewmats_looking_at(
        camera_centers, camera_centers + np.array([0, 0.02, -1]) + rng.normal(0, 0.01, (40, 3)), roll
    )
    ground = rng.uniform(-6, 6, (2000, 3)) * [1, 1, 0] + rng.normal(0, 0.02, (2000, 3))
    turn = Rotation.random(random_state=1).as_matrix()
    assert degrees_between(proper(compute_upright(*moved(viewmats, ground, turn))), turn[:, 2]) < 1


def test_cameras_give_up_without_ground_plane():
    rng = np.random.default_rng(0)
    viewmats, _, _ = room(rng, roll=1.0)
    cloud = rng.normal([0, 0, 5], 0.3, (3000, 3))
    turn = Rotation.random(random_state=2).as_matrix()
    viewmats, cloud = moved(viewmats, cloud, turn)
    upright = compute_upright(viewmats, cloud)
    assert degrees_between(proper(upright), turn[:, 2]) < 3
    heights = (cloud @ upright.rotation.T + upright.translation)[:, 2]
    assert 0 < (heights < 0).mean() < 0.05 and np.median(heights) == pytest.approx(0.6, abs=0.1)


def test_wall_is_not_taken_as_ground():
    rng = np.random.default_rng(0)
    viewmats, _, _ = room(rng, arc=60, pitch=10)
    wall = rng.uniform(-2, 2, (3000, 3)) * [0, 1, 1] + [-3, 0, 2]
    assert degrees_between(proper(compute_upright(viewmats, wall)), np.array([0, 0, 1.0])) < 3


@pytest.mark.parametrize("views", [1, 2, 40])
@pytest.mark.parametrize("points", ["four", "one place", "a line", "a line far away", "stray"])
def test_sparse_captures_are_oriented(views, points):
    rng = np.random.default_rng(0)
    viewmats, xyz, _ = room(rng)
    xyz = {
        "four": rng.normal(0, 1, (4, 3)),
        "one place": np.tile([0.3, 0.2, 0.1], (50, 1)),
        "a line": np.linspace(0, 1, 50)[:, None] * [1.0, 2, 0],
        "a line far away": np.linspace(0, 1, 50)[:, None] * [1.0, 2, 0] + 1e7,
        "stray": np.concatenate([xyz, [[1e9, 0, 0], [np.nan, 0, 0]]]),
    }[points]
    turn = Rotation.random(random_state=3).as_matrix()
    upright = compute_upright(*moved(viewmats[:views], xyz, turn))
    assert degrees_between(proper(upright), turn[:, 2]) < (30 if views < 40 else 3)


@pytest.mark.parametrize("upside_down", [False, True])
def test_upside_down_capture_is_flipped(upside_down):
    viewmats, xyz, _ = room(np.random.default_rng(0), roll=0)
    turn = np.diag([1.0, -1, -1]) if upside_down else np.eye(3)
    assert degrees_between(proper(compute_upright(*moved(viewmats, xyz, turn))), turn[:, 2]) < 0.5


def test_distant_coordinates_get_rounded_origin():
    viewmats, xyz, stray = room(np.random.default_rng(0))
    turn = Rotation.random(random_state=4).as_matrix()
    viewmats, xyz = moved(viewmats, np.concatenate([xyz, stray]), turn, 1, (500_000, 4_500_000, 120))
    upright = compute_upright(viewmats, xyz)
    assert degrees_between(proper(upright), turn[:, 2]) < 0.5
    assert np.abs(upright.origin - [500_000, 4_500_000, 120]).max() < 10
    assert (upright.origin == np.round(upright.origin)).all()
    floor = (xyz[:3000] - upright.origin) @ upright.rotation.T + upright.translation
    assert np.abs(np.median(floor[:, 2])) < 0.02 and np.abs(floor).max() < 100


@pytest.mark.parametrize(("name", "held"), [("tabletop", 0.3), ("banana", 0.6)])
@pytest.mark.long
def test_real_captures_are_placed_on_table(tmp_path, name, held):
    if not (DATA / name).is_dir():
        pytest.skip(f"{name} is absent")
    capture = load_capture(DATA / name, tmp_path)
    viewmats, xyz = np.array([view.viewmat for view in capture.views]), capture.points.xyz
    upright = compute_upright(viewmats, xyz)
    up = proper(upright)
    heights = (xyz @ upright.rotation.T + upright.translation)[:, 2]
    camera_centers = (
        -np.einsum("vji,vj->vi", viewmats[:, :3, :3], viewmats[:, :3, 3]) @ upright.rotation.T + upright.translation
    )
    size = np.median(np.linalg.norm(camera_centers, axis=1))
    assert (np.abs(heights) < 0.01 * size).mean() > held, "most points lie on the table"
    assert (heights > -0.02 * size).mean() > 0.9 and (camera_centers[:, 2] > 0.1 * size).all(), (
        "few points lie below the table"
    )
    assert np.degrees(np.abs(np.median(viewmats[:, 0, :3] @ up))) < 3, "photos are nearly level"
    assert degrees_between(-viewmats[:, 1, :3].mean(0), up) < 15
