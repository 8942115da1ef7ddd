# SPDX-License-Identifier: GPL-3.0-or-later
"""Visibility of a reconstruction's objects in a view layer."""

from __future__ import annotations

from collections.abc import Iterator

import bpy

from .. import scene


def _layers(layer: bpy.types.LayerCollection) -> Iterator[bpy.types.LayerCollection]:
    """Yield a layer collection and all its descendants."""
    yield layer
    for child in layer.children:
        yield from _layers(child)


def _layers_of(view_layer: bpy.types.ViewLayer, root: bpy.types.Collection) -> Iterator[bpy.types.LayerCollection]:
    """Yield the layer collections of a reconstruction; none if it is not in the view layer."""
    top = next((layer for layer in _layers(view_layer.layer_collection) if layer.collection == root), None)
    return _layers(top) if top is not None else iter(())


def object_layers(view_layer: bpy.types.ViewLayer, root: bpy.types.Collection) -> dict[int, bpy.types.LayerCollection]:
    """Map object IDs to layer collections, for objects that have one."""
    return {
        object_id: layer
        for layer in _layers_of(view_layer, root)
        if scene.kind_of(layer.collection) == "object"
        and (object_id := scene.object_id_of(layer.collection)) is not None
    }


def capture_layer(view_layer: bpy.types.ViewLayer, root: bpy.types.Collection) -> bpy.types.LayerCollection | None:
    """Return the layer collection of a reconstruction's cameras and points, if the view layer has it."""
    layers = _layers_of(view_layer, root)
    return next((layer for layer in layers if scene.kind_of(layer.collection) == "capture"), None)


def _duplicate_layers(view_layer: bpy.types.ViewLayer, root: bpy.types.Collection) -> list[bpy.types.LayerCollection]:
    """Return the layer collections of the objects' duplicates."""
    copies = [copy for copies in scene.duplicates_of(root).values() for copy in copies]
    return [layer for layer in _layers(view_layer.layer_collection) if layer.collection in copies] if copies else []


def toggle_solo(view_layer: bpy.types.ViewLayer, root: bpy.types.Collection, object_id: int) -> bool:
    """Hide all objects except one and its duplicates, or show all if it is the only one shown.

    Args:
        view_layer: the view layer.
        root: the reconstruction's collection.
        object_id: ID of the object to isolate.

    Returns:
        False if the object has no collection.
    """
    layers = object_layers(view_layer, root)
    if object_id not in layers:
        return False
    alone = all(layer.hide_viewport != (other == object_id) for other, layer in layers.items())
    for other, layer in layers.items():
        layer.hide_viewport = not alone and other != object_id
    for layer in _duplicate_layers(view_layer, root):
        layer.hide_viewport = not alone and scene.object_id_of(layer.collection) != object_id
    return True
