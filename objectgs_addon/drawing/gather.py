# SPDX-License-Identifier: GPL-3.0-or-later
"""What a viewport shows of the splats in a scene."""

import bpy
import numpy as np

from ...backend.palette import to_encoded
from .. import scene as scenes
from ..splat_arrays import arrays_of
from .renderer import Drawn

NO_RECOLOUR = np.hstack([np.eye(3), np.zeros((3, 1))])
NONE = (0.0, 0.0, 0.0, 0.0)
SELECTED = (1.0, 0.55, 0.1, 0.25)
POINTED_AT = (1.0, 1.0, 1.0, 0.3)

_HIDES = {"MESH", "CURVE", "SURFACE", "META", "FONT", "VOLUME", "POINTCLOUD", "CURVES", "GREASEPENCIL"}


def splat_parts(view_layer: bpy.types.ViewLayer, space: bpy.types.SpaceView3D | None = None) -> list[bpy.types.Object]:
    """The mesh carriers of splats that a view layer, or a viewport, shows."""
    return [part for part in view_layer.objects if scenes.kind_of(part) == "splats" and shown(part, view_layer, space)]


def shown(part, view_layer, space) -> bool:
    if space is None:
        return part.visible_get(view_layer=view_layer)
    return part.visible_get(view_layer=view_layer, viewport=space)


def owners() -> dict[bpy.types.Object, bpy.types.Collection]:
    """Part -> the object's or the duplicate's collection that it lies in; asking each part would look at all."""
    return {part: collection for collection in bpy.data.collections
            if scenes.kind_of(collection) in ("object", "object_copy") for part in collection.objects}


def gather(parts, colours: str = "photo", pointed_at: int | None = None, marks: bool = True) -> list[Drawn]:
    """Carriers as the renderer takes them; those whose splats are gone are left out.

    colours: "photo", or "object" for the objects' own colours; marks: show what is selected; pointed_at: the number of
    this session of a collection under the mouse.
    """
    found = []
    collections = owners()
    for part in parts:
        arrays = arrays_of(part.data)
        if arrays is None:
            continue
        collection = collections.get(part)
        highlight = NONE
        if pointed_at is not None and collection is not None and collection.session_uid == pointed_at:
            highlight = POINTED_AT
        elif marks and part.select_get():
            highlight = SELECTED
        colour = (*to_encoded(part.color[:3]), 1.0) if colours == "object" else NONE
        found.append(Drawn(arrays, np.array(part.matrix_world), colour_map(collection), colour, highlight))
    return found


def colour_map(collection) -> np.ndarray:
    """(3, 4): matrix and offset of what was asked of an object's colours, by its collection or None."""
    recolour = scenes.recolour_of(collection) if collection is not None else None
    if recolour is None:
        return NO_RECOLOUR
    matrix, offset = recolour.affine()
    return np.hstack([matrix, offset[:, None]])


def hides_splats(view_layer, space) -> bool:
    """Whether a viewport shows anything that may be in front of splats."""
    return space.overlay.show_overlays or any(
        thing.type in _HIDES and scenes.kind_of(thing) != "splats" and shown(thing, view_layer, space)
        for thing in view_layer.objects)
