# SPDX-License-Identifier: GPL-3.0-or-later
"""Maps between Blender objects and their parents, and the axes in which the transforms of pivots are given.

A pivot's location, rotation and scale are in the axes of the world: its parent inverse takes back the parent empty, as
*Set Parent to Object* does it, and those of its parts turn these instead. Pivots of files that were saved before that
have no `AXES`; theirs are in the axes of the capture.
"""

from __future__ import annotations

from itertools import chain

import bpy
import numpy as np
from mathutils import Matrix

from ....backend.shared.reconstruction.objects import is_singular
from ..kinds import ANCHORS, MESH, OBJECT_PARENT, PARENT, SPLATS, duplicates_of, kind_of, object_collections, part_of

AXES = "objectgs_axes"
"""Custom property of a pivot: the parent empty's map to the world for which its transform is in the world's axes."""

EXACT = 1e-5
"""Largest relative error of a map as location, rotation and scale; beyond it, the parent inverse stores the rest."""

DIGITS = 12
"""Decimals to which a local transform is rounded, so that what was not moved gets exactly the identity."""


def give_axes(pivot: bpy.types.Object, parent: bpy.types.Object) -> None:
    """Let the transform of a pivot be in the axes of the world while the parent empty stays as it is.

    The caller sets the transforms of the pivot and its parts. A parent empty that is scaled to zero changes nothing.
    """
    world = _axes_of_world(parent)
    if not is_singular(world):
        pivot[AXES] = world.reshape(-1).tolist()


def renew_axes(root: bpy.types.Collection, parent: bpy.types.Object) -> None:
    """Let transforms be in the axes of the world again after the add-on has moved the parent empty.

    Nothing moves. Pivots that are animated keep their axes, since their keyframes are in these, and where the parent
    empty has not moved, transforms keep the numbers that the user has given them.
    """
    world = _axes_of_world(parent)
    collections = chain(object_collections(root).values(), *duplicates_of(root).values())
    pivots = [
        pivot
        for pivot in (part_of(collection, OBJECT_PARENT) for collection in collections)
        if pivot is not None
        and AXES in pivot
        and pivot.parent == parent
        and not (pivot.animation_data or pivot.constraints or np.array_equal(_axes(pivot), world))
    ]
    if not pivots or is_singular(world):
        return
    # For each pivot, Blender would search all objects for its children.
    children: dict[bpy.types.Object, list[bpy.types.Object]] = {}
    for obj in bpy.data.objects:
        children.setdefault(obj.parent, []).append(obj)
    for pivot in pivots:
        local, before = map_to(pivot, parent), np.linalg.inv(part_axes(pivot))
        give_axes(pivot, parent)
        after = part_axes(pivot)
        for child in children.get(pivot, ()):
            relative = np.round(before @ np.array(child.matrix_parent_inverse, np.float64), DIGITS)
            child.matrix_parent_inverse = Matrix((after @ relative).tolist())
        set_local_map(pivot, local @ np.linalg.inv(after @ before))
        pivot.empty_display_size *= length_scale(after @ before)


def length_scale(matrix: np.ndarray) -> float:
    """Return the factor by which a map (4, 4) scales lengths, on average over all directions."""
    return float(np.abs(np.linalg.det(matrix[:3, :3])) ** (1 / 3))


def part_axes(above: bpy.types.Object | None) -> np.ndarray:
    """Return the map from local coordinates of parts that were not moved to those of what is above them, (4, 4).

    It is the identity but for pivots with the axes of the world, and exact in Blender's single precision.
    """
    found = np.eye(4)
    found[:3, :3] = _axes(above)[:3, :3]
    return found


def put_below(obj: bpy.types.Object, above: bpy.types.Object | None) -> None:
    """Set the parent of a part or pivot with the parent inverse that belongs to it, and keep its own transform."""
    obj.parent = above
    obj.matrix_parent_inverse = Matrix(_parent_inverse(obj).tolist())


def attach(part: bpy.types.Object, pivot: bpy.types.Object | None) -> None:
    """Give a part another pivot, and keep how the user has moved it relative to the previous one."""
    moved = np.eye(4)
    if kind_of(part.parent) == OBJECT_PARENT:
        moved = np.linalg.inv(part_axes(part.parent)) @ map_to(part, part.parent)
    part.parent = pivot
    set_local_map(part, part_axes(pivot) @ moved)


def set_local_map(obj: bpy.types.Object, wanted: np.ndarray) -> None:
    """Set the map from an object's local coordinates to those of its parent or, without one, the world, (4, 4)."""
    inverse = _parent_inverse(obj)
    needed = Matrix(np.round(np.linalg.inv(inverse) @ wanted, DIGITS).tolist())
    location, rotation, scale = needed.decompose()
    simple = Matrix.LocRotScale(location, rotation, scale)
    obj.matrix_parent_inverse = Matrix(inverse.tolist())
    obj.matrix_basis = simple
    difference = np.array(simple)[:3, :3] - np.array(needed)[:3, :3]
    if np.abs(difference).max() > EXACT * np.abs(np.array(needed)[:3, :3]).max() and obj.parent is not None:
        # The map contains shear, such as a nonuniform scale after a rotation.
        obj.matrix_parent_inverse = Matrix(inverse.tolist()) @ needed @ simple.inverted()


def map_to(obj: bpy.types.Object, above: bpy.types.Object | None) -> np.ndarray:
    """Return the map from local coordinates of `obj` to those of `above` or, if None, the world, (4, 4) float64.

    It is computed from the local transforms, since Blender does not evaluate hidden objects. Only constraints and
    parent types other than Object require Blender's evaluated matrix.
    """
    matrix, at = np.eye(4), obj
    while at is not None and at != above:
        if at.constraints or (at.parent is not None and at.parent_type != "OBJECT"):
            matrix, at = np.array(at.matrix_world) @ matrix, None
            break
        basis = np.array(at.matrix_basis, np.float64)
        if at.parent is not None:
            basis = _current_inverse(at) @ basis
        matrix, at = basis @ matrix, at.parent
    if at is None and above is not None:
        return np.linalg.inv(map_to(above, None)) @ matrix
    return matrix


def _current_inverse(obj: bpy.types.Object) -> np.ndarray:
    """Return the parent inverse of an object, (4, 4) float64, not rounded if it is as `put_below` sets it."""
    stored, exact = np.array(obj.matrix_parent_inverse, np.float64), _parent_inverse(obj)
    return exact if np.array_equal(exact.astype(np.float32), stored) else stored


def _axes_of_world(parent: bpy.types.Object) -> np.ndarray:
    """Return the `AXES` of pivots below a parent empty as it is, (4, 4) float64."""
    world = map_to(parent, None)
    world[:3, :3] = world[:3, :3].astype(np.float32)  # As Blender stores it for the parts.
    return world


def _axes(pivot: bpy.types.Object | None) -> np.ndarray:
    """Return the map of a pivot's `AXES`, (4, 4) float64; the identity without them."""
    return np.eye(4) if pivot is None or AXES not in pivot else np.array(pivot[AXES], np.float64).reshape(4, 4)


def _parent_inverse(obj: bpy.types.Object) -> np.ndarray:
    """Return the parent inverse that belongs to a part or a pivot below its parent, (4, 4) float64."""
    above, kind = obj.parent, kind_of(obj)
    if kind == OBJECT_PARENT and kind_of(above) == PARENT:
        return np.linalg.inv(_axes(obj))
    return part_axes(above) if kind in (SPLATS, ANCHORS, MESH) else np.eye(4)
