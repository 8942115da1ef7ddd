# SPDX-License-Identifier: GPL-3.0-or-later
"""Strokes on objects: their cameras in the capture, the list of marked objects, undo, and the drawn colors."""

import base64
import json
import zlib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from mathutils import Matrix
from objectgs.backend.shared.formats.ply import write_vertices
from objectgs.backend.shared.reconstruction.edits.splat_edits import SplatEdits
from objectgs.backend.shared.splats.picking import View
from objectgs.objectgs_addon import drawing
from objectgs.objectgs_addon import scene as blender_scene
from objectgs.objectgs_addon.blender import messages
from objectgs.objectgs_addon.drawing import splat_arrays, viewport
from objectgs.objectgs_addon.drawing.gather import gather, placed_parts
from objectgs.objectgs_addon.environment import locations
from objectgs.objectgs_addon.panels.objects import MarkingPanel
from objectgs.objectgs_addon.picking import marks
from objectgs.objectgs_addon.process.jobs import State
from objectgs.objectgs_addon.running import background, pointing, results, stroke_lines
from objectgs.objectgs_addon.scene import kinds
from objectgs.objectgs_addon.state.folder_state import UNKNOWN
from objectgs.objectgs_addon.state.next_step import can_mark
from objectgs.operators.common import jobs, need
from objectgs.operators.marking import clean_labels, marked_objects

import headless

from .building import OBJECTS, look_at, splat_table, write_cameras, write_folder
from .drawn import texts_of

ORIGIN = np.array([100.0, -200.0, 30.0])
PLACE = ORIGIN + np.array([0.1, -0.3, 0.2])
"""A place in the capture."""


@pytest.fixture
def root(fresh, tmp_path, backend_python, monkeypatch):
    """A turned reconstruction far from the origin with 200 splats, whose parent was moved and scaled."""
    folder = write_folder(tmp_path / "table top")
    upright = np.eye(4)
    upright[:3, :3] = np.array(Matrix.Rotation(0.7, 3, "X")) @ np.array(Matrix.Rotation(0.3, 3, "Z"))
    write_cameras(folder, [look_at(ORIGIN + np.array([3, 0, 1]), ORIGIN)], origin=ORIGIN, upright=upright)
    splats = splat_table(np.resize([0, *OBJECTS], 200), degree=1)
    for axis, name in enumerate("xyz"):
        splats[name] += ORIGIN[axis]
    write_vertices(folder / "splats.ply", splats)
    monkeypatch.setenv("OBJECTGS_PYTHON", backend_python)
    extension = headless.extension()
    extension.register()
    bpy.ops.objectgs.open_reconstruction(directory=str(folder))
    found = bpy.context.scene.objectgs.active
    parent = kinds.parent_of(found)
    parent.scale = (2.5, 2.5, 2.5)
    parent.location = (4.0, 5.0, 6.0)
    bpy.context.view_layer.update()
    yield found
    extension.unregister()


def world_of(root) -> np.ndarray:
    return (blender_scene.capture_to_world(root) @ [*PLACE, 1.0])[:3]


def views(root) -> list[View]:
    """Return a perspective and an orthographic view of the place."""
    at = world_of(root)
    viewmat = np.array(look_at(at + np.array([6.0, 2.0, 3.0]), at + np.array([0.4, 0.3, 0.0])))
    return [
        View(viewmat, 700.0, 720.0, 410.0, 290.0, 800, 600),
        View(viewmat, 90.0, 95.0, 410.0, 290.0, 800, 600, orthographic=True),
    ]


def pixel(view: View, place: np.ndarray) -> np.ndarray:
    x, y, z = (view.viewmat @ [*place, 1.0])[:3]
    z = 1.0 if view.orthographic else z
    return np.array([view.fx * x / z + view.cx, view.fy * y / z + view.cy])


def test_cameras_of_strokes_see_the_capture_as_the_view_sees_the_world(root):
    for view in views(root):
        marks.add_stroke(root, 1, view, [(10.0, 20.0), (400.0, 300.0)], area=False)
        stroke = marks.strokes_of(root)[-1]
        assert stroke["points"] == [[10 / 800, round(20 / 600, 5)], [0.5, 0.5]]
        camera = stroke["camera"]
        viewmat = np.array(camera["viewmat"])
        assert np.allclose(viewmat[:3, :3] @ viewmat[:3, :3].T, np.eye(3), atol=1e-5)
        x, y, z = (viewmat @ [*PLACE, 1.0])[:3]
        fx, fy, cx, cy = camera["intrinsics"]
        assert z > 0
        assert np.allclose([fx * x / z + cx, fy * y / z + cy], pixel(view, world_of(root)), atol=0.1)
        assert (camera["width"], camera["height"]) == (800, 600)


