# SPDX-License-Identifier: GPL-3.0-or-later
"""Geometry nodes modifiers of mesh carriers: creation, inputs, updates of node groups, and viewport display."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np

from ..kinds import kind_of
from .color_nodes import CHANNELS, OFFSET
from .node_groups import HIDE_GROUP, RENDER_GROUP, SPLATS_GROUP, hide_group, splats_group


def add_splats_modifiers(obj: bpy.types.Object, largest_point: float) -> None:
    """Add the modifiers that show a mesh carrier's splats, one for viewports and one for renders.

    Args:
        obj: the mesh carrier.
        largest_point: upper limit of the radius of the viewport's points, in the mesh's units.
    """
    viewport = obj.modifiers.new("ObjectGS Splats", "NODES")
    viewport.node_group = splats_group(SPLATS_GROUP)
    viewport.show_render = False
    set_input(viewport, "Largest Point", largest_point)
    render = obj.modifiers.new("ObjectGS Render", "NODES")
    render.node_group = splats_group(RENDER_GROUP)
    render.show_viewport = False


def use_material(obj: bpy.types.Object, material: bpy.types.Material) -> None:
    """Give the splats of a carrier a material, in viewports and renders."""
    for modifier in _splats_modifiers(obj):
        set_input(modifier, "Material", material)


def recolor_splats(obj: bpy.types.Object, affine: tuple[np.ndarray, np.ndarray] | None) -> None:
    """Recolor a carrier's splats by an affine map.

    Args:
        obj: the mesh carrier.
        affine: matrix (3, 3) and offset (3,) on sRGB-encoded colors; None restores the captured colors.
    """
    matrix, offset = affine or (np.eye(3), np.zeros(3))
    changed = False
    for modifier in _splats_modifiers(obj):
        newest = splats_group(kind_of(modifier.node_group))
        if modifier.node_group != newest:
            if affine is None:
                continue  # An older group may lack the recolor inputs, so there is nothing to reset.
            _replace_group(modifier, newest)
        for name, row in ((OFFSET, offset), *((f"Recolor {channel}", row) for channel, row in zip(CHANNELS, matrix))):
            set_input(modifier, name, [float(value) for value in row])
            changed = True
    if changed:
        obj.update_tag()


def update_groups(obj: bpy.types.Object) -> None:
    """Replace a carrier's node groups with the newest versions; inputs keep their values."""
    for modifier in _splats_modifiers(obj):
        newest = splats_group(kind_of(modifier.node_group))
        if modifier.node_group != newest:
            _replace_group(modifier, newest)


def show_preview(part: bpy.types.Object, is_on: bool) -> None:
    """Switch the viewport preview of a carrier's splats on or off; renders are not affected.

    While the preview is off, a modifier with empty output hides the vertices, which Blender would draw as dots.
    """
    preview, hiding = modifier_of(part, SPLATS_GROUP), modifier_of(part, HIDE_GROUP)
    if preview is None or part.library is not None:
        return
    if preview.show_viewport != is_on:
        preview.show_viewport = is_on
    if is_on and hiding is not None:
        part.modifiers.remove(hiding)
    elif not is_on:
        hiding = hiding or part.modifiers.new("ObjectGS Drawn", "NODES")
        if hiding.show_render:  # Each assignment makes Blender evaluate the scene again.
            hiding.show_render = False
        if hiding.node_group != (newest := hide_group()):
            hiding.node_group = newest


def set_input(modifier: bpy.types.NodesModifier, name: str, value: Any) -> None:
    """Set an input of a geometry nodes modifier by its label; raise KeyError if there is no such input."""
    for item in modifier.node_group.interface.items_tree:
        if item.item_type == "SOCKET" and item.in_out == "INPUT" and item.name == name:
            if hasattr(modifier, "properties"):  # from Blender 5.2 on
                getattr(modifier.properties.inputs, item.identifier).value = value
            else:
                modifier[item.identifier] = value
            return
    raise KeyError(name)


def inputs_of(modifier: bpy.types.NodesModifier) -> dict[str, Any]:
    """Map the labels of a geometry nodes modifier's inputs, except its geometry, to their values."""
    values = {}
    for item in modifier.node_group.interface.items_tree:
        if item.item_type == "SOCKET" and item.in_out == "INPUT" and item.socket_type != "NodeSocketGeometry":
            if hasattr(modifier, "properties"):  # from Blender 5.2 on
                values[item.name] = getattr(modifier.properties.inputs, item.identifier).value
            else:
                values[item.name] = modifier[item.identifier]
    return values


def modifier_of(obj: bpy.types.Object, kind: str) -> bpy.types.NodesModifier | None:
    """Return the first modifier of an object whose node group is of this kind, or None."""
    for modifier in obj.modifiers:
        if modifier.type == "NODES" and modifier.node_group is not None and kind_of(modifier.node_group) == kind:
            return modifier
    return None


def _splats_modifiers(obj: bpy.types.Object) -> list[bpy.types.NodesModifier]:
    """Return the existing splat modifiers for viewports and renders."""
    found = (modifier_of(obj, kind) for kind in (SPLATS_GROUP, RENDER_GROUP))
    return [modifier for modifier in found if modifier is not None]


def _replace_group(modifier: bpy.types.NodesModifier, group: bpy.types.NodeTree) -> None:
    values = inputs_of(modifier)
    modifier.node_group = group
    for name, value in values.items():
        set_input(modifier, name, value)
