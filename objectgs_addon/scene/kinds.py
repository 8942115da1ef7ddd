# SPDX-License-Identifier: GPL-3.0-or-later
"""Who is what: custom properties on collections and objects, and finding things by them.

Nothing is ever found by its name, since users rename things and Blender numbers names that are taken.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy

KIND = "objectgs_kind"  # Not "objectgs": before Blender 5.0 a property group of that name would take its place.
OBJECT_ID = "object_id"
FOLDER = "objectgs_folder"
MESH_KEY = "objectgs_mesh"  # On a mesh: its key in meshes.json.

RECONSTRUCTION = "reconstruction"
PARENT = "parent"
CAPTURE = "capture"
CAMERA = "camera"
POINTS = "points"
OBJECT = "object"
DUPLICATE = "object_copy"
OBJECT_PARENT = "object_parent"
SPLATS = "splats"
ANCHORS = "anchors"
MESH = "mesh"

SPLATS_MATERIAL = "splats_material"
MESH_MATERIAL = "mesh_material"
TEXTURE = "mesh_texture"


def kind_of(block: bpy.types.ID) -> str | None:
    """What a collection, object, mesh, material or node group is to this extension; None where it is not ours."""
    kind = block.get(KIND) if block is not None else None
    return kind if isinstance(kind, str) else None


def object_id_of(block: bpy.types.ID) -> int | None:
    """ID 0 .. 2^32 - 1 of the object that a collection or an object belongs to, or None."""
    value = block.get(OBJECT_ID) if kind_of(block) is not None else None
    return from_stored(value) if isinstance(value, int) else None


def mark(block: bpy.types.ID, kind: str, object_id: int | None = None) -> None:
    """Say what `block` is."""
    block[KIND] = kind
    if object_id is not None:
        block[OBJECT_ID] = to_stored(object_id)


def to_stored(object_id: int) -> int:
    """A mask's ID (0 .. 2^32 - 1) as Blender's signed 32-bit integers hold it: the int32 of the same bits."""
    return object_id - (1 << 32) if object_id >= 1 << 31 else object_id


def from_stored(value: int) -> int:
    """The mask's ID again."""
    return value & 0xFFFFFFFF


def folder_of(root: bpy.types.Collection) -> Path:
    """The reconstruction folder, absolute; it need not exist any more."""
    return Path(root.get(FOLDER, ""))


def parts_of(collection: bpy.types.Collection) -> list[bpy.types.Object]:
    """Our objects that lie directly in `collection`."""
    return [obj for obj in collection.objects if kind_of(obj) is not None]


def part_of(collection: bpy.types.Collection, kind: str) -> bpy.types.Object | None:
    """The first object of a kind that lies directly in `collection`, or None."""
    return next((obj for obj in collection.objects if kind_of(obj) == kind), None)


def parent_of(root: bpy.types.Collection) -> bpy.types.Object | None:
    """The empty that everything of a reconstruction hangs on, or None where the user deleted it."""
    return part_of(root, PARENT)


def adopt(
    collection: bpy.types.Collection, root: bpy.types.Collection, kinds: Any, object_id: int | None = None
) -> None:
    """Move parts that lie about in `root` itself into `collection`: those of a collection that the user dissolved."""
    for obj in list(root.objects):
        if kind_of(obj) in kinds and (object_id is None or object_id_of(obj) == object_id):
            collection.objects.link(obj)
            root.objects.unlink(obj)


def capture_of(root: bpy.types.Collection) -> bpy.types.Collection | None:
    """The collection of the cameras and points, or None."""
    return next((child for child in root.children_recursive if kind_of(child) == CAPTURE), None)


def points_of(root: bpy.types.Collection) -> bpy.types.Object | None:
    """The point cloud's object, or None."""
    capture = capture_of(root)
    return part_of(capture, POINTS) if capture is not None else None


def object_collections(root: bpy.types.Collection) -> dict[int, bpy.types.Collection]:
    """Object ID -> its collection; also those that the user moved out of the reconstruction's.

    Where the user duplicated one, the first counts.
    """
    found: dict[int, bpy.types.Collection] = {}
    for collection in root.children_recursive:
        if kind_of(collection) == OBJECT:
            found.setdefault(object_id_of(collection) or 0, collection)
    parent = parent_of(root)
    if parent is not None:
        known = set(found.values())
        for collection in bpy.data.collections:
            if kind_of(collection) == OBJECT and collection not in known:
                pivot = part_of(collection, OBJECT_PARENT)
                if pivot is not None and pivot.parent == parent:
                    found.setdefault(object_id_of(collection) or 0, collection)
    return found


def duplicates_of(root: bpy.types.Collection) -> dict[int, list[bpy.types.Collection]]:
    """Object ID -> the collections of its duplicates, in Blender's order; of the objects that have any."""
    found: dict[int, list[bpy.types.Collection]] = {}
    for collection in root.children_recursive:
        if kind_of(collection) == DUPLICATE:
            found.setdefault(object_id_of(collection) or 0, []).append(collection)
    return found


def collection_of(part: bpy.types.Object) -> bpy.types.Collection | None:
    """The collection of the object, or of the duplicate of one, that a part lies in directly; None in neither."""
    return next(
        (collection for collection in part.users_collection if kind_of(collection) in (OBJECT, DUPLICATE)), None
    )


def root_of(block: bpy.types.ID, scene: bpy.types.Scene) -> bpy.types.Collection | None:
    """The reconstruction's collection in `scene` that an object or a collection belongs to, or None."""
    roots = [child for child in scene.collection.children_recursive if kind_of(child) == RECONSTRUCTION]
    if isinstance(block, bpy.types.Collection):
        for root in roots:
            if root == block or block in root.children_recursive:
                return root
        block = part_of(block, OBJECT_PARENT)
    if not isinstance(block, bpy.types.Object):
        return None
    above = block
    while above is not None and kind_of(above) != PARENT:
        above = above.parent
    for root in roots:
        if above is not None and parent_of(root) == above:
            return root
    return next((root for root in roots if block in root.all_objects[:]), None)
