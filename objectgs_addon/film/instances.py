# SPDX-License-Identifier: GPL-3.0-or-later
"""The splat carriers of a reconstruction in a scene, and their instances: whether they are seen, and where they are."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix

from ..scene import scene_meshes
from ..scene.kinds import MESH, OBJECT_PARENT, PARENT, SPLATS, kind_of, object_id_of, parent_above, parent_of, part_of


@dataclass(frozen=True, eq=False)
class SplatsInstance:
    """A splat carrier in the scene, or an instance of it.

    Attributes:
        object_id: ID of its object.
        splats: the carrier.
        pivot: empty at the origin of its vertices.
        parts: the carrier and the meshes of the same object; at least one must be shown.
        paths: paths of layer collections from the top of the view layer; at least one path must be shown.
        instancer: empty that instances the carrier's collection, or None.
    """

    object_id: int
    splats: bpy.types.Object
    pivot: bpy.types.Object
    parts: tuple
    paths: tuple
    instancer: bpy.types.Object | None = None

    def can_move(self) -> bool:
        """Return whether it may have another place in other frames than those of a shot."""
        chain: list[bpy.types.Object] = []
        for obj in (self.splats, self.instancer):
            while obj is not None and kind_of(obj) != PARENT:
                chain.append(obj)
                obj = obj.parent
        return any(each.animation_data or each.constraints or each.rigid_body for each in chain)

    def is_seen(self) -> bool:
        """Return whether Blender renders it at the current frame, ignoring the reconstruction's own collection."""
        top = self.instancer or self.pivot
        shown = any(not part.hide_render and part.visible_camera for part in self.parts)
        return (
            shown
            and not top.hide_render
            and top.visible_camera
            and any(all(map(_is_shown, path)) for path in self.paths)
        )

    def world(self) -> np.ndarray:
        """Return the map from local to world coordinates at the current frame, (4, 4) float64."""
        world = world_of(self.splats)
        if self.instancer is not None:
            offset = Matrix.Translation(-self.instancer.instance_collection.instance_offset)
            world = world_of(self.instancer) @ offset @ world
        return np.array(world, np.float64)


def _is_shown(layer: bpy.types.LayerCollection) -> bool:
    return not (layer.exclude or layer.indirect_only or layer.collection.hide_render)


def instances_of(
    scene: bpy.types.Scene, root: bpy.types.Collection, paths: dict[bpy.types.Collection, list]
) -> list[SplatsInstance]:
    """Return the splat carriers of a reconstruction, and their instances; paths: those of `layer_paths`."""
    parent, members = parent_of(root), {root, *root.children_recursive}

    def is_ours(obj: bpy.types.Object) -> bool:
        if kind_of(obj) != SPLATS:
            return False
        above = parent_above(obj)
        # An object that the user has parented to others has none of the parents.
        return above == parent if above is not None else not members.isdisjoint(obj.users_collection)

    ours = [obj for obj in scene.objects if is_ours(obj)]
    whole = tuple(scene_meshes(root))
    found = [instance for obj in ours if (instance := _instance_of(obj, paths, whole)) is not None]
    for instancer in scene.objects:
        if instancer.instance_type == "COLLECTION" and instancer.instance_collection is not None:
            for obj in instancer.instance_collection.all_objects:
                if is_ours(obj):
                    found.append(_instance_of(obj, paths, whole, instancer))
    return [instance for instance in found if instance is not None]


def _instance_of(obj: bpy.types.Object, paths: Any, whole: tuple, instancer: Any = None) -> SplatsInstance | None:
    """Return a splat carrier as an instance, None if it belongs to no object; whole: the meshes of the whole scene."""
    collections, object_id = list(obj.users_collection), object_id_of(obj)

    def is_own(above: bpy.types.Object | None) -> bool:
        # The user may have parented a part to the pivot of another object.
        return kind_of(above) == OBJECT_PARENT and object_id_of(above) == object_id

    pivot = (
        obj.parent
        if is_own(obj.parent)
        else next(
            (pivot for collection in collections if (pivot := part_of(collection, OBJECT_PARENT)) is not None), None
        )
    )
    if pivot is None or object_id is None:
        return None
    # The user may have given a mesh another parent, or moved it to another collection.
    apart = [part for each in collections for part in each.objects if not is_own(part.parent)]
    meshes = [part for part in {*pivot.children, *apart} if kind_of(part) == MESH and object_id_of(part) == object_id]
    if object_id == 0:
        meshes += whole
    top = instancer or obj
    of_top = [path for collection in top.users_collection for path in paths.get(collection, ())]
    return SplatsInstance(object_id, obj, pivot, (obj, *meshes), tuple(of_top), instancer)


def layer_paths(view_layer: bpy.types.ViewLayer, without: bpy.types.Collection | None = None) -> dict:
    """Map collections to their paths in a view layer: lists of layer collections from the top, without one of them."""
    found: dict = {}

    def walk(layer: Any, path: list) -> None:
        if layer.collection != without:
            path = [*path, layer]
        found.setdefault(layer.collection, []).append(path)
        for child in layer.children:
            walk(child, path)

    walk(view_layer.layer_collection, [])
    return found


def layer_of(scene: bpy.types.Scene, root: bpy.types.Collection) -> bpy.types.ViewLayer:
    """Return the first view layer used for renders that a reconstruction is not excluded from, or else the first."""

    def has_root(view_layer: bpy.types.ViewLayer) -> bool:
        return any(not any(layer.exclude for layer in path) for path in layer_paths(view_layer).get(root, ()))

    return next((each for each in scene.view_layers if each.use and has_root(each)), scene.view_layers[0])


def world_of(obj: bpy.types.Object) -> Matrix:
    """Return an object's world matrix, computed from its parent's if hidden, since Blender may skip hidden objects."""
    if obj.visible_get() or obj.parent is None or obj.parent_type != "OBJECT" or obj.constraints:
        return obj.matrix_world
    return world_of(obj.parent) @ obj.matrix_parent_inverse @ obj.matrix_basis


@contextmanager
def evaluated_pivots(view_layer: bpy.types.ViewLayer, instances: Any) -> Iterator[None]:
    """Temporarily show animated pivots in viewports, since Blender does not animate hidden objects."""
    inactive = {
        instance.pivot: instance
        for instance in instances
        if (instance.pivot.animation_data or instance.pivot.constraints) and not instance.pivot.visible_get()
    }
    changed = []

    def show(obj: bpy.types.Object) -> None:
        changed.append((obj, obj.hide_viewport))
        obj.hide_viewport = False

    hidden = []
    for pivot, instance in inactive.items():
        for path in instance.paths:
            for layer in path:
                show(layer)
                show(layer.collection)
        show(pivot)
        if pivot.hide_get(view_layer=view_layer):
            hidden.append(pivot)
            pivot.hide_set(False, view_layer=view_layer)
    try:
        yield
    finally:
        for pivot in hidden:
            pivot.hide_set(True, view_layer=view_layer)
        for obj, before in reversed(changed):
            obj.hide_viewport = before
