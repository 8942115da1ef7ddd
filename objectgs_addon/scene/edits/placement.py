# SPDX-License-Identifier: GPL-3.0-or-later
"""Placement of objects: an affine map in capture coordinates from the captured pose to the current one."""

from __future__ import annotations

import bpy
import numpy as np

from ....backend.shared.errors import InputError
from ....backend.shared.reconstruction.objects import is_singular
from .. import carrier
from ..capture import origin_of
from ..kinds import ANCHORS, MESH, OBJECT_PARENT, SPLATS, kind_of, parent_of, part_of, parts_of, require_parent
from ..object_collection import center_of
from .axes import map_to, part_axes, set_local_map

PLACEMENT = "objectgs_place"
"""Custom property of a collection: its placement in objects.json and its `local_placement` at the last sync (JSON)."""

ROUNDING = 1e-6
"""Largest difference of two transforms that counts as rounding, relative to their largest number or 1."""


def local_placement(root: bpy.types.Collection, collection: bpy.types.Collection) -> np.ndarray | None:
    """Return the map from an object's local coordinates to reconstruction coordinates, (4, 4) float64.

    It is the map of the pivot, or that of the splats or mesh if they were moved relative to the pivot. The result is
    None if the user deleted the pivot or the reconstruction's parent empty.
    """
    pivot, parent = part_of(collection, OBJECT_PARENT), parent_of(root)
    if pivot is None or parent is None:
        return None
    local = map_to(pivot, parent) @ _own(collection, pivot)
    rest = _shift(_rest(pivot))
    return rest if is_rounding(pivot, local - rest) else local


def placement_of(root: bpy.types.Collection, collection: bpy.types.Collection) -> np.ndarray | None:
    """Return the map from an object's captured pose to its current one in capture coordinates, (4, 4) float64.

    It is exactly the identity if the object was not moved, and None if `local_placement` is None.
    """
    local = local_placement(root, collection)
    if local is None:
        return None
    moved = local @ _shift(-_rest(part_of(collection, OBJECT_PARENT)))
    return about(moved, origin_of(root))


def is_moved(root: bpy.types.Collection, collection: bpy.types.Collection) -> bool:
    """Return whether an object is not where it was captured."""
    place = placement_of(root, collection)
    return place is not None and not np.allclose(about(place, -origin_of(root)), np.eye(4), ROUNDING, ROUNDING)


def set_placement(root: bpy.types.Collection, collection: bpy.types.Collection, place: np.ndarray | None) -> None:
    """Move an object so that `placement_of` returns `place`; None restores the captured pose.

    This moves the pivot, and parts that the user has given another parent, also that of another object, or none.
    """
    pivot, parent = part_of(collection, OBJECT_PARENT), parent_of(root)
    if pivot is None or parent is None:
        return
    apart = {part: map_to(part, pivot) for part in _own_parts(collection, pivot) if pivot_above(part) != pivot}
    moved = np.eye(4) if place is None else about(np.asarray(place, np.float64), -origin_of(root))
    wanted = moved @ _shift(_rest(pivot)) @ np.linalg.inv(_own(collection, pivot))
    if pivot.parent is not None:
        wanted = np.linalg.inv(map_to(pivot.parent, parent)) @ wanted
    else:
        wanted = map_to(parent, None) @ wanted
    set_local_map(pivot, wanted)
    for part, own in apart.items():
        world = matrix_to_world(pivot) @ own
        set_local_map(part, world if part.parent is None else np.linalg.inv(matrix_to_world(part.parent)) @ world)


def reset_placement(root: bpy.types.Collection, collection: bpy.types.Collection) -> None:
    """Move an object and its individually moved parts back to the captured pose, with the pivot as their parent."""
    pivot = part_of(collection, OBJECT_PARENT)
    for part in _own_parts(collection, pivot) if pivot is not None else ():
        part.parent = pivot
        set_local_map(part, part_axes(pivot) @ np.linalg.inv(carrier.applied_map(part.data)))
    set_placement(root, collection, None)


def move_to_transforms(mesh: bpy.types.Mesh) -> None:
    """Give what Blender's operators have applied to a mesh back to the transforms of its objects.

    The caller restores the vertices.
    """
    applied = carrier.applied_map(mesh)
    if np.array_equal(applied, np.eye(4)):
        return
    for obj in [obj for obj in bpy.data.objects if obj.data == mesh]:
        set_local_map(obj, map_to(obj, obj.parent) @ applied)


