# SPDX-License-Identifier: GPL-3.0-or-later
"""Which objects of a reconstruction a view layer shows."""

from . import scene


def _layers(layer):
    """A layer collection and all below it."""
    yield layer
    for child in layer.children:
        yield from _layers(child)


def object_layers(view_layer, root) -> dict:
    """Object ID -> its layer collection, of the objects that have one."""
    top = next((layer for layer in _layers(view_layer.layer_collection) if layer.collection == root), None)
    return {} if top is None else {
        scene.object_id_of(layer.collection): layer for layer in _layers(top)
        if scene.kind_of(layer.collection) == "object"}


def _copy_layers(view_layer, root) -> list:
    """The layer collections of the objects' duplicates."""
    copies = [copy for copies in scene.copies_of(root).values() for copy in copies]
    return [layer for layer in _layers(view_layer.layer_collection) if layer.collection in copies] if copies else []


def toggle_solo(view_layer, root, object_id: int) -> bool:
    """Hide every object but one, or show all where that one is alone already; False where it has no collection.

    Duplicates go with what they are duplicates of.
    """
    layers = object_layers(view_layer, root)
    if object_id not in layers:
        return False
    alone = all(layer.hide_viewport != (other == object_id) for other, layer in layers.items())
    for other, layer in layers.items():
        layer.hide_viewport = not alone and other != object_id
    for layer in _copy_layers(view_layer, root):
        layer.hide_viewport = not alone and scene.object_id_of(layer.collection) != object_id
    return True
