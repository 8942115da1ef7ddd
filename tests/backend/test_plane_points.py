"""Points on planes without features: where they are, what hides them or is behind them, and what the plan does."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from backend.capture.capture import Points, View
from backend.planning.plane_points import find_plane_points

SIZE = (160, 120)
K = np.array([[150.0, 0, 80], [0, 150.0, 60], [0, 0, 1]])
TABLE, FLOOR, EDGE = 0.0, -0.8, 1.0
"""Heights of the table top and of the floor, and the radius of the former."""
NONE = np.zeros((0, 3))


def camera(angle, height=1.6, away=2.4):
    """Return the world-to-camera matrix of a camera that looks at the middle of the table."""
    center = np.array([away * np.cos(angle), away * np.sin(angle), height])
    forward = -center / np.linalg.norm(center)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ center
    return viewmat


def photo(viewmat, hole):
    """Return a photo of the table above the floor, both without texture, and a hole of this radius in the former."""
    u, v = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    rays = np.stack([(u - 80) / 150, (v - 60) / 150, np.ones_like(u)], -1) @ viewmat[:3, :3]
    center = -viewmat[:3, :3].T @ viewmat[:3, 3]
    at = center + ((TABLE - center[2]) / rays[..., 2])[..., None] * rays
    away = np.hypot(at[..., 0], at[..., 1])
    on_table = (rays[..., 2] < 0) & (away < EDGE) & (away > hole)
    return np.where(on_table[..., None], [210, 200, 190], np.where(rays[..., 2:] < 0, [90, 95, 100], [40, 40, 60]))


def ring(radius, height, count, rng):
    """Return points (count, 3) about a circle."""
    angle = rng.uniform(0, 2 * np.pi, count)
    spread = radius + rng.normal(0, 0.02, count)
    return np.column_stack([spread * np.cos(angle), spread * np.sin(angle), np.full(count, height)])


def points_at(xyz):
    count = len(xyz)
    return Points(xyz, np.zeros((count, 3), np.uint8), np.zeros(count, np.float32), np.arange(count))


@pytest.fixture
def make():
    """Function that returns a capture of the table, with points on its edge, and a few in its middle.

    More points may be anywhere; those below the table are observed through its hole.
    """

    def make(hole=0.0, gains=None, more=NONE, below=NONE, offset=(0.0, 0.0, 0.0)):
        rng = np.random.default_rng(0)
        views, photos, observed, first = [], [], [], 340 + len(more)
        for i in range(12):
            viewmat = camera(2 * np.pi * i / 12)
            center = -viewmat[:3, :3].T @ viewmat[:3, 3]
            crossing = center + (center[2] / (center[2] - below[:, 2:])) * (below - center)
            observed.append(first + np.flatnonzero(np.hypot(crossing[:, 0], crossing[:, 1]) < hole))
            gain = 1.0 if gains is None else gains[i]
            photos.append(np.clip(photo(viewmat, hole) * gain, 0, 255).astype(np.uint8))
            viewmat[:3, 3] -= viewmat[:3, :3] @ np.array(offset)
            views.append(View(f"{i}.png", None, None, K, viewmat, *SIZE, 1))
        on_table = np.concatenate([ring(EDGE - 0.04, TABLE, 300, rng), ring(max(hole + 0.05, 0.1), TABLE, 40, rng)])
        return SimpleNamespace(
            views=views, points=points_at(np.concatenate([on_table, more, below]) + np.array(offset)),
            image=lambda i: photos[i], observed=lambda i: observed[i], train_indices=tuple(range(12)),
        )  # fmt: skip

    return make


def heights(found, height):
    return np.abs(found.xyz[:, 2] - height) < 0.01


def test_a_plain_table_is_filled_up_to_its_edge(make):
    found = find_plane_points(make(), NONE)
    away = np.hypot(found.xyz[:, 0], found.xyz[:, 1])
    assert heights(found, TABLE).all() and (away < EDGE).mean() > 0.97
    assert np.histogram(away, [0.2, 0.5, 0.8])[0].min() > 30, "everywhere between its points"
    assert np.abs(found.rgb[away < 0.9].astype(int) - [210, 200, 190]).max() <= 1
    assert 0.05 < found.fraction < 0.4


def test_coordinates_far_from_the_origin_change_nothing(make):
    found, moved = find_plane_points(make(), NONE), find_plane_points(make(offset=(3e5, -2e5, 1e3)), NONE)
    assert len(moved.xyz) == pytest.approx(len(found.xyz), rel=0.05)
    assert (np.abs(moved.xyz[:, 2] - 1e3) < 0.01).all()


def test_a_surface_goes_on_beyond_its_points_up_to_a_step_of_color(make):
    """With points on spots of the table alone, and none on its edge."""
    rng, capture = np.random.default_rng(1), make()
    spots = np.array([[0.5, 0, 0], [0, 0.5, 0], [-0.5, 0, 0], [0, -0.5, 0]])
    capture.points = points_at(np.concatenate([ring(0.03, TABLE, 60, rng) + spot for spot in spots]))
    capture.observed = lambda _: np.zeros(0, np.int64)
    away = np.hypot(*find_plane_points(capture, NONE).xyz[:, :2].T)
    assert ((away > 0.6) & (away < 0.95)).sum() > 50 and (away < EDGE + 0.05).mean() > 0.97


def test_what_shows_points_behind_is_no_surface(make):
    rng = np.random.default_rng(2)
    below = np.column_stack([rng.uniform(-1.5, 1.5, (600, 2)), np.full(600, FLOOR)])
    inside = []
    for hole in (0.6, 0.0):
        found = find_plane_points(make(hole=hole, below=below), NONE)
        inside.append((np.hypot(*found.xyz[heights(found, TABLE), :2].T) < 0.5).sum())
    assert inside[0] < 0.1 * inside[1]


def test_a_floor_is_not_found_where_the_table_hides_it(make):
    rng = np.random.default_rng(3)
    found = find_plane_points(make(more=ring(1.9, FLOOR, 80, rng)), NONE)
    on_floor = found.xyz[heights(found, FLOOR)]
    assert len(on_floor) > 20 and heights(found, TABLE).sum() > 100
    assert (heights(found, TABLE) | heights(found, FLOOR)).all()
    assert np.hypot(on_floor[:, 0], on_floor[:, 1]).min() > 0.22, "cameras see it up to 0.3"


def test_exposure_of_single_photos_does_not_count(make):
    gains = 2.0 ** np.random.default_rng(4).uniform(-0.7, 0.2, 12)
    found, plain = find_plane_points(make(gains=gains), NONE), find_plane_points(make(), NONE)
    assert len(found.xyz) > 0.9 * len(plain.xyz)


def test_surfaces_with_points_get_no_more(make):
    rng = np.random.default_rng(5)
    angle, away = rng.uniform(0, 2 * np.pi, 20_000), EDGE * np.sqrt(rng.uniform(0, 1, 20_000))
    dense = np.column_stack([away * np.cos(angle), away * np.sin(angle), np.full(20_000, TABLE)])
    assert find_plane_points(make(more=dense), NONE).fraction < 0.02
    assert find_plane_points(make(), dense).fraction < 0.02


@pytest.mark.parametrize("count", [0, 1, 17, 40])
def test_too_few_points_have_no_planes(make, count):
    capture = make()
    capture.points, capture.observed = points_at(capture.points.xyz[:count]), lambda _: np.zeros(0, np.int64)
    found = find_plane_points(capture, NONE)
    assert found.fraction == 0 and found.xyz.shape == found.rgb.shape == (0, 3)


def test_points_on_a_line_or_in_one_place_have_no_plane(make):
    capture = make()
    for direction in ([1.0, 0, 0], [0.0, 0, 0]):
        capture.points = points_at(np.outer(np.linspace(-1, 1, 200), direction))
        capture.observed = lambda _: np.zeros(0, np.int64)
        assert not len(find_plane_points(capture, NONE).xyz)
