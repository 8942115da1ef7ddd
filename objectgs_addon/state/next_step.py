# SPDX-License-Identifier: GPL-3.0-or-later
"""The step that comes next on the way from a capture to objects."""

from __future__ import annotations

from dataclasses import dataclass, replace

import bpy

from ...backend.shared.formats.regular_file import is_folder
from ...backend.shared.reconstruction.folder import STROKES, Reconstruction
from .. import scene
from ..environment import known_folders, locations
from ..picking import marks
from . import folder_trust
from .folder_state import FolderState


@dataclass(frozen=True)
class Step:
    """A step: its operator, the text and icon of the button, what it is for, and the operator's properties."""

    operator: str
    label: str
    icon: str
    purpose: str
    options: tuple[tuple[str, object], ...] = ()


SET_UP = Step(
    "objectgs.set_up_backend",
    "Set Up Backend",
    "IMPORT",
    "Training runs in a program of its own, which is downloaded once.",
)
IMPORT = Step(
    "objectgs.import_capture",
    "Import Capture",
    "IMPORT",
    "The first button is for your own photos or a video; where they were taken is computed, which takes minutes. The "
    "second is for photos with their cameras, as COLMAP and other programs compute them. Masks are optional.",
)
ASSIGN = Step(
    "objectgs.assign_objects", "Assign Objects", "GROUP_VERTEX", "The masks decide which object each point belongs to."
)
TRAIN = Step("objectgs.train", "Train", "PLAY", "Training turns the photos into splats.")
RESUME = Step(
    "objectgs.train",
    "Resume",
    "PLAY",
    "The training was stopped, and goes on from there. If the splats are good enough, go on without it: with Mark "
    "Objects in a panel below or, if there are objects, with Clean Floaters in the panel Edit.",
)
FIND = Step(
    "objectgs.import_capture",
    "Find Capture",
    "VIEWZOOM",
    "The folder of the photos is not where it was; choose where it is now. What was made of it stays.",
)
RETRAIN = Step(
    "objectgs.train",
    "Retrain",
    "PLAY",
    "The capture is not that of the training any more, for example after new poses, so the training starts over.",
    (("restart", True),),
)
LABEL = Step(
    "objectgs.clean_up_labels", "Clean Up Labels", "BRUSH_DATA", "The masks decide which object each splat belongs to."
)
MARK = Step(
    "objectgs.start_marking",
    "Mark Objects",
    "GREASEPENCIL",
    "Without masks: draw over each object and what it stands on, then press Separate Objects. Suggest Objects in a "
    "panel below tries it without strokes.",
)
SEPARATE = Step(
    "objectgs.separate_marked",
    "Separate Objects",
    "CHECKMARK",
    "The marked objects get collections of their own; after a training, their borders are trained for a short time.",
)
MESHES = Step(
    "objectgs.extract_meshes", "Extract Meshes", "MESH_DATA", "Meshes are for physics, shadows and other programs."
)
RELOAD = Step(
    "objectgs.show_result",
    "Reload Result",
    "FILE_REFRESH",
    "The meshes in the folder were made after this file was saved; this shows them.",
)
CLEAN = Step(
    "objectgs.clean_floaters",
    "Clean Floaters",
    "BRUSH_DATA",
    "Hides stray splats far from their objects; they can be restored.",
    (("everything", True),),
)
SET_UP_RENDER = Step(
    "objectgs.set_up_render", "Set Up Render", "SCENE", "Splats need other render settings than Blender's defaults."
)
FILM = Step(
    "objectgs.film_frames",
    "Render Film Frames",
    "RENDER_ANIMATION",
    "Renders the splats through the scene's camera, from Frame Start to End in the panel Film.",
)


_OF_PHOTOS = {ASSIGN, TRAIN, RESUME, RETRAIN, LABEL, MARK, SEPARATE, MESHES}
"""Steps that read the photos."""


def next_step(root: bpy.types.Collection | None, owner: bpy.types.Scene) -> Step | None:
    """Return the step that comes next, or None if the folder of the reconstruction cannot be used.

    root: the active reconstruction's collection, or None. owner: the scene that shows it.
    """
    step = _next_step(root, owner)
    if root is not None and step in _OF_PHOTOS and is_capture_gone(folder_trust.state_of(root)):
        return find_step(root)
    return step


def is_capture_gone(state: FolderState) -> bool:
    """Return whether the folder of the capture does not exist; on another computer, it is not looked for."""
    return state.capture is not None and not known_folders.is_remote(state.capture) and not is_folder(state.capture)


def capture_problem(root: bpy.types.Collection, state: FolderState) -> str | None:
    """Return why the capture of a reconstruction cannot be used, without a period; None if it can."""
    location = state.capture
    if location is None:
        return f"{Reconstruction(scene.folder_of(root)).cameras} does not name the capture; import it again"
    if known_folders.is_remote(location) and not known_folders.is_known(location):
        return f"The capture {location} is on another computer; import it again to use it"
    if is_folder(location):
        return None
    return f"The capture {location} is missing; put it back, or use Find Capture, which the + menu at the top has, too"


def find_step(root: bpy.types.Collection) -> Step:
    """Return the import that gives a reconstruction the new folder of its capture."""
    return replace(FIND, options=(("folder", str(scene.folder_of(root))), ("max_size", root.objectgs.max_size)))


def _next_step(root: bpy.types.Collection | None, owner: bpy.types.Scene) -> Step | None:
    if locations.backend_python() is None:
        return SET_UP
    if root is None:
        return IMPORT
    state = folder_trust.state_of(root)
    if folder_trust.is_in_question(root) or not state.imported:
        return None
    items = root.objectgs.objects
    if not state.trained:
        return TRAIN if items or not has_masks(state) else ASSIGN
    if state.outdated:
        return RETRAIN
    cleaned = any(item.cleaned for item in items)
    if state.unfinished and not state.meshes and not cleaned and not (items and can_mark(state)):
        return RESUME
    if not items and must_use_masks(state):
        return LABEL
    if not items and can_mark(state):
        return SEPARATE if any(stroke["object"] for stroke in marks.strokes_of(root)) else MARK
    if items and not state.meshes and not cleaned:
        return CLEAN
    if state.steps and not state.meshes:
        return MESHES
    # While meshes are made, they wait to be shown together.
    if state.meshes and not state.waiting_meshes and scene.meshes_are_newer(root):
        return RELOAD
    return FILM if scene.render_problem(owner, root) is None else SET_UP_RENDER


def must_use_masks(state: FolderState) -> bool:
    """Return whether splats that were trained without objects can only get those of the capture's masks."""
    return bool(state.steps) and has_masks(state) and not can_mark(state)


def can_mark(state: FolderState) -> bool:
    """Return whether objects can be marked: the capture has no masks but those of strokes.

    Points and trainings need their capture, and splats of other programs do not.
    """
    if not state.imported or (state.capture is None and (state.steps or not state.trained)):
        return False
    if state.capture is None or not has_masks(state):
        return True
    return bool(state.steps) and (state.capture / "masks" / STROKES).is_file()


def has_masks(state: FolderState) -> bool:
    """Return whether the capture of a reconstruction has masks; a capture on another computer is not looked at."""
    capture = state.capture
    if capture is None or (known_folders.is_remote(capture) and not known_folders.is_known(capture)):
        return False
    return is_folder(capture / "masks")