def test_objects_are_added_and_removed_with_their_strokes(root):
    view = views(root)[0]
    root.objectgs.objects.clear()
    first = marks.add_object(root)
    assert (first.object_id, first.name) == (1, "Object 1")
    assert marks.add_object(root).object_id == 1, "an object without strokes is used first"
    marks.add_stroke(root, 1, view, [(1, 1)], area=False)
    second = marks.add_object(root)
    assert second.object_id == 2 and root.objectgs.active_marked == 1
    marks.add_stroke(root, 2, view, [(1, 1), (9, 1), (9, 9)], area=True)
    marks.add_stroke(root, marks.NOTHING, view, [(900, -5)], area=False)
    root.objectgs.marked[1].name = "can"
    content = marks.content(root)
    assert content["objects"] == {"1": "Object 1", "2": "can"} and content["everything"] is False
    assert [stroke["object"] for stroke in content["strokes"]] == [1, 2, 0]
    assert content["strokes"][1]["area"] is True
    assert content["strokes"][2]["points"] == [[1.0, 0.0]], "outside of the view"
    marks.remove_object(root, 0)
    assert [stroke["object"] for stroke in marks.strokes_of(root)] == [2, 0]
    assert marks.active_object(root).name == "can"
    marks.remove_stroke(root, 2)
    marks.remove_stroke(root, 7)
    assert [stroke["object"] for stroke in marks.strokes_of(root)] == [2]
    root.objectgs.strokes = "{"
    assert marks.strokes_of(root) == []


def test_ids_of_marked_objects_are_free(root):
    root.objectgs.objects.clear()
    for object_id in (1, 2, 4):
        root.objectgs.objects.add().object_id = object_id
    assert marks.add_object(root).object_id == 3


def test_strokes_are_kept_in_the_file(root, tmp_path):
    marks.add_object(root)
    marks.add_stroke(root, 1, views(root)[0], [(1, 1)], area=False)
    before = marks.content(root)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    marks.clear(root)
    assert not root.objectgs.marked and not marks.strokes_of(root)
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
    assert marks.content(bpy.context.scene.objectgs.active) == before


def test_strokes_of_a_separation_are_shown_again_in_another_file(root, monkeypatch):
    monkeypatch.setattr(background, "submit", lambda *_: {"FINISHED"})
    folder = str(blender_scene.folder_of(root))
    item = marks.add_object(root)
    item.name = "can"
    marks.add_stroke(root, item.object_id, views(root)[0], [(1, 1), (9, 1), (9, 9)], area=True)
    marks.add_stroke(root, marks.NOTHING, views(root)[0], [(5, 5)], area=False)
    before = marks.content(root)
    bpy.ops.objectgs.separate_marked()
    bpy.ops.wm.read_homefile(use_empty=True)
    bpy.ops.objectgs.open_reconstruction(directory=folder)
    again = bpy.context.scene.objectgs.active
    assert marks.content(again) == before
    for damage in ({"strokes": [{}]}, {"objects": 3}):
        (Path(folder) / "strokes.json").write_text(json.dumps({**before, **damage}))
        bpy.ops.wm.read_homefile(use_empty=True)
        bpy.ops.objectgs.open_reconstruction(directory=folder)
        assert not bpy.context.scene.objectgs.active.objectgs.marked


def test_objects_without_strokes_are_named_before_they_are_lost(root, monkeypatch):
    rows = [(item.object_id, item.name) for item in root.objectgs.objects]
    assert len(rows) > 2 and marks.names_without_strokes(root) == [name for _, name in rows]
    marks.add_stroke(root, blender_scene.from_stored(rows[0][0]), views(root)[0], [(1, 1)], area=False)
    root.objectgs.objects[1].separated = True
    assert marks.names_without_strokes(root) == [name for _, name in rows[2:]]
    for object_id, _ in (rows[0], rows[2]):
        root.objectgs.marked.add().object_id = object_id
    marks.add_stroke(root, blender_scene.from_stored(rows[2][0]), views(root)[0], [(1, 1)], area=False)
    marks.merge_object(root, 1, into=0)
    assert marks.names_without_strokes(root) == [name for _, name in rows[3:]], "merged ones are kept"


def test_what_is_removed_belongs_to_no_object(root):
    for remove in (lambda: marks.remove_object(root, 0), lambda: marks.clear(root)):
        item = marks.add_object(root)
        marks.add_stroke(root, item.object_id, views(root)[0], [(1, 1)], area=False)
        root.objectgs.everything = True
        remove()
        assert not marks.content(root)["everything"]


def test_labels_color_visible_splats(root):
    """Labels are numbers of colors; hidden splats have none, and clearing them restores the splats' own colors."""
    parts = [part for part in root.all_objects if blender_scene.kind_of(part) == "splats"]
    mesh = max(parts, key=lambda part: len(part.data.vertices)).data
    labels = np.arange(len(mesh.vertices)) % 3
    drawing.show_labels({mesh: labels}, np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]))
    arrays = splat_arrays.arrays_of(mesh)
    shown = labels if arrays.vertices is None else labels[arrays.vertices]
    drawn = gather(placed_parts(bpy.context.view_layer))
    with_labels = [obj for obj in drawn if obj.labels is not None]
    assert len(with_labels) == 1 and np.array_equal(with_labels[0].labels.of_splats, shown)
    assert with_labels[0].slots == 3 and all(obj.slots == 1 for obj in drawn if obj.labels is None)
    hidden = np.zeros(len(mesh.vertices), bool)
    hidden[:5] = True
    blender_scene.delete_splats(next(part for part in parts if part.data == mesh), hidden)
    drawing.splats_changed(mesh)
    left = next(obj.labels for obj in gather(placed_parts(bpy.context.view_layer)) if obj.labels is not None)
    assert len(left.of_splats) == len(splat_arrays.arrays_of(mesh).means) < len(labels)
    drawing.show_labels({}, np.zeros((0, 3)))
    assert all(obj.labels is None for obj in gather(placed_parts(bpy.context.view_layer)))


