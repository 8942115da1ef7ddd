# SPDX-License-Identifier: GPL-3.0-or-later
"""Where an object is, as an affine map of the capture's coordinates from where it was captured."""

from __future__ import annotations

import bpy
import numpy as np
from mathutils import Matrix

from ..capture import origin_of
from ..kinds import MESH, OBJECT_PARENT, SPLATS, parent_of, part_of
from ..object_collection import center_of

PLACEMENT = "objectgs_place"
"""On a collection: the place that objects.json had for it when Blender agreed, and `local_placement` then, as JSON."""

EXACT = 1e-5
"""Location, rotation and scale hold a map that they come this close to; the rest of others is put below them."""


def local_placement(root: bpy.types.Collection, collection: bpy.types.Collection) -> np.ndarray | None:
    """(4, 4) float64 the map from the coordinates of an object's parts into the reconstruction's; None where the user
    deleted the empty that it hangs on, or that of the whole.

    The pivot's; where splats or mesh were moved without it, theirs.
    """
    pivot, parent = part_of(collection, OBJECT_PARENT), parent_of(root)
    if pivot is None or parent is None:
        return None
    return _map(pivot, parent) @ _own(collection, pivot)


def placement_of(root: bpy.types.Collection, collection: bpy.types.Collection) -> np.ndarray | None:
    """(4, 4) float64 the map from where an object was captured to where it is, in the capture's coordinates.

    Exactly the identity where nobody moved it; None where `local_placement` is.
    """
    local = local_placement(root, collection)
    if local is None:
        return None
    moved = local @ _shift(-_rest(part_of(collection, OBJECT_PARENT)))
    return _about(moved, origin_of(root))


def set_placement(root: bpy.types.Collection, collection: bpy.types.Collection, place: np.ndarray | None) -> None:
    """Move an object's pivot so that `placement_of` becomes `place` (None: where it was captured)."""
    pivot, parent = part_of(collection, OBJECT_PARENT), parent_of(root)
    if pivot is None or parent is None:
        return
    moved = np.eye(4) if place is None else _about(np.asarray(place, np.float64), -origin_of(root))
    wanted = moved @ _shift(_rest(pivot)) @ np.linalg.inv(_own(collection, pivot))
    if pivot.parent is not None:
        wanted = np.linalg.inv(_map(pivot.parent, parent)) @ wanted
    else:
        wanted = _map(parent, None) @ wanted
    needed = Matrix(wanted.tolist())
    location, rotation, scale = needed.decompose()
    simple = Matrix.LocRotScale(location, rotation, scale)
    size = np.abs(wanted[:3, :3]).max()
    pivot.matrix_parent_inverse.identity()
    pivot.matrix_basis = simple
    if np.abs(np.array(simple) - wanted)[:3, :3].max() > EXACT * size and pivot.parent is not None:
        # Sheared, as what is stretched after a turn.
        pivot.matrix_parent_inverse = needed @ simple.inverted()


def matrix_to_world(obj: bpy.types.Object) -> np.ndarray:
    """(4, 4) float64 the map from a thing's coordinates into the world's, also of what is hidden."""
    return _map(obj, None)


def matrix_to_capture(root: bpy.types.Collection, obj: bpy.types.Object) -> np.ndarray:
    """(4, 4) float64 the map from a thing's coordinates into the capture's."""
    return _shift(origin_of(root)) @ _map(obj, parent_of(root))


def distance_moved(root: bpy.types.Collection, collection: bpy.types.Collection) -> float:
    """How far an object is from where it was captured, in the world's lengths."""
    local, parent = local_placement(root, collection), parent_of(root)
    if local is None:
        return 0.0
    return float(np.linalg.norm(matrix_to_world(parent)[:3, :3] @ (local - rest_placement(collection))[:3, 3]))


def rest_placement(collection: bpy.types.Collection) -> np.ndarray:
    """`local_placement` where nobody moved the object."""
    return _shift(_rest(part_of(collection, OBJECT_PARENT)))


def _own(collection: bpy.types.Collection, pivot: bpy.types.Object) -> np.ndarray:
    """Where the splats, or else the mesh, were moved to beside the pivot that they hang on."""
    for kind in (SPLATS, MESH):
        part = part_of(collection, kind)
        if part is not None and part.parent == pivot:
            own = _map(part, pivot)
            if not np.array_equal(own, np.eye(4)):
                return own
    return np.eye(4)


def _map(obj: bpy.types.Object, above: bpy.types.Object | None) -> np.ndarray:
    """(4, 4) float64 from a thing's coordinates into those of `above`, or of the world.

    From what the user set, since Blender does not know the place of what is hidden; only where constraints or special
    parents have a say, from what Blender has worked out.
    """
    matrix, at = np.eye(4), obj
    while at is not None and at != above:
        if at.constraints or (at.parent is not None and at.parent_type != "OBJECT"):
            matrix, at = np.array(at.matrix_world) @ matrix, None
            break
        basis = np.array(at.matrix_basis, np.float64)
        if at.parent is not None:
            basis = np.array(at.matrix_parent_inverse, np.float64) @ basis
        matrix, at = basis @ matrix, at.parent
    if at is None and above is not None:
        return np.linalg.inv(_map(above, None)) @ matrix
    return matrix


def _rest(pivot: bpy.types.Object) -> np.ndarray:
    """(3,) where the pivot was made, as Blender's single numbers hold it."""
    return center_of(pivot).astype(np.float32).astype(np.float64)


def _shift(by: np.ndarray) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, 3] = by
    return matrix


def _about(matrix: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """The map in coordinates whose origin lies at -`origin` of those it is in."""
    moved = matrix.copy()
    moved[:3, 3] += origin - matrix[:3, :3] @ origin
    return moved
