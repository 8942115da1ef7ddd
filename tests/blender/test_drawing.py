# SPDX-License-Identifier: GPL-3.0-or-later
"""Input of the viewport drawing: splat arrays, their order and placement, and objects with a hidden preview."""

import weakref
from types import SimpleNamespace

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

from mathutils import Vector
from objectgs.backend.shared.color.recolor import Recolor
from objectgs.objectgs_addon import scene
from objectgs.objectgs_addon.drawing import gather, splat_arrays, viewport
from objectgs.objectgs_addon.drawing.order import back_to_front
from objectgs.objectgs_addon.scene import carrier
from objectgs.objectgs_addon.scene.shading.modifiers import modifier_of, show_preview
from objectgs.objectgs_addon.scene.shading.node_groups import SPLATS_GROUP
from objectgs.objectgs_addon.state import viewports

from .building import HUGE, write_folder


@pytest.fixture
def root(tmp_path, fresh):
    """A reconstruction with three objects and splats of no object."""
    folder = write_folder(tmp_path / "folder")
    root = scene.show_capture(bpy.context.scene, folder)
    scene.show_result(root, folder)
    bpy.context.view_layer.update()
    splat_arrays.register()
    yield root
    splat_arrays.unregister()


def preview_of(obj):
    """Return the modifier that shows splats where they are not drawn."""
    return modifier_of(obj, SPLATS_GROUP)


def part(root, object_id: int):
    return next(obj for obj in scene.object_collections(root)[object_id].objects if scene.kind_of(obj) == "splats")


def evaluated_size(obj) -> int:
    """Return the number of vertices or points of an object that the viewport shows."""
    shape = obj.evaluated_get(bpy.context.evaluated_depsgraph_get())
    if hasattr(shape, "evaluated_geometry"):  # absent in 4.2, where scripts cannot access evaluated point clouds
        geometry = shape.evaluated_geometry()
        return sum(
            0 if block is None else len(block.attributes["position"].data) if "position" in block.attributes else 0
            for block in (geometry.mesh, geometry.pointcloud)
        )
    return len(shape.data.vertices)


def test_splats_that_no_object_has_are_dropped_from_memory(root, registered, monkeypatch):
    """Blender keeps the mesh of a deleted object; the textures are freed where no scene has anything to draw."""
    owner = bpy.context.scene
    arrays = [weakref.ref(splat_arrays.arrays_of(each.data)) for each in gather.carriers(owner)]
    bpy.data.objects.remove(part(root, 2))
    bpy.context.view_layer.update()
    assert len(bpy.data.meshes) >= len(arrays) and sum(each() is not None for each in arrays) == len(arrays) - 1
    freed = []
    textures = SimpleNamespace(has_splats=True, free=lambda: freed.append(True))
    monkeypatch.setattr(viewport, "_renderer", textures)
    context = SimpleNamespace(scene=owner, region_data=True)
    monkeypatch.setattr(viewport, "bpy", SimpleNamespace(context=context, data=bpy.data))
    other = bpy.data.scenes.new("other")
    other.collection.children.link(root)
    owner.objectgs.draw_splats, other.objectgs.draw_splats = False, True
    viewport._draw()
    assert not freed, "another scene draws them"
    other.objectgs.draw_splats = False
    viewport._draw()
    assert freed == [True]


def test_splat_arrays_match_file_and_follow_mesh_changes(root):
    obj = part(root, 2)
    arrays = splat_arrays.arrays_of(obj.data)
    assert arrays.means.shape == (10, 3) and arrays.harmonics.shape == (10, 4, 3) and arrays.opacities.shape == (10,)
    assert np.array_equal(arrays.harmonics[:, 2], carrier.read(obj.data, "radiance:sh_2"))
    assert arrays.cloud.count > 0 and splat_arrays.arrays_of(obj.data) is arrays
    obj.data.attributes["radiance:base"].data[3].color = (0.0, 0.0, 0.0, 0.5)
    obj.data.update()
    bpy.context.view_layer.update()
    assert splat_arrays.arrays_of(obj.data).opacities[3] == 0.5
    obj.data.attributes.remove(obj.data.attributes["scale"])
    bpy.context.view_layer.update()
    assert splat_arrays.arrays_of(obj.data) is None


def test_splat_arrays_outlast_updates_that_do_not_change_them(root):
    undo = next(handler for handler in bpy.app.handlers.undo_post if handler is splat_arrays._undone)
    mesh = part(root, 2).data
    arrays = splat_arrays.arrays_of(mesh)
    for update in (lambda: undo(bpy.context.scene), lambda: splat_arrays.splats_changed(mesh)):
        update()
        update()
        assert splat_arrays.arrays_of(mesh) is arrays
    mesh.attributes["radiance:base"].data[3].color = (0.0, 0.0, 0.0, 0.25)
    undo(bpy.context.scene)
    changed = splat_arrays.arrays_of(mesh)
    assert changed is not arrays and changed.opacities[3] == 0.25 and not splat_arrays._before


