# SPDX-License-Identifier: GPL-3.0-or-later
"""Background jobs: a timer polls the queue, redraws panels and shows results.

The queue belongs to the Blender process, not to the .blend file, so it survives undo and opening another file. Jobs
and reconstructions are matched by folder.
"""

from __future__ import annotations

import contextlib
import json
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy

from ...backend.shared.console import ConsoleReporter
from ...backend.shared.errors import InputError
from ...backend.shared.reconstruction.folder import Reconstruction
from ...backend.shared.reconstruction.record import read_record
from .. import scene
from ..blender import messages, undo, writing
from ..environment import environment, locations
from ..process.blocking import run_blocking
from ..process.jobs import Job, JobQueue, State
from ..state import folder_trust, object_edits, object_list
from ..state.folder_state import reconstruction_for
from ..state.next_step import find_step, has_masks, is_capture_gone
from . import pointing, previews, results
from .job_display import after_stop, summary
from .wording import IMPORT_PHOTOS, INSTALL, TRANSFORMERS, in_blender, lacking

INTERVAL = 0.1
"""Time in seconds between two polls of the queue."""
DRAW_EVERY = 1.0
"""Minimum time in seconds between two redraws for new figures."""
_SHOWN_WARNINGS = 3
_MARKING_GOES_ON = ("export", "fill", "plan")
"""Kinds of jobs that take little memory or time, and change no splats, points or masks."""

_REMEDIES: dict[str, tuple[str, str, dict[str, Any]]] = {
    "import": ("objectgs.import_capture", "Choose Another Folder...", {}),
    "sfm": ("objectgs.import_photos", "Choose Another Folder...", {}),
    "import-splats": ("objectgs.import_splats", "Choose Another File...", {}),
    "setup": ("objectgs.set_up_backend", "Try Again", {}),
}
"""Kind of a failed job -> operator that helps, label of its button and options."""

queue = JobQueue()
_drawn = 0.0
_stale = False
_summary = ""
"""State of the running job in words, whose time left falls with the clock."""
_submitted_in: dict[Job, int] = {}
"""Job -> session UID of the scene that submitted it; unlike the name, the UID never changes."""
_results: list[Job] = []
"""Finished jobs whose results are not shown yet."""
_requested_fills: dict[Path, Path] = {}
"""Reconstruction folder -> file requested from its latest fill job."""
_then: dict[Job, int] = {}
"""Job that installs packages -> number of the failed job that is run again after it; 0: none."""
_poses_told: dict[Path | None, str] = {}
"""Capture folder -> message about its poses, which goes when the capture has been trained."""
_announced: set[Job] = set()
"""Jobs in `_results` whose delay was reported to the user."""


def submit(job: Job, owner: bpy.types.Scene, report: Callable[[set[str], str], Any]) -> set[str]:
    """Start a job in the background or, without a window, run it until it ends.

    Args:
        job: a new job.
        owner: scene in which to show the result.
        report: an operator's `report` method, or a function with the same parameters.

    Returns:
        The return value for the operator's `execute`.
    """
    _submitted_in[job] = owner.session_uid
    if job.kind not in _MARKING_GOES_ON:
        _end_marking(job)
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
    messages.withdraw(after_stop(job))  # Of an earlier job with the same title, which this one continues.
    queue.add(job)
    if not bpy.app.timers.is_registered(_tick):
        bpy.app.timers.register(_tick, first_interval=0.0, persistent=True)
    return {"FINISHED"}


def _end_marking(job: Job) -> None:
    """End the process that finds marked objects, and say so unless their separation needs its end."""
    separates = job.kind == "label"
    ended = pointing.release(job.folder, keeps_colors=separates and not bpy.app.background)
    if ended and not separates:
        messages.show(f"Marking has ended for {job.title}; the strokes are kept, and Mark Objects continues it.")


