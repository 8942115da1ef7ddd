# SPDX-License-Identifier: GPL-3.0-or-later
"""The collection of one object: made with its pivot, renamed, painted and taken apart as a whole."""

from __future__ import annotations

import bpy
import numpy as np

from ...backend.shared.color.palette import to_linear
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
from .objects_file import Objects

NAME = "objectgs_name"
CENTER = "objectgs_center"

_MATERIALS = {SPLATS: SPLATS_MATERIAL, MESH: MESH_MATERIAL}


def new_collection(object_id: int, objects: Objects) -> bpy.types.Collection:
    """An object's collection, not linked anywhere yet: Blender brings all view layers up to date for each link."""
    collection = bpy.data.collections.new(objects.name(object_id))
    mark(collection, OBJECT, object_id)
    collection[NAME] = objects.name(object_id)
    return collection


def ensure_pivot(
    collection: bpy.types.Collection, parent: bpy.types.Object, object_id: int, positions: np.ndarray
) -> bpy.types.Object:
    """The object's own parent empty, made at the middle of `positions` (n, 3) where there is none; the user may move
    it."""
    pivot = part_of(collection, OBJECT_PARENT)
    if pivot is None:
        pivot = bpy.data.objects.new(collection[NAME], None)
        mark(pivot, OBJECT_PARENT, object_id)
        pivot.empty_display_type = "PLAIN_AXES"
        center, size = np.zeros(3), 1.0
        if len(positions):
            center = np.median(positions, axis=0)
            size = 0.5 * float(np.median(np.linalg.norm(positions - center, axis=1))) or 1.0
        pivot.empty_display_size = size
        pivot[CENTER] = center.tolist()
        pivot.location = center
        pivot.parent = parent
        collection.objects.link(pivot)
    elif pivot.parent is None:
        pivot.parent = parent
    return pivot


def center_of(pivot: bpy.types.Object) -> np.ndarray:
    """Where the pivot was made, in the reconstruction's coordinates: the origin of its children's."""
    return np.array(pivot.get(CENTER, (0.0, 0.0, 0.0)), np.float64)


def rename(collection: bpy.types.Collection, name: str) -> None:
    """Give collection and parts a new name from objects.json; names that the user gave in Blender stay else."""
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
    """Give the parts the color that stands for the object, sRGB 0 .. 255, where Blender shows objects or materials
    by a color."""
    color = (*to_linear(rgb), 1.0)
    for obj in parts_of(collection):
        obj.color = color
        for material in our_materials(obj):
            material.diffuse_color = color


def our_materials(obj: bpy.types.Object) -> list[bpy.types.Material]:
    """The materials that we made for a splats object or a mesh."""
    wanted = _MATERIALS.get(kind_of(obj))
    if wanted is None or obj.data is None:
        return []
    return [material for material in obj.data.materials if kind_of(material) == wanted]


def remove_if_empty(collection: bpy.types.Collection) -> None:
    """Remove a collection where only its own pivot is left in it."""
    pivot = part_of(collection, OBJECT_PARENT)
    others = [obj for obj in collection.objects if obj != pivot]
    if others or collection.children or (pivot is not None and pivot.children):
        return
    remove(pivot)
    bpy.data.collections.remove(collection)


def remove(obj: bpy.types.Object) -> None:
    """Remove an object with its mesh, our materials and their textures, where nothing else uses them."""
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
    """The textures of ours that a material uses, whoever made the material."""
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
