# SPDX-License-Identifier: GPL-3.0-or-later
"""A backend process that answers strokes on objects with the object of each splat or point, which is shown at once.

There is at most one, for one reconstruction; it reads the training and ends before a job changes it.
"""

from __future__ import annotations

import base64
import json
import zlib
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ...backend.shared.errors import InputError
from ...backend.shared.reconstruction.folder import Reconstruction
from .. import drawing, scene
from ..blender import messages, undo, writing
from ..environment import locations
from ..picking import marks
from ..process.backend_process import BackendProcess
from .wording import INSTALL, TRANSFORMERS, in_blender, lacking

INTERVAL = 0.05
"""Time in seconds between two polls of the process."""
_NOTICEABLE = 0.05
"""Share of an object that a stroke on another one may take before it is told."""


class _Session:
    """The process, and what it has answered."""

    def __init__(self, root: bpy.types.Collection) -> None:
        self.root, self.folder = root.session_uid, scene.folder_of(root)
        has_splats = Reconstruction(self.folder).splats.is_file()
        self.keys = scene.splat_keys(self.folder) if has_splats else scene.point_numbers(self.folder)
        self.kind = "splats" if has_splats else "points"
        self.segmenter = locations.segmenter()
        options = locations.segmenter_options(self.segmenter)
        job = locations.backend_job("", "point", self.folder, "point", str(self.folder), *options)
        self.process = BackendProcess(job.command, job.cwd, job.environment, in_background=False)
        self.ready, self.progress, self.message, self.failure = False, 0.0, "Starting", ""
        self.problem, self.said, self.said_passes = "", "", False
        self.asked = self.answered = 0
        self.is_proposing = False
        self.proposed_to_replace: dict[str, Any] = {}
        self._asked_strokes: list[dict[str, Any]] = []
        self._asked_everything: bool | None = None
        self.answered_strokes: list[dict[str, Any]] = []
        self.taken: tuple[int, int, float] | None = None
        self.wanted_detail: float | None = None
        self.colors: dict[int, tuple[float, ...]] = {}
        self.lacks = False
        self.proposed: dict[str, Any] | None = None
        self._parts: list[np.ndarray] = []
        self._order = np.argsort(self.keys)
        self._places: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        self.objects: np.ndarray = np.zeros(1, np.int64)
        self.classes = np.zeros(len(self.keys), np.int64)

    def ask(self, content: dict[str, Any]) -> None:
        """Send the strokes; what is shown until the answer is that of earlier ones."""
        if not self.ready:
            return
        self.is_proposing = False
        self._asked_strokes, self._asked_everything = content["strokes"], content["everything"]
        if not content["strokes"]:
            self.objects, self.classes = np.zeros(1, np.int64), np.zeros(len(self.keys), np.int64)
            self.asked = self.answered = self.asked + 1
            self.answered_strokes = []
            return
        self.asked += 1
        self.process.send(json.dumps({"request": self.asked, **content}), replaces=True)

    def has_asked(self, content: dict[str, Any]) -> bool:
        """Return whether the latest request has these strokes."""
        return self._asked_everything == content["everything"] and self._asked_strokes == content["strokes"]

    def propose(self, detail: float) -> None:
        """Ask for objects without strokes, now or as soon as the process is ready; detail: how finely to divide."""
        self.wanted_detail = None if self.ready else detail
        if self.ready:
            self.asked += 1
            self.is_proposing, self._asked_everything = True, None
            content = {"request": self.asked, "propose": True, "detail": detail}
            self.process.send(json.dumps(content), replaces=True)

    def will_propose(self) -> bool:
        return self.is_proposing or self.wanted_detail is not None

    def take(self, event: dict[str, Any]) -> int | None:
        """Process an event; return the number of a stroke that shows no splats."""
        try:
            return self._take(event)
        except (KeyError, TypeError, ValueError, IndexError, zlib.error) as error:
            self.failure = f"the backend's answer is not valid ({error!r})"
            return None

    def _take(self, event: dict[str, Any]) -> int | None:
        kind = event["type"]
        if kind == "progress":
            self.progress = float(event.get("done") or 0.0) / float(event.get("total") or 1.0)
        elif kind == "status":
            self.message = str(event.get("message"))
        elif kind == "error":
            self.lacks = event.get("lacks") == TRANSFORMERS
            lacks = lacking(TRANSFORMERS, str(event.get("option"))) if self.lacks else None
            self.failure = lacks or in_blender(str(event.get("message")))
        elif kind == "answer" and event.get("ready"):
            self.ready = event.get("splats") == len(self.keys)
            if not self.ready:
                self.failure = "The splats in the folder are not those of its training; train or separate again."
        elif kind == "answer" and event.get("request") == self.asked:
            self.is_proposing = False
            if "proposed" in event:
                self.answered, self.proposed = self.asked, dict(event["proposed"])
                return None
            if "problem" in event:
                self.answered = self.asked
                number = event.get("stroke")
                self.problem = str(event["problem"]).replace(f"Stroke {number} ", "A stroke ", 1)  # None shows it.
                return number if isinstance(number, int) else None
            self._take_classes(event)
        return None

    def _take_classes(self, event: dict[str, Any]) -> None:
        if event["first"] == 0:
            self._parts = []
        data = zlib.decompress(base64.b64decode(event["classes"]))
        self._parts.append(np.frombuffer(data, event["kind"]).astype(np.int64))
        if sum(map(len, self._parts)) >= len(self.keys):
            objects, classes = np.array(event["objects"], np.int64), np.concatenate(self._parts)
            if len(classes) != len(self.keys) or classes.max(initial=0) >= len(objects):
                raise ValueError("its objects are not those of the splats")
            self.taken = self._most_taken(objects[classes])
            self.objects, self.classes, self.answered = objects, classes, self.asked
            self.answered_strokes = self._asked_strokes

    def _most_taken(self, owners: np.ndarray) -> tuple[int, int, float] | None:
        """Return what the newest strokes have taken most of: who took, from which object, and which share of it.

        owners: (N,) IDs of the objects to which the splats belong now. None if nothing noticeable was taken.
        """
        known = len(self.answered_strokes)
        if self._asked_strokes[:known] != self.answered_strokes:
            return None
        drawn = {stroke["object"] for stroke in self._asked_strokes[known:]} - {marks.NOTHING}
        total = np.bincount(self.classes, minlength=len(self.objects))
        found = []
        for taker in drawn:
            taken = np.bincount(self.classes[owners == taker], minlength=len(self.objects)) / np.maximum(total, 1)
            taken[(self.objects == taker) | (self.objects == marks.NOTHING)] = 0.0
            loser = int(taken.argmax())
            found.append((taker, int(self.objects[loser]), float(taken[loser])))
        most = max(found, key=lambda each: each[2], default=None)
        return most if most is not None and most[2] > _NOTICEABLE else None

    def places(self, mesh: bpy.types.Mesh) -> np.ndarray:
        """Return the place (n,) of each splat of a mesh in `classes`, -1 for none; kept for each mesh."""
        keys = scene.keys_of(mesh)
        known = self._places.get(mesh.session_uid)
        if known is None or not np.array_equal(known[0], keys):
            at = np.minimum(np.searchsorted(self.keys, keys, sorter=self._order), len(self._order) - 1)
            own = self._order[at]
            known = self._places[mesh.session_uid] = keys, np.where(self.keys[own] == keys, own, -1)
        return known[1]

    def say(self, text: str, kind: str = "INFO", passes: bool = False) -> None:
        """Show a message on the marks instead of the earlier one; "" for none.

        passes: it holds until the marks change.
        """
        messages.withdraw(self.said)
        self.said, self.said_passes = text, passes
        if text:
            messages.show(text, kind)


