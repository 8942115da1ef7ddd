# SPDX-License-Identifier: GPL-3.0-or-later
"""Recovery of an object's parts after Blender operators that the add-on could not follow otherwise.

*Move to Collection* takes parts out of the collection of their object, by which the add-on finds them. *Apply* and *Set
Origin* change the vertices of splats, but not their scale and rotation.
"""

from __future__ import annotations

from itertools import chain

import bpy

from ..kinds import (
    ANCHORS,
    DUPLICATE,
    MESH,
    MESH_KEY,
    OBJECT,
    OBJECT_PARENT,
    RECONSTRUCTION,
    SPLATS,
    duplicates_of,
    is_linked,
    kind_of,
    object_collections,
    object_id_of,
    parent_above,
    parent_of,
    part_of,
    parts_of,
    release,
)
from .placement import take_back

_PARTS = (OBJECT_PARENT, SPLATS, ANCHORS, MESH)


def recover_parts(root: bpy.types.Collection) -> None:
    """Link parts that the user moved to other collections to those of their objects, and restore changed splats.

    A whole object takes its collection along. A single part stays in the user's collection, too. A copy of a mesh that
    is still in its collection is left to the user, also when that mesh is deleted later.
    """
    _link_parts(root)
    for collection in chain(object_collections(root).values(), *duplicates_of(root).values()):
        for kind in (SPLATS, ANCHORS):
            part = part_of(collection, kind)
            if part is not None:
                take_back(part.data)


def _link_parts(root: bpy.types.Collection) -> None:
    parent = parent_of(root)
    homes = [each for each in bpy.data.collections if kind_of(each) in (OBJECT, DUPLICATE) and not is_linked(each)]
    shown = [part for home in object_collections(root).values() for part in home.objects]
    at_home = {part for home in homes for part in home.objects if object_id_of(part) == object_id_of(home)}
    moved = [
        part
        for part in bpy.data.objects
        if kind_of(part) in _PARTS
        and part not in at_home
        and object_id_of(part) is not None
        and not is_linked(part)
        and parent_above(part) == parent
        and part.users_collection
    ]
    for part in sorted(moved, key=lambda part: kind_of(part) != OBJECT_PARENT) if parent is not None else ():
        home = _home_of(part, root, homes)
        if home is None:
            if kind_of(part) == MESH and any(_is_twin(part, other) for other in shown):
                release(part)
            continue
        before = part.users_collection
        home.objects.link(part)
        if kind_of(part) == OBJECT_PARENT:
            _move_collection(home, before)
        for each in before:
            if home in each.children[:] or kind_of(each) in (OBJECT, DUPLICATE):
                each.objects.unlink(part)


def _home_of(
    part: bpy.types.Object, root: bpy.types.Collection, homes: list[bpy.types.Collection]
) -> bpy.types.Collection | None:
    """Return the collection that a part was moved out of: one without it that holds others of its object or none."""
    free = [
        home
        for home in homes
        if object_id_of(home) == object_id_of(part) and _key(part) not in {_key(other) for other in home.objects}
    ]
    related = {part.parent, *part.children}
    found = next((home for home in free if not related.isdisjoint(home.objects)), None)
    if found is not None:
        return found
    others = [each for each in bpy.data.collections if kind_of(each) == RECONSTRUCTION and each != root]
    elsewhere = {each for other in others for each in other.children_recursive}
    return next((home for home in free if home not in elsewhere and not parts_of(home)), None)


def _move_collection(home: bpy.types.Collection, places: tuple[bpy.types.Collection, ...]) -> None:
    """Move the collection of an object below those collections of the scenes that its pivot was moved to."""
    scenes = [scene.collection for scene in bpy.data.scenes]
    inside = {*scenes, *(each for scene in scenes for each in scene.children_recursive)}
    inside -= {home, *home.children_recursive}
    wanted = [each for each in places if each in inside and kind_of(each) not in (OBJECT, DUPLICATE)]
    former = [each for each in inside if home in each.children[:] and each not in wanted]
    for each in wanted:
        if home not in each.children[:]:
            each.children.link(home)
    for each in former if wanted else ():
        each.children.unlink(home)


def _is_twin(part: bpy.types.Object, other: bpy.types.Object) -> bool:
    return object_id_of(part) == object_id_of(other) and _key(part) == _key(other)


def _key(part: bpy.types.Object) -> tuple:
    return kind_of(part), str(part.get(MESH_KEY, ""))