def test_splats_without_a_training_are_marked(root, monkeypatch):
    """They need neither a capture nor a training; cleaning up labels needs both."""
    submitted = []
    monkeypatch.setattr(background, "submit", lambda job, *_: submitted.append(job) or {"FINISHED"})
    folder = Path(blender_scene.folder_of(root))
    with pytest.raises(RuntimeError, match="No object is marked"):
        bpy.ops.objectgs.separate_marked()
    assert not (folder / "strokes.json").exists()
    item = marks.add_object(root)
    marks.add_stroke(root, item.object_id, views(root)[0], [(100, 100), (120, 110)], area=False)
    assert bpy.ops.objectgs.separate_marked() == {"FINISHED"}
    (stroke,) = json.loads((folder / "strokes.json").read_text())["strokes"]
    assert submitted[0].title.startswith("Separate objects of ")
    assert "camera" in stroke and submitted[0].command[submitted[0].command.index("label") + 1] == str(folder)
    with pytest.raises(RuntimeError, match=r"capture|train first"):
        bpy.ops.objectgs.clean_up_labels()


@pytest.mark.parametrize(
    ("steps", "capture", "masks", "of_strokes", "can"),
    [
        (0, False, False, False, True),
        (0, True, False, False, True),
        (0, True, True, False, False),
        (0, True, True, True, False),
        (100, False, False, False, False),
        (100, True, False, False, True),
        (100, True, True, False, False),
        (100, True, True, True, True),
    ],
)
def test_what_can_be_marked(tmp_path, steps, capture, masks, of_strokes, can):
    """A training needs its capture; masks that were not made of strokes are in the way."""
    if masks:
        (tmp_path / "masks").mkdir()
    if of_strokes:
        (tmp_path / "masks" / "strokes.json").write_text("{}")
    state = replace(UNKNOWN, imported=True, trained=True, steps=steps, capture=tmp_path if capture else None)
    assert can_mark(state) is can
    assert can_mark(replace(state, trained=False, steps=0)) is (capture and not masks), "points need their capture"
    assert not can_mark(replace(state, imported=False, trained=False, steps=0))


def test_labels_of_a_training_with_masks_are_cleaned_up(root, monkeypatch):
    submitted = []
    monkeypatch.setattr(background, "submit", lambda job, *_: submitted.append(job) or {"FINISHED"})
    monkeypatch.setattr(need, "work_on_capture", lambda *_: True)
    monkeypatch.setattr(need, "splats", lambda *_: True)
    monkeypatch.setattr(need, "has_masks", lambda _: False)
    with pytest.raises(RuntimeError, match="no masks"):
        bpy.ops.objectgs.clean_up_labels()
    monkeypatch.setattr(need, "has_masks", lambda _: True)
    assert bpy.ops.objectgs.clean_up_labels() == {"FINISHED"}
    folder = str(blender_scene.folder_of(root))
    command = submitted[0].command
    assert command[command.index("clean-labels") + 1] == folder and submitted[0].kind == "label"


@pytest.mark.parametrize("operator", [marked_objects.SeparateMarked, clean_labels.CleanUpLabels])
def test_edits_of_splats_are_not_lost_without_a_question(root, monkeypatch, operator):
    asked, steps = [], 100
    monkeypatch.setattr(marks, "names_without_strokes", lambda _: [])
    monkeypatch.setattr(jobs, "folder_state", lambda _: replace(UNKNOWN, steps=steps))
    manager = SimpleNamespace(invoke_confirm=lambda *_, **options: asked.append(options) or {"RUNNING_MODAL"})
    context = SimpleNamespace(scene=bpy.context.scene, window_manager=manager)

    def invoke():
        return operator.invoke(SimpleNamespace(execute=lambda _: {"FINISHED"}, folder=""), context, None)

    assert invoke() == {"FINISHED"}
    edits = SplatEdits().delete(np.array([5, 7], np.uint64))
    blender_scene.remember_edits(root, edits, missing=2)
    assert invoke() == {"FINISHED"} and not asked, "those of an earlier training are lost already"
    blender_scene.remember_edits(root, edits, missing=0)
    assert invoke() == {"RUNNING_MODAL"} and asked[0]["message"] == jobs.LOST_EDITS
    steps = 0
    assert invoke() == {"FINISHED"}, "splats of another program do not change"


class _Process:
    """Stands in for the backend's process."""

    exit_code = None

    def __init__(self, command, *_, **__):
        self.command, self.sent, self.events = command, [], []

    def poll(self):
        events, self.events = self.events, []
        return events

    def send(self, line: str, replaces: bool = False) -> bool:
        self.sent.append(json.loads(line))
        return True

    def kill(self) -> None: ...


@pytest.fixture
def session(root, monkeypatch):
    monkeypatch.setattr(pointing, "BackendProcess", _Process)
    pointing.start(root)
    yield pointing._session
    pointing.stop()


