# SPDX-License-Identifier: GPL-3.0-or-later
"""How points and splats look: geometry-node groups on the mesh carriers, and the materials they use.

A group or material is found again by its custom properties; one of an older version is left to what uses it, until that
is to show what only the new one can.
"""

import math

import bpy
import numpy as np

from .kinds import SPLATS_MATERIAL, kind_of, mark

VERSION = "objectgs_version"
SH_C0 = 0.28209479177387814
"""The constant spherical harmonic: colour = 0.5 + SH_C0 * f_dc."""

SMALLEST_ALPHA = 1.0 / 255.0
"""A splat ends where it is fainter than this."""

FLATTEST = 1e-3
"""Smallest scale of a splat relative to its largest: flatter ellipsoids have no surface that a ray could meet."""

LARGEST_NEARNESS = 0.9
"""Squared radius of a splat over its distance from the camera, both in sigmas; nearer ones are not rendered."""

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

    def separated(self, vector) -> list[bpy.types.NodeSocket]:
        """The three numbers of a vector."""
        return list(self.node("ShaderNodeSeparateXYZ", {0: vector}).outputs)

    def rotated(self, vector, rotation) -> bpy.types.NodeSocket:
        """A vector turned by a rotation (geometry nodes)."""
        return self.node("FunctionNodeRotateVector", {"Vector": vector, "Rotation": rotation}).outputs[0]

    def store(self, geometry, name: str, kind: str, value) -> bpy.types.NodeSocket:
        """The geometry with a named attribute of its points (geometry nodes)."""
        return self.node("GeometryNodeStoreNamedAttribute", {"Geometry": geometry, "Name": name, "Value": value},
                         data_type=kind, domain="POINT").outputs[0]

    def removed(self, geometry, pattern: str) -> bpy.types.NodeSocket:
        """The geometry without attributes of this name, which may hold a `*` (geometry nodes)."""
        node = self.node("GeometryNodeRemoveAttribute", {"Geometry": geometry, "Name": pattern})
        if hasattr(node, "pattern_mode"):
            node.pattern_mode = "WILDCARD"
        elif "Pattern Mode" in node.inputs:  # Blender 5.0 on
            node.inputs["Pattern Mode"].default_value = "Wildcard"
        return node.outputs[0]

    def arrange(self) -> None:
        """Place nodes in columns from left to right by how far from an input they are."""
        into: dict[str, list[str]] = {node.name: [] for node in self.tree.nodes}
        for link in self.tree.links:
            into[link.to_node.name].append(link.from_node.name)
        columns: dict[str, int] = {}
        rows: dict[int, int] = {}
        for node in self.tree.nodes:  # A node is made after those it is linked to.
            column = max((columns.get(name, -1) + 1 for name in into[node.name]), default=0)
            columns[node.name] = column
            node.location = (220.0 * column, -180.0 * rows.get(column, 0))
            rows[column] = rows.get(column, 0) + 1


def shared(collection, kind: str, version: int, name: str, make):
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
        socket.hide_in_modifier = label.startswith("Recolor ")  # The panel has sliders for them.
    return tree


def set_input(modifier: bpy.types.NodesModifier, name: str, value) -> None:
    """Set an input of a geometry-nodes modifier by its label."""
    for item in modifier.node_group.interface.items_tree:
        if item.item_type == "SOCKET" and item.in_out == "INPUT" and item.name == name:
            if hasattr(modifier, "properties"):  # 5.2 and newer
                getattr(modifier.properties.inputs, item.identifier).value = value
            else:
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
    return shared(bpy.data.node_groups, POINTS_GROUP, 1, "ObjectGS Points", _make_points_group)


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
    coloured = graph.store(given.outputs["Geometry"], "colour", "FLOAT_COLOR", colour)
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
    return shared(bpy.data.materials, "points_material", 1, "ObjectGS Points", _make_points_material)


def _make_points_material(name: str) -> bpy.types.Material:
    material, graph = _empty_material(name)
    colour = graph.node("ShaderNodeAttribute", attribute_name="colour").outputs["Color"]
    emission = graph.node("ShaderNodeEmission", {"Color": colour}).outputs[0]
    graph.node("ShaderNodeOutputMaterial", {"Surface": emission})
    graph.arrange()
    return material


