# SPDX-License-Identifier: GPL-3.0-or-later
"""Nodes that convert and recolor colors, in geometry nodes and in shaders."""

from __future__ import annotations

from typing import Any

import bpy

from ....backend.shared.color import srgb
from .graph import Graph

CHANNELS = ("Red", "Green", "Blue")
OFFSET = "Recolor Offset"
"""Input of a group: what is added to red, green and blue."""


def recolor_inputs() -> list[tuple[str, str, Any, None, str]]:
    """Group inputs of an affine map of sRGB-encoded colors, by default the identity.

    Returns:
        (name, socket type, default, minimum, description) of the matrix's three rows and of the offset.
    """
    rows = [
        (
            f"Recolor {channel}",
            "NodeSocketVector",
            tuple(float(i == j) for j in range(3)),
            None,
            f"How much of red, green and blue makes the new {channel.lower()}",
        )
        for i, channel in enumerate(CHANNELS)
    ]
    return [*rows, (OFFSET, "NodeSocketVector", (0.0, 0.0, 0.0), None, "Added to red, green and blue")]


def recolored(graph: Graph, color: bpy.types.NodeSocket, group_input: bpy.types.Node) -> bpy.types.NodeSocket:
    """An sRGB-encoded color under the affine map of the `recolor_inputs`."""
    rows = [
        graph.vector("DOT_PRODUCT", color, group_input.outputs[f"Recolor {channel}"], output="Value")
        for channel in CHANNELS
    ]
    mapped = graph.node("ShaderNodeCombineXYZ", dict(enumerate(rows))).outputs[0]
    return graph.vector("ADD", mapped, group_input.outputs[OFFSET])


def linear_channel(graph: Graph, value: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
    """sRGB-encoded to linear; negative values count as 0."""
    value = graph.math("MAXIMUM", value, 0.0)
    scaled = graph.math("DIVIDE", graph.math("ADD", value, srgb.OFFSET), 1.0 + srgb.OFFSET)
    curve = graph.math("POWER", scaled, srgb.GAMMA)
    line = graph.math("DIVIDE", value, srgb.LINEAR_SLOPE)
    return _select(graph, graph.math("GREATER_THAN", value, srgb.ENCODED_CUTOFF), curve, line)


def encoded_channel(graph: Graph, value: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
    """Linear to sRGB-encoded; negative values count as 0."""
    value = graph.math("MAXIMUM", value, 0.0)
    power = graph.math("POWER", value, 1.0 / srgb.GAMMA)
    curve = graph.math("MULTIPLY_ADD", power, 1.0 + srgb.OFFSET, -srgb.OFFSET)
    line = graph.math("MULTIPLY", value, srgb.LINEAR_SLOPE)
    return _select(graph, graph.math("GREATER_THAN", value, srgb.LINEAR_CUTOFF), curve, line)


def _select(graph: Graph, condition: bpy.types.NodeSocket, yes: Any, no: Any) -> bpy.types.NodeSocket:
    """`yes` where the condition is 1, `no` where it is 0."""
    return graph.math(
        "MULTIPLY_ADD", condition, yes, graph.math("MULTIPLY", graph.math("SUBTRACT", 1.0, condition), no)
    )