def answer(session, objects, classes, /, **other):
    packed = base64.b64encode(zlib.compress(np.array(classes, "u1").tobytes())).decode()
    event = {"type": "answer", "request": session.asked, "objects": objects, "kind": "u1", "first": 0}
    return session.take({**event, "classes": packed, **other})


def test_answers_are_shown_and_end_with_the_strokes(root, session):
    count = len(session.keys)
    assert session.take({"type": "answer", "ready": True, "splats": count}) is None and session.ready
    marks.add_object(root)
    marks.add_stroke(root, 3, views(root)[0], [(1, 1)], area=False)
    assert session.process.sent[-1]["request"] == session.asked == 1
    answer(session, [3], [0] * count)
    assert session.objects[session.classes].tolist() == [3] * count and pointing.state() == (1.0, False)
    marks.clear(root)
    assert not session.objects[session.classes].any() and not pointing.state()[1]


@pytest.mark.parametrize("state", [State.DONE, State.STOPPED, State.FAILED])
def test_marks_stay_in_the_viewport_while_their_objects_are_separated(root, session, monkeypatch, state):
    session.take({"type": "answer", "ready": True, "splats": len(session.keys)})
    marks.add_object(root)
    marks.add_stroke(root, 3, views(root)[0], [(1, 1)], area=False)
    answer(session, [3], [0] * len(session.keys))
    pointing.show()

    def are_colored():
        return any(obj.labels is not None for obj in gather(placed_parts(bpy.context.view_layer)))

    app = SimpleNamespace(background=False, timers=SimpleNamespace(is_registered=lambda _function: True))
    job = locations.backend_job("Objects", "label", blender_scene.folder_of(root), "label")
    with monkeypatch.context() as patched:
        patched.setattr(background, "bpy", SimpleNamespace(app=app))
        background.submit(job, bpy.context.scene, print)
    assert not pointing.is_active(root) and are_colored()
    background.queue.jobs.remove(job)
    job.state = state
    background._handle_end(job)
    background._results.clear()
    assert not are_colored()


def test_splats_that_no_stroke_has_marked_are_told_after_the_separation(root, monkeypatch):
    told = []
    monkeypatch.setattr(messages, "show", lambda text, **options: told.append((text, options["operator"])))
    job = locations.backend_job("Separate objects of table", "label", blender_scene.folder_of(root), "label")
    show = results.SHOW_BY_KIND["label"]
    assert show(job, bpy.context.scene) and not told, "corrected masks"
    job.command += ["--strokes", "strokes.json"]
    show(job, bpy.context.scene)
    assert "Separate objects of table: 25 % of the splats belong to no object" in told[0][0]
    assert told[0][1] == "objectgs.start_marking"
    for counts in ({0: 1, 1: 199}, {0: 120, 1: 80}):
        monkeypatch.setattr(results.object_list, "splat_counts", lambda _, counts=counts: counts)
        show(job, bpy.context.scene)
    assert len(told) == 1, "hardly any, or the surroundings"


@pytest.mark.parametrize(("kind", "goes_on"), [("export", True), ("fill", True), ("train", False), ("film", False)])
def test_jobs_end_the_marking_only_if_they_change_what_is_marked(root, session, monkeypatch, kind, goes_on):
    told = []
    monkeypatch.setattr(messages, "show", lambda text, *_: told.append(text))
    app = SimpleNamespace(background=False, timers=SimpleNamespace(is_registered=lambda _function: True))
    job = locations.backend_job("Job", kind, blender_scene.folder_of(root), kind)
    with monkeypatch.context() as patched:
        patched.setattr(background, "bpy", SimpleNamespace(app=app))
        background.submit(job, bpy.context.scene, print)
    background.queue.jobs.remove(job)
    background._submitted_in.clear()
    assert pointing.is_active(root) is goes_on
    assert any("Marking has ended for Job" in text for text in told) is not goes_on


def test_marks_are_shown_on_splats_that_a_job_has_changed(root, session, monkeypatch):
    session.take({"type": "answer", "ready": True, "splats": len(session.keys)})
    item = marks.add_object(root)
    marks.add_stroke(root, item.object_id, views(root)[0], [(1, 1)], area=False)
    answer(session, [item.object_id], [0] * len(session.keys))
    shown = []
    monkeypatch.setattr(drawing, "show_labels", lambda labels, _colors: shown.append(labels))
    background.finish(locations.backend_job("Job", "fill", blender_scene.folder_of(root), "edit"))
    assert shown


def test_one_list_of_objects_is_open(root, session):
    """Once the objects are separated, the list of the marked ones has the same names, unless they are being marked."""
    marks.add_object(root)
    assert "OBJECTGS_UL_marked" in texts_of(MarkingPanel)
    pointing.stop()
    assert "OBJECTGS_UL_marked" not in texts_of(MarkingPanel)
    assert "Marked Objects" in texts_of(MarkingPanel) and "objectgs.separate_marked" in texts_of(MarkingPanel)
    root.objectgs.objects.clear()
    assert "OBJECTGS_UL_marked" in texts_of(MarkingPanel)


def lines_of(root) -> list:
    return stroke_lines.lines(root, bpy.context.view_layer, None)


