# SPDX-License-Identifier: GPL-3.0-or-later
"""What operators need before they can run; each refusal says why, for the greyed-out button's tooltip."""

import os
from pathlib import Path

from ..objectgs_addon import jobs, locations, object_edits, running, scene, selection
from ..objectgs_addon.folder_state import folder_state


def active_root(context):
    """The active reconstruction's collection, or None."""
    return context.scene.objectgs.active


def backend(cls) -> bool:
    """Whether the compute backend can be run."""
    if locations.backend_python() is not None:
        return True
    cls.poll_message_set(f"{locations.backend_sentence()} See the preferences of ObjectGS")
    return False


def reconstruction(cls, context) -> bool:
    """Whether there is an active reconstruction whose folder is there."""
    root = active_root(context)
    if root is None:
        cls.poll_message_set("There is no reconstruction in this scene; import a capture first")
        return False
    folder = scene.folder_of(root)
    if not folder_state(folder).exists:
        cls.poll_message_set(f"The folder {folder} of this reconstruction is gone; put it back or import again")
        return False
    return True


def idle(cls, context) -> bool:
    """Whether nothing works in the active reconstruction's folder, here or in another program."""
    sentence = in_use(scene.folder_of(active_root(context)))
    if sentence is not None:
        cls.poll_message_set(sentence)
    return sentence is None


def in_use(folder: Path) -> str | None:
    """Who works in a reconstruction folder, as a sentence; None where nobody does."""
    if running.busy(folder):
        return f"A job works in {folder}; wait for it or stop it"
    holder = jobs.lock_holder(folder)
    if holder is not None:
        return f"Another program (process {holder}) works in {folder}; wait for it or stop it"
    return None


def capture(cls, context) -> bool:
    """Whether the active reconstruction's capture is where it was."""
    folder = scene.folder_of(active_root(context))
    place = folder_state(folder).capture
    if place is None:
        cls.poll_message_set(f"{folder / 'cameras.json'} does not say where the capture is; import it again")
        return False
    if os.path.isdir(place):
        return True
    cls.poll_message_set(f"The capture {place} is gone; put it back, or import it again from where it is now")
    return False


def training(cls, context) -> bool:
    """Whether the active reconstruction has a trained model, which splats of another program do not bring."""
    if folder_state(scene.folder_of(active_root(context))).steps:
        return True
    cls.poll_message_set("There is no training yet whose objects could become meshes; train first")
    return False


def work_on_capture(cls, context) -> bool:
    """Whether the backend could begin something with the active reconstruction's capture."""
    return backend(cls) and reconstruction(cls, context) and idle(cls, context) and capture(cls, context)


def edited(cls, context) -> bool:
    """Whether the active row, or what it is shown as, has splats or a mesh that could be edited."""
    if not objects(cls, context):
        return False
    root = active_root(context)
    item = object_edits.shown_item(root)
    if object_edits.from_stored(item.object_id) in scene.object_collections(root):
        return True
    cls.poll_message_set(f"{item.name} has no splats and no mesh yet; train first, or choose another in the list")
    return False


def not_removed(cls, context, but: str) -> bool:
    """As `edited`, and the active row is not removed, unless something is selected in the viewport; but: what to do
    where it is."""
    if not edited(cls, context):
        return False
    root = active_root(context)
    item = object_edits.shown_item(root)
    if not item.removed or selection.selected_collections(context, root):
        return True
    cls.poll_message_set(f"{item.name} is removed{but}")
    return False


def objects(cls, context) -> bool:
    """Whether the active reconstruction has a list of objects."""
    if not reconstruction(cls, context):
        return False
    if active_root(context).objectgs.objects:
        return True
    cls.poll_message_set("There are no objects yet; vote first")
    return False
