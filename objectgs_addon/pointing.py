# SPDX-License-Identifier: GPL-3.0-or-later
"""What is under the mouse in a 3D viewport: objects of splats and meshes, as they are seen."""

from dataclasses import dataclass

import bpy
import numpy as np
from bpy_extras.view3d_utils import region_2d_to_origin_3d, region_2d_to_vector_3d

from ..backend.picking import Placed, View, ids_in, pick
from . import drawing, scene
from .splat_arrays import arrays_of

LEAST_WEIGHT = 0.1
"""Splats that take less of the light of a pixel than this are not what is seen there."""

_SEE_THROUGH = ("splats", "points", "anchors")
_GRID = 12
"""Places across and down that a rectangle's meshes are looked at in."""


@dataclass(frozen=True)
class Pointed:
    """What is seen: an object's collection, or a Blender object that belongs to none."""

    collection: bpy.types.Collection | None
    thing: bpy.types.Object | None

    @property
    def name(self) -> str:
        return (self.collection or self.thing).name


def seen_at(context, x: float, y: float) -> Pointed | None:
    """What the viewport of the context shows at (x, y), pixels of its region from the lower left; None: nothing."""
    view = view_of(context)
    collections, placed = _splats(context)
    seen = pick(placed, view, x + 0.5, view.height - y - 0.5)
    if seen is not None and seen.weight < LEAST_WEIGHT:
        seen = None
    thing, depth = _mesh_at(context, _meshes(context), view, x, y)
    if thing is not None and (seen is None or depth < seen.depth):
        collection = drawing.owners().get(thing)
        return Pointed(collection, None if collection else thing)
    return None if seen is None else Pointed(collections[seen.object_id], None)


def seen_in(context, left: float, bottom: float, right: float, top: float) -> list[bpy.types.Collection]:
    """The objects' collections that the viewport shows in a rectangle, pixels of its region from the lower left."""
    view = view_of(context)
    collections, placed = _splats(context)
    found = [collections[key] for key in ids_in(placed, view, (left, view.height - top, right, view.height - bottom))]
    owners = drawing.owners()
    meshes = _meshes(context)
    if any(thing in owners for thing in meshes):
        for x in np.linspace(left, right, _GRID):
            for y in np.linspace(bottom, top, _GRID):
                thing, _ = _mesh_at(context, meshes, view, x, y)
                if thing in owners:
                    found.append(owners[thing])
    return list(dict.fromkeys(found))


def view_of(context) -> View:
    """The view of the context's viewport."""
    region, region_3d = context.region, context.region_data
    return View.of_matrices(np.array(region_3d.view_matrix), np.array(region_3d.window_matrix), region.width,
                            region.height)


def _splats(context) -> tuple[dict[int, bpy.types.Collection], list[Placed]]:
    """The shown splats by their object's collection, and the collections by the numbers that stand for them."""
    collections, placed = {}, []
    owners = drawing.owners()
    for part in drawing.splat_parts(context.view_layer, context.space_data):
        collection, arrays = owners.get(part), arrays_of(part.data)
        if collection is not None and arrays is not None and not part.hide_select:
            collections[collection.session_uid] = collection
            placed.append(Placed(collection.session_uid, arrays.cloud, np.array(part.matrix_world)))
    return collections, placed


def _meshes(context) -> list[bpy.types.Object]:
    """The meshes that the viewport shows and that are not splats or points."""
    return [thing for thing in context.view_layer.objects
            if thing.type == "MESH" and scene.kind_of(thing) not in _SEE_THROUGH and not thing.hide_select
            and drawing.shown(thing, context.view_layer, context.space_data)]


def _mesh_at(context, meshes, view: View, x: float, y: float) -> tuple[bpy.types.Object | None, float]:
    """The foremost of the meshes at a place of the region, and its depth."""
    region, region_3d = context.region, context.region_data
    origin = region_2d_to_origin_3d(region, region_3d, (x, y))
    along = region_2d_to_vector_3d(region, region_3d, (x, y))
    depsgraph = context.evaluated_depsgraph_get()
    best, nearest = None, np.inf
    for thing in meshes:
        shape = thing.evaluated_get(depsgraph)
        inverse = shape.matrix_world.inverted_safe()
        hit, place, _normal, _face = shape.ray_cast(inverse @ origin, (inverse.to_3x3() @ along).normalized())
        if hit:
            depth = float(view.viewmat[2] @ [*(shape.matrix_world @ place), 1.0])
            if view.near < depth < nearest:
                best, nearest = thing, depth
    return best, nearest