def test_lines_of_strokes_stay_until_the_strokes_are_answered(root, session):
    """From any side, they are on what they were drawn over, in the color of their object."""
    item = marks.add_object(root)
    at = world_of(root)
    for view in views(root):
        middle = pixel(view, at)
        drawn = [tuple(middle + np.array(off)) for off in ((-60, 5), (0, 0), (30, -9))]
        marks.add_stroke(root, item.object_id, view, drawn, area=False)
        points, color = lines_of(root)[-1]
        assert np.allclose([pixel(view, point) for point in points], drawn, atol=0.2)
        assert np.linalg.norm(points - at, axis=1).max() < 4 and np.allclose(color, item.color)
    marks.add_stroke(root, marks.NOTHING, views(root)[0], [tuple(middle)] * 2, area=False)
    points, color = lines_of(root)[-1]
    assert np.ptp(points, axis=0).max() > 0 and color == (1.0, 1.0, 1.0), "a click"
    marks.add_stroke(root, 1, views(root)[0], [(1, 1), (9, 1), (9, 9)], area=True)
    points = lines_of(root)[-1][0]
    assert len(lines_of(root)) == 4 and np.array_equal(points[0], points[-1])
    session.take({"type": "answer", "ready": True, "splats": len(session.keys)})
    session.ask(marks.content(root))
    assert len(lines_of(root)) == 4
    answer(session, [item.object_id], [0] * len(session.keys))
    assert not lines_of(root)
    marks.add_stroke(root, 2, views(root)[0], [(5, 5), (9, 5)], area=False)
    assert len(lines_of(root)) == 1
    session.take({"type": "answer", "request": session.asked, "problem": "Stroke 5 shows no splats", "stroke": 5})
    assert not lines_of(root)


def test_lines_of_many_strokes_on_a_large_scene_do_not_block_blender(root, session, monkeypatch):
    """A redraw places them in few of the splats, and no more than it has time for."""
    counts, place = [], stroke_lines.on_surface
    monkeypatch.setattr(stroke_lines, "on_surface", lambda *given: counts.append(len(given[1])) or place(*given))
    monkeypatch.setattr(stroke_lines, "_MOST_POINTS", 50)
    monkeypatch.setattr(stroke_lines, "_AT_ONCE", 0.0)
    other = bpy.data.collections.new("other")
    middle = pixel(views(root)[0], world_of(root))
    for i in range(3):
        marks.add_stroke(root, 1, views(root)[0], [tuple(middle), tuple(middle + i + 1)], area=False)
    for known in (1, 2, 3):
        assert len(lines_of(root)) == known
        assert bpy.app.timers.is_registered(drawing.redraw) is (known < 3)
        if known < 3:
            bpy.app.timers.unregister(drawing.redraw)
        assert not stroke_lines.lines(other, bpy.context.view_layer, None), "in another window"
    assert len(counts) == 3 and 0 < max(counts) <= 50


def test_no_line_is_drawn_of_strokes_that_are_replaced_or_have_no_camera(root, session):
    marks.add_stroke(root, 1, views(root)[0], [(1, 1), (9, 1)], area=False)
    pointing.propose(root)
    assert not lines_of(root)
    marks.set_proposed(root, PROPOSED)
    assert len(pointing.waiting_strokes(root)) == 4 and not lines_of(root)


def test_panel_asks_for_the_surroundings_of_a_single_object(root, session):
    view = views(root)[0]
    session.take({"type": "status", "message": "Comparing the splats"})
    assert "Comparing the splats" in texts_of(MarkingPanel)
    marks.add_stroke(root, 1, view, [(1, 1), (9, 1)], area=False)
    assert "Comparing the splats. Strokes are applied when this is done" in texts_of(MarkingPanel)
    session.take({"type": "answer", "ready": True, "splats": len(session.keys)})
    answer(session, [1], [0] * len(session.keys))
    assert "mark what it stands on, too" in texts_of(MarkingPanel)
    marks.add_stroke(root, 2, view, [(5, 5), (9, 5)], area=False)
    answer(session, [1, 2], [0] * len(session.keys))
    assert "stands on" not in texts_of(MarkingPanel) and "the next object" in texts_of(MarkingPanel)


def test_panel_advises_to_train_before_objects_are_marked(root):
    assert "Draw over each object in the viewport" in texts_of(MarkingPanel)
    (blender_scene.folder_of(root) / "splats.ply").unlink()
    assert "Train first" in texts_of(MarkingPanel)


def test_panel_says_why_marks_are_not_shown(root, session):
    assert "not shown" not in texts_of(MarkingPanel)
    bpy.context.scene.objectgs.draw_splats = False
    assert "switch Draw Splats on" in texts_of(MarkingPanel)
    pointing.stop()
    assert "not shown" not in texts_of(MarkingPanel)


def test_panel_says_that_marks_are_not_shown_where_drawing_has_failed(root, session, monkeypatch):
    monkeypatch.setattr(viewport, "_failure", "no memory")
    assert "The marks are not shown: no memory" in texts_of(MarkingPanel)


def test_strokes_are_answered_with_the_model_of_the_preferences(root, monkeypatch, tmp_path):
    monkeypatch.setattr(pointing, "BackendProcess", _Process)
    for chosen, options in (("", []), (str(tmp_path / "sam2"), ["--segmenter", str(tmp_path / "sam2")])):
        own = SimpleNamespace(segmenter=chosen, backend_python="", reconstructions="")
        monkeypatch.setattr(locations, "preferences", lambda own=own: own)
        pointing.start(root)
        command = pointing._session.process.command
        pointing.stop()
        assert command[command.index("point") + 2 :] == [*options, "--json"]


