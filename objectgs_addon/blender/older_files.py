# SPDX-License-Identifier: GPL-3.0-or-later
"""Migration of names that older versions of the extension wrote to .blend files, when a file is opened.

Only names are changed, and files with current names are not modified.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import bpy

from . import writing

KIND = "objectgs_kind"

CUSTOM_PROPERTIES = {
    "objectgs_centre": "objectgs_center",
    "objectgs_invented": "objectgs_unobserved",
    "objectgs_recolour": "objectgs_recolor",
}
"""Custom properties of objects and collections."""

KINDS = {"texture_recolour": "texture_recolor"}
"""Values of the custom property KIND."""

GROUPS = {"colour": "color", "splat_colors": "colors", "splat_colours": "colors"}
"""Properties of the property groups `Collection.objectgs` and `Scene.objectgs`, and of the items of their lists."""

ATTRIBUTES = {"closes": "fills", "invented": "unobserved"}
"""Attributes of splat carriers and object meshes."""

NODE_ATTRIBUTES = {"colour": "display_color"}
"""Attributes that the add-on's node groups store and the materials of points and splats read."""

_CARRIERS = ("points", "splats")
_MESHES = ("splats", "mesh")
_GROUPS_WITH_COLOR = ("points_preview", "splats_preview", "splats_render", "splat_shader")
_MATERIALS_WITH_COLOR = ("points_material", "splats_material", "ellipsoids_material")


def rename_all() -> None:
    """Replace all former names in the open file with the current ones."""
    for block in _blocks():
        _rename_keys(block, CUSTOM_PROPERTIES)
        kind = block.get(KIND)
        if isinstance(kind, str) and kind in KINDS:
            block[KIND] = KINDS[kind]
    for block in (*bpy.data.collections, *bpy.data.scenes):
        group = _stored_group(block)
        if group is not None:
            _rename_group(group)
    for obj in bpy.data.objects:
        if obj.get(KIND) in _MESHES and isinstance(obj.data, bpy.types.Mesh):
            _rename_attributes(obj.data)
    for tree in _trees_with_color():
        _rename_in_nodes(tree)


def _blocks() -> Iterator[bpy.types.ID]:
    data = bpy.data
    for blocks in (data.objects, data.collections, data.meshes, data.materials, data.images, data.scenes):
        yield from blocks
    yield from data.node_groups


def _stored_group(block: bpy.types.ID) -> Any:
    """Return the stored data of the property group `objectgs` of a collection or scene, or None."""
    if hasattr(block, "bl_system_properties_get"):  # from Blender 5.0 on
        properties = block.bl_system_properties_get()
        return None if properties is None else properties.get("objectgs")
    return block.get("objectgs")


def _rename_group(group: Any) -> None:
    if not hasattr(group, "keys"):
        return
    _rename_keys(group, GROUPS)
    for key in list(group.keys()):
        value = group[key]
        for item in value if isinstance(value, list) else ():
            _rename_group(item)


def _rename_keys(owner: Any, names: dict[str, str]) -> None:
    for former, name in names.items():
        if former in owner.keys():  # noqa: SIM118 - an ID is not a mapping
            if name not in owner.keys():  # noqa: SIM118
                owner[name] = owner[former]
            del owner[former]


def _rename_attributes(mesh: bpy.types.Mesh) -> None:
    for former, name in ATTRIBUTES.items():
        attribute = mesh.attributes.get(former)
        if attribute is not None and name not in mesh.attributes:
            attribute.name = name


def _trees_with_color() -> set[bpy.types.NodeTree]:
    """Return the node trees that use the display color attribute: the add-on's groups and materials of carriers."""
    materials = {material for material in bpy.data.materials if material.get(KIND) in _MATERIALS_WITH_COLOR}
    for obj in bpy.data.objects:
        if obj.get(KIND) in _CARRIERS and isinstance(obj.data, bpy.types.Mesh):
            materials.update(material for material in obj.data.materials if material is not None)
    trees = {tree for tree in bpy.data.node_groups if tree.get(KIND) in _GROUPS_WITH_COLOR}
    return trees | {material.node_tree for material in materials if material.node_tree is not None}


def _rename_in_nodes(tree: bpy.types.NodeTree) -> None:
    for node in tree.nodes:
        if node.bl_idname == "ShaderNodeAttribute":
            if node.attribute_name in NODE_ATTRIBUTES:
                node.attribute_name = NODE_ATTRIBUTES[node.attribute_name]
        elif node.bl_idname in ("GeometryNodeInputNamedAttribute", "GeometryNodeStoreNamedAttribute"):
            socket = node.inputs["Name"]
            if socket.default_value in NODE_ATTRIBUTES:
                socket.default_value = NODE_ATTRIBUTES[socket.default_value]


@bpy.app.handlers.persistent
@writing.allowed
def _file_loaded(*_: Any) -> None:
    rename_all()


# Blender before 4.3 has no handler for linked or appended data.
_HANDLERS = [name for name in ("load_post", "blend_import_post") if hasattr(bpy.app.handlers, name)]


def register() -> None:
    """Add the handlers for opened, linked and appended files; call this before adding handlers that read the names."""
    for name in _HANDLERS:
        getattr(bpy.app.handlers, name).append(_file_loaded)
    if not bpy.app.background:
        # The extension may be installed while a file is open, and the file cannot be changed during registration.
        bpy.app.timers.register(_file_loaded, first_interval=0.0)


def unregister() -> None:
    """Remove the handlers."""
    if bpy.app.timers.is_registered(_file_loaded):
        bpy.app.timers.unregister(_file_loaded)
    for name in _HANDLERS:
        getattr(bpy.app.handlers, name).remove(_file_loaded)
