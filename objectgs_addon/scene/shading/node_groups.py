# SPDX-License-Identifier: GPL-3.0-or-later
"""Geometry node groups that show mesh carriers: point clouds, the viewport preview of splats, and splats in renders.

Viewports show splats as points, or as ellipsoids, which are correct from every side. Renders show them as discs that
face the camera: each ray hits a splat once instead of twice, hits are sorted by the splats' centers, and colors depend
on the view direction.
"""

from __future__ import annotations

import math
from typing import Any

import bpy

from ....backend.shared.splats import spherical_harmonics as sh
from ....backend.shared.splats.blending import ALPHA_MIN
from .color_nodes import linear_channel, recolor_inputs, recolored
from .graph import Graph, find_or_make
from .materials import COLOR, ellipsoids_material

POINTS_GROUP = "points_preview"
SPLATS_GROUP = "splats_preview"
RENDER_GROUP = "splats_render"
HIDE_GROUP = "splats_drawn"

HIDDEN = "objectgs_hidden"
"""Boolean attribute of a carrier's vertices: splats that are hidden individually."""
COVERED = "objectgs_covered"
"""Boolean attribute of a carrier's vertices: splats that a mesh replaces, while splats that fill a hole stay shown."""
FLOATING = "objectgs_floating"
"""Boolean attribute of a carrier's vertices: floaters. Previews leave them out, since Blender frames what it shows."""
DISTANT = "objectgs_distant"
"""Boolean attribute of a carrier's vertices: splats of distant surroundings, which previews leave out, too."""

MINIMUM_FLATNESS = 1e-3
"""Lower limit of a splat's smallest scale relative to its largest, since rays miss flatter ellipsoids."""

MAXIMUM_NEARNESS = 0.9
"""Upper limit of a splat's (radius / camera distance)^2, both in sigmas; closer splats are not rendered."""

ICOSPHERE_INRADIUS = 0.9341
"""Distance from the center to the faces of an icosphere with 80 faces and radius 1."""


def points_group() -> bpy.types.NodeTree:
    """Return the group that shows a carrier's vertices as small octahedra in one of two colorings."""
    return find_or_make(bpy.data.node_groups, POINTS_GROUP, 3, "ObjectGS Points", _make_points_group)


def _make_points_group(name: str) -> bpy.types.NodeTree:
    tree = _geometry_group(
        name,
        [
            ("By Object", "NodeSocketBool", False, None, "Color of the object instead of the photos' color"),
            ("Size", "NodeSocketFloat", 0.01, 0.0, "Radius of a point"),
            ("Material", "NodeSocketMaterial", None, None, "Material of the points"),
        ],
    )
    graph = Graph(tree)
    group_input = graph.node("NodeGroupInput")
    color = graph.node(
        "GeometryNodeSwitch",
        {
            "Switch": group_input.outputs["By Object"],
            "False": graph.attribute("photo", "FLOAT_COLOR"),
            "True": graph.attribute("object", "FLOAT_COLOR"),
        },
        input_type="RGBA",
    ).outputs[0]
    near = graph.node(
        "GeometryNodeDeleteGeometry",
        {"Geometry": group_input.outputs["Geometry"], "Selection": graph.attribute(FLOATING, "BOOLEAN")},
    ).outputs[0]
    colored = graph.store(near, COLOR, "FLOAT_COLOR", color)
    shape = graph.node(
        "GeometryNodeMeshUVSphere", {"Segments": 4, "Rings": 2, "Radius": group_input.outputs["Size"]}
    ).outputs["Mesh"]
    placed = graph.node("GeometryNodeInstanceOnPoints", {"Points": colored, "Instance": shape}).outputs[0]
    real = graph.node("GeometryNodeRealizeInstances", {"Geometry": placed}).outputs[0]
    # A vertex of the carrier comes first, so that the result has its active color attribute, which Solid mode shows.
    index = graph.node("GeometryNodeInputIndex").outputs[0]
    first = graph.node("GeometryNodeDeleteGeometry", {"Geometry": colored, "Selection": index}).outputs[0]
    joined = graph.node("GeometryNodeJoinGeometry")
    tree.links.new(real, joined.inputs[0])
    tree.links.new(first, joined.inputs[0])
    with_material = graph.node(
        "GeometryNodeSetMaterial", {"Geometry": joined.outputs[0], "Material": group_input.outputs["Material"]}
    ).outputs[0]
    graph.node("NodeGroupOutput", {0: with_material})
    graph.arrange()
    return tree


