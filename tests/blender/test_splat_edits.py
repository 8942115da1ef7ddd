# SPDX-License-Identifier: GPL-3.0-or-later
"""Edits of single splats in Blender: selection, deletion, other objects, crop; undo, reopening, and the backend."""

import json
import shutil
import subprocess
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import bpy
import numpy as np
import pytest
from mathutils import Matrix
from objectgs.backend.shared.formats.ply import read_vertices, write_vertices
from objectgs.backend.shared.reconstruction.edits.splat_edits import inside_box, read_splat_edits
from objectgs.backend.shared.reconstruction.folder import Reconstruction
from objectgs.backend.shared.reconstruction.objects import edit_objects, read_objects
from objectgs.backend.shared.splats.picking import View
from objectgs.backend.shared.splats.regions import box_region, brush_region, lasso_region
from objectgs.objectgs_addon import drawing
from objectgs.objectgs_addon import scene as blender_scene
from objectgs.objectgs_addon.drawing import viewport
from objectgs.objectgs_addon.drawing.splat_arrays import arrays_of
from objectgs.objectgs_addon.picking import splat_selection, splats_tool
from objectgs.objectgs_addon.scene import carrier, kinds
from objectgs.objectgs_addon.scene.edits import single_splats
from objectgs.objectgs_addon.scene.shading import node_groups
from objectgs.objectgs_addon.state import object_edits, object_list, splat_edits

import headless

from .building import HUGE, OBJECTS, look_at, splat_table, write_cameras, write_folder

ORIGIN = np.array([100.0, -200.0, 30.0])


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """A turned folder far from the origin with 200 splats of three objects and of none; read-only."""
    place = write_folder(tmp_path_factory.mktemp("made") / "table top")
    upright = np.eye(4)
    upright[:3, :3] = np.array(Matrix.Rotation(0.7, 3, "X")) @ np.array(Matrix.Rotation(0.3, 3, "Z"))
    upright[:3, 3] = 1.0, 2.0, 3.0
    write_cameras(place, [look_at(ORIGIN + np.array([3, 0, 1]), ORIGIN)], origin=ORIGIN, upright=upright)
    splats = splat_table(np.resize([0, *OBJECTS], 200), degree=1)
    for axis, name in enumerate("xyz"):
        splats[name] += ORIGIN[axis]
        splats[f"scale_{axis}"] -= 3.0
    splats["opacity"] = np.abs(splats["opacity"])
    write_vertices(place / "splats.ply", splats)
    return place


@pytest.fixture
def folder(made, tmp_path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "table top"))


@pytest.fixture
def root(fresh, folder, backend_python, monkeypatch):
    """Root collection of the folder in a registered extension."""
    monkeypatch.setenv("OBJECTGS_PYTHON", backend_python)
    extension = headless.extension()
    extension.register()
    bpy.ops.objectgs.open_reconstruction(directory=str(folder))
    bpy.context.view_layer.update()
    yield active()
    extension.unregister()


def active():
    """Return the reconstruction's collection, which undo replaces."""
    return bpy.context.scene.objectgs.active


def part(object_id=1):
    return kinds.part_of(blender_scene.object_collections(active())[object_id], "splats")


def parts():
    return splat_edits.shown_parts(bpy.context, active())


def select(object_id, rows, mode="SET") -> None:
    """Select splats of an object by their positions among its visible ones."""
    wanted = arrays_of(part(object_id).data)

    def test(arrays, _matrix):
        return np.isin(np.arange(len(arrays.means)), rows) & (arrays is wanted)

    splat_selection.select(parts(), test, mode)


def edits(folder):
    return read_splat_edits(Reconstruction(folder))


def entry(folder, object_id):
    return next((e for e in read_objects(folder / "objects.json") if e.id == object_id), None)


def counts() -> dict[int, int]:
    """Return the numbers of splats in the list of objects."""
    return {blender_scene.from_stored(item.object_id): item.splats for item in active().objectgs.objects}


def shown(object_id=1) -> set[tuple]:
    """Return the captured positions, rounded, of an object's splats that are drawn."""
    obj = part(object_id)
    arrays = arrays_of(obj.data)
    center = np.array(obj.parent["objectgs_center"])
    return {tuple(row) for row in np.round(arrays.means.astype(float) + center + ORIGIN, 3).tolist()}


