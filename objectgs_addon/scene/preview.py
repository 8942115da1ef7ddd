# SPDX-License-Identifier: GPL-3.0-or-later
"""How points and splats look: geometry-node groups on the mesh carriers, and the materials they use.

A group or material is found again by its custom properties; one of an older version is left to what uses it.
"""

import math

import bpy

from .kinds import kind_of, mark

VERSION = "objectgs_version"
SH_C0 = 0.28209479177387814
"""The constant spherical harmonic: colour = 0.5 + SH_C0 * f_dc."""

SMALLEST_ALPHA = 1.0 / 255.0
"""A splat ends where it is fainter than this."""

FLATTEST = 1e-3
"""Smallest scale of a splat relative to its largest: flatter ellipsoids have no surface that a ray could meet."""

BALL_FACES = 0.9341
"""How near to the centre the faces come of an icosphere of 80 faces and radius 1."""


class Graph:
    """A node tree being built: nodes by type, links from outputs to inputs."""

    def __init__(self, tree: bpy.types.NodeTree) -> None:
        self.tree = tree

    def node(self, kind: str, inputs: dict | None = None, **settings) -> bpy.types.Node:
        """A node with its settings; `inputs`: index or name -> an output socket to link, or a value."""
        node = self.tree.nodes.new(kind)
        for name, value in settings.items():
            setattr(node, name, value)
        for key, value in (inputs or {}).items():
            socket = node.inputs[key]
            if isinstance(value, bpy.types.NodeSocket):
                self.tree.links.new(value, socket)
            else:
                socket.default_value = value
        return node

    def math(self, operation: str, *values) -> bpy.types.NodeSocket:
        """Output of a Math node on numbers or outputs."""
        return self.node("ShaderNodeMath", dict(enumerate(values)), operation=operation).outputs[0]

    def vector(self, operation: str, *values, output: str = "Vector") -> bpy.types.NodeSocket:
        """Output of a Vector Math node on vectors or outputs; SCALE takes its factor second."""
        keys = ("Vector", "Scale") if operation == "SCALE" else range(len(values))
        return self.node("ShaderNodeVectorMath", dict(zip(keys, values)), operation=operation).outputs[output]

    def attribute(self, name: str, kind: str) -> bpy.types.NodeSocket:
        """A named attribute of the geometry (geometry nodes)."""
        node = self.node("GeometryNodeInputNamedAttribute", {"Name": name}, data_type=kind)
        return next(socket for socket in node.outputs if socket.enabled and socket.name == "Attribute")

    def arrange(self) -> None:
        """Place nodes in columns from left to right by how far from an input they are."""
        depth: dict = {}
        for node in self.tree.nodes:
            depth[node] = 0
        for _ in range(len(self.tree.nodes)):
            changed = False
            for link in self.tree.links:
                if depth[link.to_node] <= depth[link.from_node]:
                    depth[link.to_node] = depth[link.from_node] + 1
                    changed = True
            if not changed:
                break
        rows: dict[int, int] = {}
        for node in self.tree.nodes:
            column = depth[node]
            node.location = (220.0 * column, -180.0 * rows.get(column, 0))
            rows[column] = rows.get(column, 0) + 1


def _shared(collection, kind: str, version: int, name: str, make):
    """The data-block of this kind and version, made where there is none."""
    for block in collection:
        if kind_of(block) == kind and block.get(VERSION) == version and block.library is None:
            return block
    block = make(name)
    mark(block, kind)
    block[VERSION] = version
    return block


def _geometry_group(name: str, inputs: list[tuple]) -> bpy.types.NodeTree:
    """A geometry-node group for a modifier; inputs: (name, socket type, default, minimum, description)."""
    tree = bpy.data.node_groups.new(name, "GeometryNodeTree")
    tree.is_modifier = True
    tree.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    tree.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    for label, kind, default, minimum, description in inputs:
        socket = tree.interface.new_socket(label, in_out="INPUT", socket_type=kind)
        socket.description = description
        if default is not None:
            socket.default_value = default
        if minimum is not None:
            socket.min_value = minimum
    return tree


def set_input(modifier: bpy.types.NodesModifier, name: str, value) -> None:
    """Set an input of a geometry-nodes modifier by its label."""
    for item in modifier.node_group.interface.items_tree:
        if item.item_type == "SOCKET" and item.in_out == "INPUT" and item.name == name:
            modifier[item.identifier] = value
            return
    raise KeyError(name)