def splats_group(kind: str) -> bpy.types.NodeTree:
    """Return the newest group that shows splats in viewports (kind: SPLATS_GROUP) or renders (RENDER_GROUP)."""
    if kind == SPLATS_GROUP:
        return find_or_make(bpy.data.node_groups, kind, 7, "ObjectGS Splats", _make_splats_group)
    return find_or_make(bpy.data.node_groups, kind, 6, "ObjectGS Render", _make_render_group)


def hide_group() -> bpy.types.NodeTree:
    """Return the newest group that shows nothing; without it, Blender draws dots for the loose vertices of a mesh.

    Its output is the corners of the box around the splats, as points of radius 0, by which Blender frames the object.
    """
    return find_or_make(bpy.data.node_groups, HIDE_GROUP, 3, "ObjectGS Drawn", _make_hide_group)


def _make_hide_group(name: str) -> bpy.types.NodeTree:
    tree = _geometry_group(name, [])
    graph = Graph(tree)
    either = graph.node(
        "FunctionNodeBooleanMath",
        {0: _hidden(graph), 1: _outside(graph)},
        operation="OR",
    ).outputs[0]
    kept = graph.node(
        "GeometryNodeDeleteGeometry", {"Geometry": graph.node("NodeGroupInput").outputs[0], "Selection": either}
    ).outputs[0]
    box = graph.node("GeometryNodeBoundBox", {"Geometry": kept}).outputs[0]
    corners = graph.node("GeometryNodeMeshToPoints", {"Mesh": box, "Radius": 0.0}).outputs[0]
    graph.node("NodeGroupOutput", {0: corners})
    graph.arrange()
    return tree


def _geometry_group(name: str, inputs: list[tuple[str, str, Any, float | None, str]]) -> bpy.types.NodeTree:
    """Create a geometry node group for a modifier; `inputs`: (name, socket type, default, minimum, description)."""
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
        socket.hide_in_modifier = label.startswith("Recolor ")  # The add-on's panel has sliders for these.
    return tree


def _make_splats_group(name: str) -> bpy.types.NodeTree:
    tree = _geometry_group(
        name,
        [
            ("Ellipsoids", "NodeSocketBool", False, None, "Show ellipsoids instead of points; slow for many splats"),
            ("Point Size", "NodeSocketFloat", 1.0, 0.0, "Radius of the points relative to the splats' size"),
            ("Largest Point", "NodeSocketFloat", 1.0, 0.0, "Maximum radius of the points"),
            ("Minimum Opacity", "NodeSocketFloat", 0.1, 0.0, "Splats of lower opacity are not shown as points"),
            ("Material", "NodeSocketMaterial", None, None, "Material of the points"),
            *recolor_inputs(),
        ],
    )
    graph = Graph(tree)
    group_input = graph.node("NodeGroupInput")
    splat = _Splat(graph)
    raw = recolored(graph, graph.vector("MULTIPLY_ADD", splat.base, (sh.C0,) * 3, (0.5,) * 3), group_input)
    points = graph.node("GeometryNodeMeshToPoints", {"Mesh": group_input.outputs["Geometry"]}).outputs[0]
    points = graph.node("GeometryNodeDeleteGeometry", {"Geometry": points, "Selection": _outside(graph)}).outputs[0]

    first, second, third = splat.sides
    middle = graph.math(
        "MAXIMUM",
        graph.math("MINIMUM", first, second),
        graph.math("MINIMUM", graph.math("MAXIMUM", first, second), third),
    )
    radius = graph.math(
        "MINIMUM",
        graph.math("MULTIPLY", middle, group_input.outputs["Point Size"]),
        group_input.outputs["Largest Point"],
    )
    faint = graph.node(
        "FunctionNodeBooleanMath",
        {0: graph.math("LESS_THAN", splat.opacity, group_input.outputs["Minimum Opacity"]), 1: splat.hidden},
        operation="OR",
    ).outputs[0]
    clear = graph.node("GeometryNodeDeleteGeometry", {"Geometry": points, "Selection": faint}).outputs[0]
    dots = graph.node("GeometryNodeSetPointRadius", {"Points": clear, "Radius": radius}).outputs[0]
    dots = graph.store(dots, COLOR, "FLOAT_COLOR", _linear_color(graph, raw, 1.0))
    dots = graph.node(
        "GeometryNodeSetMaterial", {"Geometry": dots, "Material": group_input.outputs["Material"]}
    ).outputs[0]

    size = graph.vector("SCALE", graph.vector("MAXIMUM", splat.scale, splat.thinnest), splat.reach)
    ball = graph.node("GeometryNodeMeshIcoSphere", {"Radius": 1.0 / ICOSPHERE_INRADIUS, "Subdivisions": 2}).outputs[
        "Mesh"
    ]
    ball = graph.node("GeometryNodeSetMaterial", {"Geometry": ball, "Material": ellipsoids_material()}).outputs[0]
    colored = graph.store(points, COLOR, "FLOAT_COLOR", _linear_color(graph, raw, splat.opacity))
    ellipsoids = graph.node(
        "GeometryNodeInstanceOnPoints",
        {"Points": colored, "Selection": splat.is_seen, "Instance": ball, "Rotation": splat.rotation, "Scale": size},
    ).outputs[0]

    shown = graph.node(
        "GeometryNodeSwitch",
        {"Switch": group_input.outputs["Ellipsoids"], "False": dots, "True": ellipsoids},
        input_type="GEOMETRY",
    ).outputs[0]
    graph.node("NodeGroupOutput", {0: shown})
    graph.arrange()
    return tree


