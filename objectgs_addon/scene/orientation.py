# SPDX-License-Identifier: GPL-3.0-or-later
"""Orientation to the ground and metric scale of a reconstruction, applied to its parent empty."""

from __future__ import annotations

from typing import Any

import bpy
from mathutils import Matrix, Vector

from ...backend.shared.errors import InputError
from .cameras import widen_clipping
from .edits.axes import renew_axes
from .edits.placement import matrix_to_world
from .kinds import CAMERA, capture_of, kind_of, require_parent

SMALLEST_SINE = 1e-3
"""Three points are collinear if the sine of the angle between them is at most this."""


def orient_to_ground(root: bpy.types.Collection, p1: Any, p2: Any, p3: Any) -> None:
    """Rotate and translate the reconstruction so that three points lie on the plane Z = 0.

    The side of the cameras, or without cameras the side that is currently up, faces up. The center of the points keeps
    its X and Y.

    Args:
        root: the reconstruction's collection.
        p1: first point in world coordinates.
        p2: second point in world coordinates.
        p3: third point in world coordinates.

    Raises:
        InputError: The points are collinear, or the parent empty is missing.
    """
    parent = require_parent(root)
    p1, p2, p3 = Vector(p1), Vector(p2), Vector(p3)
    first, second = p2 - p1, p3 - p1
    normal = first.cross(second)
    if normal.length <= SMALLEST_SINE * first.length * second.length or normal.length == 0.0:
        raise InputError("The three points lie on one line; pick three that span the ground.")
    normal.normalize()
    camera_centers = _camera_centers(root)
    above = sum((camera_center - p1).dot(normal) for camera_center in camera_centers) if camera_centers else normal.z
    if above < 0.0:
        normal.negate()
    center = (p1 + p2 + p3) / 3.0
    turn = normal.rotation_difference(Vector((0.0, 0.0, 1.0))).to_matrix().to_4x4()
    on_ground = Matrix.Translation((center.x, center.y, 0.0))
    _move(root, parent, on_ground @ turn @ Matrix.Translation(-center))


def scale_to_distance(root: bpy.types.Collection, p1: Any, p2: Any, distance: float) -> None:
    """Scale the reconstruction about the world origin so that two points have the given distance.

    Scaling about the origin keeps the ground at Z = 0.

    Args:
        root: the reconstruction's collection.
        p1: first point in world coordinates.
        p2: second point in world coordinates.
        distance: wanted distance between the points.

    Raises:
        InputError: The points coincide, the distance is not positive and finite, or the parent empty is missing.
    """
    parent = require_parent(root)
    apart = (Vector(p2) - Vector(p1)).length
    if apart < 1e-12:
        raise InputError("The two points coincide; pick two different points.")
    if not 0.0 < distance < float("inf"):
        raise InputError("The distance must be greater than 0.")
    _move(root, parent, Matrix.Scale(distance / apart, 4))
    widen_clipping(root)


def _move(root: bpy.types.Collection, parent: bpy.types.Object, transform: Matrix) -> None:
    bpy.context.view_layer.update()
    parent.matrix_world = transform @ parent.matrix_world
    renew_axes(root, parent)
    bpy.context.view_layer.update()


def _camera_centers(root: bpy.types.Collection) -> list[Vector]:
    capture = capture_of(root)
    if capture is None:
        return []
    bpy.context.view_layer.update()
    # Blender does not update the matrices of cameras in a collection that is excluded from the view layer.
    return [Vector(matrix_to_world(obj)[:3, 3]) for obj in capture.objects if kind_of(obj) == CAMERA]