def exported(folder, backend_python, tmp_path) -> dict[int, set[tuple]]:
    """Return the rounded positions of the splats of each object that the backend exports."""
    out = tmp_path / "out.ply"
    subprocess.run(
        [backend_python, "-m", "backend", "export", folder, "--out", out],
        cwd=headless.ROOT, check=True, capture_output=True,
    )  # fmt: skip
    table = read_vertices(out)
    places = np.round(np.stack([table[axis] for axis in "xyz"], 1).astype(float), 3)
    return {
        int(i): {tuple(row) for row in places[table["object_id"] == i].tolist()} for i in np.unique(table["object_id"])
    }


def assert_agrees(folder, backend_python, tmp_path) -> None:
    """Check that Blender shows what the backend exports."""
    bpy.context.view_layer.update()
    wanted = exported(folder, backend_python, tmp_path)
    collections = blender_scene.object_collections(active())
    visible = {i for i, each in collections.items() if not blender_scene.is_removed(each) and shown(i)}
    assert visible == set(wanted)
    for object_id in wanted:
        assert shown(object_id) == wanted[object_id], object_id


# Selection.


def a_view(orthographic=False) -> View:
    """Return a view of the reconstruction from its camera."""
    camera = next(obj for obj in active().all_objects if blender_scene.kind_of(obj) == "camera")
    matrix = np.array(camera.matrix_world.inverted())
    focal = 90.0 if orthographic else 300.0
    viewmat = np.diag([1.0, -1.0, -1.0, 1.0]) @ matrix
    return View(viewmat, focal, focal, 200.0, 150.0, 400, 300, orthographic=orthographic)


def pixels(view, obj) -> np.ndarray:
    """Return the pixels (n, 2) of an object's visible splats by Blender's own arithmetic; NaN behind the camera."""
    found = []
    for mean in arrays_of(obj.data).means.tolist():
        x, y, z, _ = view.viewmat @ np.array(obj.matrix_world @ Matrix.Translation(mean))[:, 3]
        by = 1.0 if view.orthographic else z
        found.append((view.fx * x / by + view.cx, view.fy * y / by + view.cy) if z > view.near else (np.nan, np.nan))
    return np.array(found)


@pytest.mark.parametrize("orthographic", [False, True])
@pytest.mark.parametrize("shape", ["BRUSH", "LASSO", "BOX"])
def test_regions_select_by_the_centers_on_the_screen(root, shape, orthographic):
    kinds.part_of(blender_scene.object_collections(root)[1], "object_parent").location.x += 0.4
    bpy.context.view_layer.update()
    view = a_view(orthographic)
    region = {
        "BRUSH": lambda: brush_region(400, 300, [(120.0, 100.0), (260.0, 190.0)], 45.0),
        "LASSO": lambda: lasso_region(400, 300, [(60.0, 30.0), (350.0, 60.0), (210.0, 280.0)]),
        "BOX": lambda: box_region(400, 300, (90.0, 60.0), (290.0, 250.0)),
    }[shape]()
    count = splat_selection.select(parts(), splat_selection.within(view, region), "SET")
    total = 0
    for obj in parts():
        x, y = pixels(view, obj).T
        with np.errstate(invalid="ignore"):
            inside = (x >= 0) & (x < 400) & (y >= 0) & (y < 300)
        wanted = np.zeros(len(x), bool)
        wanted[inside] = region[y[inside].astype(int), x[inside].astype(int)]
        selected = blender_scene.selected_splats(obj.data)
        assert np.array_equal(selected, wanted)
        total += wanted.sum()
    assert count == total == splat_edits.count_selected(bpy.context, root) and 20 < total < 190