def test_hidden_objects_are_not_drawn(root):
    layer = bpy.context.view_layer
    ids = lambda: sorted(scene.object_id_of(obj) for obj in gather.splat_parts(layer))  # noqa: E731
    assert ids() == [0, 1, 2, HUGE]
    part(root, 1).hide_set(True)
    next(
        child for child in layer.layer_collection.children[0].children if scene.object_id_of(child.collection) == 2
    ).hide_viewport = True
    assert ids() == [0, HUGE]


def test_transforms_marks_and_colors_are_current(root, monkeypatch):
    """Moving, selecting and recoloring reuse the arrays."""
    obj = part(root, 1)
    before = gather.gather([gather.placed(obj)])[0]
    obj.parent.location.x += 2.0
    obj.select_set(True)
    bpy.context.view_layer.update()
    monkeypatch.setattr(gather.scenes, "recolor_of", lambda _collection: Recolor(value=0.5))
    after = gather.gather([gather.placed(obj)], "object")[0]
    assert after.splats is before.splats
    assert np.allclose((after.matrix - before.matrix)[:, 3], (2.0, 0, 0, 0), atol=1e-6)
    assert np.allclose(after.recolor, np.hstack([0.5 * np.eye(3), np.zeros((3, 1))]))
    assert not before.is_selected and after.is_selected
    assert before.color == gather.NONE and np.allclose(np.multiply(after.color, 255), (10, 20, 30, 255), atol=0.1)
    collection = scene.object_collections(root)[1]
    assert gather.gather([gather.placed(obj)], pointed_at=collection.session_uid)[0].is_pointed_at
    assert not gather.gather([gather.placed(obj)], marks=False)[0].is_selected


def test_preview_is_hidden_while_drawing(root):
    """Its preview is restored with the user's settings; renders are unaffected."""
    obj = part(root, 1)
    kept = [(modifier.name, modifier.show_viewport, modifier.show_render) for modifier in obj.modifiers]
    seen = evaluated_size(obj)
    show_preview(obj, False)
    show_preview(obj, False)
    bpy.context.view_layer.update()
    assert evaluated_size(obj) in (0, 8), "nothing, or the invisible corners of its box"
    assert seen > 0 or not hasattr(obj, "evaluated_geometry")
    assert [modifier.show_render for modifier in obj.modifiers] == [False, True, False]
    show_preview(obj, True)
    bpy.context.view_layer.update()
    assert evaluated_size(obj) == seen
    assert [(modifier.name, modifier.show_viewport, modifier.show_render) for modifier in obj.modifiers] == kept


def test_updates_without_new_splats_tag_nothing(root, registered, monkeypatch):
    """Blender would evaluate the scene a second time."""
    owner, updates = bpy.context.scene, []
    owner.objectgs.draw_splats = True
    monkeypatch.setattr(viewport, "_failure", None)
    viewport._changed(owner, None)
    bpy.context.view_layer.update()
    note = lambda _scene, depsgraph: updates.extend(each.id.name for each in depsgraph.updates)  # noqa: E731
    bpy.app.handlers.depsgraph_update_post.append(note)
    try:
        viewport._changed(owner, None)
        bpy.context.view_layer.update()
        assert updates == []
        part(root, 1).modifiers["ObjectGS Drawn"].show_render = True
        viewport._changed(owner, None)
        bpy.context.view_layer.update()
    finally:
        bpy.app.handlers.depsgraph_update_post.remove(note)
    assert part(root, 1).name in updates and not part(root, 1).modifiers["ObjectGS Drawn"].show_render


def test_drawing_that_fails_is_not_tried_in_each_redraw(root, registered, monkeypatch, capsys):
    """The user switches it on again once there is memory for it."""
    owner, later, tried = bpy.context.scene, [], []

    def draw(*_):
        tried.append(True)
        raise MemoryError("Unable to allocate 9 GiB")

    monkeypatch.setattr(viewport, "_renderer", SimpleNamespace(free=lambda: None))
    monkeypatch.setattr(viewport, "_failure", None)
    monkeypatch.setattr(viewport.gather, "placed_parts", draw)
    owner.objectgs.draw_splats = True
    assert not preview_of(part(root, 1)).show_viewport
    manager = bpy.context.window_manager
    context = SimpleNamespace(scene=owner, region_data=True, space_data=None, view_layer=None, window_manager=manager)
    timers = SimpleNamespace(register=lambda call, **_: later.append(call))
    fake = SimpleNamespace(context=context, data=bpy.data, app=SimpleNamespace(timers=timers))
    monkeypatch.setattr(viewport, "bpy", fake)
    viewport._draw()
    viewport._draw()
    assert len(tried) == len(later) == 1 and "9 GiB" in viewport.failure() and "9 GiB" in capsys.readouterr().out
    later[0]()
    assert preview_of(part(root, 1)).show_viewport
    owner.objectgs.draw_splats = False
    owner.objectgs.draw_splats = True
    assert viewport.failure() is None and not preview_of(part(root, 1)).show_viewport
    viewport._draw()
    assert len(tried) == 2