# Splats. The viewport shows points, or ellipsoids that are right from every side. Renders show discs that face the
# camera: one hit a splat and ray instead of two, in the order of the splats' centres, and colours for the direction.

SPLATS_GROUP = "splats_preview"
RENDER_GROUP = "splats_render"

HIDDEN = "objectgs_hidden"
"""Attribute of the carrier's vertices: splats that are not shown, whatever object they belong to."""

CHANNELS = ("Red", "Green", "Blue")
OFFSET = "Recolor Offset"


def add_splats_modifiers(thing: bpy.types.Object, largest_point: float) -> None:
    """Show a mesh carrier's splats: one modifier for the viewport, one for renders.

    largest_point: radius of the viewport's points at most, in the mesh's units.
    """
    viewport = thing.modifiers.new("ObjectGS Splats", "NODES")
    viewport.node_group = _splats_group(SPLATS_GROUP)
    viewport.show_render = False
    set_input(viewport, "Largest Point", largest_point)
    render = thing.modifiers.new("ObjectGS Render", "NODES")
    render.node_group = _splats_group(RENDER_GROUP)
    render.show_viewport = False


def use_material(thing: bpy.types.Object, material: bpy.types.Material) -> None:
    """Give the splats of an object a material, in the viewport and in renders."""
    for kind in (SPLATS_GROUP, RENDER_GROUP):
        modifier = modifier_of(thing, kind)
        if modifier is not None:
            set_input(modifier, "Material", material)


def recolour_splats(thing: bpy.types.Object, affine: tuple | None) -> None:
    """Show a carrier's splats in other colours: affine is (matrix (3, 3), offset (3,)) of encoded colours, or None."""
    matrix, offset = affine or (np.eye(3), np.zeros(3))
    changed = False
    for modifier in _splats_modifiers(thing):
        newest = _splats_group(kind_of(modifier.node_group))
        if modifier.node_group != newest:
            if affine is None:
                continue  # It can show nothing else.
            _exchange(modifier, newest)
        for name, row in ((OFFSET, offset), *((f"Recolor {channel}", row) for channel, row in zip(CHANNELS, matrix))):
            set_input(modifier, name, [float(value) for value in row])
            changed = True
    if changed:
        thing.update_tag()


def bring_up_to_date(thing: bpy.types.Object) -> None:
    """Show a carrier's splats by the newest groups; what the user has set of the older ones' inputs stays."""
    for modifier in _splats_modifiers(thing):
        newest = _splats_group(kind_of(modifier.node_group))
        if modifier.node_group != newest:
            _exchange(modifier, newest)


def _splats_modifiers(thing: bpy.types.Object) -> list[bpy.types.NodesModifier]:
    """The carrier's two modifiers, those of them that the user has left there."""
    found = (modifier_of(thing, kind) for kind in (SPLATS_GROUP, RENDER_GROUP))
    return [modifier for modifier in found if modifier is not None]


def _exchange(modifier: bpy.types.NodesModifier, group: bpy.types.NodeTree) -> None:
    values = _inputs_of(modifier)
    modifier.node_group = group
    for name, value in values.items():
        set_input(modifier, name, value)


def _inputs_of(modifier: bpy.types.NodesModifier) -> dict:
    """Label -> value of a geometry-nodes modifier's inputs, its geometry aside."""
    values = {}
    for item in modifier.node_group.interface.items_tree:
        if item.item_type == "SOCKET" and item.in_out == "INPUT" and item.socket_type != "NodeSocketGeometry":
            if hasattr(modifier, "properties"):  # 5.2 and newer
                values[item.name] = getattr(modifier.properties.inputs, item.identifier).value
            else:
                values[item.name] = modifier[item.identifier]
    return values


def _splats_group(kind: str) -> bpy.types.NodeTree:
    """The newest group of a kind."""
    if kind == SPLATS_GROUP:
        return shared(bpy.data.node_groups, kind, 2, "ObjectGS Splats", _make_splats_group)
    return shared(bpy.data.node_groups, kind, 2, "ObjectGS Render", _make_render_group)