def test_modes_invert_all_and_none(root):
    select(1, range(10))
    select(2, range(5), "ADD")
    select(1, range(3), "SUBTRACT")
    assert splat_edits.count_selected(bpy.context, root) == 12
    assert bpy.ops.objectgs.select_all_splats(action="INVERT") == {"FINISHED"}
    assert splat_edits.count_selected(bpy.context, root) == 188
    select(2, [7])
    assert splat_edits.count_selected(bpy.context, root) == 1, "a new selection replaces that of all objects"
    bpy.ops.objectgs.select_all_splats(action="SELECT")
    assert splat_edits.count_selected(bpy.context, root) == 200
    blender_scene.object_collections(root)[2].hide_viewport = True
    bpy.context.view_layer.update()
    bpy.ops.objectgs.select_all_splats(action="DESELECT")
    assert splat_edits.count_selected(bpy.context, root) == 0
    assert blender_scene.selected_splats(part(2).data).all(), "what is hidden is not changed"
    assert not blender_scene.selected_splats(part(1).data).any()
    assert "objectgs_selected" not in part(1).data.attributes


def test_grow_and_shrink_follow_distance(root):
    select(1, [0])
    places = {}
    for obj in parts():
        world = np.array(obj.matrix_world)
        places[obj.name] = arrays_of(obj.data).means @ world[:3, :3].T + world[:3, 3]
    seed = places[part(1).name][0]
    bpy.ops.objectgs.grow_splats(distance=0.8)
    away = np.concatenate([np.linalg.norm(own - seed, axis=1) for own in places.values()])
    selected = np.concatenate([blender_scene.selected_splats(obj.data) for obj in parts()])
    assert selected[away < 0.8 * 0.13].all() and not selected[away > 0.8 * 1.87].any()
    assert 3 < selected.sum() < 150
    bpy.ops.objectgs.shrink_splats(distance=10.0)
    assert splat_edits.count_selected(bpy.context, root) == 0
    bpy.ops.objectgs.select_all_splats(action="SELECT")
    bpy.ops.objectgs.shrink_splats(distance=10.0)
    assert splat_edits.count_selected(bpy.context, root) == 200, "without others there is no border"
    select(1, [0])
    assert bpy.ops.objectgs.grow_splats() == {"FINISHED"}, "a distance of 0 is replaced by a suitable one"


def test_sphere_selects_around_the_surface(root):
    view = a_view()
    x, y = pixels(view, part(1))[4]
    depth = splat_selection.depth_at(parts(), view, x, y)
    assert depth is not None and depth > view.near
    center = np.array(part(1).matrix_world @ Matrix.Translation(arrays_of(part(1).data).means[4].tolist()))[:3, 3]
    splat_selection.select(parts(), splat_selection.within_sphere(center, 0.5), "SET")
    for obj in parts():
        world = np.array(obj.matrix_world)
        away = np.linalg.norm(arrays_of(obj.data).means @ world[:3, :3].T + world[:3, 3] - center, axis=1)
        assert np.array_equal(blender_scene.selected_splats(obj.data), away <= 0.5)


def test_visible_only_leaves_out_what_others_hide(root):
    """A wall of opaque splats in front of object 1 hides it, but not object 2 beside the wall."""
    obj = part(1)
    count = 900
    grid = np.stack(np.meshgrid(*2 * [np.linspace(-1, 1, 30)]), -1).reshape(-1, 2)
    view = a_view()
    back = np.linalg.inv(view.viewmat)
    wall = np.column_stack([grid * 0.4, np.full(count, 1.0)])
    hidden = np.column_stack([grid * 0.3, np.full(count, 2.0)])
    for own, places in ((part(2), wall), (obj, hidden)):
        local = np.linalg.inv(np.array(own.matrix_world)) @ back
        attributes = {
            "radiance:base": ("FLOAT_COLOR", np.tile([0.0, 0.0, 0.0, 0.95], (count, 1))),
            "scale": ("FLOAT_VECTOR", np.full((count, 3), 0.02)),
            "rotation": ("QUATERNION", np.tile([1.0, 0, 0, 0], (count, 1))),
        }
        carrier.fill(own.data, places @ local[:3, :3].T + local[:3, 3], attributes)
        drawing.splats_changed(own.data)
    everywhere = splat_selection.within(view, np.ones((300, 400), bool))
    assert splat_selection.select([part(1), part(2)], everywhere, "SET") == 2 * count
    test = splat_selection.only_visible(everywhere, parts(), view)
    splat_selection.select([part(1), part(2)], test, "SET")
    assert blender_scene.selected_splats(part(2).data).mean() > 0.95
    assert not blender_scene.selected_splats(part(1).data).any()