def test_drawing_that_failed_is_tried_again_in_another_file(root, registered, monkeypatch):
    """Until then, new splats are shown by their previews, too."""
    bpy.context.scene.objectgs.draw_splats = True
    preview = preview_of(part(root, 1))
    monkeypatch.setattr(viewport, "_failure", "no memory")
    monkeypatch.setattr(viewport, "_renderer", None)
    viewport._changed(bpy.context.scene, None)
    assert preview.show_viewport
    preview.show_viewport = False
    viewport._file_loaded()
    assert viewport.failure() == "no memory" and preview.show_viewport, "the driver stays the same"
    monkeypatch.setattr(viewport, "_renderer", SimpleNamespace(free=lambda: None))
    viewport._file_loaded()
    viewport._changed(bpy.context.scene, None)
    assert viewport.failure() is None and not preview.show_viewport


@pytest.mark.parametrize("orthographic", [False, True])
def test_splats_are_sorted_back_to_front(orthographic):
    depths = np.random.default_rng(0).uniform(-1.0, 50.0, 20_000).astype(np.float32)
    order = back_to_front(depths, -100.0 if orthographic else 0.01, orthographic)
    ahead = depths > (-100.0 if orthographic else 0.01)
    assert sorted(order.tolist()) == np.flatnonzero(ahead).tolist()
    steps = np.diff(depths[order])
    assert (steps <= (0.001 if orthographic else 3e-4 * depths[order][1:])).all()


def test_splats_of_equal_depth_keep_order():
    assert back_to_front(np.full(5, 2.0, np.float32), 0.1, False).tolist() == [0, 1, 2, 3, 4]
    assert back_to_front(np.full(5, 2.0, np.float32), 0.1, True).tolist() == [0, 1, 2, 3, 4]
    assert len(back_to_front(np.full(5, -2.0, np.float32), 0.1, False)) == 0


def test_instances_of_collections_are_drawn(root):
    """File > Link adds a collection as an instance; what is hidden inside is not drawn there."""
    collection = bpy.data.collections.new("prop")
    obj = part(root, 1)
    collection.objects.link(obj)
    collection.instance_offset = (0.0, 0.0, 1.0)
    outer = bpy.data.collections.new("set")
    for name, place, inside, of in (("inner", (0, 3, 0), collection, outer), ("outer", (5, 0, 0), outer, None)):
        empty = bpy.data.objects.new(name, None)
        empty.instance_type, empty.instance_collection, empty.location = "COLLECTION", inside, place
        (of or bpy.context.scene.collection).objects.link(empty)
    layer = bpy.context.view_layer
    layer.update()
    direct = {placed.part: placed for placed in gather.placed_parts(layer) if placed.instancer is None}
    (instance,) = (placed for placed in gather.placed_parts(layer) if placed.instancer is not None)
    assert instance.part == obj and instance.instancer == bpy.data.objects["outer"]
    moved = np.array(instance.matrix) - np.array(direct[obj].matrix)
    assert np.allclose(moved[:, 3], (5.0, 3.0, -1.0, 0.0), atol=1e-6) and np.allclose(moved[:, :3], 0.0)
    bpy.data.objects["outer"].select_set(True)
    assert gather.gather([instance])[0].is_selected and not gather.gather([direct[obj]])[0].is_selected
    assert obj in gather.carriers(bpy.context.scene)
    collection.hide_viewport = True
    assert all(placed.instancer is None for placed in gather.placed_parts(layer))


def test_view_looks_at_subject_of_cameras():
    rng = np.random.default_rng(0)
    centers = rng.normal(size=(20, 3))
    centers *= 3.0 / np.linalg.norm(centers, axis=1, keepdims=True)
    subject = np.array([0.2, -0.1, 0.4])
    axes = subject - centers
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    assert np.allclose(viewports.subject_of(centers, axes), subject, atol=5e-3)
    assert np.isfinite(viewports.subject_of(centers, np.tile([0.0, 1.0, 0.0], (20, 1)))).all()


def test_view_begins_before_the_drawing_of_the_first_camera(root):
    """From inside of the camera, its frame would fill the view."""
    viewports.show(root)
    spaces = [area.spaces.active for area in bpy.context.window.screen.areas if area.type == "VIEW_3D"]
    region = spaces[0].region_3d
    camera = min((obj for obj in root.all_objects if scene.kind_of(obj) == "camera"), key=lambda obj: obj.name)
    eye = region.view_location + region.view_rotation @ Vector((0.0, 0.0, region.view_distance))
    ahead = camera.matrix_world.inverted() @ eye
    frame = np.array(camera.data.view_frame(scene=bpy.context.scene))
    depth = camera.data.display_size * -frame[0, 2] / np.ptp(frame[:, 0])
    assert depth < -ahead.z < 0.5 * camera.matrix_world.translation.length and np.allclose(ahead.xy, 0.0, atol=1e-5)
    assert np.allclose(camera.matrix_world.inverted() @ region.view_location, (0.0, 0.0, -(10.0**0.5)), atol=0.1)