def test_a_model_chosen_while_marking_is_used_from_the_next_stroke_on(root, session, monkeypatch, tmp_path):
    """Until then, the panel and the separation go by the model that the strokes are shown with."""
    submitted = []
    monkeypatch.setattr(background, "submit", lambda job, *_: submitted.append(job) or {"FINISHED"})
    marks.add_stroke(root, marks.add_object(root).object_id, views(root)[0], [(1, 1)], area=False)
    own = SimpleNamespace(segmenter=str(tmp_path / "sam2"), backend_python="", reconstructions="")
    monkeypatch.setattr(locations, "preferences", lambda: own)
    for is_used in (False, True):
        assert ("all that sam2 segments" in texts_of(MarkingPanel)) is is_used
        bpy.ops.objectgs.separate_marked()
        assert ("--segmenter" in submitted[-1].command) is is_used
        pointing.start(root)
        again = pointing._session
        assert again is not session and again.process.command[-3:-1] == ["--segmenter", own.segmenter]
    pointing.start(root)
    assert pointing._session is again


@pytest.mark.parametrize("is_ready", [False, True])
def test_a_model_chosen_while_objects_are_suggested_tells_of_the_end(root, session, monkeypatch, tmp_path, is_ready):
    told = []
    monkeypatch.setattr(messages, "show", lambda text, *_: told.append(text))
    session.ready = is_ready
    for number, repeat in enumerate((pointing.propose, pointing.start)):
        pointing.propose(root)
        own = SimpleNamespace(segmenter=str(tmp_path / f"model {number}"), backend_python="", reconstructions="")
        monkeypatch.setattr(locations, "preferences", lambda own=own: own)
        repeat(root)
        assert len(told) == number
    assert "model has changed, so Suggest Objects was canceled" in told[0] == pointing._session.said


PROPOSED = {
    "everything": True,
    "strokes": [
        *({"object": number, "view": "a.png", "points": [[0.1, 0.2], [0.3, 0.2]], "exact": True}
          for number in (1, 2, 2)),
        {"object": 3, "camera": {"width": 400}, "points": [[0.1, 0.2], [0.3, 0.2]], "exact": True},
    ],
}  # fmt: skip


def test_proposed_objects_replace_the_marked_ones_and_can_be_merged(root, session):
    root.objectgs.objects.clear()
    root.objectgs.objects.add().object_id = 2
    marks.add_object(root)
    marks.add_stroke(root, 1, views(root)[0], [(1, 1)], area=False)
    root.objectgs.detail = 0.5
    pointing.propose(root)
    assert not any("propose" in each for each in session.process.sent), "the process is not ready"
    session.take({"type": "answer", "ready": True, "splats": len(session.keys)})
    session.propose(0.5)
    assert session.process.sent[-1] == {"request": session.asked, "propose": True, "detail": 0.5}
    assert pointing.state()[1]
    session.take({"type": "answer", "request": session.asked, "proposed": PROPOSED})
    pointing._show_proposed(root, session)
    assert [item.object_id for item in root.objectgs.marked] == [1, 3, 4], "2 is taken"
    content = marks.content(root)
    assert content["everything"] is True and [each["object"] for each in content["strokes"]] == [1, 3, 3, 4]
    assert [each.get("view") for each in content["strokes"]] == ["a.png"] * 3 + [None]
    assert content["strokes"][3]["camera"] == {"width": 400}
    assert session.process.sent[-1]["strokes"] == content["strokes"], "their splats are asked for"
    root.objectgs.active_marked = 0
    bpy.ops.objectgs.merge_marked(into="2")
    assert [item.object_id for item in root.objectgs.marked] == [3, 4]
    assert [each["object"] for each in marks.strokes_of(root)] == [4, 3, 3, 4]
    assert marks.active_object(root).object_id == 4
    bpy.ops.objectgs.merge_marked(into="0")
    parts = [(each["object"], each.get("part", 0)) for each in marks.strokes_of(root)]
    assert parts == [(3, 2), (3, 0), (3, 0), (3, 1)], "what was an object stays a part of its own"
    assert all(each["exact"] for each in marks.strokes_of(root))


def test_marks_stay_if_no_objects_are_proposed(root, session):
    session.take({"type": "answer", "ready": True, "splats": len(session.keys)})
    marks.add_stroke(root, marks.add_object(root).object_id, views(root)[0], [(1, 1)], area=False)
    before = (len(root.objectgs.marked), marks.content(root))
    session.propose(0.6)
    session.take({"type": "answer", "request": session.asked, "proposed": {"strokes": [], "everything": True}})
    pointing._show_proposed(root, session)
    assert (len(root.objectgs.marked), marks.content(root)) == before and "No objects were found" in session.said


