# SPDX-License-Identifier: GPL-3.0-or-later
"""Background work inside Blender: a timer looks at the queue, panels are redrawn, results are shown.

The queue lives as long as Blender does, not in the .blend: opening another file or undoing leaves the work alone, and
whoever opens the reconstruction's .blend again finds its job by the folder.
"""

import time
import traceback
from collections.abc import Callable
from functools import partial
from pathlib import Path

import bpy

from ..backend.protocol import InputError, Reconstruction
from . import film, locations, messages, object_edits, previews, scene, view, writing
from .jobs import Job, JobQueue, State, run_blocking

INTERVAL = 0.1
"""Seconds between two looks at the queue."""
DRAW_EVERY = 1.0
"""Seconds between two drawings of new figures."""

queue = JobQueue()
_drawn = 0.0
_stale = False
_wanted_in: dict[Job, int] = {}
"""Job -> the session's ID of the scene that asked for it, which stays when that is renamed."""
_results: list[Job] = []
"""Jobs whose result is still to be shown, because something is in the way."""
_asked_for: dict[Path, Path] = {}
"""Reconstruction folder -> the file that a job was to make which closes places, when the latest was submitted."""
_told: set[Job] = set()
"""Those of them for which the user knows why."""


def submit(job: Job, owner, report: Callable[[set, str], None]) -> set:
    """Run `job` for the scene `owner`: in the background, or, where there is no window, until it ends.

    Returns what an operator returns.
    """
    _wanted_in[job] = owner.session_uid
    if bpy.app.background:
        run_blocking(job, echo=lambda line: print(line, flush=True))
        if job.state is not State.DONE:
            report({"ERROR"}, job.error or job.message)
            return {"CANCELLED"}
        try:
            finish(job)
        except (InputError, OSError) as error:
            report({"ERROR"}, f"{job.title}: {messages.sentence(error)}")
            return {"CANCELLED"}
        return {"FINISHED"}
    queue.add(job)
    if not bpy.app.timers.is_registered(_tick):
        bpy.app.timers.register(_tick, first_interval=0.0, persistent=True)
    return {"FINISHED"}


def close_places(root, again: bool = True) -> None:
    """Have the backend work out what closes the places of removed objects where the folder does not hold that yet;
    again: also where it was asked for that before, and failed."""
    folder = scene.folder_of(root)
    missing = scene.missing_fill(root, scene.Objects.read(folder))
    is_asked = any(job.kind == "fill" and job.folder == folder and not job.is_finished for job in queue.jobs)
    owner = next(iter(object_edits.scenes_of(root)), None)
    if missing is None or is_asked or owner is None or (not again and _asked_for.get(folder) == missing):
        return
    _asked_for[folder] = missing

    def tell(_kind, text: str) -> None:
        messages.show(text, "ERROR")

    if locations.backend_python() is None:
        tell({"ERROR"}, f"What removed objects hid is not closed: {locations.backend_sentence()}")
    else:
        submit(locations.backend_job(f"Fill of {root.name}", "fill", folder, "edit", str(folder)), owner, tell)


def job_of(root) -> Job | None:
    """The latest job that works in a reconstruction's folder, of this Blender; None where there was none."""
    return queue.of_folder(scene.folder_of(root))


def busy(folder: Path) -> bool:
    """Whether a job waits or runs in `folder`."""
    job = queue.of_folder(folder)
    return job is not None and not job.is_finished


@writing.allowed
def _tick() -> float | None:
    changed = queue.poll()
    for job in changed:
        if job.take_preview():
            _carefully(job, previews.refresh, job.folder)
        if job.is_finished:
            _over(job)
    _show_results()
    _redraw_soon(any(job.is_finished or job.state is not State.RUNNING for job in changed), bool(changed))
    return INTERVAL if _results or any(not job.is_finished for job in queue.jobs) else None


def _redraw_soon(at_once: bool, changed: bool) -> None:
    """Draw what has changed: a new state at once, new figures once a second, since drawing a window takes time."""
    global _drawn, _stale
    _stale = _stale or changed
    now = time.monotonic()
    if _stale and (at_once or now - _drawn >= DRAW_EVERY):
        _drawn, _stale = now, False
        redraw()


