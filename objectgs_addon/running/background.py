# SPDX-License-Identifier: GPL-3.0-or-later
"""Background jobs: a timer polls the queue, redraws panels and shows results.

The queue belongs to Blender and not to the .blend: it survives undo and opening another file. A reconstruction finds
its job by the folder.
"""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy

from ...backend.shared.console import ConsoleReporter
from ...backend.shared.errors import InputError
from .. import scene
from ..blender import messages, writing
from ..environment import locations
from ..process.blocking import run_blocking
from ..process.jobs import Job, JobQueue, State
from ..state import object_edits, object_list
from . import previews, results

INTERVAL = 0.1
"""Seconds between two polls of the queue."""
DRAW_EVERY = 1.0
"""Seconds between two redraws for new figures."""

queue = JobQueue()
_drawn = 0.0
_stale = False
_submitted_in: dict[Job, int] = {}
"""Job -> session UID of the scene that submitted it, which a new name does not change."""
_results: list[Job] = []
"""Jobs with results that cannot be shown yet."""
_requested_fills: dict[Path, Path] = {}
"""Reconstruction folder -> the file that its latest fill job was to write."""
_announced: set[Job] = set()
"""Those of `_results` for which the user was told why."""


def submit(job: Job, owner: bpy.types.Scene, report: Callable[[set[str], str], Any]) -> set[str]:
    """Run a job in the background or, without a window, until it ends.

    Args:
        job: a new job.
        owner: the scene that shows the result.
        report: an operator's `report`, or a function like it.

    Returns:
        The result of the operator.
    """
    _submitted_in[job] = owner.session_uid
    if bpy.app.background:
        run_blocking(job, ConsoleReporter())
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


def fill_holes(root: bpy.types.Collection, again: bool = True) -> None:
    """Start a job that fills the holes behind removed objects, unless the folder holds its result.

    again: also after an earlier attempt has failed.
    """
    folder = scene.folder_of(root)
    missing = scene.missing_fill(root, scene.Objects.read(folder))
    is_asked = any(job.kind == "fill" and job.folder == folder and not job.is_finished for job in queue.jobs)
    owner = next(iter(object_list.scenes_of(root)), None)
    if missing is None or is_asked or owner is None or (not again and _requested_fills.get(folder) == missing):
        return
    _requested_fills[folder] = missing

    def show_error(_kind: set[str], text: str) -> None:
        messages.show(text, "ERROR")

    if locations.backend_python() is None:
        messages.show(f"Holes behind removed objects are not filled: {locations.backend_sentence()}", "ERROR")
    else:
        submit(locations.backend_job(f"Fill of {root.name}", "fill", folder, "edit", str(folder)), owner, show_error)


def job_of(root: bpy.types.Collection) -> Job | None:
    """The latest job of this Blender in a reconstruction's folder, or None."""
    return queue.of_folder(scene.folder_of(root))


def busy(folder: Path) -> bool:
    """Whether a job of this Blender is waiting or running in `folder`."""
    job = queue.of_folder(folder)
    return job is not None and not job.is_finished


@writing.allowed
def _tick() -> float | None:
    changed = queue.poll()
    for job in changed:
        if job.take_preview() and job.folder is not None:
            _guard(job, previews.refresh, job.folder)
        if job.is_finished:
            _handle_end(job)
    _show_results()
    _redraw_soon(any(job.is_finished or job.state is not State.RUNNING for job in changed), bool(changed))
    return INTERVAL if _results or any(not job.is_finished for job in queue.jobs) else None


def _redraw_soon(at_once: bool, changed: bool) -> None:
    """Redraw a new state at once, and new figures once a second, since a redraw takes time."""
    global _drawn, _stale
    _stale = _stale or changed
    now = time.monotonic()
    if _stale and (at_once or now - _drawn >= DRAW_EVERY):
        _drawn, _stale = now, False
        redraw()


