# SPDX-License-Identifier: GPL-3.0-or-later
"""Display of a reconstruction's textured meshes, updated from its folder, in place of splats or together with them.

An object's mesh is in the object's collection; meshes of the whole scene and of sets of objects are in the
reconstruction's own collection.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass, field
from pathlib import Path

import bpy
import numpy as np

from ....backend.shared.errors import InputError
from ....backend.shared.reconstruction.folder import Reconstruction
from ....backend.shared.reconstruction.meshes import NAME as MESHES
from .. import carrier
from ..edits.fills import replace_by_mesh
from ..edits.recover import recover_parts
from ..edits.show import show_edits
from ..kinds import (
    MESH,
    MESH_KEY,
    SPLATS,
    folder_of,
    kind_of,
    object_collections,
    object_id_of,
    parts_of,
    whole_duplicates_of,
)
from ..object_collection import remove, remove_if_empty
from ..object_display import Objects
from .importing import MeshImporter
from .listed import assign_to_collections, read_listed
from .shading import SHADING, shading_of

SHOW = "objectgs_show"
"""Custom property of the root collection: the chosen entry of SHOWS."""

SHOWS = ("splats", "meshes", "both")

SHOWN = "objectgs_shown_meshes"
"""Custom property of the root collection: the modification time of the meshes.json that is shown."""


@dataclass
class ShownMeshes:
    """Result of `show_meshes`: the number of meshes in Blender, the number of meshes read from files, and warnings."""

    meshes: int = 0
    updated: int = 0
    warnings: list[str] = field(default_factory=list)


def show_meshes(root: bpy.types.Collection, folder: Path) -> ShownMeshes:
    """Call `update_meshes`, then show all edits of the objects."""
    shown = update_meshes(root, folder)
    show_edits(root, Objects.read(folder))
    return shown


def update_meshes(root: bpy.types.Collection, folder: Path) -> ShownMeshes:
    """Show the meshes listed in meshes.json, each aligned with its splats.

    Existing meshes are updated in place if their files changed: transforms, names, modifiers, materials and material
    slots are kept. A mesh whose files have not changed is not modified, and one of which only the texture has changed
    keeps its geometry. A mesh made from other objects than those its collection shows is removed.

    Args:
        root: the reconstruction's collection.
        folder: the reconstruction folder.

    Returns:
        The counts of meshes, and warnings. A mesh that cannot be read is kept unchanged, with a warning.

    Raises:
        InputError: meshes.json or objects.json cannot be used, or a mesh is in Edit Mode; nothing is changed.
    """
    folder = Path(folder)
    written = _written(folder)
    listed = read_listed(folder)
    objects = Objects.read(folder)
    recover_parts(root)
    collections = object_collections(root)
    existing = _meshes_by_key(root, collections.values())
    if not listed and not existing:
        return ShownMeshes()
    carrier.require_object_mode(existing.values())
    root[SHOWN] = written
    before = _has_meshes(root)
    root[SHADING] = shading_of(root)
    assigned, warnings = assign_to_collections(listed, objects)
    shown = ShownMeshes(warnings=warnings)
    importer = MeshImporter(root, objects, collections)
    for mesh, target in assigned:
        obj = existing.pop(mesh.key, None)
        try:
            shown.updated += importer.show(mesh, target, obj)
            shown.meshes += 1
        except InputError as error:
            shown.warnings.append(str(error))
            shown.meshes += obj is not None
    for obj in existing.values():
        importer.unlink(obj)
        remove(obj)
    shown.warnings += importer.warnings
    if SHOW not in root and shown.meshes:
        show_kinds(root, "meshes")
    elif importer.changed:
        # The first mesh added and the last mesh removed change whether the splats of the unlabeled rest are shown.
        apply_shown(root, {*importer.changed, 0} if before != _has_meshes(root) else importer.changed)
    for object_id in importer.changed:
        if object_id is not None and object_id not in importer.new:
            remove_if_empty(collections[object_id])
    for object_id in importer.new:
        root.children.link(collections[object_id])
    return shown


def meshes_are_newer(root: bpy.types.Collection) -> bool:
    """Return whether the folder's meshes.json differs in modification time from the one shown.

    Files of older versions do not know the time; theirs differs if they have never shown meshes.
    """
    written = _written(folder_of(root))
    return bool(written) and (root[SHOWN] != written if SHOWN in root else not has_shown_meshes(root))


def _written(folder: Path) -> str:
    """Return the modification time of meshes.json in ns, as a string since Blender's integers have 32 bits, or ""."""
    try:
        return str((Reconstruction(folder).meshes / MESHES).stat().st_mtime_ns)
    except OSError:
        return ""


