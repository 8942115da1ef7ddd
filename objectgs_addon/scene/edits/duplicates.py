# SPDX-License-Identifier: GPL-3.0-or-later
"""Duplicates of objects: collections whose parts share the data of the original's parts."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np

from ..kinds import (
    ANCHORS,
    DUPLICATE,
    MESH,
    MESH_KEY,
    OBJECT,
    OBJECT_PARENT,
    SPLATS,
    duplicates_of,
    kind_of,
    mark,
    object_collections,
    object_id_of,
    part_of,
    parts_of,
)
from ..object_collection import NAME
from .axes import attach, part_axes, set_local_map
from .placement import PLACEMENT, matrix_to_world, pivot_above, placement_of, set_placement

DUPLICATES = "objectgs_copies"
"""Custom property of an object's collection: placements of its duplicates at the last sync with objects.json (JSON)."""

_CARRIERS = (SPLATS, ANCHORS)


def duplicate(root: bpy.types.Collection, source: bpy.types.Collection) -> bpy.types.Collection:
    """Duplicate an object or one of its duplicates in place, with all Blender objects in its collection.

    The original's sliders also control the duplicate.

    Args:
        root: the reconstruction's collection.
        source: the collection of the object or duplicate.

    Returns:
        The collection of the new duplicate.
    """
    copy = _new_collection(root, source)
    twins = {obj: obj.copy() for obj in source.objects}
    for obj, twin in twins.items():
        if obj.parent in twins:
            inverse = twin.matrix_parent_inverse.copy()
            twin.parent = twins[obj.parent]
            twin.matrix_parent_inverse = inverse
        copy.objects.link(twin)
    return copy


def remove_duplicate(copy: bpy.types.Collection) -> None:
    """Remove a duplicate and the Blender objects that are only in its collection; the data stays with the original."""
    for obj in list(copy.objects):
        if len(obj.users_collection) == 1:
            bpy.data.objects.remove(obj)
    bpy.data.collections.remove(copy)


def adopt_blender_duplicates(root: bpy.types.Collection) -> None:
    """Convert what the user duplicated with Blender's own operators to duplicates, each in its own collection.

    This applies to whole collections, to pivots with their children, and to splats alone. A mesh duplicated alone is
    left to the user, who may have another use for it.
    """
    originals = object_collections(root)
    for collection in root.children_recursive:
        if kind_of(collection) == OBJECT and collection not in originals.values():
            mark(collection, DUPLICATE, object_id_of(collection))
            for name in (PLACEMENT, DUPLICATES):
                if name in collection:
                    del collection[name]
    for collection in root.children_recursive:
        if kind_of(collection) not in (OBJECT, DUPLICATE):
            continue
        pivots = [obj for obj in collection.objects if kind_of(obj) == OBJECT_PARENT]
        parts = _parts_by_pivot(collection, pivots)
        for pivot in pivots[1:]:
            copy = _new_collection(root, collection)
            for obj in [pivot, *parts[pivot]]:
                copy.objects.link(obj)
                collection.objects.unlink(obj)
        splats = [obj for obj in collection.objects if kind_of(obj) == SPLATS]
        for obj in splats[1:] if pivots else ():
            copy = _new_collection(root, collection)
            copy.objects.link(obj)
            collection.objects.unlink(obj)
            pivot = pivots[0].copy()
            copy.objects.link(pivot)
            own = np.linalg.inv(matrix_to_world(pivot)) @ matrix_to_world(obj)
            obj.parent = pivot
            set_local_map(obj, own)
            place = placement_of(root, copy)
            set_local_map(obj, part_axes(pivot))
            set_placement(root, copy, place)


def _parts_by_pivot(
    collection: bpy.types.Collection, pivots: list[bpy.types.Object]
) -> dict[bpy.types.Object, list[bpy.types.Object]]:
    """Map the pivots in a collection to their children and, if the user has cleared or changed those, to other parts.

    Parts below none of the pivots are in their order, as they were duplicated together. A mesh with another parent than
    the splats serves another purpose.
    """
    inside = collection.objects[:]
    found = {pivot: [child for child in pivot.children if child in inside] for pivot in pivots}
    apart = [obj for obj in inside if kind_of(obj) in (*_CARRIERS, MESH) and pivot_above(obj) not in pivots]
    above = {obj.parent for obj in apart if kind_of(obj) == SPLATS}
    apart = [obj for obj in apart if kind_of(obj) != MESH or obj.parent in above]
    for key in dict.fromkeys(map(_key, apart)):
        waiting = [pivot for pivot in pivots if key not in map(_key, found[pivot])]
        for pivot, obj in zip(waiting, [obj for obj in apart if _key(obj) == key]):
            found[pivot].append(obj)
    return found


def bring_up_to_date(root: bpy.types.Collection) -> None:
    """Sync the parts of duplicates with their originals; remove duplicates whose original no longer exists."""
    originals = object_collections(root)
    for object_id, copies in duplicates_of(root).items():
        for copy in copies:
            if object_id in originals:
                _follow(originals[object_id], copy)
            else:
                remove_duplicate(copy)


def _follow(source: Any, copy: Any) -> None:
    pivot = part_of(copy, OBJECT_PARENT)
    there = {_key(obj): obj for obj in parts_of(copy) if kind_of(obj) in (*_CARRIERS, MESH)}
    for obj in [obj for obj in parts_of(source) if kind_of(obj) in (*_CARRIERS, MESH)]:
        twin = there.pop(_key(obj), None)
        if twin is None:
            twin = obj.copy()
            attach(twin, pivot)
            if pivot is not None and pivot_above(obj) not in source.objects[:]:
                _move_beside(twin, obj, source, copy)
            copy.objects.link(twin)
        elif kind_of(obj) in _CARRIERS and twin.data != obj.data:
            old, twin.data = twin.data, obj.data
            if old.users == 0:
                bpy.data.meshes.remove(old)
        twin.hide_viewport, twin.hide_render = obj.hide_viewport, obj.hide_render
    for gone in there.values():
        bpy.data.objects.remove(gone)


def _move_beside(twin: bpy.types.Object, obj: bpy.types.Object, source: Any, copy: Any) -> None:
    """Move the twin of a part without its pivot to where that is relative to the splats, or else to the pivot."""
    pairs = ((part_of(source, kind), part_of(copy, kind)) for kind in (SPLATS, OBJECT_PARENT))
    for base, other in pairs:
        if base is not None and other is not None:
            local = np.linalg.inv(matrix_to_world(base)) @ matrix_to_world(obj)
            set_local_map(twin, np.linalg.inv(matrix_to_world(twin.parent)) @ matrix_to_world(other) @ local)
            return


def _key(obj: bpy.types.Object) -> tuple:
    return kind_of(obj), str(obj.get(MESH_KEY, ""))


def _new_collection(root: bpy.types.Collection, source: Any) -> bpy.types.Collection:
    copy = bpy.data.collections.new(source[NAME])
    for name, value in source.items():
        if name.startswith("objectgs_") and name not in (PLACEMENT, DUPLICATES):
            copy[name] = value
    mark(copy, DUPLICATE, object_id_of(source))
    copy.hide_viewport, copy.hide_render = source.hide_viewport, source.hide_render
    copy.color_tag = source.color_tag
    above = next((each for each in (root, *root.children_recursive) if source in each.children[:]), root)
    above.children.link(copy)
    return copy
