# SPDX-License-Identifier: GPL-3.0-or-later
"""An object's other colours, on its splats and its textures alike: inputs of node groups, nothing is rewritten."""

import json
from pathlib import Path

import bpy
import numpy as np

from ...backend.recolour import Recolour, average_luma
from . import carrier, preview
from .fills import invented_splats
from .kinds import MESH, SPLATS, TEXTURE, kind_of, part_of, parts_of
from .object_collection import our_materials

RECOLOUR = "objectgs_recolour"
"""On an object's collection: what objects.json says of its colours, as JSON."""

TEXTURE_GROUP = "texture_recolour"


def recolour_of(collection: bpy.types.Collection) -> Recolour | None:
    """What the user asks of the colours of an object, or of the object that this is a duplicate of."""
    stored = collection.get(RECOLOUR)
    return Recolour.of(json.loads(stored)) if stored else None


def set_recolour(collection: bpy.types.Collection, recolour: Recolour | None) -> None:
    """Show splats and meshes of a collection in other colours; None takes that back, and the nodes with it."""
    stored = recolour.stored() if recolour is not None else None
    if stored is not None:
        collection[RECOLOUR] = json.dumps(stored)
    elif RECOLOUR in collection:
        del collection[RECOLOUR]
    affine = None if recolour is None else recolour.affine()
    for thing in parts_of(collection):
        if kind_of(thing) == SPLATS:
            preview.recolour_splats(thing, affine)
        elif kind_of(thing) == MESH:
            for material in our_materials(thing):
                _recolour_textures(material, affine)


def luma_of(collection: bpy.types.Collection) -> float:
    """How bright the object's splats are on average, 0 .. 1, by which recolouring keeps their shading."""
    thing = part_of(collection, SPLATS)
    if thing is None or "radiance:base" not in thing.data.attributes:
        return average_luma(np.zeros((0, 3)), np.zeros(0))
    base = carrier.read(thing.data, "radiance:base")[~invented_splats(thing.data)].astype(np.float64)
    return average_luma(0.5 + preview.SH_C0 * base[:, :3], base[:, 3])


def _recolour_textures(material: bpy.types.Material, affine) -> None:
    """Put the map between our textures and what they go into, or take it away (None)."""
    tree = material.node_tree
    for picture in [node for node in tree.nodes if node.type == "TEX_IMAGE" and kind_of(node.image) == TEXTURE]:
        colour = picture.outputs["Color"]
        between = [link.to_node for link in colour.links if _is_ours(link.to_node)]
        if affine is None:
            for node in between:
                for link in list(node.outputs[0].links):
                    tree.links.new(colour, link.to_socket)
                tree.nodes.remove(node)
            continue
        if not between:
            between = [_insert(tree, picture)]
        matrix, offset = affine
        for node in between:
            for channel, row in zip(preview.CHANNELS, matrix):
                node.inputs[f"Recolor {channel}"].default_value = row.tolist()
            node.inputs[preview.OFFSET].default_value = offset.tolist()


def with_own_textures(material: bpy.types.Material, recolour: Recolour,
                      folder: Path) -> tuple[bpy.types.Material, list[bpy.types.Image]]:
    """A copy of a material whose textures are pictures in other colours, in `folder`, and these pictures."""
    matrix, offset = recolour.affine()
    copy, images = material.copy(), []
    _recolour_textures(copy, None)
    for node in [node for node in copy.node_tree.nodes if node.type == "TEX_IMAGE" and kind_of(node.image) == TEXTURE]:
        source = node.image
        pixels = np.empty(4 * source.size[0] * source.size[1], np.float32)
        source.pixels.foreach_get(pixels)
        colours = pixels.reshape(-1, 4)
        colours[:, :3] = np.clip(colours[:, :3] @ matrix.T + offset, 0.0, 1.0)
        image = bpy.data.images.new(f"{source.name} recolored", *source.size)
        image.pixels.foreach_set(pixels)
        image.filepath_raw = str(folder / f"{bpy.path.clean_name(image.name)}.png")
        image.file_format = "PNG"
        image.save()
        image.source = "FILE"
        node.image = image
        images.append(image)
    return copy, images


def _is_ours(node) -> bool:
    return node.type == "GROUP" and kind_of(node.node_tree) == TEXTURE_GROUP


def _insert(tree, picture) -> bpy.types.Node:
    colour = picture.outputs["Color"]
    targets = [link.to_socket for link in colour.links]
    node = tree.nodes.new("ShaderNodeGroup")
    node.node_tree = preview.shared(bpy.data.node_groups, TEXTURE_GROUP, 1, "ObjectGS Recolor", _make_group)
    node.label = "Recolor"
    node.location = picture.location[0] + 20.0, picture.location[1] - 280.0
    for target in targets:
        tree.links.new(node.outputs[0], target)
    tree.links.new(colour, node.inputs["Color"])
    return node


def _make_group(name: str) -> bpy.types.NodeTree:
    """A texture's linear colours encoded, mapped, and linear again."""
    tree = bpy.data.node_groups.new(name, "ShaderNodeTree")
    tree.interface.new_socket("Color", in_out="OUTPUT", socket_type="NodeSocketColor")
    tree.interface.new_socket("Color", in_out="INPUT", socket_type="NodeSocketColor")
    for label, kind, default, _, description in preview.recolour_inputs():
        socket = tree.interface.new_socket(label, in_out="INPUT", socket_type=kind)
        socket.default_value, socket.description = default, description
    graph = preview.Graph(tree)
    given = graph.node("NodeGroupInput")
    encoded = [preview.encoded_channel(graph, channel) for channel in graph.separated(given.outputs["Color"])]
    colour = graph.node("ShaderNodeCombineXYZ", dict(enumerate(encoded))).outputs[0]
    mapped = graph.separated(preview.recoloured(graph, colour, given))
    linear = [preview.linear_channel(graph, channel) for channel in mapped]
    graph.node("NodeGroupOutput", {0: graph.node("ShaderNodeCombineXYZ", dict(enumerate(linear))).outputs[0]})
    graph.arrange()
    return tree
