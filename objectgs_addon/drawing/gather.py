# SPDX-License-Identifier: GPL-3.0-or-later
"""Selection of the splats that a viewport shows, with their transforms and colors."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import bpy
import numpy as np
from mathutils import Matrix

from ...backend.shared.color.palette import to_encoded
from .. import scene as scenes
from .entries import DrawnObject
from .splat_arrays import arrays_of, labels_of, selected_of

NO_RECOLOR = np.hstack([np.eye(3), np.zeros((3, 1))])
NONE = (0.0, 0.0, 0.0, 0.0)

_HIDES = {"MESH", "CURVE", "SURFACE", "META", "FONT", "VOLUME", "POINTCLOUD", "CURVES", "GREASEPENCIL"}


class Placed(NamedTuple):
    """A splat carrier in the scene or in an instance of its collection.

    Attributes:
        part: the mesh carrier.
        matrix: map from its local to world coordinates.
        instancer: empty of the scene that instances its collection, or None.
    """

    part: bpy.types.Object
    matrix: Matrix
    instancer: bpy.types.Object | None = None


def placed(part: bpy.types.Object) -> Placed:
    """Return a carrier at its own place."""
    return Placed(part, part.matrix_world)


def placed_parts(view_layer: bpy.types.ViewLayer, space: bpy.types.SpaceView3D | None = None) -> list[Placed]:
    """Return the splat carriers that a view layer or one of its viewports shows, also those in collection instances.

    *File > Link* adds a collection as an instance.
    """
    return [
        *(placed(part) for part in splat_parts(view_layer, space)),
        *(
            each
            for obj in view_layer.objects
            if _instances_collection(obj) and shown(obj, view_layer, space)
            for each in _instanced(obj, obj.matrix_world, obj)
        ),
    ]


def carriers(owner: bpy.types.Scene) -> list[bpy.types.Object]:
    """Return all splat carriers of a scene and of the collections that it instances, shown or not."""
    found: dict[bpy.types.Object, None] = {}
    left, known = list(owner.objects), set()
    while left:
        obj = left.pop()
        if scenes.kind_of(obj) == "splats":
            found[obj] = None
        elif _instances_collection(obj) and obj.instance_collection not in known:
            known.add(obj.instance_collection)
            left.extend(obj.instance_collection.all_objects)
    return list(found)


def _instances_collection(obj: bpy.types.Object) -> bool:
    return obj.instance_type == "COLLECTION" and obj.instance_collection is not None


def _instanced(obj: bpy.types.Object, world: Matrix, instancer: bpy.types.Object) -> Iterator[Placed]:
    """Return the visible carriers in the collection that `obj` instances with the matrix `world`."""
    world = world @ Matrix.Translation(-obj.instance_collection.instance_offset)
    left = [obj.instance_collection]
    while left:
        collection = left.pop()
        if collection.hide_viewport:
            continue
        left.extend(collection.children)
        for part in collection.objects:
            if part.hide_viewport:
                continue
            if scenes.kind_of(part) == "splats":
                yield Placed(part, world @ part.matrix_world, instancer)
            elif _instances_collection(part):
                yield from _instanced(part, world @ part.matrix_world, instancer)


def splat_parts(view_layer: bpy.types.ViewLayer, space: bpy.types.SpaceView3D | None = None) -> list[bpy.types.Object]:
    """Return the splat carriers that are visible in a view layer or in one of its viewports."""
    return [part for part in view_layer.objects if scenes.kind_of(part) == "splats" and shown(part, view_layer, space)]


def shown(part: bpy.types.Object, view_layer: bpy.types.ViewLayer, space: bpy.types.SpaceView3D) -> bool:
    if space is None:
        return part.visible_get(view_layer=view_layer)
    return part.visible_get(view_layer=view_layer, viewport=space)


def collections_by_part() -> dict[bpy.types.Object, bpy.types.Collection]:
    """Map parts to the collections of their objects or duplicates.

    This is one pass over all collections; Blender would search all of them for each part.
    """
    return {
        part: collection
        for collection in bpy.data.collections
        if scenes.kind_of(collection) in ("object", "object_copy")
        for part in collection.objects
    }


def gather(
    parts: list[Placed], colors: str = "photo", pointed_at: int | None = None, marks: bool = True
) -> list[DrawnObject]:
    """Convert carriers to objects for the renderer; carriers without the required attributes are left out.

    Args:
        parts: mesh carriers of splats with their places.
        colors: "photo", or "object" for the objects' own colors.
        pointed_at: session UID of the collection under the mouse, or None.
        marks: outline selected objects, highlight selected splats, and show labels.
    """
    found = []
    collections = collections_by_part()
    for part, matrix, instancer in parts:
        arrays = arrays_of(part.data)
        if arrays is None:
            continue
        collection = collections.get(part)
        is_pointed_at = pointed_at is not None and collection is not None and collection.session_uid == pointed_at
        color = (*to_encoded(part.color[:3]), 1.0) if colors == "object" else NONE
        found.append(
            DrawnObject(
                arrays,
                np.array(matrix),
                color_map(collection),
                color,
                marks and (instancer or part).select_get(),
                is_pointed_at,
                selected_of(part.data) if marks else None,
                labels_of(part.data) if marks else None,
            )
        )
    return found


def meshes_of(uid: int | None, view_layer: bpy.types.ViewLayer, space: bpy.types.SpaceView3D) -> list[bpy.types.Object]:
    """Return the visible meshes in the collection with a session UID; none for None."""
    if uid is None:
        return []
    return [
        part
        for part, collection in collections_by_part().items()
        if collection.session_uid == uid and scenes.kind_of(part) == "mesh" and shown(part, view_layer, space)
    ]


def color_map(collection: bpy.types.Collection) -> np.ndarray:
    """Return the (3, 4) affine recoloring of a collection's object; the identity for None or no recoloring."""
    recolor = scenes.recolor_of(collection) if collection is not None else None
    if recolor is None:
        return NO_RECOLOR
    matrix, offset = recolor.affine()
    return np.hstack([matrix, offset[:, None]])


def may_hide_splats(view_layer: bpy.types.ViewLayer, space: bpy.types.SpaceView3D) -> bool:
    """Return whether a viewport shows anything that may occlude splats."""
    return space.overlay.show_overlays or any(
        (obj.type in _HIDES or _instances_collection(obj))
        and scenes.kind_of(obj) != "splats"
        and shown(obj, view_layer, space)
        for obj in view_layer.objects
    )
