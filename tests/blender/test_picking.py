# SPDX-License-Identifier: GPL-3.0-or-later
"""Picking of points by a click."""

import numpy as np
import pytest

pytest.importorskip("bpy")

from objectgs.objectgs_addon.picking.point_picker import nearest

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


def test_front_point_occludes_point_behind():
    points = np.array([[0.0, 0, -9], [0.02, 0, -3]])
    assert nearest(points, perspective(), SIZE, np.array([100, 50]), 12) == 1


def test_points_behind_camera_are_not_picked():
    points = np.array([[0.0, 0, 5], [np.nan, 0, -5], [0, 0, 0]])
    assert nearest(points, perspective(), SIZE, np.array([100, 50]), 12) is None
    assert nearest(np.zeros((0, 3)), perspective(), SIZE, np.array([100, 50]), 12) is None