def recolour_inputs() -> list[tuple]:
    """Inputs of an affine map of encoded colours, which changes nothing unless it is set."""
    rows = [(f"Recolor {channel}", "NodeSocketVector", tuple(float(i == j) for j in range(3)), None,
             f"How much of red, green and blue makes the new {channel.lower()}") for i, channel in enumerate(CHANNELS)]
    return [*rows, (OFFSET, "NodeSocketVector", (0.0, 0.0, 0.0), None, "Added to red, green and blue")]


def recoloured(graph: Graph, colour: bpy.types.NodeSocket, given: bpy.types.Node) -> bpy.types.NodeSocket:
    """An encoded colour under the affine map of the inputs."""
    rows = [graph.vector("DOT_PRODUCT", colour, given.outputs[f"Recolor {channel}"], output="Value")
            for channel in CHANNELS]
    turned = graph.node("ShaderNodeCombineXYZ", dict(enumerate(rows))).outputs[0]
    return graph.vector("ADD", turned, given.outputs[OFFSET])


def _make_splats_group(name: str) -> bpy.types.NodeTree:
    tree = _geometry_group(name, [
        ("Ellipsoids", "NodeSocketBool", False, None, "The splats' true shapes instead of points; slow with many"),
        ("Point Size", "NodeSocketFloat", 1.0, 0.0, "Radius of the points relative to the splats' size"),
        ("Largest Point", "NodeSocketFloat", 1.0, 0.0, "Radius that no point exceeds"),
        ("Minimum Opacity", "NodeSocketFloat", 0.1, 0.0, "Fainter splats have no point"),
        ("Material", "NodeSocketMaterial", None, None, "Material of the points"),
        *recolour_inputs(),
    ])
    graph = Graph(tree)
    given = graph.node("NodeGroupInput")
    splat = _Splat(graph)
    raw = recoloured(graph, graph.vector("MULTIPLY_ADD", splat.base, (SH_C0,) * 3, (0.5,) * 3), given)
    points = graph.node("GeometryNodeMeshToPoints", {"Mesh": given.outputs["Geometry"]}).outputs[0]

    first, second, third = splat.sides
    middle = graph.math("MAXIMUM", graph.math("MINIMUM", first, second), graph.math(
        "MINIMUM", graph.math("MAXIMUM", first, second), third))
    radius = graph.math("MINIMUM", graph.math("MULTIPLY", middle, given.outputs["Point Size"]),
                        given.outputs["Largest Point"])
    faint = graph.node("FunctionNodeBooleanMath", {
        0: graph.math("LESS_THAN", splat.opacity, given.outputs["Minimum Opacity"]), 1: splat.hidden},
        operation="OR").outputs[0]
    clear = graph.node("GeometryNodeDeleteGeometry", {"Geometry": points, "Selection": faint}).outputs[0]
    dots = graph.node("GeometryNodeSetPointRadius", {
        "Points": clear, "Radius": radius}).outputs[0]
    dots = graph.store(dots, "colour", "FLOAT_COLOR", _linear_colour(graph, raw, 1.0))
    dots = graph.node("GeometryNodeSetMaterial", {
        "Geometry": dots, "Material": given.outputs["Material"]}).outputs[0]

    size = graph.vector("SCALE", graph.vector("MAXIMUM", splat.scale, splat.thinnest), splat.reach)
    ball = graph.node("GeometryNodeMeshIcoSphere", {"Radius": 1.0 / BALL_FACES, "Subdivisions": 2}).outputs["Mesh"]
    ball = graph.node("GeometryNodeSetMaterial", {"Geometry": ball, "Material": _ellipsoids_material()}).outputs[0]
    coloured = graph.store(points, "colour", "FLOAT_COLOR", _linear_colour(graph, raw, splat.opacity))
    ellipsoids = graph.node("GeometryNodeInstanceOnPoints", {
        "Points": coloured, "Selection": splat.is_seen, "Instance": ball, "Rotation": splat.rotation,
        "Scale": size}).outputs[0]

    shown = graph.node("GeometryNodeSwitch", {
        "Switch": given.outputs["Ellipsoids"], "False": dots, "True": ellipsoids}, input_type="GEOMETRY").outputs[0]
    graph.node("NodeGroupOutput", {0: shown})
    graph.arrange()
    return tree


