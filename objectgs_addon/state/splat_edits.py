# SPDX-License-Identifier: GPL-3.0-or-later
"""Edits of single splats: what the user does to the selected ones is written to the folder and shown.

Undo restores what is shown, and the folder's file follows. The earlier contents are kept for as long as Blender can
undo, which is until another .blend is opened.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import bpy
import numpy as np

from ...backend.shared.class_table import LARGEST_ID
from ...backend.shared.color.palette import colors_of
from ...backend.shared.errors import InputError
from ...backend.shared.reconstruction.edits.splat_edits import (
    SplatEdits,
    digest_of,
    read_splat_edits,
    write_splat_edits,
)
from ...backend.shared.reconstruction.folder import Reconstruction
from ...backend.shared.reconstruction.objects import Matrix, edit_objects, read_objects
from ...backend.shared.splats.keys import NO_KEY
from .. import drawing, scene
from ..picking import splat_selection
from . import folder_trust, object_edits

_MOST_ROWS = 8_000_000
"""Number of edits that all earlier contents together may have."""

_earlier: dict[Path, dict[str, SplatEdits]] = {}
"""Contents of the files of folders by their digests, the latest last."""
_followed: dict[int, str] = {}
"""Session UID of the collection -> digest of the edits that its folder has."""


def shown_parts(context: bpy.types.Context, root: bpy.types.Collection) -> list[bpy.types.Object]:
    """Return the carriers of a reconstruction whose splats are shown, and can be selected and edited."""
    return splat_selection.editable_parts(root, context.view_layer, context.space_data)


def count_selected(context: bpy.types.Context, root: bpy.types.Collection) -> int:
    """Return the number of the selected splats that are shown."""
    return splat_selection.count_selected(shown_parts(context, root))


def delete(root: bpy.types.Collection, parts: Sequence[bpy.types.Object]) -> int:
    """Delete the selected splats of carriers until they are restored; return their number."""
    edits = _up_to_date(root)
    keys = _selected_keys(parts)
    changed = edits.delete(keys)
    _write(root, edits, changed)
    for mesh, part in {part.data: part for part in parts}.items():
        selected = scene.selected_splats(mesh)
        if selected.any():
            scene.delete_splats(part, selected)
            scene.update_floaters(part)
            drawing.splats_changed(mesh)
    scene.remember_edits(root, changed, scene.shown_edits(root).missing)
    _followed[root.session_uid] = digest_of(changed)
    try:
        scene.show_edits(root, scene.Objects.read(scene.folder_of(root)))
    finally:
        object_edits.fill(root)
    object_edits.notify(root)
    return len(keys)


def restore(root: bpy.types.Collection) -> int:
    """Restore all deleted splats; return their number."""
    edits = _up_to_date(root)
    if not edits.deleted:
        raise InputError("No splats are deleted")
    _change(root, edits, edits.restore())
    return edits.deleted


def assign(root: bpy.types.Collection, parts: Sequence[bpy.types.Object], object_id: int) -> int:
    """Move the selected splats of carriers to an object, ID 0 for none; return their number."""
    edits = _up_to_date(root)
    keys = _selected_keys(parts)
    _change(root, edits, edits.assign(keys, object_id))
    return len(keys)


def separate(root: bpy.types.Collection, parts: Sequence[bpy.types.Object], name: str) -> int:
    """Move the selected splats of carriers to a new object, deselect them, and return the object's ID."""
    edits = _up_to_date(root)
    keys = _selected_keys(parts)
    path = Reconstruction(scene.folder_of(root)).objects
    object_id = _unused_id(root, edits)
    entry = {"separated": True, "name": name, "color": colors_of([object_id])[0].tolist()}
    edit_objects(path, {object_id: entry})
    try:
        _change(root, edits, edits.assign(keys, object_id))
    except (InputError, OSError):
        edit_objects(path, {object_id: dict.fromkeys(entry)})
        raise
    for part in scene.parts_of(scene.object_collections(root)[object_id]):
        if scene.kind_of(part) == "splats":
            scene.select_splats(part.data, np.zeros(len(part.data.vertices), bool))
            drawing.selection_changed(part.data)
    return object_id


def crop(root: bpy.types.Collection, box: Matrix | None) -> None:
    """Hide the splats whose captured centers are outside of a box (4, 4) in capture coordinates; None shows them."""
    edits = _up_to_date(root)
    _change(root, edits, SplatEdits(edits.rows, box))