def redraw() -> None:
    """Redraw sidebars, status bars and preferences, but not the viewports, which are slow."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            for region in area.regions:
                if (area.type, region.type) in (("VIEW_3D", "UI"), ("PREFERENCES", "WINDOW")):
                    region.tag_redraw()
        # The status bar is no area of a screen and is redrawn by setting its text, unless a modal operator uses it.
        if not len(getattr(window, "modal_operators", ())):
            # Right after a file is opened, timers have no window, without which Blender crashes here.
            with bpy.context.temp_override(window=window):
                window.workspace.status_text_set_internal(None)


def _handle_end(job: Job) -> None:
    if job.state is State.FAILED:
        messages.show(f"{job.title}: {job.error}", "ERROR")
    elif job.state is State.DONE or (job.state is State.STOPPED and job.kind in ("train", "mesh")):
        _results.append(job)
        return
    _submitted_in.pop(job, None)


def _show_results() -> None:
    """Show pending results in order, unless Blender or the user is busy with the same data."""
    while _results:
        job = _results[0]
        obstacle = _obstacle(job)
        if obstacle is not None:
            if job not in _announced:
                _announced.add(job)
                messages.show(f"{job.title} has finished; the result will be shown when {obstacle}.")
            return
        _announced.discard(_results.pop(0))
        _guard(job, finish, job)


def _obstacle(job: Job) -> str | None:
    """What must end before a result can be shown, since changes to data in use would crash Blender or be lost."""
    if bpy.app.is_job_running("RENDER") or bpy.app.is_job_running("OBJECT_BAKE"):
        return "rendering ends"
    for window in bpy.context.window_manager.windows:
        if any(operator.bl_idname.startswith("TRANSFORM_OT_") for operator in window.modal_operators):
            return "the transform is confirmed"
    for root in results.roots_of(job.folder):
        for part in root.all_objects:
            if scene.kind_of(part) is not None and part.mode != "OBJECT":
                return f"{part.name} is in Object Mode again"
    return None


def _guard(job: Job, action: Callable[..., object], *arguments: object) -> None:
    """Call `action` and show its errors: an exception in a timer would end it, and with it every other job."""
    try:
        action(*arguments)
    except (InputError, OSError) as error:
        messages.show(f"{job.title}: {messages.sentence(error)}", "ERROR")
    except Exception as error:
        traceback.print_exc()
        messages.show(f"{job.title}: the result could not be shown ({type(error).__name__}: {error})", "ERROR")


def finish(job: Job) -> None:
    """Show the result of a job, in the scene that submitted it and wherever the reconstruction is shown."""
    object_edits.flush()
    submitted_in = _submitted_in.pop(job, None)
    owner = next((owner for owner in bpy.data.scenes if owner.session_uid == submitted_in), None)
    show = _import_demo if job.kind == "demo" else results.SHOW_BY_KIND.get(job.kind)
    if show is not None and show(job, owner):
        _push_undo(job.title)
    for root in results.roots_of(job.folder):
        fill_holes(root, again=False)


def _import_demo(job: Job, owner: bpy.types.Scene | None) -> bool:
    """Import the new demo capture, if there is a backend."""
    if owner is None or locations.backend_python() is None:
        messages.show(f"The demo capture is in {job.folder}; set up the backend, then import it")
        return False
    folder = locations.reconstructions_folder() / "demo"
    submit(
        locations.backend_job("Import demo", "import", folder, "import", str(job.folder), "--out", str(folder)),
        owner,
        lambda _kind, text: messages.show(text, "ERROR"),
    )
    return False


def _push_undo(title: str) -> None:
    windows = bpy.context.window_manager.windows
    if windows and not bpy.app.background:
        with bpy.context.temp_override(window=windows[0]):
            bpy.ops.ed.undo_push(message=f"ObjectGS: {title}")


def stop() -> None:
    """Stop all jobs and forget what waits to be shown, as when the extension is disabled."""
    object_edits.flush()
    if bpy.app.timers.is_registered(_tick):
        bpy.app.timers.unregister(_tick)
    queue.stop_all(timeout=10.0)
    for known in (_results, _announced, _submitted_in, _requested_fills):
        known.clear()
    previews.clear()