def test_drawing_gets_the_selection_and_keeps_the_splats(root):
    arrays = arrays_of(part(1).data)
    select(1, [3, 5])
    (drawn,) = drawing.gather.gather([drawing.gather.placed(part(1))])
    assert np.flatnonzero(drawn.selected).tolist() == [3, 5] and drawn.splats is arrays
    (again,) = drawing.gather.gather([drawing.gather.placed(part(1))])
    assert again.selected is drawn.selected, "an unchanged selection is not drawn anew"
    assert drawing.gather.gather([drawing.gather.placed(part(1))], marks=False)[0].selected is None
    select(1, [])
    assert drawing.gather.gather([drawing.gather.placed(part(1))])[0].selected is None


def test_selected_splats_are_marked_where_they_are_not_drawn(root, monkeypatch):
    """Without Draw Splats, and where drawing has failed, previews are shown, which do not highlight them."""
    select(1, [0, 1])
    marked, shown_parts = [], parts()
    batch = SimpleNamespace(draw=lambda _shader: marked.append(True))
    monkeypatch.setattr(splats_tool, "gpu", MagicMock())
    monkeypatch.setattr(splats_tool, "batch_for_shader", lambda *_: batch)
    space = SimpleNamespace(overlay=SimpleNamespace(show_overlays=True))
    context = SimpleNamespace(scene=bpy.context.scene, view_layer=bpy.context.view_layer, space_data=space)
    monkeypatch.setattr(splats_tool, "bpy", SimpleNamespace(context=context))
    monkeypatch.setattr(splats_tool.drawing, "splat_parts", lambda *_: shown_parts)
    for failure, draw_splats, count in ((None, True, 0), ("no memory", True, 1), (None, False, 2)):
        bpy.context.scene.objectgs.draw_splats = draw_splats
        monkeypatch.setattr(viewport, "_failure", failure)
        splats_tool._draw()
        assert len(marked) == count


def test_duplicates_share_the_selection(root):
    bpy.context.scene.objectgs.active.objectgs.active_object = 0
    bpy.ops.objectgs.duplicate_object()
    (copy,) = blender_scene.duplicates_of(root)[1]
    kinds.part_of(copy, "object_parent").location.x += 30.0
    bpy.context.view_layer.update()
    twin = kinds.part_of(copy, "splats")
    world = np.array(twin.matrix_world)
    center = (world @ [*arrays_of(twin.data).means[6], 1.0])[:3]
    splat_selection.select(parts(), splat_selection.within_sphere(center, 1e-3), "SET")
    assert np.flatnonzero(blender_scene.selected_splats(part(1).data)).tolist() == [6]
    assert splat_edits.count_selected(bpy.context, root) == 1


# Edits.


@pytest.mark.long
def test_deleted_splats_are_hidden_and_restored(root, folder, backend_python, tmp_path):
    before = shown(1)
    select(1, range(8))
    select(0, range(4), "ADD")
    assert bpy.ops.objectgs.delete_splats() == {"FINISHED"}
    assert (edits(folder).deleted, edits(folder).assigned) == (12, 0)
    assert len(shown(1)) == 42 and counts()[1] == 42
    assert splat_edits.count_selected(bpy.context, root) == 0
    assert len(evaluated(part(1))) == 42 and carrier.read(part(1).data, node_groups.HIDDEN).sum() == 8
    assert_agrees(folder, backend_python, tmp_path)
    assert bpy.ops.objectgs.show_result() == {"FINISHED"}
    assert_agrees(folder, backend_python, tmp_path)
    assert counts()[1] == 42
    select(1, range(42))
    bpy.ops.objectgs.delete_splats()
    assert edits(folder).deleted == 54 and not shown(1) and counts()[1] == 0
    with pytest.raises(RuntimeError, match="No splats are selected"):
        bpy.ops.objectgs.delete_splats()
    assert bpy.ops.objectgs.restore_splats() == {"FINISHED"}
    assert shown(1) == before and counts()[1] == 50 and not (folder / "splat-edits.ply").exists()
    with pytest.raises(RuntimeError, match="No splats are deleted"):
        bpy.ops.objectgs.restore_splats()


