# SPDX-License-Identifier: GPL-3.0-or-later
"""Display of the results of finished jobs, with one function per kind of job.

Each function returns whether its changes require an undo step.
"""

from __future__ import annotations

import contextlib
from pathlib import Path

import bpy

from ...backend.shared.errors import InputError
from ...backend.shared.reconstruction.folder import Reconstruction
from ...backend.shared.reconstruction.record import read_record
from .. import film, scene
from ..blender import messages, undo
from ..environment import known_folders, locations
from ..picking import marks
from ..process.jobs import Job
from ..state import folder_trust, object_edits, object_list
from ..state import viewports as view
from ..state.folder_state import folder_state, reconstruction_for
from .wording import in_blender

_LEFT_OVER = 0.01
"""Share of the splats from which on it is told that they belong to no marked object."""


def _folder_of(job: Job) -> Path:
    """Return the folder of a job whose result can be shown."""
    assert job.folder is not None
    return job.folder


def roots_of(folder: Path | None) -> list[bpy.types.Collection]:
    """Return the local collections of the reconstruction in `folder`."""
    return [
        collection
        for collection in bpy.data.collections
        if scene.kind_of(collection) == "reconstruction"
        and scene.folder_of(collection) == folder
        and not scene.is_linked(collection)
    ]


def trained_on(capture: Path) -> list[str]:
    """Return the names of the reconstructions that were trained on a capture: of those in this file, and of the one
    that it was imported to."""
    roots = [root for root in bpy.data.collections if scene.kind_of(root) == "reconstruction"]
    folders = {scene.folder_of(root): root.name for root in roots if folder_trust.is_accepted(root)}
    # There is none in a folder relative to a .blend that is not saved yet.
    with contextlib.suppress(InputError):
        own = reconstruction_for(capture, locations.new_reconstruction)
        folders.setdefault(own, own.name)
    states = ((name, folder_state(folder)) for folder, name in folders.items())
    return sorted(name for name, state in states if state.steps and state.capture == capture)


def _shown_roots(job: Job, owner: bpy.types.Scene | None) -> list[bpy.types.Collection]:
    """Return the reconstruction's collections that are in a scene; link one that is only active in `owner` again."""
    roots = roots_of(job.folder)
    for root in roots:
        if owner is not None and owner.objectgs.active == root and not object_list.scenes_of(root):
            owner.collection.children.link(root)
    return [root for root in roots if object_list.scenes_of(root)]


def _show_capture(job: Job, owner: bpy.types.Scene | None) -> bool:
    """Show a capture and, where they are not shown yet, the splats that were trained on it.

    Beside splats that were trained on other poses, the capture is not hidden, so that the new poses can be checked.
    """
    shown = _show_points(job, owner)
    if folder_state(_folder_of(job)).outdated:
        for root in _shown_roots(job, owner):
            view.hide_capture(root, False)
    elif not all(map(scene.object_collections, _shown_roots(job, owner))):
        _show_result(job, owner)
    return shown


def _show_points(job: Job, owner: bpy.types.Scene | None) -> bool:
    known_folders.remember(_folder_of(job))
    capture = folder_state(_folder_of(job)).capture
    if capture is not None and known_folders.is_remote(capture):
        known_folders.remember(capture)
    roots = _shown_roots(job, owner)
    for root in roots:
        scene.show_capture(object_list.scenes_of(root)[0], _folder_of(job), root)
        object_edits.fill(root)
    if owner is not None:
        root = next((root for root in roots if owner in object_list.scenes_of(root)), None)
        if root is None:
            root = view.show_first(owner, _folder_of(job))
            object_edits.fill(root)
            marks.restore(root, _folder_of(job))
            roots.append(root)
        owner.objectgs.active = root
        imported = read_record(Reconstruction(_folder_of(job))).capture
        if imported is not None:
            root.objectgs.max_size = imported.max_size
        view.show(root)
    if roots:
        job.warnings.extend(scene.warnings_of(roots[0]))
    return bool(roots) or _announce_hidden(job)


def _show_imported(job: Job, owner: bpy.types.Scene | None) -> bool:
    """Show imported splats, for which cameras and points are optional."""
    return _show_points(job, owner) and _show_result(job, owner)


def _show_votes(job: Job, owner: bpy.types.Scene | None) -> bool:
    roots = _shown_roots(job, owner)
    for root in roots:
        scene.show_objects(root, _folder_of(job))
        object_edits.fill(root)
        _set_colors(root, "object")
    return bool(roots) or _announce_hidden(job)


def _set_colors(root: bpy.types.Collection, colors: str) -> None:
    """Show the colors of the photos or the objects in all scenes of a reconstruction."""
    for owner in object_list.scenes_of(root):
        owner.objectgs.colors = colors


