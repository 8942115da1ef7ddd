# SPDX-License-Identifier: GPL-3.0-or-later
"""Materials of points, splats, ellipsoids and meshes."""

from __future__ import annotations

import bpy

from ....backend.shared.splats.blending import ALPHA_MIN
from ..kinds import MESH_MATERIAL, SPLATS_MATERIAL, mark
from .graph import Graph, find_or_make

COLOR = "display_color"
"""Linear RGBA attribute of shown points and splats. Cycles uses the name "color" for the color of volumes."""

SPLAT_SHADER = "splat_shader"
POINTS_MATERIAL = "points_material"
ELLIPSOIDS_MATERIAL = "ellipsoids_material"

CAPTURED, LIT = SHADINGS = ("captured", "lit")
"""How meshes are shaded: by the colors of their textures alone, like splats, or by the scene's lights."""

MESH_ROUGHNESS = 0.8
MESH_SPECULAR = 0.2
"""Low specular level, since the texture already contains the highlights of the photos."""


def points_material() -> bpy.types.Material:
    """Return the shared emission material of point clouds."""
    return find_or_make(bpy.data.materials, POINTS_MATERIAL, 2, "ObjectGS Points", _make_points_material)


def _make_points_material(name: str) -> bpy.types.Material:
    material, graph = _empty_material(name)
    color = graph.node("ShaderNodeAttribute", attribute_name=COLOR).outputs["Color"]
    emission = graph.node("ShaderNodeEmission", {"Color": color}).outputs[0]
    graph.node("ShaderNodeOutputMaterial", {"Surface": emission})
    graph.arrange()
    return material


def splats_material(name: str, color: tuple[float, ...]) -> bpy.types.Material:
    """Create a material for the splats of one object; `color` is the linear RGB viewport color of Solid mode."""
    material, graph = _empty_material(name)
    mark(material, SPLATS_MATERIAL)
    shader = find_or_make(bpy.data.node_groups, SPLAT_SHADER, 2, "ObjectGS Splat", _make_splat_shader)
    group = graph.node("ShaderNodeGroup", node_tree=shader)
    group.width = 200.0
    graph.node("ShaderNodeOutputMaterial", {"Surface": group.outputs[0]}, location=(260.0, 0.0))
    material.diffuse_color = (*color, 1.0)
    return material


def _make_splat_shader(name: str) -> bpy.types.NodeTree:
    """Create the shader of discs, whose attribute `disc` stores the position on the disc and the camera's nearness.

    Points have no such attribute and alpha 1.
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
    """Return the shared material of ellipsoids, which reads the color from an instance attribute."""
    return find_or_make(bpy.data.materials, ELLIPSOIDS_MATERIAL, 2, "ObjectGS Ellipsoids", _make_ellipsoids_material)


def _make_ellipsoids_material(name: str) -> bpy.types.Material:
    material, graph = _empty_material(name)
    color = graph.node("ShaderNodeAttribute", attribute_type="INSTANCER", attribute_name=COLOR)
    geometry = graph.node("ShaderNodeNewGeometry")
    position = graph.node("ShaderNodeTexCoord").outputs["Object"]
    incoming = graph.node(
        "ShaderNodeVectorTransform",
        {"Vector": geometry.outputs["Incoming"]},
        vector_type="VECTOR",
        convert_from="WORLD",
        convert_to="OBJECT",
    ).outputs[0]
    along = graph.vector("DOT_PRODUCT", position, graph.vector("NORMALIZE", incoming), output="Value")
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
    """Add the output of the tree: the emission of a Gaussian, mixed by its alpha.

    alpha = opacity * exp(-sigmas^2 / 2) with sigmas^2 = 2 ln(255 opacity) * squared_distance.

    Args:
        graph: the tree under construction.
        color: emitted color.
        opacity: opacity of the splat.
        squared_distance: from the splat's center to the ray; 1 where the splat is cut off.
        hidden: 1 where alpha is forced to 0, or None.
    """
    falloff = graph.math(
        "POWER", graph.math("MULTIPLY", opacity, 1.0 / ALPHA_MIN), graph.math("MULTIPLY", squared_distance, -1.0)
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


def mesh_material(
    name: str, image: bpy.types.Image, like: bpy.types.Material | None, shading: str = CAPTURED
) -> bpy.types.Material:
    """Create a material with a mesh's texture.

    Args:
        name: the material's name.
        image: the texture.
        like: a material made with the same `shading` to copy, which is faster, or None.
        shading: an entry of SHADINGS.
    """
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
    if hasattr(material, "cycles"):
        material.cycles.emission_sampling = "NONE"  # As for splats.
    shade_mesh_material(material, shading)
    return material


def shade_mesh_material(material: bpy.types.Material, shading: str) -> bool:
    """Switch a material of `mesh_material` to an entry of SHADINGS, unless the user has linked another surface.

    Returns:
        Whether the material has changed.
    """
    tree = material.node_tree
    output = next((node for node in tree.nodes if node.type == "OUTPUT_MATERIAL" and node.is_active_output), None)
    if output is None or not output.inputs["Surface"].is_linked:
        return False
    surface = output.inputs["Surface"]
    now = surface.links[0].from_socket
    for shader in [node for node in tree.nodes if node.type == "BSDF_PRINCIPLED"]:
        color = shader.inputs["Base Color"]
        if color.is_linked and now in (shader.outputs[0], color.links[0].from_socket):
            # A color that is linked to a surface is emitted.
            wanted = color.links[0].from_socket if shading == CAPTURED else shader.outputs[0]
            if now != wanted:
                tree.links.new(wanted, surface)
            return now != wanted
    return False


def _empty_material(name: str) -> tuple[bpy.types.Material, Graph]:
    material = _material_without_nodes(name)
    material.surface_render_method = "DITHERED"
    if hasattr(material, "cycles"):
        material.cycles.emission_sampling = "NONE"  # Sampling each splat as a light would be slow.
    return material, Graph(material.node_tree)


def _material_without_nodes(name: str) -> bpy.types.Material:
    material = bpy.data.materials.new(name)
    if material.node_tree is None:
        material.use_nodes = True  # Always true, and deprecated, since Blender 5.0.
    material.node_tree.nodes.clear()
    return material