def redraw() -> None:
    """Draw the sidebars, status bars and preferences again; not the viewports, which would cost too much."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            for region in area.regions:
                if (area.type, region.type) in (("VIEW_3D", "UI"), ("PREFERENCES", "WINDOW")):
                    region.tag_redraw()
        # No area of a screen, so this is the way to have the status bar drawn; a modal operator's text stays.
        if not len(getattr(window, "modal_operators", ())):
            # Right after a file was opened a timer has no window, and Blender crashes without one here.
            with bpy.context.temp_override(window=window):
                window.workspace.status_text_set_internal(None)


def _over(job: Job) -> None:
    if job.state is State.FAILED:
        messages.show(f"{job.title}: {job.error}", "ERROR")
    elif job.state is State.DONE or (job.state is State.STOPPED and job.kind in ("train", "mesh")):
        _results.append(job)
        return
    _wanted_in.pop(job, None)


def _show_results() -> None:
    """Show what is ready, in the order it came, unless Blender or the user is busy with the same data."""
    while _results:
        job = _results[0]
        obstacle = _obstacle(job)
        if obstacle is not None:
            if job not in _told:
                _told.add(job)
                messages.show(f"{job.title} has ended; its result is shown when {obstacle}.")
            return
        _told.discard(_results.pop(0))
        _carefully(job, finish, job)


def _obstacle(job: Job) -> str | None:
    """What must be over before a result may be shown: changes to data in use would crash Blender or get lost."""
    if bpy.app.is_job_running("RENDER") or bpy.app.is_job_running("OBJECT_BAKE"):
        return "rendering has ended"
    for window in bpy.context.window_manager.windows:
        if any(operator.bl_idname.startswith("TRANSFORM_OT_") for operator in window.modal_operators):
            return "what is being moved has its place"
    for root in _roots_of(job.folder):
        for part in root.all_objects:
            if scene.kind_of(part) is not None and part.mode != "OBJECT":
                return f"{part.name} is in Object Mode again"
    return None


def _carefully(job: Job, action: Callable, *arguments) -> None:
    """Call `action` and tell how it failed: an exception that leaves a timer ends it, and with it every other job."""
    try:
        action(*arguments)
    except (InputError, OSError) as error:
        messages.show(f"{job.title}: {messages.sentence(error)}", "ERROR")
    except Exception as error:
        traceback.print_exc()
        messages.show(f"{job.title}: the result could not be shown ({type(error).__name__}: {error})", "ERROR")


def finish(job: Job) -> None:
    """Show what a job has made: in the scene that asked for it, and wherever else the reconstruction is shown."""
    object_edits.flush()
    wanted_in = _wanted_in.pop(job, None)
    owner = next((owner for owner in bpy.data.scenes if owner.session_uid == wanted_in), None)
    after = _AFTER.get(job.kind)
    if after is not None and after(job, owner):
        _push_undo(job.title)
    for root in _roots_of(job.folder):
        close_places(root, again=False)


def _roots_of(folder: Path | None) -> list:
    return [] if folder is None else [
        collection for collection in bpy.data.collections
        if scene.kind_of(collection) == "reconstruction" and scene.folder_of(collection) == folder
        and collection.library is None]


def _shown_roots(job: Job, owner) -> list:
    """The reconstruction's collections that lie in scenes; one that the user took out of `owner` comes back."""
    roots = _roots_of(job.folder)
    for root in roots:
        if owner is not None and owner.objectgs.active == root and not object_edits.scenes_of(root):
            owner.collection.children.link(root)
    return [root for root in roots if object_edits.scenes_of(root)]


def _show_capture(job: Job, owner) -> bool:
    roots = _shown_roots(job, owner)
    for root in roots:
        scene.show_capture(object_edits.scenes_of(root)[0], job.folder, root)
        object_edits.fill(root)
    if owner is not None:
        root = next((root for root in roots if owner in object_edits.scenes_of(root)), None)
        if root is None:
            root = scene.show_capture(owner, job.folder)
            object_edits.fill(root)
            roots.append(root)
        owner.objectgs.active = root
        view.show(root)
    if roots:
        job.warnings.extend(scene.warnings_of(roots[0]))
    return bool(roots) or _explain(job)


def _show_imported(job: Job, owner) -> bool:
    """Splats of another program, of which cameras and points may be none."""
    return _show_capture(job, owner) and _show_result(job, owner)


def _show_votes(job: Job, owner) -> bool:
    roots = _shown_roots(job, owner)
    for root in roots:
        scene.show_objects(root, job.folder, object_edits.scenes_of(root)[0])
        object_edits.fill(root)
        root.objectgs.colour_by = "object"
    return bool(roots) or _explain(job)


