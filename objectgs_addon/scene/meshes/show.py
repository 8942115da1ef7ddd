# SPDX-License-Identifier: GPL-3.0-or-later
"""The textured meshes of a reconstruction: updated from its folder, and shown instead of splats or beside them.

An object's mesh lies in the object's collection; those of the whole scene and of sets of objects lie in the
reconstruction's own.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass, field
from pathlib import Path

import bpy
import numpy as np

from ....backend.shared.errors import InputError
from .. import carrier
from ..edits.show import show_edits
from ..kinds import MESH, MESH_KEY, SPLATS, duplicates_of, kind_of, object_collections, object_id_of, parts_of
from ..object_collection import remove, remove_if_empty
from ..objects_file import Objects
from .importing import MeshImporter
from .listed import assign_to_collections, read_listed

SHOW = "objectgs_show"
"""Custom property of the root collection: which of SHOWS it shows."""

SHOWS = ("splats", "meshes", "both")


@dataclass
class ShownMeshes:
    """Result of `show_meshes`: how many meshes are in Blender, how many of them were read, and warnings."""

    meshes: int = 0
    updated: int = 0
    warnings: list[str] = field(default_factory=list)


def show_meshes(root: bpy.types.Collection, folder: Path) -> ShownMeshes:
    """Update the meshes as `update_meshes` does, then show all edits of the objects."""
    shown = update_meshes(root, folder)
    show_edits(root, Objects.read(folder))
    return shown


def update_meshes(root: bpy.types.Collection, folder: Path) -> ShownMeshes:
    """Show the meshes that meshes.json lists, each exactly where its splats are.

    Meshes that are shown already are updated in place if their files are newer: transforms, names, modifiers, materials
    and their slots stay as the user left them. A mesh whose files have not changed is not touched. A mesh that was made
    of other objects than its collection shows now is removed.

    Args:
        root: the reconstruction's collection.
        folder: the reconstruction folder.

    Returns:
        What was shown. A mesh that cannot be read stays as it is, with a warning.

    Raises:
        InputError: meshes.json or objects.json cannot be used; nothing is changed then.
    """
    folder = Path(folder)
    listed = read_listed(folder)
    objects = Objects.read(folder)
    collections = object_collections(root)
    existing = _meshes_by_key(root, collections.values())
    if not listed and not existing:
        return ShownMeshes()
    carrier.require_object_mode(existing.values())
    had_meshes = bool(existing)
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
        # The unlabeled rest, which never has a mesh, follows the first mesh that appears and the last that is removed.
        apply_shown(root, {*importer.changed, 0} if had_meshes != bool(shown.meshes) else importer.changed)
    for object_id in importer.changed:
        if object_id is not None and object_id not in importer.new:
            remove_if_empty(collections[object_id])
    for object_id in importer.new:
        root.children.link(collections[object_id])
    return shown


def has_shown_meshes(root: bpy.types.Collection) -> bool:
    """Whether the reconstruction ever showed meshes, so that the user can choose."""
    return SHOW in root


def shown_kinds(root: bpy.types.Collection) -> str:
    """Which of SHOWS a reconstruction shows."""
    chosen = root.get(SHOW)
    return chosen if chosen in SHOWS else SHOWS[0]


def show_kinds(root: bpy.types.Collection, which: str) -> None:
    """Show splats, meshes or both, in viewports and renders; an object without a mesh always shows its splats.

    The user can hide single objects in addition, by their collection or their eye.

    Args:
        root: the reconstruction's collection.
        which: one of SHOWS.
    """
    if which not in SHOWS:
        raise ValueError(f"{which} cannot be shown")
    root[SHOW] = which
    apply_shown(root, object_collections(root))


def apply_shown(root: bpy.types.Collection, changed: Iterable[int | None]) -> None:
    """Apply the choice of `show_kinds` to the collections of these object IDs, whose parts were added or removed."""
    wanted = set(changed)
    which, collections, copies = shown_kinds(root), object_collections(root), duplicates_of(root)
    meshes, whole = object_meshes(root), scene_meshes(root)
    hidden = {} if meshes else {obj: which == "splats" for obj in whole}
    for object_id, collection in collections.items():
        if object_id not in wanted:
            continue
        # The splats of the unlabeled rest would float between the meshes of the objects.
        replaced = object_id in meshes or (object_id == 0 and bool(meshes or whole))
        both = (collection, *copies.get(object_id, ()))
        for obj in [obj for each in both for obj in parts_of(each)]:
            if kind_of(obj) == SPLATS:
                hidden[obj] = which == "meshes" and replaced
            elif kind_of(obj) == MESH:
                hidden[obj] = which == "splats"
    _hide(hidden)


def scene_meshes(root: bpy.types.Collection) -> list[bpy.types.Object]:
    """The meshes of the whole scene and of sets of objects, which lie in the reconstruction's own collection."""
    return [obj for obj in root.objects if kind_of(obj) == MESH and object_id_of(obj) is None]


def object_meshes(root: bpy.types.Collection) -> dict[int, list[bpy.types.Object]]:
    """Object ID -> the meshes in its collection, of the objects that have one."""
    found = {
        object_id: [obj for obj in parts_of(collection) if kind_of(obj) == MESH]
        for object_id, collection in object_collections(root).items()
    }
    return {object_id: meshes for object_id, meshes in found.items() if meshes}


def _hide(hidden: dict[bpy.types.Object, bool]) -> None:
    """Hide or show objects, in viewports and renders.

    All but one are set together and without notifying Blender, which visits every object of the file each time.
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
    """Key in meshes.json -> mesh; if the user duplicated one, the first counts."""
    found: dict[str, bpy.types.Object] = {}
    for collection in (root, *collections):
        for obj in parts_of(collection):
            if kind_of(obj) == MESH and obj.data is not None:
                found.setdefault(str(obj.get(MESH_KEY, "")), obj)
    return found