def has_shown_meshes(root: bpy.types.Collection) -> bool:
    """Return whether the reconstruction has ever shown meshes, which makes the choice of SHOWS available."""
    return SHOW in root


def shown_kinds(root: bpy.types.Collection) -> str:
    """Return the entry of SHOWS that a reconstruction shows."""
    chosen = root.get(SHOW)
    return chosen if chosen in SHOWS else SHOWS[0]


def show_kinds(root: bpy.types.Collection, which: str) -> None:
    """Show splats, meshes or both in viewports and renders.

    An object without a mesh, and what fills the hole of a removed object, always show their splats.

    In addition, users can hide single objects by their collection or with the eye icon.

    Args:
        root: the reconstruction's collection.
        which: an entry of SHOWS.
    """
    if which not in SHOWS:
        raise ValueError(f"{which} cannot be shown")
    root[SHOW] = which
    apply_shown(root, object_collections(root))


def apply_shown(root: bpy.types.Collection, changed: Iterable[int | None]) -> None:
    """Apply the choice of `show_kinds` to the collections of object IDs whose parts were added or removed."""
    wanted = set(changed)
    which, collections, copies = shown_kinds(root), object_collections(root), whole_duplicates_of(root)
    meshes, whole = object_meshes(root), scene_meshes(root)
    hidden = {} if meshes else {obj: which == "splats" for obj in whole}
    for object_id, collection in collections.items():
        if object_id not in wanted:
            continue
        # Without meshes of objects, a mesh of the whole scene replaces the unlabeled rest.
        replaced = object_id in meshes or (object_id == 0 and bool(whole) and not meshes)
        both = (collection, *copies.get(object_id, ()))
        for obj in [obj for each in both for obj in parts_of(each)]:
            if kind_of(obj) == SPLATS:
                hidden[obj] = replace_by_mesh(obj, which == "meshes" and replaced)
            elif kind_of(obj) == MESH:
                hidden[obj] = which == "splats"
    _hide(hidden)


def scene_meshes(root: bpy.types.Collection) -> list[bpy.types.Object]:
    """Return the meshes of the whole scene and of sets of objects, from the reconstruction's own collection."""
    return [obj for obj in root.objects if kind_of(obj) == MESH and object_id_of(obj) is None]


def object_meshes(root: bpy.types.Collection) -> dict[int, list[bpy.types.Object]]:
    """Map the IDs of objects with meshes to the meshes in their collections."""
    found = {
        object_id: [obj for obj in parts_of(collection) if kind_of(obj) == MESH]
        for object_id, collection in object_collections(root).items()
    }
    return {object_id: meshes for object_id, meshes in found.items() if meshes}


def _has_meshes(root: bpy.types.Collection) -> tuple[bool, bool]:
    """Return whether there are meshes of single objects, and of the whole scene or of sets of objects."""
    return bool(object_meshes(root)), bool(scene_meshes(root))


def _hide(hidden: dict[bpy.types.Object, bool]) -> None:
    """Hide or show objects in viewports and renders.

    All but the last are set in bulk without notifying Blender, which visits every object in the file each time.
    """
    objs = bpy.data.objects
    index = {obj: i for i, obj in enumerate(objs)}
    for name in ("hide_viewport", "hide_render"):
        flags = np.empty(len(objs), bool)
        objs.foreach_get(name, flags)
        changed = [obj for obj, value in hidden.items() if flags[index[obj]] != value]
        if not changed:
            continue
        for obj in changed[:-1]:
            flags[index[obj]] = hidden[obj]
        objs.foreach_set(name, flags)
        for obj in changed[:-1]:
            obj.update_tag(refresh={"OBJECT"})  # Otherwise Blender's evaluation hides it again.
        setattr(changed[-1], name, hidden[changed[-1]])


def _meshes_by_key(
    root: bpy.types.Collection, collections: Collection[bpy.types.Collection]
) -> dict[str, bpy.types.Object]:
    """Map keys in meshes.json to mesh objects; if the user duplicated a mesh, the first one is returned."""
    found: dict[str, bpy.types.Object] = {}
    for collection in (root, *collections):
        for obj in parts_of(collection):
            if kind_of(obj) == MESH and obj.data is not None:
                found.setdefault(str(obj.get(MESH_KEY, "")), obj)
    return found