_session: _Session | None = None
_keeps_colors = False
"""Whether the splats keep the colors of the marks while a job separates the objects."""


def start(root: bpy.types.Collection, proposes: bool = False) -> None:
    """Start the process for a reconstruction, unless it runs with the segmentation model of the preferences.

    proposes: a suggestion is asked for next, so that it is not told that an earlier one ends.

    Raises:
        InputError: the folder has no splats that can be read, or the process cannot be started.
    """
    global _session
    if is_active(root) and segmenter(root) == locations.segmenter():
        return
    is_canceled = not proposes and is_active(root) and _session is not None and _session.will_propose()
    stop()
    try:
        _session = _Session(root)
    except OSError as error:
        raise InputError(f"The backend could not be started ({error.strerror or error}).") from error
    if is_canceled:
        _session.say("The segmentation model has changed, so Suggest Objects was canceled; press it again")
    if not bpy.app.timers.is_registered(_tick):
        bpy.app.timers.register(_tick, first_interval=0.0, persistent=True)


def stop() -> None:
    """End the process, and show the splats in their own colors."""
    if _end() or _keeps_colors:
        _show_own_colors()


def separated() -> None:
    """Show the splats in their own colors again after a job before which `release` has kept those of the marks."""
    if _keeps_colors:
        _show_own_colors()


