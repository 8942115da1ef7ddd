# SPDX-License-Identifier: GPL-3.0-or-later
"""Picking of points and objects by a click."""

from types import SimpleNamespace

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

from objectgs.objectgs_addon import scene
from objectgs.objectgs_addon.drawing import splat_arrays
from objectgs.objectgs_addon.picking import hit_test
from objectgs.objectgs_addon.picking import tool as pick_tool
from objectgs.objectgs_addon.picking.point_picker import PointPicker, nearest
from objectgs.objectgs_addon.scene import carrier, kinds
from objectgs.objectgs_addon.scene.shading.node_groups import HIDDEN
from objectgs.operators.selection import pick_object

from .building import write_folder

SIZE = (200, 100)


def perspective(near=0.1, far=100.0):
    """Return the world-to-clip matrix of a camera at the origin that looks along -Z, 90 degrees wide."""
    aspect = SIZE[0] / SIZE[1]
    return np.array(
        [
            [1, 0, 0, 0],
            [0, aspect, 0, 0],
            [0, 0, -(far + near) / (far - near), -2 * far * near / (far - near)],
            [0, 0, -1, 0],
        ]
    )


def test_click_picks_nearest_point():
    points = np.array([[0.0, 0, -5], [1, 0, -5]])
    assert nearest(points, perspective(), SIZE, np.array([100, 50]), 12) == 0
    assert nearest(points, perspective(), SIZE, np.array([121, 51]), 12) == 1
    assert nearest(points, perspective(), SIZE, np.array([160, 80]), 12) is None


def test_click_is_in_one_of_four_views():
    """In Quad View, each has its own view of the points."""

    def region(x, y, matrix, kind="WINDOW"):
        data = SimpleNamespace(perspective_matrix=matrix)
        return SimpleNamespace(type=kind, x=x, y=y, width=SIZE[0], height=SIZE[1], data=data)

    from_behind = perspective() @ np.diag([-1.0, 1, -1, 1])
    regions = [region(0, 200, None, "HEADER"), region(0, 0, perspective()), region(200, 0, from_behind)]
    picker = PointPicker.__new__(PointPicker)
    picker.positions, picker.picked = np.array([[0.0, 0, -5], [0, 0, 5]]), []
    context = SimpleNamespace(area=SimpleNamespace(regions=regions))
    for x, y, expected in ((100, 50, (0, 0, -5)), (300, 50, (0, 0, 5)), (300, 150, None)):
        found = picker.pick(context, SimpleNamespace(mouse_x=x, mouse_y=y))
        assert found == (expected is not None) and (not found or picker.picked[-1] == expected)


def test_front_point_occludes_point_behind():
    points = np.array([[0.0, 0, -9], [0.02, 0, -3]])
    assert nearest(points, perspective(), SIZE, np.array([100, 50]), 12) == 1


def test_points_behind_camera_are_not_picked():
    points = np.array([[0.0, 0, 5], [np.nan, 0, -5], [0, 0, 0]])
    assert nearest(points, perspective(), SIZE, np.array([100, 50]), 12) is None
    assert nearest(np.zeros((0, 3)), perspective(), SIZE, np.array([100, 50]), 12) is None


def test_faint_and_hidden_splats_are_not_picked(fresh, tmp_path):
    folder = write_folder(tmp_path / "folder")
    root = scene.show_capture(bpy.context.scene, folder)
    scene.show_result(root, folder)
    for obj in bpy.context.view_layer.objects:
        obj.hide_viewport = scene.kind_of(obj) not in ("splats", "object_parent", "parent")
    obj = kinds.part_of(scene.object_collections(root)[1], "splats")
    others = [each for each in bpy.data.objects if scene.kind_of(each) == "splats" and each != obj]
    for each in others:
        each.hide_viewport = True
    count = len(obj.data.vertices)
    colors = carrier.read(obj.data, "radiance:base")
    colors[:, 3] = 0.9
    colors[0, 3] = 0.1
    carrier.write(obj.data, "radiance:base", "FLOAT_COLOR", colors)
    carrier.write(obj.data, HIDDEN, "BOOLEAN", np.arange(count) == 1)
    splat_arrays.splats_changed(obj.data)
    bpy.context.view_layer.update()
    picker = PointPicker(root, bpy.context.view_layer, None)
    expected = [obj.matrix_world @ vertex.co for vertex in obj.data.vertices[2:]]
    np.testing.assert_allclose(picker.positions, np.array(expected), atol=1e-5)
    obj.hide_viewport = True
    bpy.context.view_layer.update()
    assert not PointPicker(root, bpy.context.view_layer, None).has_points


def test_clicks_beside_splats_do_not_look_for_meshes(monkeypatch):
    """For its ray casts, Blender would build a search tree of each of the user's meshes."""
    looked = []
    view = SimpleNamespace(width=200, height=100)
    monkeypatch.setattr(hit_test, "view_of", lambda _: view)
    monkeypatch.setattr(hit_test, "_splats", lambda _: ({}, []))
    monkeypatch.setattr(hit_test, "pick", lambda *_: None)
    monkeypatch.setattr(hit_test, "_meshes", lambda _: [])
    monkeypatch.setattr(hit_test, "_mesh_at", lambda *_: looked.append(True) or (None, np.inf))
    event = SimpleNamespace(mouse_region_x=5, mouse_region_y=5)
    assert pick_object.ClickObject.invoke(None, None, event) == {"PASS_THROUGH"} and not looked
    assert hit_test.object_at(None, 5, 5) is None and looked


def test_clicks_need_a_reconstruction_in_the_file(fresh, monkeypatch):
    context = SimpleNamespace(region_data=True, mode="OBJECT", scene=bpy.context.scene)
    monkeypatch.setattr(hit_test, "draws_splats", lambda _: True)
    assert not pick_object.ClickObject.poll(context)
    bpy.data.collections.new("root")[kinds.KIND] = "reconstruction"
    assert pick_object.ClickObject.poll(context)


def test_meshes_shown_as_lines_do_not_block_clicks(fresh):
    mesh = bpy.data.meshes.new("cage")
    mesh.from_pydata([(0, 0, 0), (1, 0, 0), (0, 1, 0)], [], [(0, 1, 2)])
    cage = bpy.data.objects.new("cage", mesh)
    bpy.context.scene.collection.objects.link(cage)
    bpy.context.view_layer.update()
    context = SimpleNamespace(view_layer=bpy.context.view_layer, space_data=None)
    for kind, is_solid in (("TEXTURED", True), ("SOLID", True), ("WIRE", False), ("BOUNDS", False)):
        cage.display_type = kind
        assert hit_test._meshes(context) == [cage] * is_solid


def test_viewports_are_drawn_again_only_for_labels(monkeypatch):
    redrawn = []
    context = SimpleNamespace(area=SimpleNamespace(tag_redraw=lambda: redrawn.append(True)))
    event = SimpleNamespace(mouse_region_x=5, mouse_region_y=5)
    hit = hit_test.Hit(None, SimpleNamespace(name="cup"))
    for found, count in ((None, 0), (hit, 1), (hit, 2), (None, 3), (None, 3)):
        monkeypatch.setattr(hit_test, "object_at", lambda *_, found=found: found)
        monkeypatch.setattr(pick_object.PointAt, "_next", 0.0)
        assert pick_object.PointAt.invoke(None, context, event) == {"PASS_THROUGH"}
        assert len(redrawn) == count and pick_tool.is_pointing() == (found is not None)
