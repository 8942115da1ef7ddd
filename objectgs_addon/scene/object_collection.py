# SPDX-License-Identifier: GPL-3.0-or-later
"""The collection of one object: made with its pivot, renamed, painted and taken apart as a whole."""

import bpy
import numpy as np

from ...backend.palette import to_linear
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
CENTRE = "objectgs_centre"

_MATERIALS = {SPLATS: SPLATS_MATERIAL, MESH: MESH_MATERIAL}


def new_collection(object_id: int, objects: Objects) -> bpy.types.Collection:
    """An object's collection, not linked anywhere yet: Blender brings all view layers up to date for each link."""
    collection = bpy.data.collections.new(objects.name(object_id))
    mark(collection, OBJECT, object_id)
    collection[NAME] = objects.name(object_id)
    return collection


def pivot_of(collection, parent, object_id: int, positions: np.ndarray) -> bpy.types.Object:
    """The object's own parent empty, made at the middle of `positions` (n, 3) where there is none; the user may move
    it."""
    pivot = part_of(collection, OBJECT_PARENT)
    if pivot is None:
        pivot = bpy.data.objects.new(collection[NAME], None)
        mark(pivot, OBJECT_PARENT, object_id)
        pivot.empty_display_type = "PLAIN_AXES"
        centre, size = np.zeros(3), 1.0
        if len(positions):
            centre = np.median(positions, axis=0)
            size = 0.5 * float(np.median(np.linalg.norm(positions - centre, axis=1))) or 1.0
        pivot.empty_display_size = size
        pivot[CENTRE] = centre.tolist()
        pivot.location = centre
        pivot.parent = parent
        collection.objects.link(pivot)
    elif pivot.parent is None:
        pivot.parent = parent
    return pivot


def centre_of(pivot) -> np.ndarray:
    """Where the pivot was made, in the reconstruction's coordinates: the origin of its children's."""
    return np.array(pivot.get(CENTRE, (0.0, 0.0, 0.0)), np.float64)


def rename(collection, name: str) -> None:
    """Give collection and parts a new name from objects.json; names that the user gave in Blender stay else."""
    if collection.get(NAME) == name:
        return
    collection[NAME] = collection.name = name
    for thing in parts_of(collection):
        kind = kind_of(thing)
        thing.name = name if kind == OBJECT_PARENT else f"{name} {kind}"
        if thing.data is not None:
            thing.data.name = thing.name
        for material in our_materials(thing):
            material.name = thing.name if kind == MESH else name


def paint(collection, rgb: tuple[int, int, int]) -> None:
    """Give the parts the colour that stands for the object, sRGB 0 .. 255, where Blender shows objects or materials
    by a colour."""
    colour = (*to_linear(rgb), 1.0)
    for thing in parts_of(collection):
        thing.color = colour
        for material in our_materials(thing):
            material.diffuse_color = colour


def our_materials(thing) -> list[bpy.types.Material]:
    """The materials that we made for a splats object or a mesh."""
    wanted = _MATERIALS.get(kind_of(thing))
    if wanted is None or thing.data is None:
        return []
    return [material for material in thing.data.materials if kind_of(material) == wanted]


def remove_if_empty(collection) -> None:
    """Remove a collection where only its own pivot is left in it."""
    pivot = part_of(collection, OBJECT_PARENT)
    others = [thing for thing in collection.objects if thing != pivot]
    if others or collection.children or (pivot is not None and pivot.children):
        return
    remove(pivot)
    bpy.data.collections.remove(collection)


def remove(thing) -> None:
    """Remove an object with its mesh, our materials and their textures, where nothing else uses them."""
    if thing is None:
        return
    mesh, materials = thing.data, our_materials(thing)
    images = [image for material in materials for image in textures_of(material)]
    bpy.data.objects.remove(thing)
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
    return [] if tree is None else list(dict.fromkeys(
        node.image for node in tree.nodes if node.type == "TEX_IMAGE" and kind_of(node.image) == TEXTURE))
