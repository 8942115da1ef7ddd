# SPDX-License-Identifier: GPL-3.0-or-later
"""Selection of the splats that a viewport shows, with their transforms and colors."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np

from ...backend.shared.color.palette import to_encoded
from .. import scene as scenes
from .renderer import DrawnObject
from .splat_arrays import arrays_of, selected_of

NO_RECOLOR = np.hstack([np.eye(3), np.zeros((3, 1))])
NONE = (0.0, 0.0, 0.0, 0.0)

_HIDES = {"MESH", "CURVE", "SURFACE", "META", "FONT", "VOLUME", "POINTCLOUD", "CURVES", "GREASEPENCIL"}


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


def gather(parts: Any, colors: str = "photo", pointed_at: int | None = None, marks: bool = True) -> list[DrawnObject]:
    """Convert carriers to objects for the renderer; carriers without the required attributes are left out.

    Args:
        parts: mesh carriers of splats.
        colors: "photo", or "object" for the objects' own colors.
        pointed_at: session UID of the collection under the mouse, or None.
        marks: outline selected objects, and highlight selected splats.
    """
    found = []
    collections = collections_by_part()
    for part in parts:
        arrays = arrays_of(part.data)
        if arrays is None:
            continue
        collection = collections.get(part)
        is_pointed_at = pointed_at is not None and collection is not None and collection.session_uid == pointed_at
        color = (*to_encoded(part.color[:3]), 1.0) if colors == "object" else NONE
        found.append(
            DrawnObject(
                arrays,
                np.array(part.matrix_world),
                color_map(collection),
                color,
                marks and part.select_get(),
                is_pointed_at,
                selected_of(part.data) if marks else None,
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
        obj.type in _HIDES and scenes.kind_of(obj) != "splats" and shown(obj, view_layer, space)
        for obj in view_layer.objects
    )