def fill_holes(root: bpy.types.Collection, again: bool = True) -> None:
    """Start a job that fills the holes of removed and moved objects, unless its result exists or the folder is not
    accepted.

    Args:
        root: the reconstruction's collection.
        again: also start a job if the same fill was requested before.
    """
    if not folder_trust.is_accepted(root):
        return
    folder = scene.folder_of(root)
    missing = scene.missing_fill(root, scene.Objects.read(folder))
    job = fill_of(root)
    is_asked = job is not None and not job.is_finished
    owner = next(iter(object_list.scenes_of(root)), None)
    if missing is None or is_asked or owner is None or (not again and _requested_fills.get(folder) == missing):
        return
    _requested_fills[folder] = missing

    def show_error(_kind: set[str], text: str) -> None:
        messages.show(text, "ERROR")

    if locations.backend_python() is None:
        messages.show(f"Holes of removed and moved objects are not filled: {locations.backend_sentence()}", "ERROR")
    else:
        submit(locations.backend_job(f"Fill of {root.name}", "fill", folder, "edit", str(folder)), owner, show_error)


def install_transformers(owner: bpy.types.Scene, report: Callable[[set[str], str], Any], then: int) -> set[str]:
    """Start a job that installs the package transformers for the backend.

    Args:
        owner, report: as for `submit`.
        then: number of the failed job to run again afterward; 0: none.

    Returns:
        The return value for the operator's `execute`.
    """
    python = locations.backend_python()
    assert python is not None
    job = environment.add_models_job(python, locations.environment_folder())
    messages.settle(job.title, INSTALL[0])
    _then[job] = then
    return submit(job, owner, report)


def job_of(root: bpy.types.Collection) -> Job | None:
    """Return the latest job in the queue for a reconstruction's folder, or None; other folders are not looked at."""
    return queue.of_folder(scene.folder_of(root)) if folder_trust.is_accepted(root) else None


def fill_of(root: bpy.types.Collection) -> Job | None:
    """Return the latest job in the queue that fills holes of a reconstruction, or None."""
    folder = scene.folder_of(root)
    jobs = (job for job in reversed(queue.jobs) if job.kind == "fill" and job.folder == folder)
    return next(jobs, None) if folder_trust.is_accepted(root) else None


def is_busy(root: bpy.types.Collection) -> bool:
    """Return whether the queue contains an unfinished job for a reconstruction, for panels."""
    return folder_trust.is_accepted(root) and busy(scene.folder_of(root))


def ended_job(number: int) -> Job | None:
    """Return the failed or stopped job with a number, or None."""
    ended = (State.FAILED, State.STOPPED)
    return next((job for job in queue.jobs if job.number == number and job.state in ended), None)


def busy(folder: Path) -> bool:
    """Return whether the queue contains an unfinished job for `folder`."""
    job = queue.of_folder(folder)
    return job is not None and not job.is_finished


@writing.allowed
def _tick() -> float | None:
    global _summary
    changed = queue.poll()
    for job in changed:
        if job.take_preview() and job.folder is not None:
            _guard(job, previews.refresh, job.folder)
        if job.is_finished:
            _guard(job, _handle_end, job)
    _show_results()
    before, _summary = _summary, "" if queue.running is None else summary(queue.running)
    at_once = any(job.is_finished or job.state is not State.RUNNING for job in changed)
    _redraw_soon(at_once, bool(changed) or _summary != before)
    return INTERVAL if _results or any(not job.is_finished for job in queue.jobs) else None


def _redraw_soon(at_once: bool, changed: bool) -> None:
    """Redraw immediately after a change of state, and at most once per `DRAW_EVERY` for new figures."""
    global _drawn, _stale
    _stale = _stale or changed
    now = time.monotonic()
    if _stale and (at_once or now - _drawn >= DRAW_EVERY):
        _drawn, _stale = now, False
        redraw()


