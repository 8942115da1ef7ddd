# SPDX-License-Identifier: GPL-3.0-or-later
"""Materials of points, splats, ellipsoids and meshes."""

from __future__ import annotations

import bpy

from ..kinds import MESH_MATERIAL, SPLATS_MATERIAL, mark
from .graph import Graph, find_or_make

SMALLEST_ALPHA = 1.0 / 255.0
"""Alpha at which a splat ends."""

COLOR = "display_color"
"""Attribute of shown points and splats: linear RGBA. Not "color", which Cycles takes for the color of a volume."""

SPLAT_SHADER = "splat_shader"
POINTS_MATERIAL = "points_material"
ELLIPSOIDS_MATERIAL = "ellipsoids_material"

MESH_ROUGHNESS = 0.8
MESH_SPECULAR = 0.2
"""Low, since the texture already contains the photos' highlights."""


def points_material() -> bpy.types.Material:
    """The shared material of point clouds, which emits their color."""
    return find_or_make(bpy.data.materials, POINTS_MATERIAL, 2, "ObjectGS Points", _make_points_material)


def _make_points_material(name: str) -> bpy.types.Material:
    material, graph = _empty_material(name)
    color = graph.node("ShaderNodeAttribute", attribute_name=COLOR).outputs["Color"]
    emission = graph.node("ShaderNodeEmission", {"Color": color}).outputs[0]
    graph.node("ShaderNodeOutputMaterial", {"Surface": emission})
    graph.arrange()
    return material


def splats_material(name: str, color: tuple[float, ...]) -> bpy.types.Material:
    """Make a material for one object's splats; color: linear RGB, shown by Solid mode."""
    material, graph = _empty_material(name)
    mark(material, SPLATS_MATERIAL)
    shader = find_or_make(bpy.data.node_groups, SPLAT_SHADER, 2, "ObjectGS Splat", _make_splat_shader)
    group = graph.node("ShaderNodeGroup", node_tree=shader)
    group.width = 200.0
    graph.node("ShaderNodeOutputMaterial", {"Surface": group.outputs[0]}, location=(260.0, 0.0))
    material.diffuse_color = (*color, 1.0)
    return material


def _make_splat_shader(name: str) -> bpy.types.NodeTree:
    """The shader of discs, whose attribute `disc` holds the position on the disc and the nearness of the camera.

    Points have no such attribute, and alpha 1.
    """
    tree = bpy.data.node_groups.new(name, "ShaderNodeTree")
    tree.interface.new_socket("Shader", in_out="OUTPUT", socket_type="NodeSocketShader")
    graph = Graph(tree)
    color = graph.node("ShaderNodeAttribute", attribute_type="GEOMETRY", attribute_name=COLOR)
    disc = graph.node("ShaderNodeAttribute", attribute_type="GEOMETRY", attribute_name="disc").outputs["Vector"]
    x, y, nearness = graph.separated(disc)
    flat = graph.math("ADD", graph.math("MULTIPLY", x, x), graph.math("MULTIPLY", y, y))
    squared_distance = graph.math("DIVIDE", flat, graph.math("MULTIPLY_ADD", flat, nearness, 1.0))
    _falloff(graph, color.outputs["Color"], color.outputs["Alpha"], squared_distance, None)
    return tree


def ellipsoids_material() -> bpy.types.Material:
    """The shared material of ellipsoids, whose color is an attribute of the instance."""
    return find_or_make(bpy.data.materials, ELLIPSOIDS_MATERIAL, 2, "ObjectGS Ellipsoids", _make_ellipsoids_material)