def _show_result(job: Job, owner: bpy.types.Scene | None) -> bool:
    if not Reconstruction(_folder_of(job)).splats.exists():
        return False
    roots = _shown_roots(job, owner)
    for root in roots:
        if not scene.object_collections(root):
            view.hide_capture(root)
            _set_colors(root, "photo")
        shown = scene.show_result(root, _folder_of(job))
        job.warnings.extend(shown.warnings)
        object_edits.fill(root)
    return bool(roots) or _announce_hidden(job)


def _show_labels(job: Job, owner: bpy.types.Scene | None) -> bool:
    """Show the objects that strokes have separated, each in a collection of its own."""
    for root in _shown_roots(job, owner):
        scene.show_objects(root, _folder_of(job))
    is_shown = _show_result(job, owner)
    roots = _shown_roots(job, owner)
    if roots and "--strokes" in job.command:
        _tell_unmarked(job, roots[0])
    return is_shown


def _tell_unmarked(job: Job, root: bpy.types.Collection) -> None:
    """Say how many splats belong to no marked object, such as a ring between two; a larger rest is meant to be one."""
    counts = object_list.splat_counts(root)
    share = counts.get(marks.NOTHING, 0) / max(sum(counts.values()), 1)
    if _LEFT_OVER < share < 0.5:
        messages.show(
            f"{job.title}: {100 * share:.0f} % of the splats belong to no object and stay background. If they should "
            "not, draw over them, too, or check Everything Is Marked, and separate again.",
            operator="objectgs.start_marking",
            label="Mark Objects",
        )


def _show_meshes(job: Job, owner: bpy.types.Scene | None) -> bool:
    """Show the meshes of a finished or stopped job."""
    roots = _shown_roots(job, owner)
    for root in roots:
        shown = scene.show_meshes(root, _folder_of(job))
        job.warnings.extend(shown.warnings)
        if shown.meshes and scene.shown_kinds(root) == "splats":
            scene.show_kinds(root, "meshes")
        view.keep_outlines(root)
        object_edits.fill(root)
    return bool(roots) or _announce_hidden(job)


def _show_fill_job(job: Job, _owner: bpy.types.Scene | None) -> bool:
    """Show the fill, without an undo step unless it moves splats; undoing the edits also undoes the fill."""
    for root in _shown_roots(job, None):
        with undo.step_for_links("Fill"):
            show_fill(root)
    return False


def show_fill(root: bpy.types.Collection, has_step: bool = True) -> None:
    """Show the fills that objects.json requires; `has_step` as for `scene.show_fills`."""
    scene.show_fills(root, scene.Objects.read(scene.folder_of(root)), has_step)


def _announce_hidden(job: Job) -> bool:
    """Tell the user where to find a result that no scene shows; return False."""
    messages.show(
        f"{job.title} has finished, but its scene or collection is gone; open {job.folder} with Open Reconstruction."
    )
    return False


def _show_film(job: Job, _owner: bpy.types.Scene | None) -> bool:
    """Show new frames in the compositors that use their folder, and tell where they are; return False."""
    folder, count = Path(str(job.result.get("film", ""))), job.result.get("frames")
    for other in bpy.data.scenes:
        film.show_frames(other, folder)
    if isinstance(count, int):
        where = f"{count} frame{'s are' if count != 1 else ' is'} in {folder}."
        text = " ".join([where, *map(in_blender, job.warnings)])
        messages.show(text, operator="wm.path_open", label="Open Folder", filepath=str(folder))
    return False


def _show_masks(job: Job, _owner: bpy.types.Scene | None) -> bool:
    """Tell what was found in imported masks; return False."""
    result = job.result.get("result")
    found = len(result.get("objects", ())) if isinstance(result, dict) else 0
    photos, folder = (job.result.get(key) for key in ("photos", "masks"))
    lines = [f"The masks show {found} objects in {photos} photos; {folder} has a picture.", *job.warnings]
    messages.show(" ".join(map(in_blender, lines)))
    return False


def _tell_export(job: Job, _owner: bpy.types.Scene | None) -> bool:
    """Tell what was written; return False."""
    count, files, out = (job.result.get(key) for key in ("splats", "files", "exported"))
    if isinstance(count, int) and isinstance(files, int):
        where = str(out) if files == 1 else f"{files} files in {out}"
        messages.show(" ".join([f"Wrote {count:,} splats to {where}.", *map(in_blender, job.warnings)]))
    return False


def _tell_check(job: Job, _owner: bpy.types.Scene | None) -> bool:
    """Tell how the backend works, and what hinders it; return False."""
    messages.show(" ".join(map(in_blender, [job.message, *job.warnings])))
    return False


SHOW_BY_KIND = {
    "import": _show_capture,
    "masks": _show_masks,
    "vote": _show_votes,
    "train": _show_result,
    "label": _show_labels,
    "mesh": _show_meshes,
    "film": _show_film,
    "import-splats": _show_imported,
    "fill": _show_fill_job,
    "export": _tell_export,
    "doctor": _tell_check,
    "setup": _tell_check,
}
