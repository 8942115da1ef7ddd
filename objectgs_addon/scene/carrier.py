# SPDX-License-Identifier: GPL-3.0-or-later
"""Mesh carriers: meshes of loose vertices with point attributes, read and written as NumPy arrays."""

from __future__ import annotations

from collections.abc import Iterable

import bpy
import numpy as np

from ...backend.shared.class_table import LARGEST_ID
from ...backend.shared.errors import InputError

# Attribute type -> field name for foreach_set, NumPy type and number of components per vertex.
_FIELDS = {
    "FLOAT": ("value", np.float32, 1),
    "INT": ("value", np.int32, 1),
    "INT32_2D": ("value", np.int32, 2),
    "FLOAT_VECTOR": ("vector", np.float32, 3),
    "FLOAT_COLOR": ("color", np.float32, 4),
    "QUATERNION": ("value", np.float32, 4),
    "BOOLEAN": ("value", bool, 1),
}
KINDS = frozenset(_FIELDS)
"""Attribute types that can be read and written."""

SAMPLES = "objectgs_samples"
"""Custom property of a mesh: its number of vertices and the positions of some when it was filled."""

EXACT = 1e-5
"""Largest distance of a vertex from an affine map of it, relative to the coordinates."""


def require_object_mode(objs: Iterable[bpy.types.Object]) -> None:
    """Raise InputError if any of the objects is in Edit Mode or another mode that edits its mesh.

    Leaving Edit Mode would overwrite data written to the mesh.
    """
    for obj in objs:
        if obj is not None and (obj.mode != "OBJECT" or getattr(obj.data, "is_editmode", False)):
            mode = "Edit" if obj.mode == "OBJECT" else obj.mode.replace("_", " ").title()
            raise InputError(f"{obj.name} is in {mode} Mode; leave it and try again.")


def fill(mesh: bpy.types.Mesh, positions: np.ndarray, attributes: dict[str, tuple[str, np.ndarray]]) -> None:
    """Replace all vertices of `mesh` and keep its materials.

    Args:
        mesh: the mesh carrier.
        positions: (n, 3) vertex positions.
        attributes: name -> (Blender attribute type, array of n rows).
    """
    count = len(positions)
    mesh.clear_geometry()
    mesh.vertices.add(count)
    write(mesh, "position", "FLOAT_VECTOR", positions)
    for name, (kind, values) in attributes.items():
        write(mesh, name, kind, values)
    mesh.update()
    remember_positions(mesh)


def remember_positions(mesh: bpy.types.Mesh) -> None:
    """Store the positions of some vertices of a newly filled mesh, with which `applied_map` compares later ones."""
    mesh[SAMPLES] = _sampled(mesh)


def applied_map(mesh: bpy.types.ID) -> np.ndarray:
    """Return the map that Blender's operators have applied to all vertices since the mesh was filled, (4, 4) float64.

    *Apply* and *Set Origin* change vertices and transform at once, so that the mesh stays where it is. The map is
    exactly the identity without them, or after edits of the shape.
    """
    found = np.eye(4)
    if not isinstance(mesh, bpy.types.Mesh):
        return found  # The user has converted it.
    stored, current = getattr(mesh.get(SAMPLES), "to_list", list)(), _sampled(mesh)
    if stored == current or len(stored) != len(current) or stored[0] != current[0]:
        return found
    before, now = (np.array(each[1:]).reshape(-1, 3) for each in (stored, current))
    tolerance = EXACT * max(np.abs(before).max(), np.abs(now).max())
    shift = (now - before).mean(0)
    if np.abs(before + shift - now).max() <= tolerance:
        found[:3, 3] = shift
        return found
    local = np.column_stack([before, np.ones(len(before))])
    fit, _, rank, _ = np.linalg.lstsq(local, now, rcond=None)
    # Any change of 4 vertices is an affine map.
    if len(before) > 4 and rank == 4 and np.abs(local @ fit - now).max() <= tolerance and np.linalg.det(fit[:3]):
        found[:3] = fit.T
    return found


def _sampled(mesh: bpy.types.Mesh) -> list[float]:
    """Return the number of vertices of a mesh, and the coordinates of up to 12 spread over it."""
    vertices, count = mesh.vertices, len(mesh.vertices)
    chosen = sorted({index * (count - 1) // 11 for index in range(12)}) if count else ()
    return [float(count), *(value for index in chosen for value in vertices[index].co)]


def write(mesh: bpy.types.Mesh, name: str, kind: str, values: np.ndarray) -> None:
    """Set a point attribute for all vertices; create it if it is missing or has another type or domain."""
    field, dtype, width = _FIELDS[kind]
    if name in mesh.attributes and not has(mesh, name, kind):
        mesh.attributes.remove(mesh.attributes[name])
    attribute = mesh.attributes.get(name) or mesh.attributes.new(name, kind, "POINT")
    if len(values):
        flat = np.ascontiguousarray(values, dtype).reshape(-1)
        if flat.size != width * len(mesh.vertices):
            raise ValueError(f"{name}: {flat.size} numbers for {len(mesh.vertices)} vertices")
        attribute.data.foreach_set(field, flat)


def has(mesh: bpy.types.Mesh, name: str, kind: str) -> bool:
    """Return whether a mesh has a point attribute of a Blender attribute type."""
    attribute = mesh.attributes.get(name)
    return attribute is not None and attribute.data_type == kind and attribute.domain == "POINT"


def read(mesh: bpy.types.Mesh, name: str) -> np.ndarray:
    """Return an attribute of all vertices, (n,) or (n, width)."""
    attribute = mesh.attributes[name]
    field, dtype, width = _FIELDS[attribute.data_type]
    values = np.empty(width * len(mesh.vertices), dtype)
    attribute.data.foreach_get(field, values)
    return values if width == 1 else values.reshape(-1, width)


def stored_ids(ids: np.ndarray) -> np.ndarray:
    """Reinterpret the bits of IDs 0 .. 2^32 - 1 as int32, the integer type of attributes."""
    return np.asarray(ids, np.int64).astype(np.uint32).view(np.int32)


def read_ids(mesh: bpy.types.Mesh, name: str) -> np.ndarray:
    """Return the object IDs of an attribute written with `stored_ids`, (n,) int64 in 0 .. 2^32 - 1."""
    return read(mesh, name).astype(np.int64) & LARGEST_ID