def _make_ellipsoids_material(name: str) -> bpy.types.Material:
    material, graph = _empty_material(name)
    color = graph.node("ShaderNodeAttribute", attribute_type="INSTANCER", attribute_name=COLOR)
    geometry = graph.node("ShaderNodeNewGeometry")
    position = graph.node("ShaderNodeTexCoord").outputs["Object"]
    eye = graph.node(
        "ShaderNodeVectorTransform",
        {"Vector": geometry.outputs["Incoming"]},
        vector_type="VECTOR",
        convert_from="WORLD",
        convert_to="OBJECT",
    ).outputs[0]
    along = graph.vector("DOT_PRODUCT", position, graph.vector("NORMALIZE", eye), output="Value")
    squared_distance = graph.math(
        "SUBTRACT",
        graph.vector("DOT_PRODUCT", position, position, output="Value"),
        graph.math("MULTIPLY", along, along),
    )
    _falloff(graph, color.outputs["Color"], color.outputs["Alpha"], squared_distance, geometry.outputs["Backfacing"])
    return material


def _falloff(
    graph: Graph,
    color: bpy.types.NodeSocket,
    opacity: bpy.types.NodeSocket,
    squared_distance: bpy.types.NodeSocket,
    hidden: bpy.types.NodeSocket | None,
) -> None:
    """Make the Gaussian's emission and alpha the output of the tree.

    alpha = opacity * exp(-sigmas^2 / 2) with sigmas^2 = 2 ln(255 opacity) * squared_distance, where squared_distance,
    of the ray from the splat's center, is 1 at the end of the splat. hidden: 1 where alpha is 0, or None.
    """
    falloff = graph.math(
        "POWER", graph.math("MULTIPLY", opacity, 1.0 / SMALLEST_ALPHA), graph.math("MULTIPLY", squared_distance, -1.0)
    )
    alpha = graph.math(
        "MULTIPLY", graph.math("MULTIPLY", opacity, falloff), graph.math("LESS_THAN", squared_distance, 1.0)
    )
    if hidden is not None:
        alpha = graph.math("MULTIPLY", alpha, graph.math("SUBTRACT", 1.0, hidden))
    emission = graph.node("ShaderNodeEmission", {"Color": color}).outputs[0]
    clear = graph.node("ShaderNodeBsdfTransparent").outputs[0]
    mixed = graph.node("ShaderNodeMixShader", {0: alpha, 1: clear, 2: emission}).outputs[0]
    is_group = isinstance(graph.tree, bpy.types.ShaderNodeTree) and graph.tree.interface.items_tree
    graph.node("NodeGroupOutput" if is_group else "ShaderNodeOutputMaterial", {0: mixed})
    graph.arrange()


def mesh_material(name: str, image: bpy.types.Image, like: bpy.types.Material | None) -> bpy.types.Material:
    """Make a material with a mesh's texture, as a copy of `like` if given, which is faster."""
    if like is not None:
        material = like.copy()
        material.name = name
        next(node for node in material.node_tree.nodes if node.type == "TEX_IMAGE").image = image
        return material
    material = _material_without_nodes(name)
    mark(material, MESH_MATERIAL)
    graph = Graph(material.node_tree)
    texture = graph.node("ShaderNodeTexImage", location=(-320.0, 0.0))
    texture.image = image
    shader = graph.node(
        "ShaderNodeBsdfPrincipled",
        {"Base Color": texture.outputs["Color"], "Roughness": MESH_ROUGHNESS, "Specular IOR Level": MESH_SPECULAR},
    )
    graph.node("ShaderNodeOutputMaterial", {"Surface": shader.outputs[0]}, location=(320.0, 0.0))
    return material


def _empty_material(name: str) -> tuple[bpy.types.Material, Graph]:
    material = _material_without_nodes(name)
    material.surface_render_method = "DITHERED"
    if hasattr(material, "cycles"):
        material.cycles.emission_sampling = "NONE"  # A million small lamps would be slow.
    return material, Graph(material.node_tree)


def _material_without_nodes(name: str) -> bpy.types.Material:
    material = bpy.data.materials.new(name)
    if material.node_tree is None:
        material.use_nodes = True  # From Blender 5.0 on always so, and deprecated.
    material.node_tree.nodes.clear()
    return material
