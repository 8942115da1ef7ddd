# SPDX-License-Identifier: GPL-3.0-or-later
"""Standing a reconstruction on the ground and giving it its true size, by its parent empty alone."""

from __future__ import annotations

from typing import Any

import bpy
from mathutils import Matrix, Vector

from ...backend.shared.errors import InputError
from .kinds import CAMERA, capture_of, kind_of, parent_of

SMALLEST_SINE = 1e-3
"""Three points count as one line below this sine of the angle between them."""


def orient_to_ground(root: bpy.types.Collection, p1: Any, p2: Any, p3: Any) -> None:
    """Turn and lift the reconstruction so that three points, in world coordinates, lie on Z = 0.

    Up is the side of the cameras, or without cameras the side that is up now. The points' center keeps its X and Y.
    Raises InputError where the points lie on one line.
    """
    parent = _parent(root)
    p1, p2, p3 = Vector(p1), Vector(p2), Vector(p3)
    first, second = p2 - p1, p3 - p1
    normal = first.cross(second)
    if normal.length <= SMALLEST_SINE * first.length * second.length or normal.length == 0.0:
        raise InputError("The three points lie on one line; pick three that span the ground.")
    normal.normalize()
    eyes = _camera_centers(root)
    above = sum((eye - p1).dot(normal) for eye in eyes) if eyes else normal.z
    if above < 0.0:
        normal.negate()
    center = (p1 + p2 + p3) / 3.0
    turn = normal.rotation_difference(Vector((0.0, 0.0, 1.0))).to_matrix().to_4x4()
    on_ground = Matrix.Translation((center.x, center.y, 0.0))
    _move(parent, on_ground @ turn @ Matrix.Translation(-center))


def scale_to_distance(root: bpy.types.Collection, p1: Any, p2: Any, distance: float) -> None:
    """Scale the reconstruction about the world's origin so that two points, in world coordinates, are that far apart.

    About the origin, so that what stands on the ground stays there. Raises InputError where the points are one, or
    the distance is not above 0.
    """
    parent = _parent(root)
    apart = (Vector(p2) - Vector(p1)).length
    if apart < 1e-12:
        raise InputError("The two points are at the same place; pick two that are apart.")
    if not 0.0 < distance < float("inf"):
        raise InputError("The distance must be above 0.")
    _move(parent, Matrix.Scale(distance / apart, 4))


def _parent(root: bpy.types.Collection) -> bpy.types.Object:
    parent = parent_of(root)
    if parent is None:
        raise InputError(f"{root.name} has lost the empty that moves it; run Import again.")
    return parent


def _move(parent: bpy.types.Object, transform: Matrix) -> None:
    bpy.context.view_layer.update()
    parent.matrix_world = transform @ parent.matrix_world
    bpy.context.view_layer.update()


def _camera_centers(root: bpy.types.Collection) -> list[Vector]:
    capture = capture_of(root)
    if capture is None:
        return []
    bpy.context.view_layer.update()
    return [obj.matrix_world.translation.copy() for obj in capture.objects if kind_of(obj) == CAMERA]
