# SPDX-License-Identifier: GPL-3.0-or-later
"""Objects of a reconstruction as assets."""

from __future__ import annotations

import uuid
from pathlib import Path

import bpy
import numpy as np

from ....backend.shared.errors import InputError
from ....backend.shared.formats.atomic import write_atomic
from ..edits.placement import matrix_to_world

CATALOGS = "blender_assets.cats.txt"
"""File in which Blender looks for the catalogs of the .blend files beside it."""

_HEADER = "# This is an Asset Catalog Definition file for Blender.\n\nVERSION 1\n"


def mark_asset(collection: bpy.types.Collection, meshes: list[bpy.types.Object], catalog: str) -> None:
    """Mark an object's collection as an asset whose instances stand upright, at true size, at the drop position.

    This marks the collection instead of the mesh, since the mesh alone lacks the rotation of its parents.

    Args:
        collection: the object's collection.
        meshes: the object's meshes, at least one.
        catalog: name of the catalog, which `write_catalog` makes known.
    """
    low, high = bounds(meshes)
    collection.instance_offset = (*((low + high) / 2)[:2], low[2])
    if collection.asset_data is None:
        collection.asset_mark()
        collection.asset_data.description = f"{collection.name}, reconstructed from photos"
    collection.asset_data.tags.new("ObjectGS", skip_if_exists=True)
    collection.asset_data.catalog_id = str(_catalog_id(catalog))
    collection.asset_generate_preview()


def write_catalog(folder: Path, catalog: str) -> None:
    """Add a catalog to the catalogs of the .blend files in a folder, unless it is there.

    Raises:
        InputError: The file of catalogs cannot be read or written.
    """
    path = folder / CATALOGS
    try:
        text = path.read_text(encoding="utf-8") if path.exists() else _HEADER
        if str(_catalog_id(catalog)) not in text:
            line = f"{_catalog_id(catalog)}:ObjectGS/{catalog}:ObjectGS-{catalog}"
            write_atomic(path, f"{text.rstrip()}\n{line}\n".encode())
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read or written ({error}); check it and its permissions.") from error


def _catalog_id(catalog: str) -> uuid.UUID:
    """Return the catalog's ID, which is the same for the same name in all files."""
    return uuid.uuid5(uuid.NAMESPACE_URL, f"objectgs:{catalog}")


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
