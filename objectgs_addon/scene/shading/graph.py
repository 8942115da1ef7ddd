# SPDX-License-Identifier: GPL-3.0-or-later
"""Construction of node trees, and lookup of shared node groups and materials by kind and version."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import bpy

from ..kinds import kind_of, mark

VERSION = "objectgs_version"
"""Custom property of a node group or material: the version of its nodes. Users of an older version keep it until they
require a feature of the newer version."""


class Graph:
    """Builder for a node tree; its methods add nodes and link sockets."""

    def __init__(self, tree: bpy.types.NodeTree) -> None:
        self.tree = tree

    def node(self, kind: str, inputs: dict[Any, Any] | None = None, **settings: Any) -> bpy.types.Node:
        """Add a node.

        Args:
            kind: the node's type, such as "ShaderNodeMath".
            inputs: index or name of an input -> the output socket to link to it, or its value.
            settings: attributes of the node.
        """
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

    def math(self, operation: str, *values: Any) -> bpy.types.NodeSocket:
        """Add a Math node with numbers or sockets as inputs and return its output."""
        return self.node("ShaderNodeMath", dict(enumerate(values)), operation=operation).outputs[0]

    def vector(self, operation: str, *values: Any, output: str = "Vector") -> bpy.types.NodeSocket:
        """Add a Vector Math node and return its output; the second value of SCALE is the factor."""
        keys: Iterable[Any] = ("Vector", "Scale") if operation == "SCALE" else range(len(values))
        return self.node("ShaderNodeVectorMath", dict(zip(keys, values)), operation=operation).outputs[output]

    def attribute(self, name: str, kind: str) -> bpy.types.NodeSocket:
        """Return a named attribute of the geometry (geometry nodes)."""
        node = self.node("GeometryNodeInputNamedAttribute", {"Name": name}, data_type=kind)
        return next(socket for socket in node.outputs if socket.enabled and socket.name == "Attribute")

    def separated(self, vector: Any) -> list[bpy.types.NodeSocket]:
        """Return the three components of a vector."""
        return list(self.node("ShaderNodeSeparateXYZ", {0: vector}).outputs)

    def rotated(self, vector: Any, rotation: Any) -> bpy.types.NodeSocket:
        """Rotate a vector (geometry nodes)."""
        return self.node("FunctionNodeRotateVector", {"Vector": vector, "Rotation": rotation}).outputs[0]

    def store(self, geometry: Any, name: str, kind: str, value: Any) -> bpy.types.NodeSocket:
        """Store a named point attribute and return the new geometry (geometry nodes)."""
        return self.node(
            "GeometryNodeStoreNamedAttribute",
            {"Geometry": geometry, "Name": name, "Value": value},
            data_type=kind,
            domain="POINT",
        ).outputs[0]

    def removed(self, geometry: Any, pattern: str) -> bpy.types.NodeSocket:
        """Remove attributes whose names match `pattern`, with `*` as wildcard (geometry nodes)."""
        node = self.node("GeometryNodeRemoveAttribute", {"Geometry": geometry, "Name": pattern})
        if hasattr(node, "pattern_mode"):
            node.pattern_mode = "WILDCARD"
        elif "Pattern Mode" in node.inputs:  # from Blender 5.0 on
            node.inputs["Pattern Mode"].default_value = "Wildcard"
        return node.outputs[0]

    def arrange(self) -> None:
        """Arrange the nodes in columns from left to right by their longest distance from an input."""
        into: dict[str, list[str]] = {node.name: [] for node in self.tree.nodes}
        for link in self.tree.links:
            into[link.to_node.name].append(link.from_node.name)
        columns: dict[str, int] = {}
        rows: dict[int, int] = {}
        for node in self.tree.nodes:  # Nodes come after those linked to their inputs.
            column = max((columns.get(name, -1) + 1 for name in into[node.name]), default=0)
            columns[node.name] = column
            node.location = (220.0 * column, -180.0 * rows.get(column, 0))
            rows[column] = rows.get(column, 0) + 1


def find_or_make(collection: Iterable[Any], kind: str, version: int, name: str, make: Callable[[str], Any]) -> Any:
    """Return the local data-block of this kind and version, created by make(name) if missing."""
    for block in collection:
        if kind_of(block) == kind and block.get(VERSION) == version and block.library is None:
            return block
    block = make(name)
    mark(block, kind)
    block[VERSION] = version
    return block
