# SPDX-License-Identifier: GPL-3.0-or-later
"""Nondestructive recoloring of an object's splats and textures through inputs of node groups."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ....backend.shared.color.recolor import Recolor, average_luma
from ....backend.shared.splats.spherical_harmonics import C0
from .. import carrier
from ..kinds import MESH, MESH_COLORS, SPLATS, TEXTURE, kind_of, part_of, parts_of
from ..object_collection import our_materials
from ..shading.color_nodes import CHANNELS, OFFSET, encoded_channel, linear_channel, recolor_inputs, recolored
from ..shading.graph import Graph, find_or_make
from ..shading.modifiers import recolor_splats
from .fills import unobserved_splats

RECOLOR = "objectgs_recolor"
"""Custom property of an object's collection: its recoloring from objects.json, as JSON."""

TEXTURE_GROUP = "texture_recolor"

RECOLORED = "Recolored"
"""Color attribute of a recolored object's meshes, which Solid mode shows instead of the captured colors."""


def recolor_of(collection: bpy.types.Collection) -> Recolor | None:
    """Return the recoloring of an object or duplicate, or None."""
    stored = collection.get(RECOLOR)
    return Recolor.of(json.loads(stored)) if stored else None


def set_recolor(collection: bpy.types.Collection, recolor: Recolor | None) -> None:
    """Recolor the splats and meshes of a collection; None restores the captured colors and removes texture nodes."""
    stored = recolor.stored() if recolor is not None else None
    if stored is not None:
        collection[RECOLOR] = json.dumps(stored)
    elif RECOLOR in collection:
        del collection[RECOLOR]
    affine = None if recolor is None else recolor.affine()
    for obj in parts_of(collection):
        if kind_of(obj) == SPLATS:
            recolor_splats(obj, affine)
        elif kind_of(obj) == MESH:
            for material in our_materials(obj):
                _recolor_textures(material, affine)
            _recolor_vertices(obj.data, affine)


def luma_of(collection: bpy.types.Collection) -> float:
    """Return the average luma of the object's splats, 0 .. 1, from which recoloring preserves shading."""
    obj = part_of(collection, SPLATS)
    if obj is None or "radiance:base" not in obj.data.attributes:
        return average_luma(np.zeros((0, 3)), np.zeros(0))
    base = carrier.read(obj.data, "radiance:base")[~unobserved_splats(obj.data)].astype(np.float64)
    return average_luma(0.5 + C0 * base[:, :3], base[:, 3])


def _recolor_vertices(mesh: bpy.types.ID, affine: tuple[np.ndarray, np.ndarray] | None) -> None:
    """Show a mesh's vertex colors mapped in a color attribute of its own; None shows the captured ones and removes it.

    A mesh in Edit Mode, where attributes cannot be written, and one that the user has converted are left as they are.
    """
    if not isinstance(mesh, bpy.types.Mesh) or mesh.is_editmode:
        return
    attributes = mesh.color_attributes
    is_shown = attributes.active_color_name in (MESH_COLORS, RECOLORED)
    before = attributes.get(RECOLORED)
    if before is not None:
        attributes.remove(before)
    captured = attributes.get(MESH_COLORS)
    if captured is None:
        return
    if affine is not None:
        colors = np.empty((len(captured.data), 4), np.float32)
        captured.data.foreach_get("color_srgb", colors.reshape(-1))
        matrix, offset = affine
        colors[:, :3] = np.clip(colors[:, :3] @ matrix.T + offset, 0.0, 1.0)
        mapped = attributes.new(RECOLORED, captured.data_type, captured.domain)
        mapped.data.foreach_set("color_srgb", colors.reshape(-1))
    if is_shown:
        attributes.active_color_name = MESH_COLORS if affine is None else RECOLORED
    mesh.update_tag()


def _recolor_textures(material: bpy.types.Material, affine: Any) -> None:
    """Insert or update the recolor node after each of the add-on's textures; None removes it."""
    tree = material.node_tree
    for image_node in [node for node in tree.nodes if node.type == "TEX_IMAGE" and kind_of(node.image) == TEXTURE]:
        color = image_node.outputs["Color"]
        between = [link.to_node for link in color.links if _is_ours(link.to_node)]
        if affine is None:
            for node in between:
                for link in list(node.outputs[0].links):
                    tree.links.new(color, link.to_socket)
                tree.nodes.remove(node)
            continue
        if not between:
            between = [_insert(tree, image_node)]
        matrix, offset = affine
        for node in between:
            for channel, row in zip(CHANNELS, matrix):
                node.inputs[f"Recolor {channel}"].default_value = row.tolist()
            node.inputs[OFFSET].default_value = offset.tolist()


