# SPDX-License-Identifier: GPL-3.0-or-later
"""Hit tests for objects, shown as splats or meshes, at a pixel or in a rectangle of a 3D viewport."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import bpy
import numpy as np
from bpy_extras.view3d_utils import region_2d_to_origin_3d, region_2d_to_vector_3d

from ...backend.shared.splats.picking import Cloud, PickObject, View, ids_in, pick
from .. import drawing, scene
from ..drawing.splat_arrays import SplatArrays, arrays_of

MIN_PROBABILITY = 0.1
"""Minimum contribution of an object's splats to a pixel for the object to count as visible there."""

_SEE_THROUGH = ("splats", "points", "anchors")
_LINES = ("WIRE", "BOUNDS")
_GRID = 12
"""Number of mesh sample points per side of a rectangle."""


@dataclass(frozen=True)
class Hit:
    """A visible object: its collection, or a Blender object outside such collections, or one that instances them."""

    collection: bpy.types.Collection | None
    obj: bpy.types.Object | None

    @property
    def name(self) -> str:
        return (self.collection or self.obj).name


def object_at(context: bpy.types.Context, x: float, y: float, needs_splats: bool = False) -> Hit | None:
    """Return the object that the context's viewport shows at a pixel.

    Args:
        context: context of a 3D viewport.
        x: pixel in the region from the left.
        y: pixel in the region from the bottom.
        needs_splats: look for meshes only where there are splats, since Blender first builds a search tree of each.

    Returns:
        The nearest splats or mesh, or None.
    """
    view = view_of(context)
    hits, placed = _splats(context)
    seen = pick(placed, view, x + 0.5, view.height - y - 0.5)
    if seen is not None and seen.probability < MIN_PROBABILITY:
        seen = None
    if seen is None and needs_splats:
        return None
    obj, depth = _mesh_at(context, _meshes(context), view, x, y)
    if obj is not None and (seen is None or depth < seen.depth):
        collection = drawing.collections_by_part().get(obj)
        return Hit(collection, None if collection else obj)
    return None if seen is None else hits[seen.object_id]


def draws_splats(context: bpy.types.Context) -> bool:
    """Return whether the context's viewport draws splats itself, so that Blender's own tools do not see them."""
    return context.scene.objectgs.draw_splats and drawing.failure() is None


def is_drawn(context: bpy.types.Context, hit: Hit) -> bool:
    """Return whether the context's viewport shows the splats of what was hit."""
    if hit.collection is None:
        return hit.obj.instance_type == "COLLECTION"
    return any(
        scene.kind_of(part) == "splats" and drawing.shown(part, context.view_layer, context.space_data)
        for part in hit.collection.objects
    )


def is_in_viewport(window: bpy.types.Window, x: int, y: int) -> bool:
    """Return whether a pixel of a window, from the lower left, is in a 3D viewport and in no region over it."""
    for area in window.screen.areas:
        over = [
            region.type
            for region in area.regions
            if region.x <= x < region.x + region.width and region.y <= y < region.y + region.height
        ]
        if over and area.type == "VIEW_3D":
            return over == ["WINDOW"]
    return False


def objects_in(context: bpy.types.Context, left: float, bottom: float, right: float, top: float) -> list[Hit]:
    """Return the objects visible in a rectangle, given in region pixels from the lower left.

    Floaters do not count, which may be anywhere in the view.
    """
    view = view_of(context)
    hits, placed = _splats(context, with_floaters=False)
    keys = ids_in(placed, view, (left, view.height - top, right, view.height - bottom))
    found = [hits[key] for key in keys]
    collections_by_part = drawing.collections_by_part()
    meshes = _meshes(context)
    if any(obj in collections_by_part for obj in meshes):
        for x in np.linspace(left, right, _GRID):
            for y in np.linspace(bottom, top, _GRID):
                obj, _ = _mesh_at(context, meshes, view, x, y)
                if obj in collections_by_part:
                    found.append(Hit(collections_by_part[obj], None))
    return list(dict.fromkeys(found))


def view_of(context: bpy.types.Context) -> View:
    """Return the view of the context's viewport."""
    region, region_3d = context.region, context.region_data
    return View.of_matrices(
        np.array(region_3d.view_matrix), np.array(region_3d.window_matrix), region.width, region.height
    )


def _splats(context: bpy.types.Context, with_floaters: bool = True) -> tuple[dict[int, Hit], list[PickObject]]:
    """Return what a click on visible splats selects, by the session UID of what it selects, and these splats."""
    hits, found = {}, []
    collections_by_part = drawing.collections_by_part()
    for part, matrix, instancer in drawing.placed_parts(context.view_layer, context.space_data):
        collection, arrays = collections_by_part.get(part), arrays_of(part.data)
        if collection is not None and arrays is not None and not (instancer or part).hide_select:
            key = (instancer or collection).session_uid
            hits[key] = Hit(collection, None) if instancer is None else Hit(None, instancer)
            cloud = arrays.cloud if with_floaters else _without_floaters(part.data, arrays)
            found.append(PickObject(key, cloud, np.array(matrix)))
    return hits, found


def _without_floaters(mesh: bpy.types.Mesh, arrays: SplatArrays) -> Cloud:
    """Return the visible splats of a carrier except its floaters."""
    floating, hidden = scene.floating_splats(mesh), scene.hidden_splats(mesh)
    if hidden is not None:
        floating = floating[~hidden]
    if not floating.any():
        return arrays.cloud
    kept = (values[~floating] for values in (arrays.means, arrays.quats, arrays.scales, arrays.opacities))
    return Cloud(*kept, arrays.blur)


def _meshes(context: bpy.types.Context) -> list[bpy.types.Object]:
    """Return the visible mesh objects except splats, points, anchors and those of which only lines are shown."""
    return [
        obj
        for obj in context.view_layer.objects
        if obj.type == "MESH"
        and scene.kind_of(obj) not in _SEE_THROUGH
        and obj.display_type not in _LINES
        and not obj.hide_select
        and drawing.shown(obj, context.view_layer, context.space_data)
    ]


def _mesh_at(
    context: bpy.types.Context, meshes: Any, view: View, x: float, y: float
) -> tuple[bpy.types.Object | None, float]:
    """Return the nearest of the meshes at a pixel of the region, and its depth."""
    region, region_3d = context.region, context.region_data
    origin = region_2d_to_origin_3d(region, region_3d, (x, y))
    along = region_2d_to_vector_3d(region, region_3d, (x, y))
    depsgraph = context.evaluated_depsgraph_get()
    best, nearest = None, np.inf
    for obj in meshes:
        shape = obj.evaluated_get(depsgraph)
        inverse = shape.matrix_world.inverted_safe()
        hit, place, _normal, _face = shape.ray_cast(inverse @ origin, (inverse.to_3x3() @ along).normalized())
        if hit:
            depth = float(view.viewmat[2] @ [*(shape.matrix_world @ place), 1.0])
            if view.near < depth < nearest:
                best, nearest = obj, depth
    return best, nearest
