# SPDX-License-Identifier: GPL-3.0-or-later
"""Background work inside Blender: a timer looks at the queue, panels are redrawn, results are shown.

The queue lives as long as Blender does, not in the .blend: opening another file or undoing leaves the work alone, and
whoever opens the reconstruction's .blend again finds its job by the folder.
"""

import traceback
from collections.abc import Callable
from pathlib import Path

import bpy

from ..backend.protocol import InputError, Reconstruction
from . import locations, messages, object_edits, previews, scene, view
from .jobs import Job, JobQueue, State, run_blocking

INTERVAL = 0.1
"""Seconds between two looks at the queue."""

queue = JobQueue()
_wanted_in: dict[int, str] = {}
"""id(job) -> name of the scene that asked for it."""


def submit(job: Job, owner, report: Callable[[set, str], None]) -> set:
    """Run `job` for the scene `owner`: in the background, or, where there is no window, until it ends.

    Returns what an operator returns.
    """
    _wanted_in[id(job)] = owner.name
    if bpy.app.background:
        run_blocking(job, echo=lambda line: print(line, flush=True))
        if job.state is not State.DONE:
            report({"ERROR"}, job.error or job.message)
            return {"CANCELLED"}
        finish(job)
        return {"FINISHED"}
    queue.add(job)
    if not bpy.app.timers.is_registered(_tick):
        bpy.app.timers.register(_tick, first_interval=0.0, persistent=True)
    return {"FINISHED"}


def job_of(root) -> Job | None:
    """The latest job that works in a reconstruction's folder, of this Blender; None where there was none."""
    return queue.of_folder(scene.folder_of(root))


def busy(folder: Path) -> bool:
    """Whether a job waits or runs in `folder`."""
    job = queue.of_folder(folder)
    return job is not None and not job.is_finished


def _tick() -> float | None:
    changed = queue.poll()
    for job in changed:
        if job.take_preview():
            previews.refresh(job.folder)
        if job.is_finished:
            _over(job)
    if changed:
        redraw()
    return INTERVAL if any(not job.is_finished for job in queue.jobs) else None


def redraw() -> None:
    """Draw the sidebars, status bars and preferences again; not the viewports, which would cost too much."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            for region in area.regions:
                if (area.type, region.type) in (("VIEW_3D", "UI"), ("PREFERENCES", "WINDOW")):
                    region.tag_redraw()
        # No area of a screen, so this is the way to have the status bar drawn; a modal operator's text stays.
        if not len(getattr(window, "modal_operators", ())):
            window.workspace.status_text_set_internal(None)


def _over(job: Job) -> None:
    if job.state is State.FAILED:
        messages.show(f"{job.title}: {job.error}", "ERROR")
    elif job.state is State.DONE or (job.state is State.STOPPED and job.kind == "train"):
        try:
            finish(job)
        except (InputError, OSError) as error:
            messages.show(f"{job.title}: {error}", "ERROR")
        except Exception as error:
            # An exception that leaves a timer ends it, and with it every other job.
            traceback.print_exc()
            messages.show(f"{job.title}: the result could not be shown ({type(error).__name__}: {error})", "ERROR")


def finish(job: Job) -> None:
    """Show what a job has made, in the scene that asked for it, if that is still open."""
    owner = bpy.data.scenes.get(_wanted_in.pop(id(job), ""))
    after = _AFTER.get(job.kind)
    if after is None or (owner is None and not _roots_of(job.folder)):
        return
    if after(job, owner):
        _push_undo(job.title)


def _roots_of(folder: Path | None) -> list:
    return [] if folder is None else [
        collection for collection in bpy.data.collections
        if scene.kind_of(collection) == "reconstruction" and scene.folder_of(collection) == folder]


def _show_capture(job: Job, owner) -> bool:
    roots = _roots_of(job.folder)
    if owner is None and not roots:
        return False
    root = scene.show_capture(owner or object_edits.scenes_of(roots[0])[0], job.folder, roots[0] if roots else None)
    object_edits.fill(root)
    if owner is not None:
        owner.objectgs.active = root
        view.show(root)
    job.warnings.extend(scene.warnings_of(root))
    return True


def _show_votes(job: Job, _owner) -> bool:
    roots = _roots_of(job.folder)
    for root in roots:
        for holder in object_edits.scenes_of(root)[:1]:
            scene.show_objects(root, job.folder, holder)
        object_edits.fill(root)
        root.objectgs.colour_by = "object"
    return bool(roots)


def _show_result(job: Job, _owner) -> bool:
    roots = _roots_of(job.folder) if Reconstruction(job.folder).splats.exists() else []
    for root in roots:
        if not scene.object_collections(root):
            view.hide_points(root)
        for holder in object_edits.scenes_of(root)[:1]:
            shown = scene.show_result(root, job.folder, holder)
            job.warnings.extend(shown.warnings)
        object_edits.fill(root)
    return bool(roots)


def _import_demo(job: Job, owner) -> bool:
    """The demo capture is there: import it, if there is a backend to do it."""
    if owner is None or locations.backend_python() is None:
        messages.show(f"The demo capture is in {job.folder}; set up the backend, then import it")
        return False
    folder = locations.reconstructions_folder() / "demo"
    submit(locations.backend_job("Import demo", "import", folder, "import", str(job.folder), "--out", str(folder)),
           owner, lambda _kind, text: messages.show(text, "ERROR"))
    return False


_AFTER = {"demo": _import_demo, "import": _show_capture, "vote": _show_votes, "train": _show_result}


def _push_undo(title: str) -> None:
    windows = bpy.context.window_manager.windows
    if windows and not bpy.app.background:
        with bpy.context.temp_override(window=windows[0]):
            bpy.ops.ed.undo_push(message=f"ObjectGS: {title}")


@bpy.app.handlers.persistent
def _undone(*_) -> None:
    """The list was undone or redone: objects.json follows."""
    for root in bpy.data.collections:
        if scene.kind_of(root) == "reconstruction":
            try:
                object_edits.store(root)
            except (InputError, OSError) as error:
                messages.show(str(error), "ERROR")


@bpy.app.handlers.persistent
def _file_loaded(*_) -> None:
    """A file made without a window knows its reconstructions but not which one is worked on, nor their objects."""
    for owner in bpy.data.scenes:
        roots = [root for root in owner.collection.children_recursive if scene.kind_of(root) == "reconstruction"]
        for root in roots:
            if not root.objectgs.objects:
                try:
                    object_edits.fill(root)
                except (InputError, OSError):
                    pass  # The folder is gone or broken: the panel says so.
        if roots and owner.objectgs.active is None:
            owner.objectgs.active = roots[0]


def register():
    bpy.app.handlers.load_post.append(_file_loaded)
    bpy.app.handlers.undo_post.append(_undone)
    bpy.app.handlers.redo_post.append(_undone)


def unregister():
    bpy.app.handlers.redo_post.remove(_undone)
    bpy.app.handlers.undo_post.remove(_undone)
    bpy.app.handlers.load_post.remove(_file_loaded)
    if bpy.app.timers.is_registered(_tick):
        bpy.app.timers.unregister(_tick)
    queue.stop_all(timeout=10.0)
    previews.clear()