def _make_render_group(name: str) -> bpy.types.NodeTree:
    tree = _geometry_group(name, [
        ("Material", "NodeSocketMaterial", None, None, "Material of the splats"),
        *recolour_inputs(),
    ])
    graph = Graph(tree)
    given = graph.node("NodeGroupInput")
    splat = _Splat(graph)
    place = graph.node("GeometryNodeInputPosition").outputs[0]
    camera = graph.node("GeometryNodeInputActiveCamera").outputs[0]
    eye = graph.node("GeometryNodeObjectInfo", {"Object": camera}, transform_space="RELATIVE").outputs["Location"]
    towards = graph.vector("SUBTRACT", eye, place)

    # In the space where the splat is a unit ball: direction to the eye, and two directions across it.
    sigmas = graph.vector("MAXIMUM", splat.scale, splat.thinnest)
    back = graph.node("FunctionNodeInvertRotation", {0: splat.rotation}).outputs[0]
    local = graph.vector("DIVIDE", graph.rotated(towards, back), sigmas)
    distance = graph.vector("LENGTH", local, output="Value")
    axis = graph.vector("NORMALIZE", local)
    x = graph.separated(axis)[0]
    # Any vector that is not along the axis will do.
    aside = graph.node("ShaderNodeCombineXYZ", {
        0: graph.math("LESS_THAN", graph.math("ABSOLUTE", x), 0.6),
        1: graph.math("GREATER_THAN", graph.math("ABSOLUTE", x), 0.6)}).outputs[0]
    across = graph.vector("NORMALIZE", graph.vector("CROSS_PRODUCT", axis, aside))
    along = graph.vector("CROSS_PRODUCT", axis, across)

    # Seen from nearby a ball hides more of the plane through its centre than its own disc.
    ratio = graph.math("DIVIDE", splat.reach, graph.math("MAXIMUM", distance, 1e-20))
    nearness = graph.math("MULTIPLY", ratio, ratio)
    outside = graph.math("LESS_THAN", nearness, LARGEST_NEARNESS)
    widened = graph.math("DIVIDE", 1.0, graph.math("SQRT", graph.math("SUBTRACT", 1.0, graph.math(
        "MINIMUM", nearness, LARGEST_NEARNESS))))
    extent = graph.math("MULTIPLY", splat.reach, widened)

    raw = graph.vector("MULTIPLY_ADD", splat.base, (SH_C0,) * 3, (0.5,) * 3)
    raw = _add_harmonics(graph, raw, graph.vector("NORMALIZE", graph.vector("SCALE", towards, -1.0)))
    raw = recoloured(graph, raw, given)
    kept = graph.node("FunctionNodeBooleanMath", {0: splat.is_seen, 1: outside}, operation="AND").outputs[0]
    dropped = graph.node("FunctionNodeBooleanMath", {0: kept}, operation="NOT").outputs[0]
    points = graph.node("GeometryNodeMeshToPoints", {"Mesh": given.outputs["Geometry"]}).outputs[0]
    points = graph.node("GeometryNodeDeleteGeometry", {"Geometry": points, "Selection": dropped}).outputs[0]
    points = graph.store(points, "colour", "FLOAT_COLOR", _linear_colour(graph, raw, splat.opacity))
    points = graph.store(points, "centre", "FLOAT_VECTOR", place)
    for label, direction in (("across", across), ("along", along)):
        wide = graph.vector("MULTIPLY", graph.vector("SCALE", direction, extent), sigmas)
        points = graph.store(points, label, "FLOAT_VECTOR", graph.rotated(wide, splat.rotation))
    points = graph.store(points, "disc_size", "FLOAT_VECTOR", graph.node("ShaderNodeCombineXYZ", {
        0: widened, 1: widened, 2: nearness}).outputs[0])
    for pattern in ("radiance:*", "rotation", "scale", "object_id", HIDDEN):
        points = graph.removed(points, pattern)

    square = graph.node("GeometryNodeMeshGrid", {
        "Size X": 2.0, "Size Y": 2.0, "Vertices X": 2, "Vertices Y": 2}).outputs["Mesh"]
    square = graph.store(square, "disc", "FLOAT_VECTOR", graph.node("GeometryNodeInputPosition").outputs[0])
    quads = graph.node("GeometryNodeInstanceOnPoints", {"Points": points, "Instance": square}).outputs[0]
    quads = graph.node("GeometryNodeRealizeInstances", {"Geometry": quads}).outputs[0]
    corner_x, corner_y, _ = graph.separated(graph.attribute("disc", "FLOAT_VECTOR"))
    put = graph.vector("ADD", graph.attribute("centre", "FLOAT_VECTOR"), graph.vector(
        "ADD", graph.vector("SCALE", graph.attribute("across", "FLOAT_VECTOR"), corner_x),
        graph.vector("SCALE", graph.attribute("along", "FLOAT_VECTOR"), corner_y)))
    quads = graph.node("GeometryNodeSetPosition", {"Geometry": quads, "Position": put}).outputs[0]
    flat = graph.node("ShaderNodeCombineXYZ", {0: corner_x, 1: corner_y, 2: 1.0}).outputs[0]
    quads = graph.store(quads, "disc", "FLOAT_VECTOR", graph.vector(
        "MULTIPLY", flat, graph.attribute("disc_size", "FLOAT_VECTOR")))
    for spent in ("centre", "across", "along", "disc_size"):
        quads = graph.removed(quads, spent)
    quads = graph.node("GeometryNodeSetMaterial", {
        "Geometry": quads, "Material": given.outputs["Material"]}).outputs[0]
    graph.node("NodeGroupOutput", {0: quads})
    graph.arrange()
    return tree


