# SPDX-License-Identifier: GPL-3.0-or-later
"""Custom properties that identify the add-on's data-blocks, and lookups by them.

Lookups never use names, since users rename data-blocks and Blender appends numbers to names already in use.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import bpy

from ...backend.shared.class_table import LARGEST_ID
from ...backend.shared.errors import InputError

KIND = "objectgs_kind"  # Not "objectgs": before Blender 5.0, it would collide with the property group of that name.
OBJECT_ID = "object_id"
FOLDER = "objectgs_folder"
RELATIVE_FOLDER = "objectgs_relative_folder"  # The folder relative to the .blend when it was saved.
MESH_KEY = "objectgs_mesh"  # Key of a mesh in meshes.json.
MESH_COLORS = "Col"  # Color attribute of a mesh with the captured colors.

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
CROP_BOX = "crop_box"
FILM = "film"  # The compositor nodes that read film frames, and their image.

SPLATS_MATERIAL = "splats_material"
MESH_MATERIAL = "mesh_material"
TEXTURE = "mesh_texture"


def kind_of(block: bpy.types.ID) -> str | None:
    """Return the kind of a data-block (collection, object, mesh, material, node group); None if it has none."""
    kind = block.get(KIND) if block is not None else None
    return kind if isinstance(kind, str) else None


def is_in_file() -> bool:
    """Return whether the .blend has anything of a reconstruction; other files need no look at all their objects."""
    return any(KIND in block for blocks in (bpy.data.collections, bpy.data.node_groups) for block in blocks)


def is_linked(block: bpy.types.ID) -> bool:
    """Return whether another .blend holds a data-block, linked or overridden, so that changes are not saved."""
    return block.library is not None or block.override_library is not None


def object_id_of(block: bpy.types.ID) -> int | None:
    """Return the object ID (0 .. 2^32 - 1) of a collection or Blender object, or None."""
    value = block.get(OBJECT_ID) if kind_of(block) is not None else None
    return from_stored(value) if isinstance(value, int) else None


def mark(block: bpy.types.ID, kind: str, object_id: int | None = None) -> None:
    """Store the kind and, if given, the object ID of `block` as custom properties."""
    block[KIND] = kind
    if object_id is not None:
        block[OBJECT_ID] = to_stored(object_id)


def release(block: bpy.types.ID) -> None:
    """Leave a copy of the add-on's data-block to the user; the add-on no longer changes or removes it."""
    for name in (KIND, OBJECT_ID, MESH_KEY):
        if name in block:
            del block[name]


def to_stored(object_id: int) -> int:
    """Convert an object ID (0 .. 2^32 - 1) to the signed 32-bit integer with the same bits, as Blender stores it."""
    return object_id - (1 << 32) if object_id >= 1 << 31 else object_id


def from_stored(value: int) -> int:
    """Convert the result of `to_stored` back to an object ID."""
    return value & LARGEST_ID


def folder_of(root: bpy.types.Collection) -> Path:
    """Return the path of the reconstruction folder as stored in the .blend, without `..`.

    It may be missing or, in a .blend from elsewhere, any folder of any computer: see `state/folder_trust.py` before
    using it.
    """
    stored = root.get(FOLDER)
    return Path(os.path.normpath(stored)) if isinstance(stored, str) and "\0" not in stored else Path()


def link_folder(root: bpy.types.Collection, folder: Path) -> None:
    """Store the absolute path of the reconstruction folder."""
    root[FOLDER] = str(folder)


def parts_of(collection: bpy.types.Collection) -> list[bpy.types.Object]:
    """Return the add-on's Blender objects directly in `collection`."""
    return [obj for obj in collection.objects if kind_of(obj) is not None]


def part_of(collection: bpy.types.Collection, kind: str) -> bpy.types.Object | None:
    """Return the first Blender object of a kind directly in `collection`, or None."""
    return next((obj for obj in collection.objects if kind_of(obj) == kind), None)


def parent_of(root: bpy.types.Collection) -> bpy.types.Object | None:
    """Return the reconstruction's parent empty, or None if the user deleted it."""
    return part_of(root, PARENT)


def require_parent(root: bpy.types.Collection) -> bpy.types.Object:
    """Return the reconstruction's parent empty; raises InputError if the user deleted it."""
    parent = parent_of(root)
    if parent is None:
        raise InputError(f"{root.name} has lost its parent empty; use Reload Result to show it again.")
    return parent


def adopt(
    collection: bpy.types.Collection, root: bpy.types.Collection, kinds: Any, object_id: int | None = None
) -> None:
    """Move parts of these kinds (and this object ID, if given) from `root` itself into `collection`.

    Parts end up directly in `root` when the user deletes their collection.
    """
    for obj in list(root.objects):
        if kind_of(obj) in kinds and (object_id is None or object_id_of(obj) == object_id):
            collection.objects.link(obj)
            root.objects.unlink(obj)


