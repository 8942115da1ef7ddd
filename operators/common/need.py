# SPDX-License-Identifier: GPL-3.0-or-later
"""Conditions of operators; one that is not met gives the reason in the tooltip of the disabled button."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy

from ...backend.shared.errors import InputError
from ...backend.shared.reconstruction.lock import lock_holder
from ...objectgs_addon import scene
from ...objectgs_addon.environment import locations
from ...objectgs_addon.picking import selection
from ...objectgs_addon.running import background
from ...objectgs_addon.state import folder_trust, object_list
from ...objectgs_addon.state.folder_state import folder_state
from ...objectgs_addon.state.next_step import can_mark, capture_problem, has_masks


def active_root(context: bpy.types.Context) -> Any:
    """Return the active reconstruction's collection, or None."""
    return context.scene.objectgs.active


def backend(cls: Any) -> bool:
    """Return whether the compute backend can be run."""
    if locations.backend_python() is not None:
        return True
    if background.busy(locations.environment_folder()):
        cls.poll_message_set("The backend is being set up; wait until it is done")
        return False
    cls.poll_message_set(f"{locations.backend_sentence()} See the preferences of ObjectGS")
    return False


def shown(cls: Any, context: bpy.types.Context) -> bool:
    """Return whether there is an active reconstruction, for operators that do not use its folder."""
    if active_root(context) is None:
        cls.poll_message_set("There is no reconstruction in this scene; import photos or a capture first")
        return False
    return True


def reconstruction(cls: Any, context: bpy.types.Context) -> bool:
    """Return whether there is an active reconstruction whose folder the user has accepted, and which exists."""
    if not shown(cls, context):
        return False
    root = active_root(context)
    if not folder_trust.is_accepted(root):
        cls.poll_message_set(folder_trust.REFUSAL)
        return False
    folder = scene.folder_of(root)
    if not folder_state(folder).exists:
        cls.poll_message_set(f"The folder {folder} of this reconstruction is missing; put it back or import again")
        return False
    return True


def idle(cls: Any, context: bpy.types.Context) -> bool:
    """Return whether no job uses the active reconstruction's folder, in this or another program."""
    sentence = _use_of(scene.folder_of(active_root(context)))
    if sentence is not None:
        cls.poll_message_set(sentence)
    return sentence is None


def require_unused(folder: Path) -> None:
    """Raise InputError if a job uses a reconstruction folder, in this or another program."""
    sentence = _use_of(folder)
    if sentence is not None:
        raise InputError(sentence)


def _use_of(folder: Path) -> str | None:
    """Return a sentence about the job or program that uses a reconstruction folder; None if it is unused."""
    if background.busy(folder):
        return f"A job is using {folder}; wait for it to finish or stop it"
    holder = lock_holder(folder)
    if holder is not None:
        process = f" (process {holder})" if holder else ""
        return f"Another program{process} is using {folder}; wait for it to finish or stop it"
    return None


def capture(cls: Any, context: bpy.types.Context) -> bool:
    """Return whether the active reconstruction's capture folder exists."""
    root = active_root(context)
    problem = capture_problem(root, folder_state(scene.folder_of(root)))
    if problem is not None:
        cls.poll_message_set(problem)
    return problem is None


def splats(cls: Any, context: bpy.types.Context) -> bool:
    """Return whether the active reconstruction has splats."""
    if folder_state(scene.folder_of(active_root(context))).trained:
        return True
    cls.poll_message_set("There are no splats yet; train first")
    return False


def training(cls: Any, context: bpy.types.Context) -> bool:
    """Return whether the active reconstruction has a trained model, which imported splats lack."""
    if folder_state(scene.folder_of(active_root(context))).steps:
        return True
    cls.poll_message_set("This needs a trained model; train first")
    return False


def markable(cls: Any, context: bpy.types.Context) -> bool:
    """Return whether objects can be marked on the splats or points of the active reconstruction."""
    if not (backend(cls) and reconstruction(cls, context) and idle(cls, context)):
        return False
    state = folder_state(scene.folder_of(active_root(context)))
    if (state.steps or not state.trained) and not capture(cls, context):
        return False
    if can_mark(state):
        return True
    cls.poll_message_set(
        "The capture has masks of its own, which strokes would replace; move its folder masks elsewhere"
    )
    return False


def masked(cls: Any, context: bpy.types.Context) -> bool:
    """Return whether a job on the active reconstruction could start that has splats and whose capture has masks."""
    if not (work_on_capture(cls, context) and splats(cls, context)):
        return False
    if has_masks(folder_state(scene.folder_of(active_root(context)))):
        return True
    cls.poll_message_set("The capture has no masks; import some, or mark objects")
    return False


def work_on_capture(cls: Any, context: bpy.types.Context) -> bool:
    """Return whether a job on the active reconstruction's capture could start."""
    return backend(cls) and reconstruction(cls, context) and idle(cls, context) and capture(cls, context)


def objects(cls: Any, context: bpy.types.Context) -> bool:
    """Return whether the active reconstruction's folder can be used, and it has a list of objects."""
    return reconstruction(cls, context) and listed_objects(cls, context)


def object_mode(cls: Any, context: bpy.types.Context) -> bool:
    """Return whether Blender is in Object Mode, so that another object may become the active one."""
    if context.mode == "OBJECT":
        return True
    cls.poll_message_set("Switch to Object Mode first")
    return False


def listed_objects(cls: Any, context: bpy.types.Context) -> bool:
    """Return whether the active reconstruction has a list of objects, for operators that do not use its folder."""
    if not shown(cls, context):
        return False
    if active_root(context).objectgs.objects:
        return True
    cls.poll_message_set("There are no objects yet; use Assign Objects or, without masks, Mark Objects first")
    return False


def edited(cls: Any, context: bpy.types.Context) -> bool:
    """Return whether the active object, or the one it is merged into, has splats or a mesh that can be edited."""
    if not objects(cls, context):
        return False
    root = active_root(context)
    item = object_list.shown_item(root)
    if scene.from_stored(item.object_id) in scene.object_collections(root):
        return True
    cls.poll_message_set(why_not_shown(root, item))
    return False


def shown_objects(cls: Any, context: bpy.types.Context) -> bool:
    """Return whether the active reconstruction has a list of objects, and any of them has splats or a mesh."""
    if not objects(cls, context):
        return False
    root = active_root(context)
    if scene.object_collections(root):
        return True
    cls.poll_message_set(why_not_shown(root, object_list.shown_item(root)))
    return False


def why_not_shown(root: bpy.types.Collection, item: Any) -> str:
    """Return why an object of the list has no splats and no mesh in the scene, and what to do."""
    if item.chosen and folder_state(scene.folder_of(root)).trained:
        return f"{item.name} is not shown; use Reload Result, or choose another in the list"
    return f"{item.name} has no splats and no mesh yet; train first, or choose another in the list"


def not_removed(cls: Any, context: bpy.types.Context, addition: str) -> bool:
    """Return whether the active object can be edited and is not removed, unless objects are selected in the viewport.

    addition: the text after "... is removed" in the message.
    """
    if not edited(cls, context):
        return False
    root = active_root(context)
    item = object_list.shown_item(root)
    if not item.removed or selection.selected_collections(context, root):
        return True
    cls.poll_message_set(f"{item.name} is removed{addition}")
    return False