def clear(root: bpy.types.Collection) -> None:
    """Remove all edits of single splats, including those that match no splat; separated objects lose their splats."""
    folder_trust.require_accepted(root)
    try:
        edits = read_splat_edits(Reconstruction(scene.folder_of(root)))
    except InputError:
        edits = SplatEdits()  # An invalid file is replaced as well.
    _change(root, edits, SplatEdits())


def crop_of(root: bpy.types.Collection) -> Matrix | None:
    """Return the box (4, 4) in capture coordinates that the scene is cropped to, or None."""
    folder_trust.require_accepted(root)
    return read_splat_edits(Reconstruction(scene.folder_of(root))).crop


def follow(root: bpy.types.Collection) -> None:
    """Write the edits that are shown after an undo or redo to the folder, if this has changed them.

    Raises:
        InputError: They were made before the .blend was opened, so that they are not known.
        OSError: The file cannot be written.
    """
    shown, before = scene.shown_edits(root), _followed.get(root.session_uid)
    if shown is None or before is None or shown.digest == before or not folder_trust.is_accepted(root):
        return
    folder = Reconstruction(scene.folder_of(root))
    edits = _earlier.get(folder.folder, {}).get(shown.digest)
    if edits is None:
        raise InputError(
            f"{folder.splat_edits} keeps its edits of single splats, since those that undo shows are older than the "
            "opened file; use Reload Result to show them."
        )
    write_splat_edits(folder, edits)
    _followed[root.session_uid] = shown.digest


def forget() -> None:
    """Forget the contents of files that undo could restore, for when another .blend is opened."""
    _earlier.clear()
    _followed.clear()


def _up_to_date(root: bpy.types.Collection) -> SplatEdits:
    """Return the folder's edits after making sure that they, and the folder's splats, are those that are shown."""
    folder_trust.require_accepted(root)
    folder = scene.folder_of(root)
    scene.require_object_mode(part for part in root.all_objects if scene.kind_of(part) is not None)
    edits = read_splat_edits(Reconstruction(folder))
    shown = scene.shown_edits(root)
    if shown is None or shown.digest != digest_of(edits) or scene.result_is_newer(root):
        scene.show_result(root, folder)
        _forget_splats(root)
    return edits


def _change(root: bpy.types.Collection, before: SplatEdits, after: SplatEdits) -> None:
    """Write edits to the folder, and show all of the result again."""
    object_edits.store_edits(root)
    _write(root, before, after)
    try:
        scene.show_result(root, scene.folder_of(root))
        _followed[root.session_uid] = digest_of(after)
        _forget_splats(root)
    finally:
        object_edits.fill(root)
    object_edits.notify(root)


def _write(root: bpy.types.Collection, before: SplatEdits, after: SplatEdits) -> None:
    """Write edits to the folder, and keep those before and after for undo and redo."""
    folder = Reconstruction(scene.folder_of(root))
    write_splat_edits(folder, after)
    known = _earlier.setdefault(folder.folder, {})
    for edits in (before, after):
        known.pop(digest_of(edits), None)
        known[digest_of(edits)] = edits
    while len(known) > 2 and sum(len(edits.rows) for edits in known.values()) > _MOST_ROWS:
        del known[next(iter(known))]


def _selected_keys(parts: Sequence[bpy.types.Object]) -> np.ndarray:
    """Return the keys of the selected splats of carriers; raise InputError if there are none."""
    meshes = {part.data for part in parts}
    keys = np.concatenate(
        [np.zeros(0, np.uint64), *(scene.keys_of(mesh)[scene.selected_splats(mesh)] for mesh in meshes)]
    )
    keys = keys[keys != NO_KEY]
    if not len(keys):
        raise InputError("No splats are selected; select some with the tool Select Splats")
    return keys


def _unused_id(root: bpy.types.Collection, edits: SplatEdits) -> int:
    """Return an object ID that neither an object, nor a marked one, nor a splat, nor an edit has."""
    path = Reconstruction(scene.folder_of(root)).objects
    used = {entry.id for entry in read_objects(path)} | set(scene.object_collections(root))
    used.update(np.unique(edits.rows["object_id"]).tolist())
    used.update(item.object_id for item in root.objectgs.marked)
    largest = max(used, default=0)
    return largest + 1 if largest < LARGEST_ID else next(i for i in range(1, LARGEST_ID) if i not in used)


def _forget_splats(root: bpy.types.Collection) -> None:
    for part in root.all_objects:
        if scene.kind_of(part) == "splats":
            drawing.splats_changed(part.data)