def evaluated(obj) -> np.ndarray:
    """Return the positions of the points that the viewport's geometry nodes generate."""
    node_tree = bpy.data.node_groups.new("vertices", "GeometryNodeTree")
    for way in ("OUTPUT", "INPUT"):
        node_tree.interface.new_socket("Geometry", in_out=way, socket_type="NodeSocketGeometry")
    from objectgs.objectgs_addon.scene.shading import modifiers
    from objectgs.objectgs_addon.scene.shading.graph import Graph

    nodes = Graph(node_tree)
    vertices = nodes.node("GeometryNodePointsToVertices", {0: nodes.node("NodeGroupInput").outputs[0]})
    nodes.node("NodeGroupOutput", {0: vertices.outputs[0]})
    modifier = obj.modifiers.new("vertices", "NODES")
    modifier.node_group = node_tree
    preview = modifiers.modifier_of(obj, node_groups.SPLATS_GROUP)
    modifiers.set_input(preview, "Minimum Opacity", 0.0)
    obj.update_tag()
    mesh = obj.evaluated_get(bpy.context.evaluated_depsgraph_get()).to_mesh()
    count = len(mesh.vertices)
    obj.modifiers.remove(modifier)
    return np.zeros(count)


def test_renders_leave_out_deleted_splats(root):
    """The group of renders hides them too, and leaves no attribute of the edits behind."""
    from objectgs.objectgs_addon.scene.shading import modifiers

    bpy.context.scene.camera = next(obj for obj in root.all_objects if blender_scene.kind_of(obj) == "camera")
    select(1, range(10))
    obj = part(1)

    def quads() -> int:
        for modifier in obj.modifiers:
            modifier.show_viewport = kinds.kind_of(modifier.node_group) == node_groups.RENDER_GROUP
        obj.update_tag()
        mesh = obj.evaluated_get(bpy.context.evaluated_depsgraph_get()).to_mesh()
        assert not [name for name in mesh.attributes.keys() if name.startswith("objectgs_")]  # noqa: SIM118
        return len(mesh.vertices) // 4

    before = quads()
    bpy.ops.objectgs.delete_splats()
    assert before - 10 <= quads() < before
    assert modifiers.modifier_of(obj, node_groups.RENDER_GROUP).node_group == node_groups.splats_group(
        node_groups.RENDER_GROUP
    )


@pytest.mark.long
def test_assigned_splats_move_to_the_object_and_follow_it(root, folder, backend_python, tmp_path):
    mug = shown(1)
    select(1, range(12))
    moved = {tuple(row) for row in list_of(1)[:12]}
    assert bpy.ops.objectgs.assign_splats(object="2") == {"FINISHED"}
    assert shown(1) == mug - moved and moved <= shown(2)
    assert counts() == {1: 38, 2: 62, HUGE: 50}
    assert_agrees(folder, backend_python, tmp_path)
    place = kinds.part_of(blender_scene.object_collections(active())[2], "object_parent")
    place.location.x += 2.0
    blender_scene.store_placements(active())
    exported_now = exported(folder, backend_python, tmp_path)
    assert len(exported_now[2]) == 62 and not exported_now[2] & moved, "assigned splats are moved with their object"
    select(2, range(62))
    bpy.ops.objectgs.assign_splats(object="0")
    assert counts()[2] == 0 and len(shown(0)) == 112
    with pytest.raises(RuntimeError, match="There is no object 77"):
        bpy.ops.objectgs.assign_splats(object="77")


def list_of(object_id) -> list[list[float]]:
    obj = part(object_id)
    center = np.array(obj.parent["objectgs_center"])
    return np.round(arrays_of(obj.data).means.astype(float) + center + ORIGIN, 3).tolist()


