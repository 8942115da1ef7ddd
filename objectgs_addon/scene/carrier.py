# SPDX-License-Identifier: GPL-3.0-or-later
"""Meshes of loose vertices that carry a value of each kind for each vertex, filled without loops."""

from __future__ import annotations

from collections.abc import Iterable

import bpy
import numpy as np

from ...backend.shared.errors import InputError

# Attribute type -> its field in foreach_set, NumPy type and numbers for each vertex.
_FIELDS = {
    "FLOAT": ("value", np.float32, 1),
    "INT": ("value", np.int32, 1),
    "FLOAT_VECTOR": ("vector", np.float32, 3),
    "FLOAT_COLOR": ("color", np.float32, 4),
    "QUATERNION": ("value", np.float32, 4),
    "BOOLEAN": ("value", bool, 1),
}
KINDS = frozenset(_FIELDS)
"""The types of attributes that can be read and written."""


def require_object_mode(objs: Iterable[bpy.types.Object]) -> None:
    """Raise InputError where one of the objects is in Edit Mode or another mode that works on its mesh.

    Edit Mode would overwrite what is written to the mesh when it is left.
    """
    for obj in objs:
        if obj is not None and (obj.mode != "OBJECT" or getattr(obj.data, "is_editmode", False)):
            mode = "Edit" if obj.mode == "OBJECT" else obj.mode.replace("_", " ").title()
            raise InputError(f"{obj.name} is in {mode} Mode; leave it and try again.")


def fill(mesh: bpy.types.Mesh, positions: np.ndarray, attributes: dict[str, tuple[str, np.ndarray]]) -> None:
    """Replace all vertices of `mesh`; its materials stay.

    positions (n, 3); attributes: name -> (Blender's attribute type, array of n rows).
    """
    count = len(positions)
    mesh.clear_geometry()
    mesh.vertices.add(count)
    write(mesh, "position", "FLOAT_VECTOR", positions)
    for name, (kind, values) in attributes.items():
        write(mesh, name, kind, values)
    mesh.update()


def write(mesh: bpy.types.Mesh, name: str, kind: str, values: np.ndarray) -> None:
    """Set one attribute of all vertices, made where it is missing or of another type."""
    field, dtype, width = _FIELDS[kind]
    attribute = mesh.attributes.get(name)
    if attribute is not None and (attribute.data_type != kind or attribute.domain != "POINT"):
        mesh.attributes.remove(attribute)
        attribute = None
    if attribute is None:
        attribute = mesh.attributes.new(name, kind, "POINT")
    if len(values):
        flat = np.ascontiguousarray(values, dtype).reshape(-1)
        if flat.size != width * len(mesh.vertices):
            raise ValueError(f"{name}: {flat.size} numbers for {len(mesh.vertices)} vertices")
        attribute.data.foreach_set(field, flat)


def read(mesh: bpy.types.Mesh, name: str) -> np.ndarray:
    """One attribute of all vertices: (n,) or (n, width)."""
    attribute = mesh.attributes[name]
    field, dtype, width = _FIELDS[attribute.data_type]
    values = np.empty(width * len(mesh.vertices), dtype)
    attribute.data.foreach_get(field, values)
    return values if width == 1 else values.reshape(-1, width)


def stored_ids(ids: np.ndarray) -> np.ndarray:
    """IDs 0 .. 2^32 - 1 as the int32 of the same bits, which is what attributes can hold."""
    return np.asarray(ids, np.int64).astype(np.uint32).view(np.int32)