def _make_render_group(name: str) -> bpy.types.NodeTree:
    tree = _geometry_group(
        name,
        [
            ("Material", "NodeSocketMaterial", None, None, "Material of the splats"),
            *recolor_inputs(),
        ],
    )
    graph = Graph(tree)
    group_input = graph.node("NodeGroupInput")
    splat = _Splat(graph)
    position = graph.node("GeometryNodeInputPosition").outputs[0]
    camera = graph.node("GeometryNodeInputActiveCamera").outputs[0]
    camera_center = graph.node("GeometryNodeObjectInfo", {"Object": camera}, transform_space="RELATIVE").outputs[
        "Location"
    ]
    towards = graph.vector("SUBTRACT", camera_center, position)

    # In the space where the splat is a unit sphere: the direction to the camera and two directions orthogonal to it.
    sigmas = graph.vector("MAXIMUM", splat.scale, splat.thinnest)
    back = graph.node("FunctionNodeInvertRotation", {0: splat.rotation}).outputs[0]
    local = graph.vector("DIVIDE", graph.rotated(towards, back), sigmas)
    distance = graph.vector("LENGTH", local, output="Value")
    axis = graph.vector("NORMALIZE", local)
    x = graph.separated(axis)[0]
    # Any vector not parallel to the axis.
    aside = graph.node(
        "ShaderNodeCombineXYZ",
        {
            0: graph.math("LESS_THAN", graph.math("ABSOLUTE", x), 0.6),
            1: graph.math("GREATER_THAN", graph.math("ABSOLUTE", x), 0.6),
        },
    ).outputs[0]
    across = graph.vector("NORMALIZE", graph.vector("CROSS_PRODUCT", axis, aside))
    along = graph.vector("CROSS_PRODUCT", axis, across)

    # Seen from nearby, the silhouette of a sphere on the plane through its center is larger than its great circle.
    ratio = graph.math("DIVIDE", splat.reach, graph.math("MAXIMUM", distance, 1e-20))
    nearness = graph.math("MULTIPLY", ratio, ratio)
    outside = graph.math("LESS_THAN", nearness, MAXIMUM_NEARNESS)
    widened = graph.math(
        "DIVIDE",
        1.0,
        graph.math("SQRT", graph.math("SUBTRACT", 1.0, graph.math("MINIMUM", nearness, MAXIMUM_NEARNESS))),
    )
    extent = graph.math("MULTIPLY", splat.reach, widened)

    raw = graph.vector("MULTIPLY_ADD", splat.base, (sh.C0,) * 3, (0.5,) * 3)
    raw = _add_harmonics(graph, raw, graph.vector("NORMALIZE", graph.vector("SCALE", towards, -1.0)))
    raw = recolored(graph, raw, group_input)
    kept = graph.node("FunctionNodeBooleanMath", {0: splat.is_seen, 1: outside}, operation="AND").outputs[0]
    dropped = graph.node("FunctionNodeBooleanMath", {0: kept}, operation="NOT").outputs[0]
    points = graph.node("GeometryNodeMeshToPoints", {"Mesh": group_input.outputs["Geometry"]}).outputs[0]
    points = graph.node("GeometryNodeDeleteGeometry", {"Geometry": points, "Selection": dropped}).outputs[0]
    points = graph.store(points, COLOR, "FLOAT_COLOR", _linear_color(graph, raw, splat.opacity))
    points = graph.store(points, "center", "FLOAT_VECTOR", position)
    for label, direction in (("across", across), ("along", along)):
        wide = graph.vector("MULTIPLY", graph.vector("SCALE", direction, extent), sigmas)
        points = graph.store(points, label, "FLOAT_VECTOR", graph.rotated(wide, splat.rotation))
    points = graph.store(
        points,
        "disc_size",
        "FLOAT_VECTOR",
        graph.node("ShaderNodeCombineXYZ", {0: widened, 1: widened, 2: nearness}).outputs[0],
    )
    for pattern in ("radiance:*", "rotation", "scale", "object_id", "objectgs_*"):
        points = graph.removed(points, pattern)

    square = graph.node(
        "GeometryNodeMeshGrid", {"Size X": 2.0, "Size Y": 2.0, "Vertices X": 2, "Vertices Y": 2}
    ).outputs["Mesh"]
    square = graph.store(square, "disc", "FLOAT_VECTOR", graph.node("GeometryNodeInputPosition").outputs[0])
    quads = graph.node("GeometryNodeInstanceOnPoints", {"Points": points, "Instance": square}).outputs[0]
    quads = graph.node("GeometryNodeRealizeInstances", {"Geometry": quads}).outputs[0]
    corner_x, corner_y, _ = graph.separated(graph.attribute("disc", "FLOAT_VECTOR"))
    put = graph.vector(
        "ADD",
        graph.attribute("center", "FLOAT_VECTOR"),
        graph.vector(
            "ADD",
            graph.vector("SCALE", graph.attribute("across", "FLOAT_VECTOR"), corner_x),
            graph.vector("SCALE", graph.attribute("along", "FLOAT_VECTOR"), corner_y),
        ),
    )
    quads = graph.node("GeometryNodeSetPosition", {"Geometry": quads, "Position": put}).outputs[0]
    flat = graph.node("ShaderNodeCombineXYZ", {0: corner_x, 1: corner_y, 2: 1.0}).outputs[0]
    quads = graph.store(
        quads, "disc", "FLOAT_VECTOR", graph.vector("MULTIPLY", flat, graph.attribute("disc_size", "FLOAT_VECTOR"))
    )
    for spent in ("center", "across", "along", "disc_size"):
        quads = graph.removed(quads, spent)
    quads = graph.node(
        "GeometryNodeSetMaterial", {"Geometry": quads, "Material": group_input.outputs["Material"]}
    ).outputs[0]
    graph.node("NodeGroupOutput", {0: quads})
    graph.arrange()
    return tree