def _show_result(job: Job, owner) -> bool:
    if not Reconstruction(job.folder).splats.exists():
        return False
    roots = _shown_roots(job, owner)
    for root in roots:
        if not scene.object_collections(root):
            view.hide_points(root)
        shown = scene.show_result(root, job.folder, object_edits.scenes_of(root)[0])
        job.warnings.extend(shown.warnings)
        object_edits.fill(root)
    return bool(roots) or _explain(job)


def _show_meshes(job: Job, owner) -> bool:
    """What was made before a stop is shown, too."""
    roots = _shown_roots(job, owner)
    for root in roots:
        shown = scene.show_meshes(root, job.folder)
        job.warnings.extend(shown.warnings)
        if shown.meshes and scene.shown_kinds(root) == "splats":
            scene.show_kinds(root, "meshes")
        object_edits.fill(root)
    return bool(roots) or _explain(job)


def _show_fill(job: Job, _owner) -> bool:
    """No undo step: what is shown follows from the edits, and comes and goes with theirs."""
    for root in _shown_roots(job, None):
        _show_fill_of(root)
    return False


def _show_fill_of(root) -> None:
    scene.show_fills(root, scene.Objects.read(scene.folder_of(root)))


def _explain(job: Job) -> bool:
    """Say where the result is that has no place in the open file any more; False, since nothing has changed."""
    messages.show(f"{job.title} has ended, but its scene or collection is gone; Open Reconstruction shows "
                  f"{job.folder}.")
    return False


def _import_demo(job: Job, owner) -> bool:
    """The demo capture is there: import it, if there is a backend to do it."""
    if owner is None or locations.backend_python() is None:
        messages.show(f"The demo capture is in {job.folder}; set up the backend, then import it")
        return False
    folder = locations.reconstructions_folder() / "demo"
    submit(locations.backend_job("Import demo", "import", folder, "import", str(job.folder), "--out", str(folder)),
           owner, lambda _kind, text: messages.show(text, "ERROR"))
    return False


def _show_film(job: Job, owner) -> bool:
    """Compositors that show the frames' folder show those that are new."""
    for other in bpy.data.scenes:
        film.show_frames(other, Path(job.result.get("film", "")))
    return False


_AFTER = {"demo": _import_demo, "import": _show_capture, "vote": _show_votes, "train": _show_result,
          "mesh": _show_meshes, "film": _show_film, "import-splats": _show_imported,
          "fill": _show_fill}


def _push_undo(title: str) -> None:
    windows = bpy.context.window_manager.windows
    if windows and not bpy.app.background:
        with bpy.context.temp_override(window=windows[0]):
            bpy.ops.ed.undo_push(message=f"ObjectGS: {title}")


@bpy.app.handlers.persistent
@writing.allowed
def _undone(*_) -> None:
    """The list was undone or redone: objects.json follows, and what closes places follows that."""
    for root in [root for root in bpy.data.collections if scene.kind_of(root) == "reconstruction"]:
        for how in (object_edits.store, _show_fill_of, partial(close_places, again=False)):
            _store(root, how)


@bpy.app.handlers.persistent
@writing.allowed
def _saving(*_) -> None:
    """objects.json gets what the .blend gets: colours that wait to be written, and where objects are."""
    for root in bpy.data.collections:
        if scene.kind_of(root) == "reconstruction" and root.library is None:
            _store(root, object_edits.store_edits)


def _store(root, how) -> None:
    try:
        how(root)
    except (InputError, OSError) as error:
        messages.show(messages.sentence(error), "ERROR")


@bpy.app.handlers.persistent
@writing.allowed
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
    object_edits.after_edits.append(close_places)
    bpy.app.handlers.load_post.append(_file_loaded)
    bpy.app.handlers.save_pre.append(_saving)
    bpy.app.handlers.undo_post.append(_undone)
    bpy.app.handlers.redo_post.append(_undone)


def unregister():
    bpy.app.handlers.redo_post.remove(_undone)
    bpy.app.handlers.undo_post.remove(_undone)
    bpy.app.handlers.save_pre.remove(_saving)
    bpy.app.handlers.load_post.remove(_file_loaded)
    object_edits.after_edits.remove(close_places)
    object_edits.flush()
    if bpy.app.timers.is_registered(_tick):
        bpy.app.timers.unregister(_tick)
    queue.stop_all(timeout=10.0)
    for known in (_results, _told, _wanted_in, _asked_for):
        known.clear()
    previews.clear()