@pytest.mark.long
def test_separated_splats_become_an_object(root, folder, backend_python, tmp_path):
    select(1, range(6))
    select(2, range(7), "ADD")
    assert bpy.ops.objectgs.separate_splats(name=" handle ") == {"FINISHED"}
    (new,) = set(counts()) - {1, 2, HUGE}
    assert new == HUGE + 1 and entry(folder, new).name == "handle" and entry(folder, new).separated
    assert counts() == {1: 44, 2: 43, HUGE: 50, new: 13}
    assert blender_scene.object_collections(active())[new].name == "handle"
    assert {blender_scene.object_id_of(obj) for obj in bpy.context.selected_objects} == {new}
    assert_agrees(folder, backend_python, tmp_path)
    row = next(item for item in active().objectgs.objects if blender_scene.from_stored(item.object_id) == new)
    row.hue = 0.25
    assert entry(folder, new).recolor.hue == 0.25, "it is an object like all others"
    active().objectgs.active_object = list(counts()).index(new)
    bpy.ops.objectgs.remove_object()
    assert entry(folder, new).removed
    assert_agrees(folder, backend_python, tmp_path)
    bpy.ops.objectgs.restore_object(object=str(new))
    assert not blender_scene.selected_splats(part(new).data).any()
    with pytest.raises(RuntimeError, match="No splats are selected"):
        bpy.ops.objectgs.separate_splats(name="nothing")
    assert set(counts()) == {1, 2, HUGE, new} and entry(folder, new + 1) is None


def test_separated_splats_are_named_after_their_source(root, folder):
    select(1, range(3))
    select(2, range(7), "ADD")
    assert bpy.ops.objectgs.separate_splats() == {"FINISHED"}
    (new,) = set(counts()) - {1, 2, HUGE}
    assert entry(folder, new).name == f"{entry(folder, 2).name} part"


def test_crop_box_is_around_the_objects(root, folder):
    splats = read_vertices(folder / "splats.ply")
    splats["x"][splats["object_id"] == 0] += 1000.0
    write_vertices(folder / "splats.ply", splats)
    bpy.ops.objectgs.show_result()
    bpy.ops.objectgs.add_crop_box()
    assert max(blender_scene.crop_box_of(active()).scale) < 50.0


@pytest.mark.long
def test_crop_keeps_the_inside_of_the_box_and_survives_new_splats(root, folder, backend_python, tmp_path):
    assert not bpy.ops.objectgs.apply_crop.poll()
    assert bpy.ops.objectgs.add_crop_box() == {"FINISHED"}
    box = blender_scene.crop_box_of(root)
    assert bpy.context.selected_objects == [box]
    assert np.array(box.matrix_world.to_3x3().normalized()) == pytest.approx(np.eye(3), abs=1e-5), "upright"
    box.scale = [0.4 * side for side in box.scale]
    box.rotation_euler.z += 0.5
    bpy.context.view_layer.update()
    wanted = np.array(box.matrix_world)
    assert bpy.ops.objectgs.apply_crop() == {"FINISHED"}
    assert blender_scene.crop_box_of(active()) is None
    splats = read_vertices(folder / "splats.ply")
    positions = np.stack([splats[axis].astype(float) for axis in "xyz"], 1)
    inside = inside_box(positions, edits(folder).crop)
    parent = next(obj for obj in active().objects if blender_scene.kind_of(obj) == "parent")
    world = (positions - ORIGIN) @ np.array(parent.matrix_world)[:3, :3].T + np.array(parent.matrix_world)[:3, 3]
    assert np.array_equal(inside, inside_box(world, wanted)) and 5 < inside.sum() < 150
    assert sum(counts().values()) == (inside & (splats["object_id"] != 0)).sum()
    assert_agrees(folder, backend_python, tmp_path)
    splats["f_dc_0"] += 0.01  # as after further training
    write_vertices(folder / "splats.ply", splats)
    bpy.ops.objectgs.show_result()
    assert_agrees(folder, backend_python, tmp_path)
    assert sum(counts().values()) == (inside & (splats["object_id"] != 0)).sum()
    bpy.ops.objectgs.add_crop_box()
    again = np.array(blender_scene.crop_box_of(active()).matrix_world)
    bpy.context.view_layer.update()
    again = np.array(blender_scene.crop_box_of(active()).matrix_world)
    assert again == pytest.approx(wanted, abs=1e-4), "the box of a crop can be changed"
    bpy.ops.objectgs.remove_crop()
    assert sum(counts().values()) == 150 and edits(folder).crop is None