def _show_own_colors() -> None:
    global _keeps_colors
    _keeps_colors = False
    drawing.show_labels({}, np.zeros((0, 3)))
    drawing.redraw()


def _end() -> bool:
    """End the process; return whether it ran."""
    global _session
    if _session is None:
        return False
    _session.process.kill()
    _session.say("")
    _session = None
    return True


def propose(root: bpy.types.Collection) -> None:
    """Ask for objects without strokes, which replace those that are marked; starts the process if it does not run."""
    start(root, proposes=True)
    assert _session is not None
    _session.proposed_to_replace = marks.content(root)
    _session.propose(root.objectgs.detail)


def release(folder: Path | None, keeps_colors: bool = False) -> bool:
    """End the process if it reads this folder, which a job is going to change; return whether it did.

    keeps_colors: the marked splats are drawn in the colors of their objects until `separated`.
    """
    global _keeps_colors
    if _session is None or folder is None or _session.folder != folder:
        return False
    if keeps_colors:
        _keeps_colors = _end()
    else:
        stop()
    return True


def is_active(root: bpy.types.Collection) -> bool:
    """Return whether the process runs for a reconstruction."""
    return _session is not None and _session.root == root.session_uid


def segmenter(root: bpy.types.Collection) -> Path | None:
    """Return the folder of the model that segments a reconstruction's strokes: the one they are shown with, if any."""
    return _session.segmenter if _session is not None and is_active(root) else locations.segmenter()


def state() -> tuple[float, bool]:
    """Return the progress of the preparation, 1 when it is complete, and whether an answer is awaited."""
    if _session is None:
        return 0.0, False
    return (1.0 if _session.ready else min(_session.progress, 0.99)), _session.asked > _session.answered


def message() -> str:
    """Return what the preparation is doing."""
    return "" if _session is None else _session.message


def waiting_strokes(root: bpy.types.Collection) -> list[dict[str, Any]]:
    """Return the strokes on a reconstruction that are not answered yet, but will be."""
    session = _session if is_active(root) else None
    if session is None or session.will_propose() or (session.ready and session.asked == session.answered):
        return []
    return [stroke for stroke in marks.strokes_of(root) if stroke not in session.answered_strokes]


def refresh(root: bpy.types.Collection) -> None:
    """Ask for the objects of strokes if they have changed, which may settle a problem of earlier ones."""
    if _session is not None and _session.root == root.session_uid:
        content = marks.content(root)
        is_proposing = _session.will_propose()
        if is_proposing and content == _session.proposed_to_replace:
            # What was undone or set was something else.
            return
        if _session.has_asked(content):
            show()  # An undo may have replaced meshes.
            return
        if _session.said_passes:
            _session.say("")
        _session.wanted_detail = None
        _session.ask(content)
        if is_proposing:
            _session.say("The marks have changed, so Suggest Objects was canceled; press it again")
        show()


def recolor(root: bpy.types.Collection) -> None:
    """Show the colors of the marked objects if those have changed."""
    if _session is not None and _session.root == root.session_uid:
        colors = _colors(root, _session)
        # Where other objects are listed, a new answer shows them.
        if colors.keys() == _session.colors.keys() and colors != _session.colors:
            show()


def _colors(root: bpy.types.Collection, session: _Session) -> dict[int, tuple[float, ...]]:
    """Return the colors of the marked objects that splats belong to, by ID."""
    marked = {item.object_id: tuple(item.color) for item in root.objectgs.marked}
    return {object_id: marked[object_id] for object_id in session.objects.tolist() if object_id in marked}