def modifier_of(thing: bpy.types.Object, kind: str) -> bpy.types.NodesModifier | None:
    """The object's modifier whose node group is of this kind."""
    for modifier in thing.modifiers:
        if modifier.type == "NODES" and modifier.node_group is not None and kind_of(modifier.node_group) == kind:
            return modifier
    return None


# Points.

POINTS_GROUP = "points_preview"


def points_group() -> bpy.types.NodeTree:
    """The group that shows a mesh carrier's vertices as small octahedra with the chosen colour."""
    return _shared(bpy.data.node_groups, POINTS_GROUP, 1, "ObjectGS Points", _make_points_group)


def _make_points_group(name: str) -> bpy.types.NodeTree:
    tree = _geometry_group(name, [
        ("By Object", "NodeSocketBool", False, None, "Color of the object instead of the photos' color"),
        ("Size", "NodeSocketFloat", 0.01, 0.0, "Radius of a point"),
        ("Material", "NodeSocketMaterial", None, None, "Material of the points"),
    ])
    graph = Graph(tree)
    given = graph.node("NodeGroupInput")
    colour = graph.node("GeometryNodeSwitch", {
        "Switch": given.outputs["By Object"], "False": graph.attribute("photo", "FLOAT_COLOR"),
        "True": graph.attribute("object", "FLOAT_COLOR")}, input_type="RGBA").outputs[0]
    coloured = graph.node("GeometryNodeStoreNamedAttribute", data_type="FLOAT_COLOR", domain="POINT", inputs={
        "Geometry": given.outputs["Geometry"], "Name": "colour", "Value": colour}).outputs[0]
    shape = graph.node("GeometryNodeMeshUVSphere", {
        "Segments": 4, "Rings": 2, "Radius": given.outputs["Size"]}).outputs["Mesh"]
    placed = graph.node("GeometryNodeInstanceOnPoints", {"Points": coloured, "Instance": shape}).outputs[0]
    real = graph.node("GeometryNodeRealizeInstances", {"Geometry": placed}).outputs[0]
    # Joined after the carrier, whose settings the result takes over: the active colour, which Solid shows.
    index = graph.node("GeometryNodeInputIndex").outputs[0]
    first = graph.node("GeometryNodeDeleteGeometry", {"Geometry": coloured, "Selection": index}).outputs[0]
    joined = graph.node("GeometryNodeJoinGeometry")
    tree.links.new(real, joined.inputs[0])
    tree.links.new(first, joined.inputs[0])
    dressed = graph.node("GeometryNodeSetMaterial", {
        "Geometry": joined.outputs[0], "Material": given.outputs["Material"]}).outputs[0]
    graph.node("NodeGroupOutput", {0: dressed})
    graph.arrange()
    return tree


def points_material() -> bpy.types.Material:
    """The shared material of point clouds: they shine with their colour."""
    return _shared(bpy.data.materials, "points_material", 1, "ObjectGS Points", _make_points_material)


def _make_points_material(name: str) -> bpy.types.Material:
    material, graph = _empty_material(name)
    colour = graph.node("ShaderNodeAttribute", attribute_name="colour").outputs["Color"]
    emission = graph.node("ShaderNodeEmission", {"Color": colour}).outputs[0]
    graph.node("ShaderNodeOutputMaterial", {"Surface": emission})
    graph.arrange()
    return material


# Splats.

SPLATS_GROUP = "splats_preview"


def splats_group() -> bpy.types.NodeTree:
    """The group that shows a mesh carrier's splats: as ellipsoids in renders, as points in the viewport."""
    return _shared(bpy.data.node_groups, SPLATS_GROUP, 1, "ObjectGS Splats", _make_splats_group)


