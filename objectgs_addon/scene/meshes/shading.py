# SPDX-License-Identifier: GPL-3.0-or-later
"""Shading of a reconstruction's meshes: as captured, like splats, or by the scene's lights."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager

import bpy

from ..kinds import MESH, kind_of
from ..object_collection import our_materials
from ..shading.materials import CAPTURED, LIT, SHADINGS, shade_mesh_material

SHADING = "objectgs_shading"
"""Custom property of the root collection: the chosen entry of SHADINGS."""


def shading_of(root: bpy.types.Collection) -> str:
    """Return the entry of SHADINGS that the meshes of a reconstruction have."""
    chosen = root.get(SHADING)
    if chosen in SHADINGS:
        return chosen
    # Files of older versions have lit meshes and no such property.
    return LIT if any(kind_of(obj) == MESH for obj in root.all_objects) else CAPTURED


def shade_meshes(root: bpy.types.Collection, shading: str) -> None:
    """Shade the meshes of a reconstruction by an entry of SHADINGS; the user's own materials are not changed."""
    if shading not in SHADINGS:
        raise ValueError(f"meshes cannot be shaded by {shading}")
    root[SHADING] = shading
    _shade([obj for obj in root.all_objects if kind_of(obj) == MESH], shading)


@contextmanager
def lit(meshes: Iterable[bpy.types.Object]) -> Iterator[None]:
    """Shade meshes by lights for a while, since exporters find the textures of lit materials only."""
    changed = _shade(meshes, LIT)
    try:
        yield
    finally:
        for material in changed:
            shade_mesh_material(material, CAPTURED)


def _shade(meshes: Iterable[bpy.types.Object], shading: str) -> list[bpy.types.Material]:
    """Shade the add-on's materials of meshes, and return those that have changed."""
    materials = dict.fromkeys(material for obj in meshes for material in our_materials(obj))
    return [each for each in materials if each.library is None and shade_mesh_material(each, shading)]
