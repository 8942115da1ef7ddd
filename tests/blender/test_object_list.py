# SPDX-License-Identifier: GPL-3.0-or-later
"""The list of objects and its operators: names, colors, solo, choosing, merging and selection."""

import shutil

import numpy as np
import pytest

import headless

bpy = pytest.importorskip("bpy")

from objectgs.backend.shared.reconstruction.objects import read_objects
from objectgs.objectgs_addon import scene
from objectgs.objectgs_addon.panels.objects.panel import describe
from objectgs.objectgs_addon.picking import selection
from objectgs.objectgs_addon.scene import carrier, kinds, result
from objectgs.objectgs_addon.scene.points import read_points
from objectgs.objectgs_addon.state import object_edits, object_list, visibility

from .building import write_folder


@pytest.fixture
def root(fresh, trained, tmp_path):
    """A reconstruction with its objects shown, in a registered extension."""
    extension = headless.extension()
    extension.register()
    folder = shutil.copytree(trained, tmp_path / "demo")
    bpy.ops.objectgs.open_reconstruction(directory=str(folder))
    yield bpy.context.scene.objectgs.active
    extension.unregister()


def entry(root, object_id):
    """Return an object's entry in objects.json."""
    path = scene.folder_of(root) / "objects.json"
    return next(found for found in read_objects(path) if found.id == object_id)


def first_ids(root) -> list[int]:
    """Return the IDs of the rows that have splats."""
    return [scene.from_stored(item.object_id) for item in root.objectgs.objects if item.splats]


def activate(root, object_id: int) -> None:
    """Make an object's row active, like a click in the list."""
    rows = [scene.from_stored(item.object_id) for item in root.objectgs.objects]
    root.objectgs.active_object = rows.index(object_id)


def test_rows_match_objects_file(root):
    entries = read_objects(scene.folder_of(root) / "objects.json")
    items = root.objectgs.objects
    assert [(scene.from_stored(i.object_id), i.name, i.points) for i in items] == [
        (e.id, e.name, e.points) for e in entries
    ]
    counts = object_list.splat_counts(root)
    assert sum(counts.values()) > 0 and all(
        item.splats == counts.get(scene.from_stored(item.object_id), 0) for item in items
    )
    assert f"{items[0].points:,} points" in describe(items[0], root.objectgs)


def test_name_and_color_are_stored_and_shown(root):
    object_id = first_ids(root)[0]
    item = next(i for i in root.objectgs.objects if scene.from_stored(i.object_id) == object_id)
    item.name = "  tall thing "
    item.color = (1.0, 0.5, 0.0)
    assert entry(root, object_id).name == "tall thing" and entry(root, object_id).color == (255, 128, 0)
    collection = scene.object_collections(root)[object_id]
    assert collection.name == "tall thing"
    splats = next(part for part in scene.parts_of(collection) if scene.kind_of(part) == "splats")
    assert splats.color[0] == pytest.approx(1.0) and splats.color[1] == pytest.approx(0.2159, abs=0.001)


def test_edits_of_rows_do_not_read_the_points_again(root, monkeypatch):
    """With a million points, each rename would keep the user waiting."""
    mesh = kinds.points_of(root).data
    object_id = first_ids(root)[0]
    item = next(i for i in root.objectgs.objects if scene.from_stored(i.object_id) == object_id)
    own = np.flatnonzero(carrier.read_ids(mesh, "object_id") == object_id)
    read = []
    monkeypatch.setattr(result, "read_points", lambda folder: read.append(folder) or read_points(folder))
    item.name = "cup"
    item.color = (1.0, 0.0, 0.0)
    object_edits.flush()
    assert carrier.read(mesh, "object")[own] == pytest.approx(np.tile([1.0, 0, 0, 1], (len(own), 1)))
    item.chosen = False
    assert entry(root, object_id).name == "cup" and entry(root, object_id).left_out
    assert len(own) and (carrier.read(mesh, "object")[own, 0] < 0.5).all(), "they are gray"
    assert not read
    mesh.attributes.remove(mesh.attributes["object_id"])
    item.name = "mug"
    assert read and "object_id" in mesh.attributes


def test_solo_toggles_visibility_of_others(root):
    object_id = first_ids(root)[0]
    activate(root, object_id)
    bpy.ops.objectgs.solo_object()
    layers = visibility.object_layers(bpy.context.view_layer, root)
    assert len(layers) > 2 and {i: layer.hide_viewport for i, layer in layers.items()} == {
        i: i != object_id for i in layers
    }
    other = first_ids(root)[1]
    activate(root, other)
    bpy.ops.objectgs.solo_object()
    assert [i for i, layer in layers.items() if not layer.hide_viewport] == [other]
    bpy.ops.objectgs.solo_object()
    assert not any(layer.hide_viewport for layer in layers.values())


def test_selection_of_many_objects_is_found_without_a_search_for_each(fresh, tmp_path, monkeypatch):
    root = scene.show_capture(bpy.context.scene, write_folder(tmp_path / "many"))
    many = {object_id: bpy.data.collections.new(f"{object_id}") for object_id in range(1, 101)}
    for object_id, collection in many.items():
        kinds.mark(collection, kinds.OBJECT, object_id)
        root.children.link(collection)
        obj = bpy.data.objects.new(f"{object_id}", None)
        kinds.mark(obj, kinds.OBJECT_PARENT, object_id)
        obj.parent = kinds.parent_of(root) if object_id % 2 else None
        collection.objects.link(obj)
        obj.select_set(True)
    other = bpy.data.objects.new("other", None)
    bpy.context.scene.collection.objects.link(other)
    other.select_set(True)
    searched, parent_of = [], kinds.parent_of
    monkeypatch.setattr(kinds, "parent_of", lambda root: searched.append(root) or parent_of(root))
    assert set(selection.selected_collections(bpy.context, root)) == set(many.values())
    assert set(selection.selected_ids(bpy.context, root)) == set(many)
    assert len(searched) <= 4


