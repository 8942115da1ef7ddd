# SPDX-License-Identifier: GPL-3.0-or-later
"""The collection of one object: creation with its pivot, renaming, coloring and removal."""

from __future__ import annotations

import bpy
import numpy as np

from ...backend.shared.color.palette import to_linear
from .edits.axes import give_axes, length_scale, part_axes, put_below, set_local_map
from .kinds import (
    MESH,
    MESH_MATERIAL,
    OBJECT,
    OBJECT_PARENT,
    SPLATS,
    SPLATS_MATERIAL,
    TEXTURE,
    kind_of,
    mark,
    part_of,
    parts_of,
)
from .object_display import Objects

NAME = "objectgs_name"
CENTER = "objectgs_center"
"""Custom property of a pivot and of its collection: the pivot's initial position in reconstruction coordinates."""

_MATERIALS = {SPLATS: SPLATS_MATERIAL, MESH: MESH_MATERIAL}


def new_collection(object_id: int, objects: Objects) -> bpy.types.Collection:
    """Return a new collection for an object, unlinked since Blender updates all view layers for each link."""
    collection = bpy.data.collections.new(objects.name(object_id))
    mark(collection, OBJECT, object_id)
    collection[NAME] = objects.name(object_id)
    return collection


def ensure_pivot(
    collection: bpy.types.Collection, parent: bpy.types.Object | None, object_id: int, positions: np.ndarray
) -> bpy.types.Object:
    """Return the object's pivot (its own parent empty), created at the median of `positions` (n, 3) if missing.

    A new one becomes the parent of parts whose pivot the user deleted, and is created where that was, since the
    vertices of meshes and duplicates are relative to it. Others without a parent are left as they are, since the user
    has cleared it.
    """
    pivot = part_of(collection, OBJECT_PARENT)
    if pivot is None:
        pivot = bpy.data.objects.new(collection[NAME], None)
        mark(pivot, OBJECT_PARENT, object_id)
        pivot.empty_display_type = "PLAIN_AXES"
        center, size = np.zeros(3), 1.0
        if len(positions):
            center = np.array(collection.get(CENTER, np.median(positions, axis=0)), np.float64)
            size = 0.2 * float(np.median(np.linalg.norm(positions - center, axis=1))) or 1.0
        pivot.empty_display_size = size if parent is None else min(size, parent.empty_display_size)
        pivot[CENTER] = center.tolist()
        pivot.parent = parent
        if parent is not None:
            give_axes(pivot, parent)
        place = np.eye(4)
        place[:3, 3] = center
        set_local_map(pivot, place @ np.linalg.inv(part_axes(pivot)))
        pivot.empty_display_size *= length_scale(part_axes(pivot))
        for part in parts_of(collection):
            if part.parent is None:
                put_below(part, pivot)
        collection.objects.link(pivot)
    collection[CENTER] = center_of(pivot).tolist()
    return pivot


def center_of(pivot: bpy.types.Object) -> np.ndarray:
    """Return the pivot's initial position in reconstruction coordinates, the origin of its children's coordinates."""
    return np.array(pivot.get(CENTER, (0.0, 0.0, 0.0)), np.float64)


def rename(collection: bpy.types.Collection, name: str) -> None:
    """Rename a collection and its parts if the name in objects.json changed; otherwise keep the user's names."""
    if collection.get(NAME) == name:
        return
    collection[NAME] = collection.name = name
    for obj in parts_of(collection):
        kind = kind_of(obj)
        obj.name = name if kind == OBJECT_PARENT else f"{name} {kind}"
        if obj.data is not None:
            obj.data.name = obj.name
        for material in our_materials(obj):
            material.name = obj.name if kind == MESH else name


def paint(collection: bpy.types.Collection, rgb: tuple[int, int, int]) -> None:
    """Set the viewport colors of the parts and their materials to the object's color, sRGB 0 .. 255."""
    color = (*to_linear(rgb), 1.0)
    for obj in parts_of(collection):
        obj.color = color
        for material in our_materials(obj):
            material.diffuse_color = color


def our_materials(obj: bpy.types.Object) -> list[bpy.types.Material]:
    """Return the materials that the add-on created for a splats carrier or a mesh."""
    wanted = _MATERIALS.get(kind_of(obj))
    if wanted is None or obj.data is None:
        return []
    return [material for material in obj.data.materials if kind_of(material) == wanted]


def remove_if_empty(collection: bpy.types.Collection) -> None:
    """Remove a collection that contains at most its own pivot."""
    pivot = part_of(collection, OBJECT_PARENT)
    others = [obj for obj in collection.objects if obj != pivot]
    if others or collection.children or (pivot is not None and pivot.children):
        return
    remove(pivot)
    bpy.data.collections.remove(collection)


def remove(obj: bpy.types.Object) -> None:
    """Remove a Blender object with its mesh, add-on materials and their textures, unless they have other users."""
    if obj is None:
        return
    mesh, materials = obj.data, our_materials(obj)
    images = [image for material in materials for image in textures_of(material)]
    bpy.data.objects.remove(obj)
    if mesh is not None and mesh.users == 0:
        bpy.data.meshes.remove(mesh)
    for material in materials:
        if material.users == 0:
            bpy.data.materials.remove(material)
    for image in images:
        if image.users == 0:
            bpy.data.images.remove(image)


def textures_of(material: bpy.types.Material | None) -> list[bpy.types.Image]:
    """Return the add-on's textures that a material, including a user's own, references."""
    tree = material.node_tree if material is not None else None
    return (
        []
        if tree is None
        else list(
            dict.fromkeys(
                node.image for node in tree.nodes if node.type == "TEX_IMAGE" and kind_of(node.image) == TEXTURE
            )
        )
    )
