# SPDX-License-Identifier: GPL-3.0-or-later
"""Floaters in Blender: left out of previews and bounds, hidden by an edit; what else keeps the viewports clear."""

import json

import bpy
import numpy as np
import pytest
from objectgs.backend.shared.formats.ply import write_vertices
from objectgs.backend.shared.reconstruction.objects import edit_objects, read_objects
from objectgs.backend.shared.splats.floaters import floating, near_sphere
from objectgs.objectgs_addon import scene as blender_scene
from objectgs.objectgs_addon.drawing.splat_arrays import arrays_of
from objectgs.objectgs_addon.panels.capture import CapturePanel
from objectgs.objectgs_addon.scene import kinds
from objectgs.objectgs_addon.scene.edits import floaters
from objectgs.objectgs_addon.scene.shading import modifiers, node_groups
from objectgs.objectgs_addon.state import visibility

import headless

from .building import splat_table, write_folder, write_points
from .drawn import texts_of

STRAYS = np.array([(40.0, 0, 0), (0, -30.0, 0), (0, 0, 79.0)])
ORIGIN = np.array([100.0, -200.0, 30.0])


@pytest.fixture
def root(fresh, tmp_path, backend_python, monkeypatch):
    """A reconstruction of an object 1, a ball with radius 1 and three strays, and object 2, a ball without."""
    folder = write_folder(tmp_path / "table top")
    (folder / "anchors.ply").unlink()
    rng = np.random.default_rng(0)
    balls = rng.normal(size=(600, 3))
    balls /= np.linalg.norm(balls, axis=1, keepdims=True)
    balls[300:] += (4.0, 0, 0)
    table = splat_table(np.repeat([1, 2, 1], [300, 300, len(STRAYS)]))
    places = np.concatenate([balls, STRAYS])
    for axis, name in enumerate("xyz"):
        table[name] = places[:, axis]
    for axis in range(3):
        table[f"scale_{axis}"] = np.log(0.05)
    table["opacity"] = 3.0
    write_vertices(folder / "splats.ply", table)
    monkeypatch.setenv("OBJECTGS_PYTHON", backend_python)
    extension = headless.extension()
    extension.register()
    bpy.ops.objectgs.open_reconstruction(directory=str(folder))
    yield bpy.context.scene.objectgs.active
    extension.unregister()


def part(root, object_id=1, kind="splats"):
    return kinds.part_of(blender_scene.object_collections(root)[object_id], kind)


def size_of(obj) -> np.ndarray:
    """Return the size (3,) of the box by which Blender frames an object."""
    bpy.context.view_layer.update()
    bpy.context.evaluated_depsgraph_get()
    return np.ptp(np.array(obj.bound_box), axis=0)


def hidden(root, object_id=1) -> int:
    mask = blender_scene.hidden_splats(part(root, object_id).data)
    return 0 if mask is None else int(mask.sum())


def cleaned(root) -> list[int]:
    return [e.id for e in read_objects(blender_scene.folder_of(root) / "objects.json") if e.cleaned]


@pytest.mark.skipif(bpy.app.version < (4, 3), reason="Blender 4.2 does not give scripts the bounds of point clouds")
@pytest.mark.parametrize("preview", [True, False])
def test_bounds_leave_floaters_out(root, preview):
    obj = part(root)
    modifiers.show_preview(obj, preview)
    assert np.abs(size_of(obj) - 2.0).max() < 0.3
    assert len(arrays_of(obj.data).means) == 303, "they are still drawn"
    assert hidden(root) == 0, "they are still rendered"


def test_box_of_drawn_splats_is_invisible(root):
    """While splats are drawn, the carrier is the corners of their box, as points of radius 0."""
    obj = part(root)
    modifiers.show_preview(obj, False)
    bpy.context.view_layer.update()
    shape = obj.evaluated_get(bpy.context.evaluated_depsgraph_get())
    if hasattr(shape, "evaluated_geometry"):
        geometry = shape.evaluated_geometry()  # Without it, its parts are removed.
        points = geometry.pointcloud
        assert len(points.attributes["position"].data) == 8
        assert {value.value for value in points.attributes["radius"].data} == {0.0}
    assert len(shape.data.vertices) == 0


def test_far_points_of_the_capture_are_left_out(root):
    rng = np.random.default_rng(0)
    folder = blender_scene.folder_of(root)
    write_points(folder, np.concatenate([rng.uniform(-1, 1, (200, 3)), STRAYS]), np.zeros(203, int))
    blender_scene.show_objects(root, folder)
    points = kinds.points_of(root)
    points.hide_viewport = False
    assert len(points.data.vertices) == 203
    assert size_of(points).max() < 2.5


def test_distant_surroundings_do_not_count_for_the_view(root):
    """The sky of a capture, ten times as far as its points, is drawn, but Blender frames the rest."""
    folder = blender_scene.folder_of(root)
    rng = np.random.default_rng(0)
    write_points(folder, rng.uniform(-2, 5, (200, 3)), np.ones(200, int))
    blender_scene.show_objects(root, folder)
    table = splat_table(np.repeat([1, 0], [300, 400]))
    places = rng.normal(size=(700, 3))
    places *= np.repeat([1.0, 60.0], [300, 400])[:, None] / np.linalg.norm(places, axis=1)[:, None]
    for axis, name in enumerate("xyz"):
        table[name] = places[:, axis]
    write_vertices(folder / "splats.ply", table)
    blender_scene.show_result(root, folder)
    sky = part(root, 0)
    assert len(sky.data.vertices) == 400 and len(arrays_of(sky.data).means) == 400
    evaluated = sky.evaluated_get(bpy.context.evaluated_depsgraph_get())
    assert np.ptp(np.array(evaluated.bound_box)) == 0 and 1.5 < size_of(part(root)).max() < 3
    assert bpy.ops.objectgs.clean_floaters(everything=True) == {"FINISHED"}
    assert hidden(root, 0) == floating(places[300:]).sum(), "as the backend's export does"