class _Splat:
    """What geometry nodes read of a splat, and what follows from it."""

    def __init__(self, graph: Graph) -> None:
        base = graph.attribute("radiance:base", "FLOAT_COLOR")
        self.base = base
        self.opacity = graph.node("FunctionNodeSeparateColor", {0: base}).outputs["Alpha"]
        self.scale = graph.attribute("scale", "FLOAT_VECTOR")
        self.rotation = graph.attribute("rotation", "QUATERNION")
        self.sides = graph.separated(self.scale)
        longest = graph.math("MAXIMUM", graph.math("MAXIMUM", *self.sides[:2]), self.sides[2])
        self.thinnest = graph.math("MULTIPLY", longest, FLATTEST)
        # Alpha falls to 1/255 this many sigmas from the centre.
        ratio = graph.math("MAXIMUM", graph.math("MULTIPLY", self.opacity, 1.0 / SMALLEST_ALPHA), 1.0)
        self.reach = graph.math("SQRT", graph.math("MULTIPLY", graph.math("LOGARITHM", ratio, math.e), 2.0))
        self.hidden = graph.attribute(HIDDEN, "BOOLEAN")
        shown = graph.node("FunctionNodeBooleanMath", {0: self.hidden}, operation="NOT").outputs[0]
        self.is_seen = graph.node("FunctionNodeBooleanMath", {
            0: graph.math("GREATER_THAN", self.opacity, 1.01 * SMALLEST_ALPHA), 1: shown}, operation="AND").outputs[0]