def capture_of(root: bpy.types.Collection) -> bpy.types.Collection | None:
    """Return the collection of the cameras and points, also if the user has moved it out of `root`; None without it."""
    found = next((child for child in root.children_recursive if kind_of(child) == CAPTURE), None)
    if found is not None or (parent := parent_of(root)) is None:
        return found
    for scene in bpy.data.scenes:
        for other in scene.collection.children_recursive:
            if kind_of(other) == CAPTURE and any(
                part.parent == parent and kind_of(part) in (CAMERA, POINTS) for part in other.objects
            ):
                return other
    return None


def points_of(root: bpy.types.Collection) -> bpy.types.Object | None:
    """Return the Blender object of the point cloud, or None."""
    capture = capture_of(root)
    return part_of(capture, POINTS) if capture is not None else None


def object_collections(root: bpy.types.Collection) -> dict[int, bpy.types.Collection]:
    """Map object IDs to their collections, including those the user moved out of the reconstruction's collection.

    If the user duplicated a collection, the first one is returned.
    """
    found: dict[int, bpy.types.Collection] = {}
    for collection in root.children_recursive:
        if kind_of(collection) == OBJECT:
            found.setdefault(object_id_of(collection) or 0, collection)
    for collection in _moved_out(root, OBJECT, found.values()):
        found.setdefault(object_id_of(collection) or 0, collection)
    return found


def duplicates_of(root: bpy.types.Collection) -> dict[int, list[bpy.types.Collection]]:
    """Map the IDs of objects with duplicates to the duplicates' collections, in Blender's order."""
    inside = [collection for collection in root.children_recursive if kind_of(collection) == DUPLICATE]
    found: dict[int, list[bpy.types.Collection]] = {}
    # One that the user unlinked is in no scene.
    for collection in [*inside, *(each for each in _moved_out(root, DUPLICATE, inside) if each.users)]:
        found.setdefault(object_id_of(collection) or 0, []).append(collection)
    return found


def whole_duplicates_of(root: bpy.types.Collection) -> dict[int, list[bpy.types.Collection]]:
    """Return the duplicates of each object whose pivots the user has not deleted.

    Hidden parts of others are left, which Blender's *Delete* cannot select, until the edits are stored.
    """
    return {
        object_id: [copy for copy in copies if part_of(copy, OBJECT_PARENT) is not None]
        for object_id, copies in duplicates_of(root).items()
    }


def _moved_out(
    root: bpy.types.Collection, kind: str, inside: Iterable[bpy.types.Collection]
) -> list[bpy.types.Collection]:
    """Return the collections of a kind that the user moved out of the reconstruction, given those that are inside."""
    parent = parent_of(root)
    if parent is None:
        return []
    known = set(inside)
    others = [each for each in bpy.data.collections if kind_of(each) == kind and each not in known]
    pivots = ((each, part_of(each, OBJECT_PARENT)) for each in others)
    return [each for each, pivot in pivots if pivot is not None and parent_above(pivot) == parent]


def collection_of(part: bpy.types.Object) -> bpy.types.Collection | None:
    """Return the collection of the object or duplicate that directly contains a part, or None."""
    return next(
        (collection for collection in part.users_collection if kind_of(collection) in (OBJECT, DUPLICATE)), None
    )


def parent_above(obj: bpy.types.Object) -> bpy.types.Object | None:
    """Return the parent empty of the reconstruction that a Blender object is parented to, also through others."""
    above = obj
    while above is not None and kind_of(above) != PARENT:
        above = above.parent
    return above


def root_of(block: bpy.types.ID, scene: bpy.types.Scene) -> bpy.types.Collection | None:
    """Return the reconstruction collection in `scene` that a Blender object or collection belongs to, or None."""
    roots = [child for child in scene.collection.children_recursive if kind_of(child) == RECONSTRUCTION]
    if isinstance(block, bpy.types.Collection):
        for root in roots:
            if root == block or block in root.children_recursive:
                return root
        block = part_of(block, OBJECT_PARENT)
    if not isinstance(block, bpy.types.Object):
        return None
    above = parent_above(block)
    for root in roots:
        if above is not None and parent_of(root) == above:
            return root
    return next((root for root in roots if block in root.all_objects[:]), None)


def only_of(
    root: bpy.types.Collection, parts: Iterable[bpy.types.Object], scene: bpy.types.Scene
) -> list[bpy.types.Object]:
    """Return those of the add-on's Blender objects whose `root_of` in `scene` is `root`, without a search for each."""
    inside, own = set(root.all_objects), parent_of(root)
    others = {parent_of(each) for each in scene.collection.children_recursive if kind_of(each) == RECONSTRUCTION}
    others -= {own, None}
    found = ((part, parent_above(part)) for part in parts if kind_of(part) is not None)
    return [
        part
        for part, above in found
        if (above is not None and above == own) or (part in inside and above not in others)
    ]
