# SPDX-License-Identifier: GPL-3.0-or-later
"""Duplicates of objects: a collection each, whose parts share the data of the object's own."""

import bpy

from .kinds import (
    ANCHORS,
    COPY,
    MESH,
    MESH_KEY,
    OBJECT,
    OBJECT_PARENT,
    SPLATS,
    copies_of,
    kind_of,
    mark,
    object_collections,
    object_id_of,
    part_of,
    parts_of,
)
from .object_collection import NAME
from .places import PLACE, place_of, put

COPIES = "objectgs_copies"
"""On an object's collection: where objects.json has its duplicates, as of when Blender agreed with it, as JSON."""

_CARRIERS = (SPLATS, ANCHORS)


def duplicate(root: bpy.types.Collection, source: bpy.types.Collection) -> bpy.types.Collection:
    """A duplicate of an object, or of a duplicate of it, in the same place; all that lies in its collection comes
    along. The original's sliders work on it, too."""
    copy = _new_collection(root, source)
    twins = {thing: thing.copy() for thing in source.objects}
    for thing, twin in twins.items():
        if thing.parent in twins:
            inverse = twin.matrix_parent_inverse.copy()
            twin.parent = twins[thing.parent]
            twin.matrix_parent_inverse = inverse
        copy.objects.link(twin)
    return copy


def remove_copy(copy: bpy.types.Collection) -> None:
    """Remove a duplicate with all that lies only in it; the data stays with the original."""
    for thing in list(copy.objects):
        if len(thing.users_collection) == 1:
            bpy.data.objects.remove(thing)
    bpy.data.collections.remove(copy)


def adopt_duplicates(root: bpy.types.Collection) -> None:
    """Make what the user duplicated with Blender's own means duplicates of ours, each in its own collection.

    That is: a whole collection; an object's pivot with the parts that hang on it; its splats alone. A mesh alone, which
    may be on its way to becoming something else, stays the user's.
    """
    originals = object_collections(root)
    for collection in root.children_recursive:
        if kind_of(collection) == OBJECT and collection not in originals.values():
            mark(collection, COPY, object_id_of(collection))
            for name in (PLACE, COPIES):
                if name in collection:
                    del collection[name]
    for collection in root.children_recursive:
        if kind_of(collection) not in (OBJECT, COPY):
            continue
        pivots = [thing for thing in collection.objects if kind_of(thing) == OBJECT_PARENT]
        for pivot in pivots[1:]:
            copy = _new_collection(root, collection)
            for thing in [pivot, *(child for child in pivot.children if child in collection.objects[:])]:
                copy.objects.link(thing)
                collection.objects.unlink(thing)
        splats = [thing for thing in collection.objects if kind_of(thing) == SPLATS]
        for thing in splats[1:] if pivots else ():
            copy = _new_collection(root, collection)
            copy.objects.link(thing)
            collection.objects.unlink(thing)
            pivot = pivots[0].copy()
            copy.objects.link(pivot)
            thing.parent = pivot
            place = place_of(root, copy)
            thing.matrix_parent_inverse.identity()
            thing.matrix_basis.identity()
            put(root, copy, place)


def bring_up_to_date(root: bpy.types.Collection) -> None:
    """Give duplicates the parts that their originals have now; those of objects that are gone go."""
    originals = object_collections(root)
    for object_id, copies in copies_of(root).items():
        for copy in copies:
            if object_id in originals:
                _follow(originals[object_id], copy)
            else:
                remove_copy(copy)


def _follow(source, copy) -> None:
    pivot = part_of(copy, OBJECT_PARENT)
    there = {_key(thing): thing for thing in parts_of(copy) if kind_of(thing) in (*_CARRIERS, MESH)}
    for thing in [thing for thing in parts_of(source) if kind_of(thing) in (*_CARRIERS, MESH)]:
        twin = there.pop(_key(thing), None)
        if twin is None:
            twin = thing.copy()
            twin.parent = pivot
            copy.objects.link(twin)
        elif kind_of(thing) in _CARRIERS and twin.data != thing.data:
            old, twin.data = twin.data, thing.data
            if old.users == 0:
                bpy.data.meshes.remove(old)
        twin.hide_viewport, twin.hide_render = thing.hide_viewport, thing.hide_render
    for gone in there.values():
        bpy.data.objects.remove(gone)


def _key(thing) -> tuple:
    return kind_of(thing), str(thing.get(MESH_KEY, ""))


def _new_collection(root, source) -> bpy.types.Collection:
    copy = bpy.data.collections.new(source[NAME])
    for name, value in source.items():
        if name.startswith("objectgs_") and name not in (PLACE, COPIES):
            copy[name] = value
    mark(copy, COPY, object_id_of(source))
    copy.hide_viewport, copy.hide_render = source.hide_viewport, source.hide_render
    copy.color_tag = source.color_tag
    above = next((each for each in (root, *root.children_recursive) if source in each.children[:]), root)
    above.children.link(copy)
    return copy