class _Splat:
    """Sockets of a splat's attributes and of values derived from them."""

    def __init__(self, graph: Graph) -> None:
        base = graph.attribute("radiance:base", "FLOAT_COLOR")
        self.base = base
        self.opacity = graph.node("FunctionNodeSeparateColor", {0: base}).outputs["Alpha"]
        self.scale = graph.attribute("scale", "FLOAT_VECTOR")
        self.rotation = graph.attribute("rotation", "QUATERNION")
        self.sides = graph.separated(self.scale)
        longest = graph.math("MAXIMUM", graph.math("MAXIMUM", *self.sides[:2]), self.sides[2])
        self.thinnest = graph.math("MULTIPLY", longest, MINIMUM_FLATNESS)
        # Distance from the center in sigmas at which alpha falls to 1/255.
        ratio = graph.math("MAXIMUM", graph.math("MULTIPLY", self.opacity, 1.0 / ALPHA_MIN), 1.0)
        self.reach = graph.math("SQRT", graph.math("MULTIPLY", graph.math("LOGARITHM", ratio, math.e), 2.0))
        self.hidden = _hidden(graph)
        shown = graph.node("FunctionNodeBooleanMath", {0: self.hidden}, operation="NOT").outputs[0]
        self.is_seen = graph.node(
            "FunctionNodeBooleanMath",
            {0: graph.math("GREATER_THAN", self.opacity, 1.01 * ALPHA_MIN), 1: shown},
            operation="AND",
        ).outputs[0]