def test_marks_and_suggestions_do_not_cancel_each_other_silently(root, session, monkeypatch):
    told = []
    monkeypatch.setattr(messages, "show", lambda text, *_: told.append(text))
    marks.add_stroke(root, marks.add_object(root).object_id, views(root)[0], [(1, 1)], area=False)
    pointing.propose(root)
    session.process.events = [{"type": "answer", "ready": True, "splats": len(session.keys)}]
    pointing._tick()
    assert [each["request"] for each in session.process.sent] == [1] and session.process.sent[0]["propose"]
    session.process.events = [{"type": "answer", "request": 1, "proposed": {"strokes": [], "everything": True}}]
    pointing._tick()
    assert session.process.sent[-1]["strokes"] == marks.strokes_of(root), "the marks that are kept are asked for"
    session.propose(0.5)
    marks.add_stroke(root, 1, views(root)[0], [(2, 2)], area=False)
    assert "Suggest Objects was canceled" in told[-1]
    count = len(told)
    marks.add_stroke(root, 1, views(root)[0], [(3, 3)], area=False)
    assert len(told) == count
    pointing.propose(root)
    pointing.refresh(root)
    assert session.is_proposing and len(told) == count, "as after an undo of something else"
    root.objectgs.everything = True
    pointing.propose(root)
    marks.clear(root)
    assert not session.is_proposing and "Suggest Objects was canceled" in told[-1] == session.said


def test_an_undo_of_something_else_asks_for_nothing(root, session):
    session.take({"type": "answer", "ready": True, "splats": len(session.keys)})
    item = marks.add_object(root)
    marks.add_stroke(root, item.object_id, views(root)[0], [(1, 1)], area=False)
    session.say("Vase took 12 % of Box", passes=True)
    item.name = "can"
    pointing.refresh(root)
    assert len(session.process.sent) == 1 and session.said
    root.objectgs.everything = True
    assert len(session.process.sent) == 2 and not session.said
    session.propose(0.5)
    session.take({"type": "answer", "request": session.asked, "proposed": {"strokes": [], "everything": True}})
    pointing.refresh(root)
    assert len(session.process.sent) == 4, "the strokes may not have been answered before the suggestion"


def test_strokes_during_the_preparation_cancel_a_suggestion(root, session, monkeypatch):
    told = []
    monkeypatch.setattr(messages, "show", lambda text, *_: told.append(text))
    pointing.propose(root)
    marks.add_stroke(root, marks.add_object(root).object_id, views(root)[0], [(1, 1)], area=False)
    assert "Suggest Objects was canceled" in told[-1]
    session.process.events = [{"type": "answer", "ready": True, "splats": len(session.keys)}]
    pointing._tick()
    assert session.process.sent[-1]["strokes"] == marks.strokes_of(root) and not session.is_proposing


def test_new_objects_do_not_get_ids_of_merged_ones(root):
    for _ in range(2):
        item = marks.add_object(root)
        marks.add_stroke(root, item.object_id, views(root)[0], [(1, 1)], area=False)
    known = {item.object_id for item in root.objectgs.marked}
    marks.merge_object(root, 1, 0)
    assert marks.add_object(root).object_id not in known


def test_colors_of_marked_objects_are_shown_when_they_are_set(root, session, monkeypatch):
    session.take({"type": "answer", "ready": True, "splats": len(session.keys)})
    item = marks.add_object(root)
    marks.add_stroke(root, item.object_id, views(root)[0], [(1, 1)], area=False)
    answer(session, [0, item.object_id], np.arange(len(session.keys)) % 2)
    pointing.show()
    shown = []
    monkeypatch.setattr(drawing, "show_labels", lambda _labels, colors: shown.append(colors))
    item.color = (0.25, 0.5, 0.75)
    item.color = (0.25, 0.5, 0.75)
    marks.add_object(root)
    assert len(shown) == 1 and np.allclose(shown[0], (0.25, 0.5, 0.75)), "once, and not for an object without splats"


def test_invalid_proposals_end_the_process_with_a_sentence(root, session):
    session.take({"type": "answer", "ready": True, "splats": len(session.keys)})
    session.propose(0.6)
    session.take({"type": "answer", "request": session.asked, "proposed": {"strokes": [{}]}})
    pointing._show_proposed(root, session)
    assert "not valid" in session.failure


def test_answers_to_earlier_strokes_are_ignored(root, session):
    session.take({"type": "answer", "ready": True, "splats": len(session.keys)})
    for _ in range(2):
        marks.add_stroke(root, 3, views(root)[0], [(1, 1)], area=False)
    answer(session, [3], [0] * len(session.keys), request=1)
    assert pointing.state()[1] and not session.objects[session.classes].any()
    assert session.take({"type": "answer", "request": 2, "problem": "Stroke 2 shows no splats", "stroke": 2}) == 2


def test_a_renamed_object_has_its_new_name_among_the_marks(root):
    marks.add_object(root)
    marked = root.objectgs.marked[0]
    row = next(item for item in root.objectgs.objects if item.object_id == 1)
    marked.object_id = row.object_id
    row.name = "  old   cup "
    assert marked.name == row.name == "old cup"
    row.name = ""
    assert marked.name == row.name == "old cup"


