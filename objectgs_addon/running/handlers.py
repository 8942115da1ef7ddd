# SPDX-License-Identifier: GPL-3.0-or-later
"""Handlers for opening and saving a .blend file, undo and redo."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from functools import partial
from typing import Any

import bpy

from ...backend.shared.errors import InputError
from .. import scene
from ..blender import messages, undo, writing
from ..state import folder_trust, object_edits, object_list, splat_edits
from . import background, pointing, results

_RELOAD = "objectgs.show_result"
"""Operator that shows the newer edits in a folder."""

_before: dict[int, object_list.State] = {}
"""Session UID of a reconstruction -> its state before the undo or redo that is going on."""


@bpy.app.handlers.persistent
@writing.allowed
def _leaving(*_: Any) -> None:
    """Write pending colors before another .blend is opened."""
    object_edits.flush(is_shown=False)


@bpy.app.handlers.persistent
@writing.allowed
def _undoing(*_: Any) -> None:
    """Write pending colors, and remember what undo or redo may change."""
    object_edits.flush(is_shown=False)
    _before.clear()
    _before.update({root.session_uid: object_list.state_of(root) for root in _accepted_roots()})


@bpy.app.handlers.persistent
@writing.allowed
def _undone(*_: Any) -> None:
    """Update the folder's edits and the fills after undo or redo."""
    for root in _accepted_roots():
        store = partial(object_edits.store, before=_before.pop(root.session_uid, object_list.State({}, {})))
        show_fill = partial(results.show_fill, has_step=False)
        fill_holes = partial(background.fill_holes, again=False)
        for action in (store, splat_edits.follow, show_fill, fill_holes, pointing.refresh):
            _try(action, root)


@bpy.app.handlers.persistent
@writing.allowed
def _saving(path: str = "", *_: Any) -> None:
    """Write pending colors and transforms to objects.json before the .blend is saved at `path`.

    Transforms of a reconstruction that is in no scene anymore are not written: Blender only keeps what was deleted with
    a scene or unlinked until another file is opened.
    """
    for root in _accepted_roots():
        if object_list.scenes_of(root):
            _try(object_edits.store_edits, root)
        if path:
            folder_trust.store_relative(root, path)


def _accepted_roots() -> list[bpy.types.Collection]:
    """Return the local reconstructions whose folders may be used."""
    return [
        root
        for root in bpy.data.collections
        if scene.kind_of(root) == "reconstruction" and not scene.is_linked(root) and folder_trust.is_accepted(root)
    ]


def _try(action: Callable[[bpy.types.Collection], None], root: bpy.types.Collection) -> None:
    try:
        action(root)
    except (InputError, OSError) as error:
        messages.show(messages.sentence(error), "ERROR")


@bpy.app.handlers.persistent
@writing.allowed
def _file_loaded(*_: Any) -> None:
    """Set up reconstructions of files built without a window, and tell if the .blend is older than the folder's edits.

    Exports use those edits, of objects in objects.json. Only accepted folders are read.
    """
    splat_edits.forget()
    messages.settle("", _RELOAD)
    _set_up()
    older = []
    for root in _accepted_roots():
        # The panel already reports a missing or invalid folder.
        with contextlib.suppress(InputError, OSError):
            if object_list.scenes_of(root) and not object_list.shows_edits(root):
                older.append(root)
    active = bpy.context.scene.objectgs.active
    for root in sorted(older, key=lambda root: root == active):
        # The button acts on the active reconstruction, whose message is the latest.
        label = "Reload Result" if root == active else ""
        messages.show(object_list.newer_edits(root), operator=_RELOAD, label=label)


@bpy.app.handlers.persistent
@writing.allowed
def _imported(*_: Any) -> None:
    """Set up reconstructions that were appended."""
    _set_up()


@writing.allowed
def _enabled() -> None:
    """Set up reconstructions of the file in which the extension is enabled."""
    if _set_up():
        undo.push("List of Objects")


def _set_up() -> bool:
    """Set the active reconstructions and fill the lists of objects that are missing, and return whether any was."""
    changed = False
    for owner in bpy.data.scenes:
        roots = [root for root in owner.collection.children_recursive if scene.kind_of(root) == "reconstruction"]
        local = next((root for root in roots if not scene.is_linked(root)), None)
        if local is not None and owner.objectgs.active is None:
            owner.objectgs.active = local
            changed = True
    for root in _accepted_roots():
        if not root.objectgs.objects:
            with contextlib.suppress(InputError, OSError):
                object_edits.fill(root)
            changed = changed or bool(root.objectgs.objects)
    return changed


# Blender before 4.3 has no handler for appended data.
_IMPORTS = getattr(bpy.app.handlers, "blend_import_post", [])


def register() -> None:
    object_edits.after_edits.append(background.fill_holes)
    bpy.app.handlers.load_pre.append(_leaving)
    bpy.app.handlers.load_post.append(_file_loaded)
    _IMPORTS.append(_imported)
    bpy.app.handlers.save_pre.append(_saving)
    for handlers in (bpy.app.handlers.undo_pre, bpy.app.handlers.redo_pre):
        handlers.append(_undoing)
    for handlers in (bpy.app.handlers.undo_post, bpy.app.handlers.redo_post):
        handlers.append(_undone)
    if not bpy.app.background:
        # A file may be open already, and cannot be changed during registration.
        bpy.app.timers.register(_enabled, first_interval=0.0)


def unregister() -> None:
    if bpy.app.timers.is_registered(_enabled):
        bpy.app.timers.unregister(_enabled)
    for handlers in (bpy.app.handlers.undo_post, bpy.app.handlers.redo_post):
        handlers.remove(_undone)
    for handlers in (bpy.app.handlers.undo_pre, bpy.app.handlers.redo_pre):
        handlers.remove(_undoing)
    bpy.app.handlers.save_pre.remove(_saving)
    _IMPORTS.remove(_imported)
    bpy.app.handlers.load_post.remove(_file_loaded)
    bpy.app.handlers.load_pre.remove(_leaving)
    object_edits.after_edits.remove(background.fill_holes)
    background.stop()