def test_crop_box_surrounds_selected_splats(root):
    select(1, [2, 3, 9])
    bpy.ops.objectgs.add_crop_box()
    bpy.context.view_layer.update()
    box = np.array(blender_scene.crop_box_of(root).matrix_world)
    world = np.array(part(1).matrix_world)
    points = arrays_of(part(1).data).means[[2, 3, 9]] @ world[:3, :3].T + world[:3, 3]
    grown = box @ np.diag([1.001, 1.001, 1.001, 1])
    assert inside_box(points, grown).all()
    assert np.abs(np.linalg.inv(box) @ np.column_stack([points, np.ones(3)]).T)[:3].max() == pytest.approx(1, abs=1e-3)


@pytest.mark.long
def test_edits_agree_with_floaters_and_fills(root, folder, backend_python, tmp_path):
    """Floaters are in the hull of the splats that an object has after the edits."""
    select(1, range(5))
    bpy.ops.objectgs.delete_splats()
    select(1, range(20))
    bpy.ops.objectgs.assign_splats(object="0")
    select(0, range(10))
    bpy.ops.objectgs.delete_splats()
    active().objectgs.active_object = list(counts()).index(2)
    bpy.ops.objectgs.remove_object(floaters=True)
    hidden = blender_scene.hidden_splats(part(0).data)
    assert hidden.sum() > 10
    assert_agrees(folder, backend_python, tmp_path)
    bpy.ops.objectgs.restore_object(object="2")
    assert blender_scene.hidden_splats(part(0).data).sum() == 10
    assert_agrees(folder, backend_python, tmp_path)


# Undo, reopening, further training.


def state(folder) -> dict:
    """Return all that edits change."""
    return {
        "selected": {i: np.flatnonzero(blender_scene.selected_splats(part(i).data)).tolist() for i in all_ids()},
        "shown": {i: shown(i) for i in all_ids()},
        "file": edits(folder).rows.tolist(),
        "crop": edits(folder).crop,
        "objects": json.loads((folder / "objects.json").read_text()),
        "counts": counts(),
    }


def all_ids() -> list[int]:
    return sorted(blender_scene.object_collections(active()))


def test_undo_and_redo_restore_splats_and_the_folder(root, folder):
    bpy.context.preferences.edit.use_global_undo = True
    bpy.ops.ed.undo_push(message="opened")
    states = [state(folder)]

    def step(action) -> None:
        action()
        bpy.ops.ed.undo_push(message="step")
        states.append(state(folder))

    step(lambda: select(1, range(9)))
    step(bpy.ops.objectgs.delete_splats)
    step(lambda: select(2, range(9)))
    step(lambda: bpy.ops.objectgs.separate_splats(name="handle"))
    step(lambda: select(HUGE, range(9)))
    step(lambda: bpy.ops.objectgs.assign_splats(object="1"))
    step(bpy.ops.objectgs.restore_splats)
    step(bpy.ops.objectgs.add_crop_box)
    step(lambda: blender_scene.crop_box_of(active()).scale.__imul__(0.3))
    step(bpy.ops.objectgs.apply_crop)
    step(bpy.ops.objectgs.clear_splat_edits)
    assert len({str(each) for each in states}) > 8
    for wanted in states[-2::-1]:
        bpy.ops.ed.undo()
        bpy.context.view_layer.update()
        assert state(folder) == wanted
    for wanted in states[1:]:
        bpy.ops.ed.redo()
        bpy.context.view_layer.update()
        assert state(folder) == wanted


def test_edits_are_kept_after_reopening(root, folder, tmp_path):
    select(1, range(9))
    bpy.ops.objectgs.delete_splats()
    select(2, range(4))
    bpy.ops.objectgs.separate_splats(name="handle")
    wanted = state(folder)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "edited.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "edited.blend"))
    bpy.context.view_layer.update()
    assert state(folder) == wanted
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.objectgs.open_reconstruction(directory=str(folder))
    bpy.context.view_layer.update()
    del wanted["selected"]
    assert {key: value for key, value in state(folder).items() if key != "selected"} == wanted