def linear_channel(graph: Graph, value: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
    """sRGB, 0 where it is below, to linear; by nodes that shaders have, too."""
    value = graph.math("MAXIMUM", value, 0.0)
    high = graph.math("POWER", graph.math("DIVIDE", graph.math("ADD", value, 0.055), 1.055), 2.4)
    return _chosen(graph, graph.math("GREATER_THAN", value, 0.04045), high, graph.math("DIVIDE", value, 12.92))


def encoded_channel(graph: Graph, value: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
    """Linear, 0 where it is below, to sRGB."""
    value = graph.math("MAXIMUM", value, 0.0)
    high = graph.math("MULTIPLY_ADD", graph.math("POWER", value, 1.0 / 2.4), 1.055, -0.055)
    return _chosen(graph, graph.math("GREATER_THAN", value, 0.0031308), high, graph.math("MULTIPLY", value, 12.92))


def _chosen(graph: Graph, first: bpy.types.NodeSocket, yes, no) -> bpy.types.NodeSocket:
    """`yes` where `first` is 1, `no` where it is 0."""
    return graph.math("MULTIPLY_ADD", first, yes, graph.math("MULTIPLY", graph.math("SUBTRACT", 1.0, first), no))


def _linear_colour(graph: Graph, raw: bpy.types.NodeSocket, alpha) -> bpy.types.NodeSocket:
    """What the splats mean is sRGB, and may be below 0; Blender's colours are linear."""
    channels = {index: linear_channel(graph, channel) for index, channel in enumerate(graph.separated(raw))}
    return graph.node("FunctionNodeCombineColor", {**channels, "Alpha": alpha}).outputs[0]


def _add_harmonics(graph: Graph, colour: bpy.types.NodeSocket, direction: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
    """`colour` and the spherical harmonics of degree 1 to 3 for a direction; what a splat does not have counts 0."""
    x, y, z = graph.separated(direction)
    xx, yy, zz = (graph.math("MULTIPLY", side, side) for side in (x, y, z))
    xy, yz, xz = graph.math("MULTIPLY", x, y), graph.math("MULTIPLY", y, z), graph.math("MULTIPLY", x, z)

    def combined(*terms) -> bpy.types.NodeSocket:
        """Sum of factor * output."""
        total = 0.0
        for factor, value in terms:
            total = graph.math("MULTIPLY_ADD", value, factor, total)
        return total

    def times(left, right) -> bpy.types.NodeSocket:
        return graph.math("MULTIPLY", left, right)

    round_ = combined((4.0, zz), (-1.0, xx), (-1.0, yy))
    terms = (
        (-0.4886025119029199, y), (0.4886025119029199, z), (-0.4886025119029199, x),
        (1.0925484305920792, xy), (-1.0925484305920792, yz),
        (0.31539156525252005, combined((2.0, zz), (-1.0, xx), (-1.0, yy))),
        (-1.0925484305920792, xz), (0.5462742152960396, combined((1.0, xx), (-1.0, yy))),
        (-0.5900435899266435, times(y, combined((3.0, xx), (-1.0, yy)))), (2.890611442640554, times(xy, z)),
        (-0.4570457994644658, times(y, round_)),
        (0.3731763325901154, times(z, combined((2.0, zz), (-3.0, xx), (-3.0, yy)))),
        (-0.4570457994644658, times(x, round_)), (1.445305721320277, times(z, combined((1.0, xx), (-1.0, yy)))),
        (-0.5900435899266435, times(x, combined((1.0, xx), (-3.0, yy)))),
    )
    for k, (factor, value) in enumerate(terms, start=1):
        weight = graph.math("MULTIPLY", value, factor)
        colour = graph.vector("ADD", colour, graph.vector(
            "SCALE", graph.attribute(f"radiance:sh_{k}", "FLOAT_VECTOR"), weight))
    return colour


def splats_material(name: str, colour: tuple[float, ...]) -> bpy.types.Material:
    """A new material for one object's splats; `colour` (linear RGB) is what Solid shows."""
    material, graph = _empty_material(name)
    mark(material, SPLATS_MATERIAL)
    shader = shared(bpy.data.node_groups, "splat_shader", 1, "ObjectGS Splat", _make_splat_shader)
    group = graph.node("ShaderNodeGroup", node_tree=shader)
    group.width = 200.0
    graph.node("ShaderNodeOutputMaterial", {"Surface": group.outputs[0]}, location=(260.0, 0.0))
    material.diffuse_color = (*colour, 1.0)
    return material


def _make_splat_shader(name: str) -> bpy.types.NodeTree:
    """Discs by their attribute `disc`: place on the disc and how near the camera is; points have none, and alpha 1."""
    tree = bpy.data.node_groups.new(name, "ShaderNodeTree")
    tree.interface.new_socket("Shader", in_out="OUTPUT", socket_type="NodeSocketShader")
    graph = Graph(tree)
    colour = graph.node("ShaderNodeAttribute", attribute_type="GEOMETRY", attribute_name="colour")
    disc = graph.node("ShaderNodeAttribute", attribute_type="GEOMETRY", attribute_name="disc").outputs["Vector"]
    x, y, nearness = graph.separated(disc)
    flat = graph.math("ADD", graph.math("MULTIPLY", x, x), graph.math("MULTIPLY", y, y))
    beside = graph.math("DIVIDE", flat, graph.math("MULTIPLY_ADD", flat, nearness, 1.0))
    _falloff(graph, colour.outputs["Color"], colour.outputs["Alpha"], beside, None)
    return tree


def _ellipsoids_material() -> bpy.types.Material:
    """The shared material of ellipsoids, whose colour is an attribute of the instance."""
    return shared(bpy.data.materials, "ellipsoids_material", 1, "ObjectGS Ellipsoids", _make_ellipsoids_material)


def _make_ellipsoids_material(name: str) -> bpy.types.Material:
    material, graph = _empty_material(name)
    colour = graph.node("ShaderNodeAttribute", attribute_type="INSTANCER", attribute_name="colour")
    geometry = graph.node("ShaderNodeNewGeometry")
    place = graph.node("ShaderNodeTexCoord").outputs["Object"]
    eye = graph.node("ShaderNodeVectorTransform", {"Vector": geometry.outputs["Incoming"]}, vector_type="VECTOR",
                     convert_from="WORLD", convert_to="OBJECT").outputs[0]
    along = graph.vector("DOT_PRODUCT", place, graph.vector("NORMALIZE", eye), output="Value")
    beside = graph.math("SUBTRACT", graph.vector("DOT_PRODUCT", place, place, output="Value"),
                        graph.math("MULTIPLY", along, along))
    _falloff(graph, colour.outputs["Color"], colour.outputs["Alpha"], beside, geometry.outputs["Backfacing"])
    return material


def _falloff(graph: Graph, colour, opacity, beside, hidden) -> None:
    """The Gaussian's light and alpha as the tree's output.

    beside: squared distance at which the ray passes the centre, 1 where alpha falls to 1/255; hidden: 1 where there
    is nothing, or None. opacity * exp(-sigmas^2 / 2) with sigmas^2 = 2 ln(255 opacity) * beside.
    """
    falloff = graph.math("POWER", graph.math("MULTIPLY", opacity, 1.0 / SMALLEST_ALPHA),
                         graph.math("MULTIPLY", beside, -1.0))
    alpha = graph.math("MULTIPLY", graph.math("MULTIPLY", opacity, falloff), graph.math("LESS_THAN", beside, 1.0))
    if hidden is not None:
        alpha = graph.math("MULTIPLY", alpha, graph.math("SUBTRACT", 1.0, hidden))
    emission = graph.node("ShaderNodeEmission", {"Color": colour}).outputs[0]
    clear = graph.node("ShaderNodeBsdfTransparent").outputs[0]
    mixed = graph.node("ShaderNodeMixShader", {0: alpha, 1: clear, 2: emission}).outputs[0]
    is_group = isinstance(graph.tree, bpy.types.ShaderNodeTree) and graph.tree.interface.items_tree
    graph.node("NodeGroupOutput" if is_group else "ShaderNodeOutputMaterial", {0: mixed})
    graph.arrange()


def _empty_material(name: str) -> tuple[bpy.types.Material, Graph]:
    material = bpy.data.materials.new(name)
    if material.node_tree is None:
        material.use_nodes = True  # always so, and warned about, from Blender 5.0 on
    material.node_tree.nodes.clear()
    material.surface_render_method = "DITHERED"
    if hasattr(material, "cycles"):
        material.cycles.emission_sampling = "NONE"  # A million small lamps are no use, and slow.
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