def test_active_row_selects_object(root):
    first, second = first_ids(root)[:2]
    activate(root, first)
    assert selection.selected_ids(bpy.context, root) == [first]
    kinds = {scene.kind_of(part) for part in bpy.context.selected_objects}
    assert {"object_parent", "splats"} <= kinds
    activate(root, second)
    bpy.ops.objectgs.select_object(extend=True)
    selection.select_object(bpy.context, root, first, extend=True)
    assert selection.selected_ids(bpy.context, root) == [second, first], "the active object comes last"


def test_selected_objects_are_merged_and_split(root):
    first, second = first_ids(root)[:2]
    before = object_list.splat_counts(root)
    points_before = {scene.from_stored(item.object_id): item.points for item in root.objectgs.objects}
    selection.select_object(bpy.context, root, first)
    selection.select_object(bpy.context, root, second, extend=True)
    bpy.ops.objectgs.merge_objects(into=str(second))
    assert entry(root, first).merged_into == second and entry(root, second).merged_into is None
    after = object_list.splat_counts(root)
    assert after[second] == before[first] + before[second] and first not in after
    assert object_list.merge_target(root, first) == second
    points = {scene.from_stored(item.object_id): item.points for item in root.objectgs.objects}
    assert points[second] == points_before[first] + points_before[second]
    activate(root, second)
    bpy.ops.objectgs.split_objects()
    assert object_list.splat_counts(root) == before and entry(root, first).merged_into is None


def test_merged_objects_are_chosen_together(root):
    first, second = first_ids(root)[:2]
    activate(root, first)
    bpy.ops.objectgs.merge_objects(into=str(second))
    for active in (first, second):
        activate(root, active)
        assert bpy.ops.objectgs.choose_objects(which="ACTIVE") == {"FINISHED"}
        kept = {scene.from_stored(item.object_id) for item in root.objectgs.objects if item.chosen}
        assert kept == {first, second}


def test_the_only_object_is_not_merged(root):
    first, *others = [scene.from_stored(item.object_id) for item in root.objectgs.objects]
    for other in others:
        activate(root, other)
        bpy.ops.objectgs.merge_objects(into=str(first))
    activate(root, first)
    assert not bpy.ops.objectgs.merge_objects.poll()


def test_one_object_is_not_merged_into_itself(root):
    first, second = first_ids(root)[:2]
    selection.select_nothing(bpy.context)
    activate(root, first)
    with pytest.raises(TypeError):
        bpy.ops.objectgs.merge_objects(into=str(first))
    selection.select_object(bpy.context, root, first)
    selection.select_object(bpy.context, root, second, extend=True)
    bpy.ops.objectgs.merge_objects(into=str(first))
    assert entry(root, second).merged_into == first


def test_choose_objects_leaves_out_others(root):
    first, *others = [scene.from_stored(item.object_id) for item in root.objectgs.objects]
    activate(root, first)
    bpy.ops.objectgs.choose_objects(which="ACTIVE")
    assert not entry(root, first).left_out and all(entry(root, i).left_out for i in others)
    assert first in scene.object_collections(root) and not set(others) & set(scene.object_collections(root))
    bpy.ops.objectgs.choose_objects(which="INVERT")
    assert entry(root, first).left_out and not any(entry(root, i).left_out for i in others)
    bpy.ops.objectgs.choose_objects(which="ALL")
    assert not any(found.left_out for found in read_objects(scene.folder_of(root) / "objects.json"))


def test_set_distance_and_ground(root):
    parent = next(part for part in root.objects if scene.kind_of(part) == "parent")
    bpy.ops.objectgs.set_distance(points=(0, 0, 0, 0.25, 0, 0), distance=1.0)
    assert parent.matrix_world.to_scale().x == pytest.approx(4.0, rel=1e-5)
    bpy.ops.objectgs.set_ground(points=(0, 0, 1, 1, 0, 1, 0, 1, 1))
    bpy.context.view_layer.update()
    with pytest.raises(RuntimeError):
        bpy.ops.objectgs.set_ground(points=(0, 0, 0, 1, 0, 0, 2, 0, 0))
    with pytest.raises(RuntimeError):
        bpy.ops.objectgs.set_distance(points=(1, 1, 1, 1, 1, 1), distance=2.0)


def test_colors_of_the_scene_select_point_colors(root):
    points = next(part for part in root.all_objects if scene.kind_of(part) == "points")
    bpy.context.scene.objectgs.colors = "object"
    assert points.data.color_attributes.active_color_name == "object"
    bpy.context.scene.objectgs.colors = "photo"
    assert points.data.color_attributes.active_color_name == "photo"


def test_newer_result_is_detected(root):
    assert not scene.result_is_newer(root)
    splats = scene.folder_of(root) / "splats.ply"
    splats.write_bytes(splats.read_bytes())
    assert scene.result_is_newer(root)
    bpy.ops.objectgs.show_result()
    assert not scene.result_is_newer(root)
    splats.unlink()
    assert not scene.result_is_newer(root)