def test_points_are_measured_once_for_all_objects(root, monkeypatch):
    measured = []
    monkeypatch.setattr(floaters, "near_sphere", lambda points: measured.append(len(points)) or near_sphere(points))
    blender_scene.show_result(root, blender_scene.folder_of(root))
    assert measured == [len(kinds.points_of(root).data.vertices)]


def test_clean_floaters_is_an_edit_of_the_object(root):
    assert bpy.ops.objectgs.clean_floaters() == {"FINISHED"}
    assert cleaned(root) == [1] and hidden(root) == 3 and hidden(root, 2) == 0
    positions = np.array([vertex.co for vertex in part(root).data.vertices])
    shown = ~blender_scene.hidden_splats(part(root).data)
    assert np.array_equal(shown, ~floating(positions)) and np.ptp(positions[shown], axis=0).max() < 2.1
    assert len(arrays_of(part(root).data).means) == 300
    blender_scene.show_result(root, blender_scene.folder_of(root))
    assert hidden(root) == 3, "a refresh keeps them hidden"
    assert bpy.ops.objectgs.clean_floaters(restore=True) == {"FINISHED"}
    assert cleaned(root) == [] and hidden(root) == 0


def test_clean_floaters_of_all_objects(root):
    assert bpy.ops.objectgs.clean_floaters(everything=True) == {"FINISHED"}
    assert cleaned(root) == [1, 2] and hidden(root) == 3


def test_undo_restores_floaters(root):
    bpy.ops.ed.undo_push(message="begin")
    bpy.ops.objectgs.clean_floaters()
    bpy.ops.ed.undo_push(message="cleaned")
    bpy.ops.ed.undo()
    root = bpy.context.scene.objectgs.active
    assert cleaned(root) == [] and hidden(root) == 0
    bpy.ops.ed.redo()
    root = bpy.context.scene.objectgs.active
    assert cleaned(root) == [1] and hidden(root) == 3


def test_deleted_splats_do_not_keep_others_from_floating(root):
    """The backend leaves them out, too, before it looks for floaters."""
    mesh = part(root).data
    positions = np.array([vertex.co for vertex in mesh.vertices])
    before, deleted = blender_scene.floating_splats(mesh), np.arange(len(positions)) < 295
    for attempt in range(2):
        if attempt == 0:
            blender_scene.select_splats(mesh, deleted)
            assert bpy.ops.objectgs.delete_splats() == {"FINISHED"}
        else:
            blender_scene.show_result(root, blender_scene.folder_of(root))
        found = blender_scene.floating_splats(mesh)
        assert not found[deleted].any() and not np.array_equal(found, before & ~deleted)
        assert np.array_equal(found[~deleted], floating(positions[~deleted]))


def test_edits_from_the_command_line_are_shown(root):
    edit_objects(blender_scene.folder_of(root) / "objects.json", {1: {"cleaned": True}})
    assert bpy.ops.objectgs.show_result() == {"FINISHED"}
    assert hidden(root) == 3


def test_carriers_of_older_versions_can_be_cleaned(root):
    """They have no stored floaters."""
    mesh = part(root).data
    mesh.attributes.remove(mesh.attributes[node_groups.FLOATING])
    assert blender_scene.floater_counts(root)[1] == 3
    bpy.ops.objectgs.clean_floaters()
    assert hidden(root) == 3


def test_capture_comes_after_objects(root):
    capture = kinds.capture_of(root)
    assert root.children[-1] == capture and len(root.children) == 3
    assert kinds.points_of(root).hide_viewport, "what is hidden stays hidden"
    assert capture.name not in bpy.context.scene.collection.children and len(bpy.data.collections) == 4
    blender_scene.show_result(root, blender_scene.folder_of(root))
    assert json.loads(root["objectgs_grouping"]) == {} and root.children[-1] == capture


def test_cameras_are_hidden_when_splats_replace_the_capture(root):
    """They would be in the way of strokes; the first panel shows them again."""
    layer = visibility.capture_layer(bpy.context.view_layer, root)
    cameras = [obj for obj in layer.collection.objects if obj.type == "CAMERA"]
    assert layer.hide_viewport and cameras and not any(obj.visible_get() or obj.hide_viewport for obj in cameras)
    assert "hide_viewport Cameras" in texts_of(CapturePanel)
    layer.hide_viewport = False
    blender_scene.show_result(root, blender_scene.folder_of(root))
    assert all(obj.visible_get() for obj in cameras), "what the user shows stays"
    for obj in cameras:
        bpy.data.objects.remove(obj)
    assert "hide_viewport Cameras" not in texts_of(CapturePanel)


def test_order_of_the_user_is_kept(root):
    capture = kinds.capture_of(root)
    root.children.unlink(first := root.children[0])
    root.children.link(first)
    assert root.children[-1] == first
    blender_scene.show_result(root, blender_scene.folder_of(root))
    assert root.children[-1] == first and capture in root.children[:]