@writing.allowed
def _tick() -> float | None:
    session = _session
    if session is None:
        return None
    root = next((each for each in bpy.data.collections if each.session_uid == session.root), None)
    if root is None:
        stop()
        return None
    events = session.process.poll()
    was_ready, before = session.ready, session.answered
    for event in events:
        number = session.take(event)
        if number is not None:
            marks.remove_stroke(root, number)
        if session.problem:
            session.say(session.problem, "ERROR", passes=True)
            session.problem = ""
    if session.ready and not was_ready:
        if session.wanted_detail is None:
            session.ask(marks.content(root))
        else:
            session.propose(session.wanted_detail)
    if session.proposed is not None:
        _show_proposed(root, session)
    if session.taken is not None:
        _tell_taken(root, session)
    if session.answered != before:
        show()
    if events:
        redraw()
    if session.failure or session.process.exit_code is not None:
        lines = session.process.log
        why = session.failure or (lines[-1] if lines else "it gave no reason")
        button = INSTALL if session.lacks else (None, "")
        messages.show(f"The objects of strokes cannot be found: {why}", "ERROR", *button)
        stop()
        redraw()
        return None
    return INTERVAL


def _tell_taken(root: bpy.types.Collection, session: _Session) -> None:
    """Say that a stroke on one object has taken a part of another, which is easily overlooked."""
    assert session.taken is not None
    (taker, loser, share), session.taken = session.taken, None
    names = {item.object_id: item.name for item in root.objectgs.marked}
    if taker in names and loser in names:
        session.say(
            f"{names[taker]} took {100 * share:.0f} % of {names[loser]}; if it should not, draw over the lost part of "
            f"{names[loser]} again",
            passes=True,
        )


def _show_proposed(root: bpy.types.Collection, session: _Session) -> None:
    """Mark the proposed objects, as one undo step; if there are none, the marks stay as they are."""
    proposed, session.proposed = session.proposed, None
    if not proposed or proposed.get("strokes") == []:
        session.say("No objects were found by their shape; try another Detail, or draw over them")
        # The marks may not have been answered yet.
        session.ask(marks.content(root))
        return
    try:
        marks.set_proposed(root, proposed)
    except (KeyError, TypeError, ValueError) as error:
        session.failure = f"the backend's answer is not valid ({error!r})"
        return
    session.say(
        f"{len(root.objectgs.marked)} objects were found. Remove those that are none, merge parts, and draw over what "
        "is missing; then press Separate Objects. Another Detail gives more or fewer"
    )
    undo.push("Suggest Objects")


def show() -> None:
    """Draw the splats of the marked objects in the objects' colors."""
    session = _session
    root = next((each for each in bpy.data.collections if session and each.session_uid == session.root), None)
    if session is None or root is None:
        return
    session.colors = colors = _colors(root, session)
    shown = list(colors)
    number_of = np.array([shown.index(i) + 1 if i in colors else 0 for i in session.objects.tolist()], np.int64)
    numbers = number_of[session.classes]
    found: dict[bpy.types.Mesh, np.ndarray] = {}
    for part in root.all_objects:
        if scene.kind_of(part) != session.kind or part.data.is_editmode:
            continue
        if session.kind == "points":
            found[part.data] = numbers
        else:
            found[part.data] = np.append(numbers, 0)[session.places(part.data)]
    drawing.show_labels(found, np.array([colors[i] for i in shown]).reshape(-1, 3))
    drawing.redraw()


def redraw() -> None:
    """Redraw the sidebars and headers of the viewports."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                for region in area.regions:
                    if region.type in ("UI", "TOOL_HEADER"):
                        region.tag_redraw()


@bpy.app.handlers.persistent
def _file_loads(*_: Any) -> None:
    stop()


def register() -> None:
    marks.after_strokes.append(refresh)
    marks.after_colors.append(recolor)
    bpy.app.handlers.load_pre.append(_file_loads)


def unregister() -> None:
    stop()
    bpy.app.handlers.load_pre.remove(_file_loads)
    marks.after_colors.remove(recolor)
    marks.after_strokes.remove(refresh)
