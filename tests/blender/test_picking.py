# SPDX-License-Identifier: GPL-3.0-or-later
"""Picking of points by a click."""

from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("bpy")

from objectgs.objectgs_addon.picking.point_picker import PointPicker, nearest

SIZE = (200, 100)


def perspective(near=0.1, far=100.0):
    """Return the world-to-clip matrix of a camera at the origin that looks along -Z, 90 degrees wide."""
    aspect = SIZE[0] / SIZE[1]
    return np.array(
        [
            [1, 0, 0, 0],
            [0, aspect, 0, 0],
            [0, 0, -(far + near) / (far - near), -2 * far * near / (far - near)],
            [0, 0, -1, 0],
        ]
    )


def test_click_picks_nearest_point():
    points = np.array([[0.0, 0, -5], [1, 0, -5]])
    assert nearest(points, perspective(), SIZE, np.array([100, 50]), 12) == 0
    assert nearest(points, perspective(), SIZE, np.array([121, 51]), 12) == 1
    assert nearest(points, perspective(), SIZE, np.array([160, 80]), 12) is None


def test_click_is_in_one_of_four_views():
    """In Quad View, each has its own view of the points."""

    def region(x, y, matrix, kind="WINDOW"):
        data = SimpleNamespace(perspective_matrix=matrix)
        return SimpleNamespace(type=kind, x=x, y=y, width=SIZE[0], height=SIZE[1], data=data)

    from_behind = perspective() @ np.diag([-1.0, 1, -1, 1])
    regions = [region(0, 200, None, "HEADER"), region(0, 0, perspective()), region(200, 0, from_behind)]
    picker = PointPicker.__new__(PointPicker)
    picker.positions, picker.picked = np.array([[0.0, 0, -5], [0, 0, 5]]), []
    context = SimpleNamespace(area=SimpleNamespace(regions=regions))
    for x, y, expected in ((100, 50, (0, 0, -5)), (300, 50, (0, 0, 5)), (300, 150, None)):
        found = picker.pick(context, SimpleNamespace(mouse_x=x, mouse_y=y))
        assert found == (expected is not None) and (not found or picker.picked[-1] == expected)


def test_front_point_occludes_point_behind():
    points = np.array([[0.0, 0, -9], [0.02, 0, -3]])
    assert nearest(points, perspective(), SIZE, np.array([100, 50]), 12) == 1


def test_points_behind_camera_are_not_picked():
    points = np.array([[0.0, 0, 5], [np.nan, 0, -5], [0, 0, 0]])
    assert nearest(points, perspective(), SIZE, np.array([100, 50]), 12) is None
    assert nearest(np.zeros((0, 3)), perspective(), SIZE, np.array([100, 50]), 12) is None
