# SPDX-License-Identifier: GPL-3.0-or-later
"""Nodes for color conversion and recoloring in geometry and shader node trees."""

from __future__ import annotations

from typing import Any

import bpy

from ....backend.shared.color import srgb
from .graph import Graph

CHANNELS = ("Red", "Green", "Blue")
OFFSET = "Recolor Offset"
"""Name of the group input that is added to red, green and blue."""


def recolor_inputs() -> list[tuple[str, str, Any, None, str]]:
    """Return the group inputs of an affine map on sRGB-encoded colors, by default the identity.

    Returns:
        (name, socket type, default, minimum, description) of the three matrix rows and of the offset.
    """
    rows = [
        (
            f"Recolor {channel}",
            "NodeSocketVector",
            tuple(float(i == j) for j in range(3)),
            None,
            f"Weights of red, green and blue in the new {channel.lower()}",
        )
        for i, channel in enumerate(CHANNELS)
    ]
    return [*rows, (OFFSET, "NodeSocketVector", (0.0, 0.0, 0.0), None, "Added to red, green and blue")]


def recolored(graph: Graph, color: bpy.types.NodeSocket, group_input: bpy.types.Node) -> bpy.types.NodeSocket:
    """Apply the affine map from the `recolor_inputs` to an sRGB-encoded color."""
    rows = [
        graph.vector("DOT_PRODUCT", color, group_input.outputs[f"Recolor {channel}"], output="Value")
        for channel in CHANNELS
    ]
    mapped = graph.node("ShaderNodeCombineXYZ", dict(enumerate(rows))).outputs[0]
    return graph.vector("ADD", mapped, group_input.outputs[OFFSET])


def linear_channel(graph: Graph, value: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
    """Convert an sRGB-encoded value to linear; negative values are clamped to 0."""
    value = graph.math("MAXIMUM", value, 0.0)
    scaled = graph.math("DIVIDE", graph.math("ADD", value, srgb.OFFSET), 1.0 + srgb.OFFSET)
    curve = graph.math("POWER", scaled, srgb.GAMMA)
    line = graph.math("DIVIDE", value, srgb.LINEAR_SLOPE)
    return _select(graph, graph.math("GREATER_THAN", value, srgb.ENCODED_CUTOFF), curve, line)


def encoded_channel(graph: Graph, value: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
    """Convert a linear value to sRGB-encoded; negative values are clamped to 0."""
    value = graph.math("MAXIMUM", value, 0.0)
    power = graph.math("POWER", value, 1.0 / srgb.GAMMA)
    curve = graph.math("MULTIPLY_ADD", power, 1.0 + srgb.OFFSET, -srgb.OFFSET)
    line = graph.math("MULTIPLY", value, srgb.LINEAR_SLOPE)
    return _select(graph, graph.math("GREATER_THAN", value, srgb.LINEAR_CUTOFF), curve, line)


def _select(graph: Graph, condition: bpy.types.NodeSocket, yes: Any, no: Any) -> bpy.types.NodeSocket:
    """Return `yes` where the condition is 1 and `no` where it is 0."""
    return graph.math(
        "MULTIPLY_ADD", condition, yes, graph.math("MULTIPLY", graph.math("SUBTRACT", 1.0, condition), no)
    )