def test_an_older_blend_shows_later_edits_before_it_changes_them(root, folder, tmp_path):
    """Edits that a saved .blend does not know are neither lost by an edit in it nor by undo."""
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "before.blend"))
    select(1, range(9))
    bpy.ops.objectgs.delete_splats()
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "before.blend"))
    bpy.context.view_layer.update()
    bpy.context.preferences.edit.use_global_undo = True
    bpy.ops.ed.undo_push(message="opened")
    assert len(shown(1)) == 50
    select(2, range(3))
    bpy.ops.objectgs.delete_splats()
    assert edits(folder).deleted == 12 and len(shown(1)) == 41 and len(shown(2)) == 47
    bpy.ops.ed.undo_push(message="deleted")
    bpy.ops.ed.undo()
    assert edits(folder).deleted == 12, "the state before is not that of any edits that this session knows"


def test_further_training_is_reported_and_keeps_the_file(root, folder):
    select(1, range(9))
    bpy.ops.objectgs.delete_splats()
    before = (folder / "splat-edits.ply").read_bytes()
    splats = read_vertices(folder / "splats.ply")
    splats["x"] = np.nextafter(splats["x"], np.float32(1e9))
    write_vertices(folder / "splats.ply", splats)
    result = blender_scene.show_result(root, folder)
    (warning,) = [text for text in result.warnings if "splat-edits.ply" in text]
    assert warning.startswith("9 of 9 edits") and warning.endswith(".")
    assert blender_scene.shown_edits(root).missing == 9 and len(shown(1)) == 50
    assert (folder / "splat-edits.ply").read_bytes() == before
    select(1, range(2))
    bpy.ops.objectgs.delete_splats()
    assert edits(folder).deleted == 11 and len(shown(1)) == 48
    bpy.ops.objectgs.clear_splat_edits()
    assert not (folder / "splat-edits.ply").exists() and len(shown(1)) == 50


def test_invalid_file_is_reported_and_can_be_cleared(root, folder):
    (folder / "splat-edits.ply").write_bytes(b"nonsense")
    select(1, range(2))
    with pytest.raises(RuntimeError, match=r"splat-edits\.ply is not a PLY file"):
        bpy.ops.objectgs.delete_splats()
    assert len(shown(1)) == 50
    assert bpy.ops.objectgs.clear_splat_edits() == {"FINISHED"}
    bpy.ops.objectgs.delete_splats()
    assert edits(folder).deleted == 2, "the selection is kept"


def test_splats_shown_by_an_earlier_version_are_shown_again(root, folder):
    for obj in parts():
        obj.data.attributes.remove(obj.data.attributes[single_splats.KEY])
    del root[single_splats.SPLAT_EDITS]
    select(1, range(2))
    with pytest.raises(RuntimeError, match="No splats are selected"):
        bpy.ops.objectgs.delete_splats()
    select(1, range(2))
    bpy.ops.objectgs.delete_splats()
    assert edits(folder).deleted == 2


def test_splats_that_fill_a_hole_cannot_be_selected(root):
    obj = part(1)
    carrier.write(obj.data, "unobserved", "BOOLEAN", np.arange(50) < 20)
    bpy.ops.objectgs.select_all_splats(action="SELECT")
    assert blender_scene.selected_splats(obj.data).sum() == 30


def test_folders_of_others_are_not_edited(root, folder, known, monkeypatch):
    known.unlink()
    from objectgs.objectgs_addon.environment import known_folders

    monkeypatch.setattr(known_folders, "_unwritten", [])
    select(1, range(2))
    with pytest.raises(RuntimeError):
        bpy.ops.objectgs.delete_splats()
    assert not (folder / "splat-edits.ply").exists()
    assert not bpy.ops.objectgs.restore_splats.poll() and not bpy.ops.objectgs.add_crop_box.poll()


@pytest.mark.long
def test_merged_object_takes_assigned_splats(root, folder, backend_python, tmp_path):
    object_edits.merge(root, [2], 1)
    select(HUGE, range(5))
    bpy.ops.objectgs.assign_splats(object="2")
    assert counts()[1] == 105 and object_list.splat_counts(active())[1] == 105
    assert_agrees(folder, backend_python, tmp_path)
    edit_objects(folder / "objects.json", {2: {"merged_into": None}})
    bpy.ops.objectgs.show_result()
    assert counts()[1] == 55