def redraw() -> None:
    """Redraw sidebars, status bars and preferences, but not the viewports, which redraw slowly."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            for region in area.regions:
                if (area.type, region.type) in (("VIEW_3D", "UI"), ("PREFERENCES", "WINDOW")):
                    region.tag_redraw()
        # The status bar has no area to tag. Setting its text redraws it; modal operators show their own text there.
        if not len(getattr(window, "modal_operators", ())):
            # After a file is opened, the timer's context has no window, and Blender would crash here.
            with bpy.context.temp_override(window=window):
                window.workspace.status_text_set_internal(None)


def _handle_end(job: Job) -> None:
    if job.kind == "label":
        pointing.separated()
    operator, label, options = _remedy(job)
    if job.state is State.FAILED and job.lacks is not None and job.lacks[0] == TRANSFORMERS:
        messages.show(f"{job.title}: {lacking(*job.lacks)}", "ERROR", *INSTALL, number=job.number)
    elif job.state is State.FAILED:
        if job in _then:
            operator, options = INSTALL[0], {"number": _then[job]}
        messages.show(f"{job.title}: {in_blender(job.error or job.message)}", "ERROR", operator, label, **options)
    elif job.state is State.DONE:
        messages.settle(job.title, operator if job.kind in _REMEDIES else None)
        for root in results.roots_of(job.folder) if job.kind == "train" else ():
            # The folder may not be readable at this moment.
            with contextlib.suppress(InputError, OSError):
                messages.withdraw(_poses_told.pop(folder_trust.state_of(root).capture, ""))
    elif job.state is State.STOPPED and job.kind == "sfm":
        messages.show(after_stop(job), "INFO", "objectgs.retry_job", "Continue", number=job.number)
    # One that was stopped while it waited has changed nothing.
    has_changed = job.exit_code is not None and job.kind in ("train", "label", "mesh")
    if job.state is State.DONE or (job.state is State.STOPPED and has_changed):
        _results.append(job)
    else:
        _submitted_in.pop(job, None)
        _then.pop(job, None)


def _remedy(job: Job) -> tuple[str, str, dict[str, Any]]:
    """Return what helps if a job fails: an operator, the label of its button and options."""
    if job.kind == "import" and job.error and IMPORT_PHOTOS in job.error:
        folder = job.command[job.command.index("import") + 1]
        return _REMEDIES["sfm"][0], "Import Photos of This Folder...", {"directory": folder}
    if job.kind in _REMEDIES:
        return _REMEDIES[job.kind]
    root = next(iter(results.roots_of(job.folder)), None)
    # A folder on a network can fail at any time.
    with contextlib.suppress(OSError):
        if root is not None and is_capture_gone(folder_trust.state_of(root)):
            step = find_step(root)
            return step.operator, f"{step.label}...", dict(step.options)
    return "objectgs.retry_job", "Try Again", {"number": job.number}


def _show_results() -> None:
    """Show pending results in order, until one must wait for a render or the user."""
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
    """Describe what delays a result: data in use must not change, or Blender crashes or loses the change."""
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
    """Call `action` and show its errors; an uncaught exception would end the timer, which all jobs require."""
    try:
        action(*arguments)
    except (InputError, OSError) as error:
        messages.show(f"{job.title}: {messages.sentence(error)}", "ERROR")
    except Exception as error:
        traceback.print_exc()
        messages.show(f"{job.title}: the result could not be shown ({type(error).__name__}: {error})", "ERROR")


def finish(job: Job) -> None:
    """Show the result of a job in the scene that submitted it and in all scenes that show the reconstruction."""
    object_edits.flush()
    submitted_in = _submitted_in.pop(job, None)
    owner = next((owner for owner in bpy.data.scenes if owner.session_uid == submitted_in), None)
    show = _import_made if job.kind in ("demo", "sfm") else results.SHOW_BY_KIND.get(job.kind)
    has_changed = show is not None  # What was shown before an error needs an undo step, too.
    try:
        has_changed = show is not None and show(job, owner)
    finally:
        if has_changed:
            undo.push(job.title)
    pointing.show()  # A filled hole adds splats to those that are marked.
    if job.kind == "packages":
        _go_on(job, owner)
    if job.kind in ("import", "masks") and owner is not None and not bpy.app.background:
        _assign_objects(job, owner)
    for root in results.roots_of(job.folder):
        fill_holes(root, again=False)


def _go_on(job: Job, owner: bpy.types.Scene | None) -> None:
    """Run the job again that lacked the packages which a job has installed."""
    failed = ended_job(_then.pop(job, 0))
    if failed is None or owner is None:
        messages.show(job.message)
    else:
        submit(failed.again(locations.backend_python()), owner, lambda _kind, text: messages.show(text, "ERROR"))


def _import_made(job: Job, owner: bpy.types.Scene | None) -> bool:
    """Import the capture that a job has made if the backend is set up; return False."""
    assert job.folder is not None
    if job.kind == "sfm":
        _show_poses(job)
    if owner is None or locations.backend_python() is None:
        first = "set up the backend, then use" if locations.backend_python() is None else "use"
        messages.show(f"The new capture is in {job.folder}; {first} Import Capture, and open this folder")
        return False
    try:
        demo = locations.reconstructions_folder() / "demo" if job.kind == "demo" else None
        following = import_job(job.folder, demo)
    except InputError as error:
        raise InputError(
            f"The new capture is in {job.folder}; use Import Capture, since this failed: {error}"
        ) from error
    submit(following, owner, lambda _kind, text: messages.show(text, "ERROR"))
    return False


def import_job(capture: Path, folder: Path | None = None) -> Job:
    """Return a job that imports a capture, with images of the size of an earlier import.

    folder: the reconstruction's folder; None: that of an earlier import, or a new one.
    """
    folder = folder or reconstruction_for(capture, locations.new_reconstruction)
    before = read_record(Reconstruction(folder)).capture
    size = [] if before is None else ["--max-size", str(before.max_size)]
    return locations.backend_job(
        f"Import {folder.name}", "import", folder, "import", str(capture), "--out", str(folder), *size
    )


def _show_poses(job: Job) -> None:
    """Show how many photos have a pose, with a button to use another set of them, or to leave out the weak ones."""
    text = " ".join(map(in_blender, [f"{job.title}: {job.message}", *job.warnings[:_SHOWN_WARNINGS]]))
    if len(job.warnings) > _SHOWN_WARNINGS:
        text += " The folder sfm of the capture names all of them."
    weak, sets, number = (job.result.get(key) for key in ("weak", "separate_sets", "set"))
    again = {"operator": "objectgs.recompute_poses", "capture": str(job.folder)}
    _poses_told[job.folder] = text
    if isinstance(sets, list) and len(sets) > 1 and isinstance(number, int):
        following = number % len(sets) + 1
        messages.show(text, label=f"Use Set {following} ({sets[following - 1]} Photos)", photo_set=following, **again)
    elif isinstance(weak, list) and weak:
        label = f"Leave Out {len(weak)} Weak Photo{'s' if len(weak) > 1 else ''}"
        messages.show(text, label=label, leave_out=json.dumps(weak), **again)
    else:
        messages.show(text)


def _assign_objects(job: Job, owner: bpy.types.Scene) -> None:
    """Let new masks decide on the objects of a capture's points, which takes seconds, or on those of trained splats."""
    root = next(iter(results.roots_of(job.folder)), None)
    state = None if root is None else folder_trust.state_of(root)
    if state is None or not has_masks(state) or locations.backend_python() is None:
        return
    if root.objectgs.objects and job.kind != "masks":
        return
    edits = scene.shown_edits(root)
    if state.steps and edits is not None and edits.match:
        messages.show(
            f"Clean Up Labels gives the splats of {root.name} the objects of the new masks; deleted and separated "
            "splats come back then",
            operator="objectgs.clean_up_labels", label="Clean Up Labels", folder=str(job.folder),
        )  # fmt: skip
        return
    if state.trained:
        follow = locations.backend_job(f"Labels of {root.name}", "label", job.folder, "clean-labels", str(job.folder))
    else:
        options = ("--strategy", root.objectgs.strategy, "--max-size", str(root.objectgs.max_size))
        follow = locations.backend_job(
            f"Assign objects of {root.name}", "vote", job.folder, "vote", str(state.capture), "--out", str(job.folder),
            *options,
        )  # fmt: skip
    submit(follow, owner, lambda _kind, text: messages.show(text, "ERROR"))


def stop() -> None:
    """Stop all jobs and discard pending results, for when the extension is disabled."""
    object_edits.flush()
    if bpy.app.timers.is_registered(_tick):
        bpy.app.timers.unregister(_tick)
    queue.stop_all(timeout=10.0)
    for known in (_results, _announced, _submitted_in, _requested_fills, _then):
        known.clear()
    previews.clear()
    messages.clear()