def _hidden(graph: Graph) -> bpy.types.NodeSocket:
    """Return whether a splat is hidden for any reason."""
    return _either(graph, HIDDEN, COVERED)


def _outside(graph: Graph) -> bpy.types.NodeSocket:
    """Return whether previews leave a splat out, since Blender would frame it."""
    return _either(graph, FLOATING, DISTANT)


def _either(graph: Graph, *names: str) -> bpy.types.NodeSocket:
    """Return whether one of two Boolean attributes is true."""
    attributes = {index: graph.attribute(name, "BOOLEAN") for index, name in enumerate(names)}
    return graph.node("FunctionNodeBooleanMath", attributes, operation="OR").outputs[0]


def _linear_color(graph: Graph, raw: bpy.types.NodeSocket, alpha: Any) -> bpy.types.NodeSocket:
    """Convert a splat's sRGB-encoded color, which may be negative, to linear RGBA."""
    channels = {index: linear_channel(graph, channel) for index, channel in enumerate(graph.separated(raw))}
    return graph.node("FunctionNodeCombineColor", {**channels, "Alpha": alpha}).outputs[0]


def _add_harmonics(graph: Graph, color: bpy.types.NodeSocket, direction: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
    """Add the spherical harmonics of degrees 1 to 3 in a direction to `color`; missing coefficients count as 0."""
    x, y, z = graph.separated(direction)
    xx, yy, zz = (graph.math("MULTIPLY", side, side) for side in (x, y, z))
    xy, yz, xz = graph.math("MULTIPLY", x, y), graph.math("MULTIPLY", y, z), graph.math("MULTIPLY", x, z)

    def combined(*terms: tuple[float, Any]) -> bpy.types.NodeSocket:
        """Return the sum of factor * value."""
        total: Any = 0.0
        for factor, value in terms:
            total = graph.math("MULTIPLY_ADD", value, factor, total)
        return total

    def times(left: Any, right: Any) -> bpy.types.NodeSocket:
        return graph.math("MULTIPLY", left, right)

    round_ = combined((4.0, zz), (-1.0, xx), (-1.0, yy))
    terms = (
        (-sh.C1, y),
        (sh.C1, z),
        (-sh.C1, x),
        (sh.C2, xy),
        (-sh.C2, yz),
        (sh.C20, combined((2.0, zz), (-1.0, xx), (-1.0, yy))),
        (-sh.C2, xz),
        (sh.C2 / 2, combined((1.0, xx), (-1.0, yy))),
        (-sh.C33, times(y, combined((3.0, xx), (-1.0, yy)))),
        (sh.C32, times(xy, z)),
        (-sh.C31, times(y, round_)),
        (sh.C30, times(z, combined((2.0, zz), (-3.0, xx), (-3.0, yy)))),
        (-sh.C31, times(x, round_)),
        (sh.C32 / 2, times(z, combined((1.0, xx), (-1.0, yy)))),
        (-sh.C33, times(x, combined((1.0, xx), (-3.0, yy)))),
    )
    for k, (factor, value) in enumerate(terms, start=1):
        weight = graph.math("MULTIPLY", value, factor)
        color = graph.vector(
            "ADD", color, graph.vector("SCALE", graph.attribute(f"radiance:sh_{k}", "FLOAT_VECTOR"), weight)
        )
    return color