def _make_splats_group(name: str) -> bpy.types.NodeTree:
    tree = _geometry_group(name, [
        ("Ellipsoids in Viewport", "NodeSocketBool", False, None, "Show what a render shows; slow with many splats"),
        ("Point Size", "NodeSocketFloat", 1.0, 0.0, "Radius of the viewport's points relative to the splats' size"),
        ("Minimum Opacity", "NodeSocketFloat", 0.1, 0.0, "Fainter splats have no point in the viewport"),
        ("Material", "NodeSocketMaterial", None, None, "Material of the splats"),
    ])
    graph = Graph(tree)
    given = graph.node("NodeGroupInput")
    base = graph.attribute("radiance:base", "FLOAT_COLOR")
    scale = graph.attribute("scale", "FLOAT_VECTOR")
    separate = graph.node("FunctionNodeSeparateColor", {0: base})
    opacity = separate.outputs["Alpha"]

    # The colour that the splats mean is sRGB; Blender's is linear.
    linear = graph.node("FunctionNodeCombineColor")
    for channel in range(3):
        value = graph.math("MULTIPLY_ADD", separate.outputs[channel], SH_C0, 0.5)
        tree.links.new(_linear(graph, value), linear.inputs[channel])
    tree.links.new(opacity, linear.inputs["Alpha"])

    points = graph.node("GeometryNodeMeshToPoints", {"Mesh": given.outputs["Geometry"]}).outputs[0]
    coloured = graph.node("GeometryNodeStoreNamedAttribute", data_type="FLOAT_COLOR", domain="POINT", inputs={
        "Geometry": points, "Name": "colour", "Value": linear.outputs[0]}).outputs[0]

    # Ellipsoids reach to where alpha falls to 1/255, which is this many sigmas.
    ratio = graph.math("MAXIMUM", graph.math("MULTIPLY", opacity, 1.0 / SMALLEST_ALPHA), 1.0)
    reach = graph.math("SQRT", graph.math("MULTIPLY", graph.math("LOGARITHM", ratio, math.e), 2.0))
    sides = graph.node("ShaderNodeSeparateXYZ", {0: scale})
    longest = graph.math("MAXIMUM", graph.math("MAXIMUM", sides.outputs[0], sides.outputs[1]), sides.outputs[2])
    thinnest = graph.math("MULTIPLY", longest, FLATTEST)
    size = graph.vector("SCALE", graph.vector("MAXIMUM", scale, thinnest), reach)
    dressed_ball = graph.node("GeometryNodeSetMaterial", {
        "Geometry": _bounding_ball(graph), "Material": given.outputs["Material"]}).outputs[0]
    ellipsoids = graph.node("GeometryNodeInstanceOnPoints", {
        "Points": coloured, "Selection": graph.math("GREATER_THAN", opacity, SMALLEST_ALPHA),
        "Instance": dressed_ball, "Rotation": graph.attribute("rotation", "QUATERNION"),
        "Scale": size}).outputs[0]

    middle = graph.math("DIVIDE", graph.math("ADD", graph.math("ADD", sides.outputs[0], sides.outputs[1]),
                                             sides.outputs[2]), 3.0)
    faint = graph.math("LESS_THAN", opacity, given.outputs["Minimum Opacity"])
    clear = graph.node("GeometryNodeDeleteGeometry", {"Geometry": coloured, "Selection": faint}).outputs[0]
    sized = graph.node("GeometryNodeSetPointRadius", {
        "Points": clear, "Radius": graph.math("MULTIPLY", middle, given.outputs["Point Size"])}).outputs[0]
    flagged = graph.node("GeometryNodeStoreNamedAttribute", data_type="FLOAT", domain="POINT", inputs={
        "Geometry": sized, "Name": "is_point", "Value": 1.0}).outputs[0]
    dots = graph.node("GeometryNodeSetMaterial", {
        "Geometry": flagged, "Material": given.outputs["Material"]}).outputs[0]

    as_ellipsoids = graph.node("FunctionNodeBooleanMath", {
        0: graph.node("GeometryNodeIsViewport").outputs[0], 1: given.outputs["Ellipsoids in Viewport"]},
        operation="IMPLY").outputs[0]
    shown = graph.node("GeometryNodeSwitch", {
        "Switch": as_ellipsoids, "False": dots, "True": ellipsoids}, input_type="GEOMETRY").outputs[0]
    graph.node("NodeGroupOutput", {0: shown})
    graph.arrange()
    return tree


