# SPDX-License-Identifier: GPL-3.0-or-later
"""Objects of a reconstruction as assets."""

from __future__ import annotations

import bpy
import numpy as np

from ..edits.placement import matrix_to_world


def mark_asset(collection: bpy.types.Collection, meshes: list[bpy.types.Object]) -> None:
    """Mark an object's collection as an asset whose instances stand upright, at true size, at the drop position.

    This marks the collection instead of the mesh, since the mesh alone lacks the rotation of its parents.

    Args:
        collection: the object's collection.
        meshes: the object's meshes, at least one.
    """
    low, high = bounds(meshes)
    collection.instance_offset = (*((low + high) / 2)[:2], low[2])
    if collection.asset_data is None:
        collection.asset_mark()
        collection.asset_data.description = f"{collection.name}, reconstructed from photos"
    collection.asset_data.tags.new("ObjectGS", skip_if_exists=True)
    collection.asset_generate_preview()


def bounds(meshes: list[bpy.types.Object]) -> np.ndarray:
    """Return the minimum and maximum world coordinates of mesh objects, (2, 3) float64."""
    ends = []
    for obj in meshes:
        local = np.empty(3 * len(obj.data.vertices), np.float32)
        obj.data.vertices.foreach_get("co", local)
        matrix = matrix_to_world(obj)
        world = local.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3]
        ends += [world.min(0), world.max(0)]
    return np.stack([np.min(ends, axis=0), np.max(ends, axis=0)])