def test_a_problem_is_shown_until_the_marks_change(root, session, monkeypatch):
    shown = {}
    monkeypatch.setattr(messages, "show", lambda text, kind: shown.update({text: kind}))
    monkeypatch.setattr(messages, "withdraw", lambda text: shown.pop(text, None))
    session.take({"type": "answer", "ready": True, "splats": len(session.keys)})

    def draw():
        marks.add_stroke(root, 3, views(root)[0], [(1, 1)], area=False)

    def refuse():
        problem = "Stroke 1 shows no splats"
        session.process.events = [{"type": "answer", "request": session.asked, "problem": problem, "stroke": 1}]
        pointing._tick()

    draw()
    refuse()
    assert shown == {"A stroke shows no splats": "ERROR"} and not marks.strokes_of(root)
    draw()
    assert not shown
    refuse()
    session.propose(0.5)
    session.process.events = [{"type": "answer", "request": session.asked, "proposed": PROPOSED}]
    pointing._tick()
    assert list(shown.values()) == ["INFO"]
    draw()
    assert len(shown) == 1, "what to do with proposed objects is of use for longer"
    pointing.stop()
    assert not shown


def test_what_a_stroke_took_most_of_is_found_among_many_objects(session):
    rng = np.random.default_rng(0)
    session.objects = np.array([7, marks.NOTHING, 30, 2, 9, 4])
    for takers in ((2,), (9, 30), (marks.NOTHING,)):
        session.classes = rng.choice(5, len(session.keys))  # The last object has no splats.
        owners = session.objects[rng.integers(0, 6, len(session.keys))]
        session._asked_strokes = [{"object": taker} for taker in takers]
        before = session.objects[session.classes]
        shares = {
            (taker, loser): float((owners[before == loser] == taker).mean())
            for taker in takers
            for loser in set(before.tolist()) - {taker, marks.NOTHING}
            if taker != marks.NOTHING
        }
        taken = session._most_taken(owners)
        assert taken is None if not shares else taken[2] == shares[taken[:2]] == max(shares.values())


def test_a_stroke_that_takes_a_part_of_another_object_says_so(root, session, monkeypatch):
    shown = {}
    monkeypatch.setattr(messages, "show", lambda text, kind: shown.update({text: kind}))
    monkeypatch.setattr(messages, "withdraw", lambda text: shown.pop(text, None))
    session.take({"type": "answer", "ready": True, "splats": len(session.keys)})
    root.objectgs.objects.clear()
    place = views(root)[0]

    def draw(object_id, counts):
        """Draw over an object, after which objects 0, 1 and 2 have these numbers of splats, in this order."""
        marks.add_stroke(root, object_id, place, [(1, 1)], area=False)
        assert not shown
        answer(session, [0, 1, 2], np.repeat([0, 1, 2], counts))
        pointing._tick()

    for object_id, name in ((1, "Box"), (2, "Vase")):
        marks._add_row(root, object_id).name = name
    draw(1, (0, 200, 0))
    draw(2, (0, 192, 8))
    assert not shown, "4 % is not noticeable"
    draw(2, (0, 168, 32))
    assert list(shown) == ["Vase took 12 % of Box; if it should not, draw over the lost part of Box again"]
    draw(marks.NOTHING, (100, 68, 32))
    assert not shown, "it was taken away on purpose"
    marks.remove_stroke(root, 2)
    answer(session, [0, 1, 2], np.repeat([0, 1, 2], (0, 0, 200)))
    pointing._tick()
    assert not shown, "nothing was drawn"


@pytest.mark.parametrize(
    "change",
    [
        {"classes": "?"}, {"classes": base64.b64encode(b"no zlib").decode()}, {"kind": "nonsense"}, {"objects": []},
        {"objects": "x"}, {"objects": None},
    ],
)  # fmt: skip
def test_invalid_answers_end_the_process_with_a_sentence(root, session, change):
    session.take({"type": "answer", "ready": True, "splats": len(session.keys)})
    marks.add_stroke(root, 3, views(root)[0], [(1, 1)], area=False)
    answer(session, [3], [0] * len(session.keys), **change)
    assert "not valid" in session.failure
    session.failure = ""
    answer(session, [3], [0] * (len(session.keys) + 1))
    assert "not valid" in session.failure


def test_lines_of_strokes_have_a_dark_outline(monkeypatch):
    """A white line alone is lost on white objects."""
    drawn, now = [], {}
    shader = SimpleNamespace(uniform_float=now.__setitem__)
    batch = SimpleNamespace(draw=lambda _shader: drawn.append((sum(now["color"][:3]), now["lineWidth"])))
    state = SimpleNamespace(blend_set=lambda _mode: None, viewport_get=lambda: (0, 0, 80, 60))
    made = SimpleNamespace(from_builtin=lambda _name: shader)
    monkeypatch.setattr(stroke_lines, "gpu", SimpleNamespace(shader=made, state=state))
    monkeypatch.setattr(stroke_lines, "batch_for_shader", lambda *_: batch)
    system = SimpleNamespace(system=SimpleNamespace(ui_scale=2.0))
    monkeypatch.setattr(stroke_lines, "bpy", SimpleNamespace(context=SimpleNamespace(preferences=system)))
    stroke_lines.draw_line([(1, 2), (30, 40)])
    (outline, wide), (line, narrow) = drawn
    assert outline == 0 and line == 3 and wide > narrow + 2 and now["viewportSize"] == (80, 60)


def test_splats_of_another_training_are_refused(session):
    session.take({"type": "answer", "ready": True, "splats": 7})
    assert not session.ready and "train or separate again" in session.failure