def _linear(graph: Graph, value: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
    """An sRGB channel as linear light, 0 below 0."""
    value = graph.math("MAXIMUM", value, 0.0)
    high = graph.math("POWER", graph.math("DIVIDE", graph.math("ADD", value, 0.055), 1.055), 2.4)
    return graph.node("GeometryNodeSwitch", {
        "Switch": graph.math("GREATER_THAN", value, 0.04045), "False": graph.math("DIVIDE", value, 12.92),
        "True": high}, input_type="FLOAT").outputs[0]


def _bounding_ball(graph: Graph) -> bpy.types.NodeSocket:
    """An icosphere of 80 faces that encloses the unit ball."""
    return graph.node("GeometryNodeMeshIcoSphere", {"Radius": 1.0 / BALL_FACES, "Subdivisions": 2}).outputs["Mesh"]


def splats_material(name: str, colour: tuple[float, ...]) -> bpy.types.Material:
    """A new material for one object's splats; `colour` (linear RGB) is what Solid shows."""
    material, graph = _empty_material(name)
    mark(material, "splats_material")
    group = graph.node("ShaderNodeGroup", node_tree=_splat_shader())
    group.width = 200.0
    graph.node("ShaderNodeOutputMaterial", {"Surface": group.outputs[0]}, location=(260.0, 0.0))
    material.diffuse_color = (*colour, 1.0)
    material.surface_render_method = "DITHERED"
    return material


def _splat_shader() -> bpy.types.NodeTree:
    """Shared by all splats' materials: the Gaussian's alpha on an ellipsoid, all of it on a point."""
    return _shared(bpy.data.node_groups, "splat_shader", 1, "ObjectGS Splat", _make_splat_shader)


def _make_splat_shader(name: str) -> bpy.types.NodeTree:
    tree = bpy.data.node_groups.new(name, "ShaderNodeTree")
    tree.interface.new_socket("Shader", in_out="OUTPUT", socket_type="NodeSocketShader")
    graph = Graph(tree)
    of_instance = graph.node("ShaderNodeAttribute", attribute_type="INSTANCER", attribute_name="colour")
    of_point = graph.node("ShaderNodeAttribute", attribute_type="GEOMETRY", attribute_name="colour")
    is_point = graph.node("ShaderNodeAttribute", attribute_type="GEOMETRY", attribute_name="is_point").outputs["Fac"]
    opacity = of_instance.outputs["Alpha"]
    geometry = graph.node("ShaderNodeNewGeometry")
    place = graph.node("ShaderNodeTexCoord").outputs["Object"]
    eye = graph.node("ShaderNodeVectorTransform", {"Vector": geometry.outputs["Incoming"]}, vector_type="VECTOR",
                     convert_from="WORLD", convert_to="OBJECT").outputs[0]
    eye = graph.vector("NORMALIZE", eye)
    # The ray passes the centre at this squared distance, where 1 is the ellipsoid's surface.
    along = graph.vector("DOT_PRODUCT", place, eye, output="Value")
    beside = graph.math("SUBTRACT", graph.vector("DOT_PRODUCT", place, place, output="Value"),
                        graph.math("MULTIPLY", along, along))
    # opacity * exp(-sigmas^2 / 2), with sigmas^2 = 2 ln(255 opacity) * beside
    falloff = graph.math("POWER", graph.math("MULTIPLY", opacity, 1.0 / SMALLEST_ALPHA),
                         graph.math("MULTIPLY", beside, -1.0))
    alpha = graph.math("MULTIPLY", opacity, falloff)
    alpha = graph.math("MULTIPLY", alpha, graph.math("LESS_THAN", beside, 1.0))
    alpha = graph.math("MULTIPLY", alpha, graph.math("SUBTRACT", 1.0, geometry.outputs["Backfacing"]))
    alpha = graph.math("MAXIMUM", alpha, is_point)
    colour = graph.vector("ADD", of_instance.outputs["Color"], of_point.outputs["Color"])
    emission = graph.node("ShaderNodeEmission", {"Color": colour}).outputs[0]
    clear = graph.node("ShaderNodeBsdfTransparent").outputs[0]
    mixed = graph.node("ShaderNodeMixShader", {0: alpha, 1: clear, 2: emission}).outputs[0]
    graph.node("NodeGroupOutput", {0: mixed})
    graph.arrange()
    return tree


def _empty_material(name: str) -> tuple[bpy.types.Material, Graph]:
    material = bpy.data.materials.new(name)
    if material.node_tree is None:
        material.use_nodes = True  # always so, and warned about, from Blender 5.0 on
    material.node_tree.nodes.clear()
    return material, Graph(material.node_tree)


def prepare_render(scene: bpy.types.Scene) -> None:
    """Set what a faithful picture of splats needs: colours as they are, and rays that pass many splats.

    Changes the scene's view transform and Cycles' bounces; nothing else calls this for a user's scene.
    """
    scene.view_settings.view_transform = "Standard"
    scene.view_settings.look = "None"
    scene.view_settings.exposure = 0.0
    scene.view_settings.gamma = 1.0
    if hasattr(scene, "cycles"):
        scene.cycles.transparent_max_bounces = 1024
        scene.cycles.max_bounces = max(scene.cycles.max_bounces, 4)
