# SPDX-License-Identifier: GPL-3.0-or-later
"""Carriers whose splats something else draws in the viewport: without their preview, and without dots for vertices."""

import bpy

from .kinds import kind_of, mark
from .preview import SPLATS_GROUP, modifier_of

DRAWN_GROUP = "splats_drawn"


def show_preview(part: bpy.types.Object, is_on: bool) -> None:
    """Switch the geometry nodes' preview of a carrier's splats in viewports; renders keep theirs."""
    preview, drawn = modifier_of(part, SPLATS_GROUP), modifier_of(part, DRAWN_GROUP)
    if preview is None or part.library is not None:
        return
    if preview.show_viewport != is_on:
        preview.show_viewport = is_on
    if is_on and drawn is not None:
        part.modifiers.remove(drawn)
    elif not is_on and drawn is None:
        drawn = part.modifiers.new("ObjectGS Drawn", "NODES")
        drawn.node_group = _nothing()
        drawn.show_render = False


def _nothing() -> bpy.types.NodeTree:
    """The group that shows nothing: Blender would mark the vertices of a mesh that has only those."""
    for tree in bpy.data.node_groups:
        if kind_of(tree) == DRAWN_GROUP and tree.library is None:
            return tree
    tree = bpy.data.node_groups.new("ObjectGS Drawn", "GeometryNodeTree")
    mark(tree, DRAWN_GROUP)
    tree.is_modifier = True
    for side in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Geometry", in_out=side, socket_type="NodeSocketGeometry")
    tree.nodes.new("NodeGroupOutput")
    return tree
