# SPDX-License-Identifier: GPL-3.0-or-later
"""What operators need before they can run; each refusal says why, for the greyed-out button's tooltip."""

from ..objectgs_addon import jobs, locations, running, scene
from ..objectgs_addon.folder_state import folder_state


def active_root(context):
    """The active reconstruction's collection, or None."""
    return context.scene.objectgs.active


def backend(cls) -> bool:
    """Whether the compute backend can be run."""
    if locations.backend_python() is not None:
        return True
    cls.poll_message_set(locations.NO_BACKEND)
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
    folder = scene.folder_of(active_root(context))
    if running.busy(folder):
        cls.poll_message_set("A job works on this reconstruction; wait for it or stop it")
        return False
    holder = jobs.lock_holder(folder)
    if holder is not None:
        cls.poll_message_set(f"Another program works on this reconstruction (process {holder}); wait for it or stop it")
        return False
    return True


def capture(cls, context) -> bool:
    """Whether the active reconstruction's capture is where it was."""
    place = folder_state(scene.folder_of(active_root(context))).capture
    if place is not None and place.is_dir():
        return True
    cls.poll_message_set(f"The capture {place} is gone; put it back, or import it again from where it is now")
    return False


def objects(cls, context) -> bool:
    """Whether the active reconstruction has a list of objects."""
    if not reconstruction(cls, context):
        return False
    if active_root(context).objectgs.objects:
        return True
    cls.poll_message_set("There are no objects yet; vote first")
    return False