def with_own_textures(
    material: bpy.types.Material, recolor: Recolor | None, folder: Path, prefix: str = ""
) -> tuple[bpy.types.Material, list[bpy.types.Image]]:
    """Copy a material with copies of its texture images, which are recolored.

    Args:
        material: the material to copy.
        recolor: the recoloring; None to keep the colors.
        folder: where to save the images as PNG; those that are there are kept.
        prefix: how the names of these files begin.

    Returns:
        The copy and its new images.
    """
    copy, images = material.copy(), []
    _recolor_textures(copy, None)
    for node in [node for node in copy.node_tree.nodes if node.type == "TEX_IMAGE" and kind_of(node.image) == TEXTURE]:
        source = node.image
        if not source.size[0]:
            continue  # Its file is missing.
        pixels = np.empty(4 * source.size[0] * source.size[1], np.float32)
        source.pixels.foreach_get(pixels)
        if recolor is not None:
            matrix, offset = recolor.affine()
            colors = pixels.reshape(-1, 4)
            colors[:, :3] = np.clip(colors[:, :3] @ matrix.T + offset, 0.0, 1.0)
        image = bpy.data.images.new(source.name, *source.size)
        image.pixels.foreach_set(pixels)
        stem = bpy.path.clean_name(source.name if recolor is None else f"{source.name} recolored")
        image.filepath_raw = str(_free_path(folder, f"{prefix}{stem}"))
        image.file_format = "PNG"
        image.save()
        image.source = "FILE"
        node.image = image
        images.append(image)
    return copy, images


def _free_path(folder: Path, stem: str) -> Path:
    """Return a PNG in a folder whose name differs from those of the others in more than upper and lower case."""
    taken = {path.stem.casefold() for path in folder.iterdir()}
    names = itertools.chain([stem], (f"{stem}_{number}" for number in itertools.count(2)))
    return folder / f"{next(name for name in names if name.casefold() not in taken)}.png"


def _is_ours(node: bpy.types.Node) -> bool:
    return node.type == "GROUP" and kind_of(node.node_tree) == TEXTURE_GROUP


def _insert(tree: bpy.types.NodeTree, image_node: Any) -> bpy.types.Node:
    color = image_node.outputs["Color"]
    targets = [link.to_socket for link in color.links]
    node = tree.nodes.new("ShaderNodeGroup")
    node.node_tree = find_or_make(bpy.data.node_groups, TEXTURE_GROUP, 1, "ObjectGS Recolor", _make_group)
    node.label = "Recolor"
    node.location = image_node.location[0] + 20.0, image_node.location[1] - 280.0
    for target in targets:
        tree.links.new(node.outputs[0], target)
    tree.links.new(color, node.inputs["Color"])
    return node


def _make_group(name: str) -> bpy.types.NodeTree:
    """Create the shader group that applies the affine map to a texture's linear colors in sRGB encoding."""
    tree = bpy.data.node_groups.new(name, "ShaderNodeTree")
    tree.interface.new_socket("Color", in_out="OUTPUT", socket_type="NodeSocketColor")
    tree.interface.new_socket("Color", in_out="INPUT", socket_type="NodeSocketColor")
    for label, kind, default, _, description in recolor_inputs():
        socket = tree.interface.new_socket(label, in_out="INPUT", socket_type=kind)
        socket.default_value, socket.description = default, description
    graph = Graph(tree)
    given = graph.node("NodeGroupInput")
    encoded = [encoded_channel(graph, channel) for channel in graph.separated(given.outputs["Color"])]
    color = graph.node("ShaderNodeCombineXYZ", dict(enumerate(encoded))).outputs[0]
    mapped = graph.separated(recolored(graph, color, given))
    linear = [linear_channel(graph, channel) for channel in mapped]
    graph.node("NodeGroupOutput", {0: graph.node("ShaderNodeCombineXYZ", dict(enumerate(linear))).outputs[0]})
    graph.arrange()
    return tree