def take_back(mesh: bpy.types.Mesh) -> None:
    """Undo what Blender's operators have applied to the vertices of splats; their scale and rotation have not changed.

    Splats in Edit Mode and those of other .blend files are left as they are.
    """
    applied = carrier.applied_map(mesh)
    if np.array_equal(applied, np.eye(4)) or mesh.is_editmode or mesh.library is not None:
        return
    move_to_transforms(mesh)
    back = np.linalg.inv(applied)
    positions = carrier.read(mesh, "position").astype(np.float64) @ back[:3, :3].T + back[:3, 3]
    carrier.write(mesh, "position", "FLOAT_VECTOR", positions)
    mesh.update()
    carrier.remember_positions(mesh)


def matrix_to_world(obj: bpy.types.Object) -> np.ndarray:
    """Return the map from local to world coordinates of a Blender object, also if it is hidden, (4, 4) float64."""
    return map_to(obj, None)


def matrix_to_capture(root: bpy.types.Collection, obj: bpy.types.Object) -> np.ndarray:
    """Return the map from local to capture coordinates of a Blender object, (4, 4) float64."""
    return _shift(origin_of(root)) @ map_to(obj, parent_of(root))


def matrix_of_root(root: bpy.types.Collection) -> np.ndarray:
    """Return the map from capture coordinates relative to the origin to the world, (4, 4) float64.

    Raises:
        InputError: The parent empty is missing, or scaled to zero.
    """
    world = matrix_to_world(require_parent(root))
    if is_singular(world):
        raise InputError(f"{root.name} is scaled to zero by its parent; set a scale other than zero.")
    return world


def distance_moved(root: bpy.types.Collection, collection: bpy.types.Collection) -> float:
    """Return the distance of an object from its captured position in world units."""
    local, parent = local_placement(root, collection), parent_of(root)
    if local is None:
        return 0.0
    return float(np.linalg.norm(matrix_to_world(parent)[:3, :3] @ (local - rest_placement(collection))[:3, 3]))


def rest_placement(collection: bpy.types.Collection) -> np.ndarray:
    """Return the `local_placement` of an object that was not moved."""
    return _shift(_rest(part_of(collection, OBJECT_PARENT)))


def _own(collection: bpy.types.Collection, pivot: bpy.types.Object) -> np.ndarray:
    """Return the map of the splats, or else of the mesh, relative to the pivot; exactly `part_axes` if not moved.

    What Blender's operators have applied to the vertices counts as part of it.
    """
    rest = part_axes(pivot)
    for kind in (SPLATS, MESH):
        part = part_of(collection, kind)
        # A mesh of which the user has cleared or changed the parent alone serves another purpose.
        if part is not None and (kind == SPLATS or part.parent in (pivot, pivot.parent)):
            own = map_to(part, pivot) @ carrier.applied_map(part.data)
            if np.array_equal(own, rest):
                continue
            base = matrix_to_world(pivot)
            if np.abs(base @ (own - rest)).max() > ROUNDING * np.abs(base @ rest).max():
                return own
    return rest


def _own_parts(collection: bpy.types.Collection, pivot: bpy.types.Object) -> list[bpy.types.Object]:
    """Return the parts of the object with this pivot, without those of copies that the user made with Blender."""
    parts = [part for part in parts_of(collection) if kind_of(part) in (SPLATS, ANCHORS, MESH)]
    others = {other for other in parts_of(collection) if kind_of(other) == OBJECT_PARENT and other != pivot}
    return [part for part in parts if pivot_above(part) not in others]


def pivot_above(part: bpy.types.Object) -> bpy.types.Object | None:
    """Return the pivot that a part is parented to, also through other objects; None without one."""
    above = part.parent
    while above is not None and kind_of(above) != OBJECT_PARENT:
        above = above.parent
    return above


def is_rounding(pivot: bpy.types.Object, difference: np.ndarray) -> bool:
    """Return whether two maps of `local_placement` differ, by (4, 4), no more than single precision explains."""
    shift = np.array(pivot.matrix_parent_inverse.translation)
    size = max(1.0, np.abs(_rest(pivot)).max(), np.abs(shift).max())
    turned, moved = np.abs(difference[:3, :3]).max(), np.abs(difference[:3, 3]).max()
    return bool(turned <= 2.0 * ROUNDING and moved <= ROUNDING * size)


def _rest(pivot: bpy.types.Object) -> np.ndarray:
    """Return the pivot's (3,) initial position, rounded to Blender's single precision."""
    return center_of(pivot).astype(np.float32).astype(np.float64)


def _shift(by: np.ndarray) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, 3] = by
    return matrix


def about(matrix: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Return the map `matrix` (4, 4) expressed in coordinates that are shifted by `origin` (3,)."""
    moved = matrix.copy()
    moved[:3, 3] += origin - matrix[:3, :3] @ origin
    return moved
