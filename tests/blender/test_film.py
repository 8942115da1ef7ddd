# SPDX-License-Identifier: GPL-3.0-or-later
"""Film from Blender: cameras and objects in the shot against Blender's projection, the compositor, and the frames."""

import math
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import bpy
import numpy as np
import pytest
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Euler, Matrix
from objectgs.backend.shared.errors import InputError
from objectgs.backend.shared.formats.ply import write_vertices
from objectgs.backend.shared.reconstruction.folder import Reconstruction
from objectgs.backend.shared.reconstruction.objects import edit_objects
from objectgs.backend.shared.reconstruction.record import TrainingRecord, VotesRecord, update_record
from objectgs.backend.shared.reconstruction.shot import read_shot, write_shot
from objectgs.objectgs_addon import film
from objectgs.objectgs_addon import scene as blender_scene
from objectgs.objectgs_addon.film.properties import folder_of
from objectgs.objectgs_addon.headless import filming
from objectgs.objectgs_addon.running import background
from objectgs.objectgs_addon.scene import kinds
from objectgs.objectgs_addon.scene.object_collection import center_of

import headless

from .building import (
    OBJECTS,
    look_at,
    splat_table,
    tetrahedron,
    write_cameras,
    write_folder,
    write_meshes,
    write_objects,
    write_points,
)

ORIGIN = np.array([100.0, -200.0, 30.0])


@pytest.fixture
def root(fresh, tmp_path):
    """A tilted reconstruction far from the origin, and a separate scene camera that sees part of it."""
    place = write_folder(tmp_path / "table top")
    upright = np.eye(4)
    upright[:3, :3] = np.array(Matrix.Rotation(0.7, 3, "X")) @ np.array(Matrix.Rotation(0.3, 3, "Z"))
    upright[:3, 3] = 1.0, 2.0, 3.0
    write_cameras(place, [look_at(ORIGIN + np.array([3, 0, 1]), ORIGIN)], origin=ORIGIN, upright=upright)
    splats = splat_table(np.resize([0, *OBJECTS], 40))
    for axis, name in enumerate("xyz"):
        splats[name] += ORIGIN[axis]
    write_vertices(place / "splats.ply", splats)
    scene = bpy.context.scene
    root = blender_scene.show_capture(scene, place)
    blender_scene.show_result(root, place)
    parent = kinds.parent_of(root)
    parent.matrix_world = Matrix.Scale(2.5, 4) @ parent.matrix_world
    camera = bpy.data.objects.new("Film", bpy.data.cameras.new("Film"))
    camera.location, camera.rotation_euler = (2.0, -9.0, 8.0), (0.9, 0.1, 0.2)
    scene.collection.objects.link(camera)
    scene.camera = camera
    scene.render.resolution_x, scene.render.resolution_y = 640, 360
    bpy.context.view_layer.update()
    return root


def shoot(root, frames=(1,), samples=1):
    return film.shot_of(bpy.context.scene, bpy.context.view_layer, root, list(frames), samples)


def ensure_pivot(root, object_id):
    return kinds.part_of(blender_scene.object_collections(root)[object_id], "object_parent")


def splats_of(root, object_id):
    return kinds.part_of(blender_scene.object_collections(root)[object_id], "splats")


def captured(splats) -> np.ndarray:
    """Return the capture coordinates (n, 3) of the object's splats."""
    vertices = np.array([vertex.co for vertex in splats.data.vertices], np.float64)
    return vertices + center_of(kinds.part_of(kinds.collection_of(splats), "object_parent")) + ORIGIN


def seen(shot, sample, points) -> np.ndarray:
    """Project capture points to pixels and depth, (n, 3), with the shot's camera."""
    at = points @ sample.viewmat[:3, :3].T + sample.viewmat[:3, 3]
    pixels = at @ sample.K.T
    return np.column_stack([pixels[:, :2] / pixels[:, 2:], shot.depth_scale * at[:, 2]])


def seen_by_blender(splats) -> np.ndarray:
    """Project an object's splats at their current location to pixels and depth, (n, 3), with Blender."""
    scene = bpy.context.scene
    percent = scene.render.resolution_percentage
    size = scene.render.resolution_x * percent // 100, scene.render.resolution_y * percent // 100
    found = [
        world_to_camera_view(scene, scene.camera, splats.matrix_world @ vertex.co) for vertex in splats.data.vertices
    ]
    return np.array([(x * size[0], (1 - y) * size[1], z) for x, y, z in found])


def assert_placed(root, shot, sample, object_id, splats, place=0) -> None:
    """Check that an object's map in the shot moves its splats to where Blender sees them."""
    maps = sample.objects[object_id].maps
    at = np.eye(4) if maps is None else maps[place]
    points = captured(splats_of(root, object_id)) @ at[:3, :3].T + at[:3, 3]
    ahead = seen_by_blender(splats)
    close = ahead[:, 2] > 0.5
    assert close.sum() > 5
    np.testing.assert_allclose(seen(shot, sample, points)[close], ahead[close], rtol=2e-3, atol=0.02)


@pytest.mark.parametrize("fit", ["AUTO", "HORIZONTAL", "VERTICAL"])
@pytest.mark.parametrize(
    ("size", "aspect"), [((640, 360), (1.0, 1.0)), ((300, 500), (1.0, 2.0)), ((330, 220), (1.5, 1.0))]
)
def test_shot_cameras_match_blender_projection(root, fit, size, aspect):
    scene = bpy.context.scene
    scene.render.resolution_x, scene.render.resolution_y = size
    scene.render.resolution_percentage = 60
    scene.render.pixel_aspect_x, scene.render.pixel_aspect_y = aspect
    lens = scene.camera.data
    lens.sensor_fit, lens.sensor_width, lens.sensor_height, lens.lens = fit, 30.0, 25.0, 28.0
    lens.shift_x, lens.shift_y = 0.11, -0.07
    lens.clip_start, lens.clip_end = 0.5, 75.0
    scene.camera.scale = 2.0, 3.0, 0.5
    bpy.context.view_layer.update()
    shot = shoot(root)
    sample = shot.frames[0].samples[0]
    assert (shot.width, shot.height) == (size[0] * 60 // 100, size[1] * 60 // 100)
    assert shot.pixel_aspect == pytest.approx(aspect[0] / aspect[1]) and shot.depth_scale == pytest.approx(2.5)
    assert sample.clip == pytest.approx((0.2, 30.0))
    for object_id in OBJECTS:
        assert sample.objects[object_id].maps is None, "no object has been moved"
        assert_placed(root, shot, sample, object_id, splats_of(root, object_id))


def test_capture_cameras_round_trip(root):
    scene = bpy.context.scene
    camera = next(obj for obj in root.all_objects if kinds.kind_of(obj) == "camera")
    blender_scene.use_camera(scene, camera)
    bpy.context.view_layer.update()
    shot = shoot(root)
    sample = shot.frames[0].samples[0]
    np.testing.assert_allclose(sample.viewmat, look_at(ORIGIN + np.array([3, 0, 1]), ORIGIN), atol=2e-4)
    np.testing.assert_allclose(sample.K, [[500, 0, 310], [0, 500, 250.5], [0, 0, 1]], atol=1e-3)


def test_animation_is_sampled_in_every_frame(root):
    """Camera, lens, an object and the whole reconstruction have keyframes; the scene's current frame is restored."""
    scene = bpy.context.scene
    pivot, parent = ensure_pivot(root, 1), kinds.parent_of(root)
    for frame, amount in ((1, 0.0), (11, 1.0)):
        scene.camera.location.x = 2.0 + amount
        scene.camera.keyframe_insert("location", frame=frame)
        scene.camera.data.lens = 40 + 30 * amount
        scene.camera.data.keyframe_insert("lens", frame=frame)
        pivot.rotation_euler = (amount, 0.5 * amount, 0)
        pivot.scale = (1 + amount, 1, 1 - 0.4 * amount)
        pivot.keyframe_insert("rotation_euler", frame=frame)
        pivot.keyframe_insert("scale", frame=frame)
        parent.scale = [2.5 * (1 + 0.2 * amount)] * 3
        parent.keyframe_insert("scale", frame=frame)
    scene.frame_set(3)
    shot = shoot(root, (1, 6, 11))
    assert (scene.frame_current, scene.frame_subframe) == (3, 0.0)
    assert [frame.number for frame in shot.frames] == [1, 6, 11]
    for frame in shot.frames:
        scene.frame_set(frame.number)
        for object_id in OBJECTS:
            assert_placed(root, shot, frame.samples[0], object_id, splats_of(root, object_id))
    lenses = [frame.samples[0].K[0, 0] for frame in shot.frames]
    assert lenses[0] < lenses[1] < lenses[2]


def test_object_that_rests_in_a_part_of_its_animation_is_placed_there(root):
    """The timeline may stand where it is elsewhere, as on a farm that renders a part of the frames."""
    scene, pivot = bpy.context.scene, ensure_pivot(root, 1)
    captured_at = pivot.location.x
    for frame, moved in ((1, 0.0), (5, 0.0), (9, 2.0)):
        pivot.location.x = captured_at + moved
        pivot.keyframe_insert("location", frame=frame)
    scene.frame_set(9)
    first, second = (frame.samples[0].objects for frame in shoot(root, (1, 3)).frames)
    for objects in (first, second):
        np.testing.assert_array_equal(objects[1].maps, np.eye(4)[None])
        assert objects[2].maps is None, "an object that cannot move keeps its place of objects.json"


def test_resting_objects_are_placed_once(root, monkeypatch):
    """With hundreds of objects, the samples of motion blur would keep the user waiting."""
    pivot = ensure_pivot(root, 1)
    for frame, moved in ((1, 0.0), (4, 1.0)):
        pivot.location.x = moved
        pivot.keyframe_insert("location", frame=frame)
    placed, transform = [], film.shot._RootTransform
    place = transform.map_from
    monkeypatch.setattr(transform, "map_from", lambda *args: placed.append(args) or place(*args))
    shoot(root, (1, 2, 3, 4))
    assert len(placed) == len({0, *OBJECTS}) + 3


def test_whole_scene_mesh_does_not_hide_the_rest(root):
    folder = blender_scene.folder_of(root)
    write_meshes(folder, {"scene": tetrahedron(ORIGIN)})
    blender_scene.show_meshes(root, folder)
    blender_scene.show_kinds(root, "meshes")
    assert splats_of(root, 0).hide_render
    assert 0 in shoot(root).frames[0].samples[0].objects
    for mesh in blender_scene.scene_meshes(root):
        mesh.hide_render = True
    assert 0 not in shoot(root).frames[0].samples[0].objects


@pytest.mark.parametrize("others", [0.0, 1.0], ids=["point", "disc"])
def test_objects_that_grow_from_nothing_are_omitted_until_then(root, tmp_path, others):
    pivot = ensure_pivot(root, 1)
    for frame, size in ((1, 0.0), (3, 1.0)):
        pivot.scale = size, max(size, others), max(size, others)
        pivot.keyframe_insert("scale", frame=frame)
    bpy.context.scene.frame_set(1)
    shot = shoot(root, (1, 2, 3))
    assert [1 in frame.samples[0].objects for frame in shot.frames] == [False, True, True]
    write_shot(tmp_path / "shot.json", shot)
    assert len(read_shot(tmp_path / "shot.json").frames) == 3


def test_objects_hidden_in_viewport_are_animated(root):
    scene = bpy.context.scene
    pivot = ensure_pivot(root, 1)
    before = splats_of(root, 1).matrix_world.copy()
    for frame, place in ((1, 0.0), (5, 2.0)):
        pivot.location.x = place
        pivot.keyframe_insert("location", frame=frame)
    scene.frame_set(1)
    layer = bpy.context.view_layer.layer_collection.children[root.name].children[
        blender_scene.object_collections(root)[1].name
    ]
    layer.hide_viewport = True
    shot = shoot(root, (1, 5))
    assert layer.hide_viewport and before
    first, last = (frame.samples[0].objects[1].maps[0] for frame in shot.frames)
    assert np.linalg.norm(last[:3, 3] - first[:3, 3]) == pytest.approx(2.0, rel=1e-3)


def test_objects_hidden_in_renders_are_omitted(root):
    scene, layer = bpy.context.scene, bpy.context.view_layer.layer_collection.children[root.name]
    collections = blender_scene.object_collections(root)
    ids = set(OBJECTS) | {0}

    def shown():
        return set(shoot(root).frames[0].samples[0].objects)

    assert shown() == ids and shoot(root).only_named
    root.hide_render = True
    assert shown() == ids, "hiding the reconstruction does not omit its objects"
    collections[1].hide_render = True
    assert shown() == ids - {1}
    layer.children[collections[2].name].exclude = True
    assert shown() == ids - {1, 2}
    collections[1].hide_render = False
    splats_of(root, 1).hide_render = True
    assert shown() == ids - {1, 2}
    ensure_pivot(root, 0).hide_render = True
    for frame, hidden in ((1, True), (3, False)):
        ensure_pivot(root, 0).hide_render = hidden
        ensure_pivot(root, 0).keyframe_insert("hide_render", frame=frame)
    scene.frame_set(1)
    objects = [set(frame.samples[0].objects) for frame in shoot(root, (1, 2, 3)).frames]
    assert objects == [ids - {0, 1, 2}, ids - {0, 1, 2}, ids - {1, 2}]


def test_objects_parented_to_the_pivot_of_another_are_placed(root):
    splats = splats_of(root, 1)
    for part in (ensure_pivot(root, 1), splats):
        world = part.matrix_world.copy()
        part.parent = ensure_pivot(root, 2)
        part.matrix_world = world
    ensure_pivot(root, 2).location.x += 0.3
    bpy.context.view_layer.update()
    shot = shoot(root)
    assert_placed(root, shot, shot.frames[0].samples[0], 1, splats)


def test_objects_below_others_are_filmed(root):
    scene = bpy.context.scene
    own = bpy.data.objects.new("own", None)
    scene.collection.objects.link(own)
    pivot = ensure_pivot(root, 1)
    bpy.context.view_layer.update()
    world = pivot.matrix_world.copy()
    pivot.parent = own
    pivot.matrix_world = world
    own.location.x = 2.0
    bpy.context.view_layer.update()
    shot = shoot(root)
    assert_placed(root, shot, shot.frames[0].samples[0], 1, splats_of(root, 1))
    mesh = bpy.data.objects.new("mesh", bpy.data.meshes.new("mesh"))
    kinds.mark(mesh, "mesh", 1)
    blender_scene.object_collections(root)[1].objects.link(mesh)
    mesh.parent, splats_of(root, 1).hide_render = own, True
    assert 1 in shoot(root).frames[0].samples[0].objects, "its mesh is seen, and has the same parent as the pivot"


def test_duplicates_hidden_in_renders_are_not_filmed(root):
    copy = blender_scene.duplicate(root, blender_scene.object_collections(root)[2])
    bpy.context.view_layer.update()
    kinds.part_of(copy, "object_parent").location.x += 1.0
    bpy.context.view_layer.update()
    assert len(shoot(root).frames[0].samples[0].objects[2].maps) == 2
    # The copy is in objects.json, which counts for objects without maps.
    copy.hide_render = True
    (only,) = shoot(root).frames[0].samples[0].objects[2].maps
    assert np.allclose(only, np.eye(4))


def test_markers_change_cameras_between_frames(root):
    """Not within the exposure of one, and not if a camera is given."""
    scene = bpy.context.scene
    first, second = scene.camera, scene.camera.copy()
    second.data = scene.camera.data.copy()
    second.location.x += 3
    scene.collection.objects.link(second)
    for frame, camera in ((1, first), (3, second)):
        scene.timeline_markers.new(camera.name, frame=frame).camera = camera
    scene.render.use_motion_blur, scene.render.motion_blur_shutter = True, 1.0
    bpy.context.view_layer.update()
    found = shoot(root, (2, 3), 4)
    of_first, of_second = ([sample.viewmat for sample in frame.samples] for frame in found.frames)
    assert all(np.allclose(each, of_first[0]) for each in of_first)
    assert all(np.allclose(each, of_second[0]) for each in of_second) and not np.allclose(of_first[0], of_second[0])
    given = film.shot_of(scene, bpy.context.view_layer, root, [3], camera=first)
    assert np.allclose(given.frames[0].samples[0].viewmat, of_first[0])


def test_settings_that_films_ignore_are_named(root):
    scene = bpy.context.scene
    assert film.ignored_settings(scene) is None
    scene.camera.data.dof.use_dof = True
    assert "depth of field of Film" in film.ignored_settings(scene)
    scene.render.use_border = scene.render.use_crop_to_border = True
    assert "and Crop to Render Region" in film.ignored_settings(scene)
    scene.render.use_multiview = True
    splats = splats_of(root, 1)
    splats.is_holdout = True
    assert film.ignored_settings(scene).endswith(" Film, Crop to Render Region, Stereoscopy and Holdout.")
    splats.is_holdout = False
    bpy.context.view_layer.layer_collection.children[root.name].holdout = True
    assert "Holdout" in film.ignored_settings(scene)


@pytest.mark.parametrize("way", ["camera", "indirect"])
def test_what_the_camera_does_not_see_is_left_out(root, way):
    (sample,) = shoot(root).frames[0].samples
    assert 1 in sample.objects
    collection = blender_scene.object_collections(root)[1]
    if way == "camera":
        for part in collection.objects:
            part.visible_camera = False
    else:
        layer = bpy.context.view_layer.layer_collection.children[root.name]
        layer.children[collection.name].indirect_only = True
    (sample,) = shoot(root).frames[0].samples
    assert 1 not in sample.objects and 2 in sample.objects


def test_what_renders_show_beside_film_frames_is_named(root):
    scene, layer = bpy.context.scene, bpy.context.view_layer
    root.hide_render = True
    assert film.rendered_twice(scene, layer, root) is None
    first, second = (blender_scene.object_collections(root)[each] for each in (1, 2))
    scene.collection.children.link(first)
    for name, collection, owner in (
        ("outside", second, scene.collection),
        ("inside", second, root),
        ("whole", root, scene.collection),
    ):
        instance = bpy.data.objects.new(name, None)
        instance.instance_type, instance.instance_collection = "COLLECTION", collection
        owner.objects.link(instance)
    assert f" table top: {ensure_pivot(root, 1).name}, outside; " in film.rendered_twice(scene, layer, root)
    bpy.data.objects["outside"].hide_render = True
    scene.collection.children.unlink(first)
    assert film.rendered_twice(scene, layer, root) is None


def test_hidden_camera_follows_its_constraints(root):
    scene = bpy.context.scene
    dolly, aim = (bpy.data.objects.new(name, None) for name in ("dolly", "aim"))
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    camera.parent = dolly
    dolly.location, aim.location = (0, -4, 1), (0, 0, 0.5)
    for obj in (dolly, aim, camera):
        scene.collection.objects.link(obj)
    tracks = camera.constraints.new("TRACK_TO")
    tracks.target, tracks.track_axis, tracks.up_axis = aim, "TRACK_NEGATIVE_Z", "UP_Y"
    scene.camera = camera
    bpy.context.view_layer.update()
    seen = shoot(root).frames[0].samples[0].viewmat
    camera.hide_set(True)
    bpy.context.view_layer.update()
    assert shoot(root).frames[0].samples[0].viewmat == pytest.approx(seen)


def test_duplicates_and_instances_are_included(root):
    """A duplicated object, and an empty that instances a collection elsewhere."""
    scene = bpy.context.scene
    collection = blender_scene.object_collections(root)[2]
    pivot, splats = ensure_pivot(root, 2), splats_of(root, 2)
    other, copy = pivot.copy(), splats.copy()
    copy.parent = other
    other.location.x += 1.5
    for obj in (other, copy):
        collection.objects.link(obj)
    empty = bpy.data.objects.new("elsewhere", None)
    empty.instance_type, empty.instance_collection = "COLLECTION", blender_scene.object_collections(root)[1]
    empty.location, empty.rotation_euler = (0.5, 0.25, 1.0), (0, 0, 0.4)
    scene.collection.objects.link(empty)
    bpy.context.view_layer.update()
    shot = shoot(root)
    sample = shot.frames[0].samples[0]
    assert len(sample.objects[2].maps) == 2 and len(sample.objects[1].maps) == 2
    order = [np.array_equal(at, np.eye(4)) for at in sample.objects[2].maps]
    assert_placed(root, shot, sample, 2, copy, order.index(False))
    assert sample.objects[0].maps is None
    instanced = sample.objects[1].maps[1]
    points = captured(splats_of(root, 1)) @ instanced[:3, :3].T + instanced[:3, 3]
    world = empty.matrix_world @ splats_of(root, 1).matrix_world
    expected = np.array(
        [world_to_camera_view(scene, scene.camera, world @ vertex.co).z for vertex in splats_of(root, 1).data.vertices]
    )
    np.testing.assert_allclose(seen(shot, sample, points)[:, 2], expected, rtol=1e-3, atol=1e-3)


def test_shutter_times_match_motion_blur_settings(root):
    render = bpy.context.scene.render
    render.motion_blur_shutter = 0.5
    for position, opens in (("START", 5.0), ("CENTER", 4.75), ("END", 4.5)):
        render.motion_blur_position = position
        (frame,) = shoot(root, (5,), samples=5).frames
        assert frame.shutter == pytest.approx((opens, opens + 0.5))
        assert [sample.time for sample in frame.samples] == pytest.approx([opens + 0.05 + 0.1 * i for i in range(5)])
        assert frame.samples[frame.middle].time == pytest.approx(opens + 0.25)
    assert shoot(root, (5,)).frames[0].samples[0].time == 5.0


def test_unsupported_cameras_are_rejected(root):
    scene = bpy.context.scene
    for kind, word in (("ORTHO", "orthographic"), ("PANO", "panoramic")):
        scene.camera.data.type = kind
        with pytest.raises(InputError, match=word):
            shoot(root)
    scene.camera.data.type = "PERSP"
    scene.camera.scale.x = -1.0
    bpy.context.view_layer.update()
    with pytest.raises(InputError, match="Film is mirrored"):
        shoot(root)
    scene.camera.scale = (3.0, 1.0, 2.0)
    bpy.context.view_layer.update()
    viewmat = shoot(root).frames[0].samples[0].viewmat[:3, :3]
    np.testing.assert_allclose(viewmat @ viewmat.T, np.eye(3), atol=1e-6)
    scene.camera = None
    with pytest.raises(InputError, match="no camera"):
        shoot(root)
    with pytest.raises(InputError, match="below 0"):
        shoot(root, (-1, 0))
    bpy.data.objects.remove(kinds.parent_of(root))
    with pytest.raises(InputError, match="lost its parent empty"):
        shoot(root)


# --- frames in Blender -----------------------------------------------------------------------------------------------

RED, GREEN, BLUE = (0.8, 0.2, 0.2), (0.1, 0.7, 0.2), (0.1, 0.2, 0.9)
SIZE = 80


def wall_splats() -> np.ndarray:
    """Return two opaque discs, each of several identical splats: "mug" on the left, red and oblique, and "can" on the
    right, green."""
    table = splat_table([1, 2], degree=0)
    rotation = Euler((0.0, math.radians(35), 0.0)).to_quaternion()
    for name, values in {
        "x": (-3.0, 3.0),
        "y": (0, 0),
        "z": (0, 0),
        "opacity": (8, 8),
        "scale_0": (0.2, 0.2),
        "scale_1": (0.2, 0.2),
        "scale_2": (-9, -9),
        "rot_0": (rotation.w, 1),
        "rot_1": (rotation.x, 0),
        "rot_2": (rotation.y, 0),
        "rot_3": (rotation.z, 0),
        **{f"f_dc_{i}": (np.array([RED[i], GREEN[i]]) - 0.5) / 0.28209479 for i in range(3)},
    }.items():
        table[name] = values
    return np.repeat(table, 12)


@pytest.fixture(scope="module")
def shot_blend(tmp_path_factory):
    """A .blend with a camera above two discs, a ball in front of the right one, a ball behind the left one, and a plane
    exactly at the left disc that is hidden in renders."""
    place = tmp_path_factory.mktemp("film") / "wall"
    place.mkdir()
    write_cameras(place, [look_at((0, -1, 10.0))])
    write_points(place, np.random.default_rng(0).normal(size=(9, 3)), np.ones(9, int))
    write_objects(place, {1: "mug", 2: "can"})
    write_vertices(place / "splats.ply", wall_splats())
    training = TrainingRecord({"primitive": "2d"}, VotesRecord("majority", None, 1600, "", None))
    update_record(Reconstruction(place), training=training)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    root = blender_scene.show_capture(scene, place)
    blender_scene.show_result(root, place)
    blender_scene.prepare_render(scene)
    camera = bpy.data.objects.new("Film", bpy.data.cameras.new("Film"))
    camera.location = 0, 0, 10
    camera.data.lens = 40
    scene.collection.objects.link(camera)
    scene.camera = camera
    material = bpy.data.materials.new("blue")
    if material.node_tree is None:
        material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    emission, output = tree.nodes.new("ShaderNodeEmission"), tree.nodes.new("ShaderNodeOutputMaterial")
    emission.inputs["Color"].default_value = (*BLUE, 1)
    tree.links.new(emission.outputs[0], output.inputs["Surface"])
    for name, location in (("before", (2.5, 0, 3)), ("behind", (-2.5, 0, -3))):
        bpy.ops.mesh.primitive_uv_sphere_add(radius=0.8, location=location)
        bpy.context.object.name = name
        bpy.context.object.data.materials.append(material)
    bpy.ops.mesh.primitive_plane_add(size=3, location=(-3, 0, 0), rotation=(0, math.radians(35), 0))
    bpy.context.object.name, bpy.context.object.hide_render = "plane", True
    scene.render.engine = "CYCLES"
    scene.cycles.samples = 4
    scene.render.resolution_x = scene.render.resolution_y = SIZE
    scene.frame_start = scene.frame_end = 7
    path = place.parent / "shot.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    return path


@pytest.fixture(scope="module")
def filmed(shot_blend, backend_python):
    """Output folder of headless.py: a film frame, a composite, and a .blend with its compositor set up."""
    out = shot_blend.parent / "film"
    ran = subprocess.run(
        [
            sys.executable,
            headless.__file__,
            "film",
            shot_blend,
            "--out",
            out,
            "--composite",
            "png",
            "--png",
            "--save",
            out / "joined.blend",
        ],
        capture_output=True,
        text=True,
        timeout=300,
        env={**os.environ, "OBJECTGS_PYTHON": backend_python},
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr
    return out


def pixels_of(path) -> np.ndarray:
    """Return the stored pixels (H, W, 4), from the top row."""
    image = bpy.data.images.load(str(path))
    try:
        image.colorspace_settings.name = "Non-Color"
        image.alpha_mode = "CHANNEL_PACKED"
        return np.array(image.pixels[:]).reshape(image.size[1], image.size[0], -1)[::-1]
    finally:
        bpy.data.images.remove(image)


def planes_of(path, python) -> dict[str, np.ndarray]:
    """Read the channels of an EXR with OpenEXR."""
    script = (
        "import sys, numpy, OpenEXR\n"
        "parts = OpenEXR.File(sys.argv[1], separate_channels=True).parts\n"
        "numpy.savez(sys.argv[2], **{name: channel.pixels for part in parts for name, channel in\n"
        "                            part.channels.items()})\n"
    )
    table = path.with_suffix(".npz")
    subprocess.run([python, "-c", script, path, table], check=True)
    return dict(np.load(table))


def encoded(linear) -> np.ndarray:
    linear = np.asarray(linear)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)


LEFT_BALL, RIGHT_BALL, LEFT_WALL, RIGHT_WALL = (40, 23), (40, 71), (30, 12), (30, 60)
"""(row, column) of a pixel in the middle of each of these."""


def test_composite_combines_by_depth(filmed):
    image = pixels_of(filmed / "composite.0007.png")
    splats = pixels_of(filmed / "splats.0007.png")
    assert image.shape[:2] == (SIZE, SIZE)
    for place, color in ((LEFT_BALL, RED), (LEFT_WALL, RED), (RIGHT_WALL, GREEN), (RIGHT_BALL, encoded(BLUE))):
        np.testing.assert_allclose(image[place][:3], color, atol=0.015, err_msg=str(place))
        if place != RIGHT_BALL:
            np.testing.assert_allclose(image[place], splats[place], atol=0.006)


def test_depth_matches_blender(shot_blend, filmed, backend_python, tmp_path):
    """The depth of a disc equals Blender's depth of a plane in its place, and so does the depth of the background."""
    bpy.ops.wm.open_mainfile(filepath=str(shot_blend))
    scene = bpy.context.scene
    for obj in scene.objects:
        obj.hide_render = obj.name != "plane"
    bpy.context.view_layer.use_pass_z = True
    settings = scene.render.image_settings
    if hasattr(settings, "media_type"):
        settings.media_type = "MULTI_LAYER_IMAGE"
    settings.file_format, settings.color_depth = "OPEN_EXR_MULTILAYER", "32"
    scene.render.filepath, scene.cycles.samples = str(tmp_path / "plane.exr"), 1
    scene.render.film_transparent = True
    bpy.ops.render.render(write_still=True)
    planes = planes_of(tmp_path / "plane.exr", backend_python)
    (of_plane,) = [values for name, values in planes.items() if name.endswith("Depth.Z")]
    of_disc = planes_of(filmed / "splats.0007.exr", backend_python)["Z"]
    on_it = of_plane < 1e6
    inner = on_it.copy()
    inner[1:-1, 1:-1] &= on_it[:-2, 1:-1] & on_it[2:, 1:-1] & on_it[1:-1, :-2] & on_it[1:-1, 2:]
    assert inner.sum() > 200
    # Blender's rays pass through a random point in the pixel, ours through its center; depth varies by 0.1 in a pixel.
    assert np.abs(of_disc - of_plane)[inner].max() < 0.12
    assert abs((of_disc - of_plane)[inner].mean()) < 0.02
    assert np.ptp(of_plane[inner]) > 1.0
    assert of_plane.max() == of_disc.max() == np.float32(1e10)


def test_blender_reads_cryptomattes(filmed, backend_python):
    """Blender's Cryptomatte node finds the objects by the hash of their name, and extracts their mattes."""
    bpy.ops.wm.open_mainfile(filepath=str(filmed / "joined.blend"))
    scene = bpy.context.scene
    tree = scene.compositing_node_group if bpy.app.version >= (5, 0) else scene.node_tree
    node = next(node for node in tree.nodes if node.type == "CRYPTOMATTE_V2")
    planes = planes_of(filmed / "splats.0007.exr", backend_python)
    for name, object_id, place in (("mug", 1, LEFT_WALL), ("can", 2, RIGHT_WALL)):
        node.matte_id = name
        assert [entry.name for entry in node.entries] == [name]
        # Blender computed this hash from the name.
        assert node.entries[0].encoded_hash == planes["CryptoObject00.R"][place]
        assert planes["IndexOB.X"][place] == object_id
    node.matte_id = "can"
    output = next(node for node in tree.nodes if node.type in ("GROUP_OUTPUT", "COMPOSITE"))
    tree.links.new(node.outputs["Matte"], output.inputs[0])
    scene.render.filepath, scene.render.use_file_extension = str(filmed / "matte.png"), False
    scene.frame_set(7)
    bpy.ops.render.render(write_still=True)
    matte = pixels_of(filmed / "matte.png")[..., 0]
    assert matte[RIGHT_WALL] > 0.98 and matte[LEFT_WALL] < 0.02


def test_compositor_setup_is_idempotent(shot_blend, filmed, tmp_path):
    bpy.ops.wm.open_mainfile(filepath=str(shot_blend))
    scene, layer = bpy.context.scene, bpy.context.view_layer
    root = next(child for child in scene.collection.children_recursive if kinds.kind_of(child) == "reconstruction")
    with pytest.raises(InputError, match="no film frames"):
        film.set_up_compositor(scene, layer, root, filmed.parent)
    assert not blender_scene.has_frames(scene) or bpy.app.version < (5, 0)
    film.set_up_compositor(scene, layer, root, filmed)
    assert blender_scene.has_frames(scene) and root.hide_render and scene.render.film_transparent and layer.use_pass_z
    tree = scene.compositing_node_group if bpy.app.version >= (5, 0) else scene.node_tree
    nodes = [node.name for node in tree.nodes]
    images = len(bpy.data.images)
    film.set_up_compositor(scene, layer, root, filmed)
    film.show_frames(scene, filmed)
    assert [node.name for node in tree.nodes] == nodes and len(bpy.data.images) == images
    node = next(node for node in tree.nodes if node.type == "IMAGE")
    assert (node.frame_start, node.frame_offset, node.frame_duration) == (7, 6, 1)
    assert node.image.source == "SEQUENCE" and not [link for link in tree.links if not link.is_valid]
    other = bpy.data.collections.new("another")
    scene.collection.children.link(other)
    kinds.mark(other, "reconstruction")
    second = tmp_path / "frames"
    shutil.copytree(filmed, second)
    film.set_up_compositor(scene, layer, other, second)
    assert other.hide_render and not root.hide_render, "renders no longer show its frames"


def test_compositor_setup_keeps_existing_nodes(shot_blend, filmed):
    bpy.ops.wm.open_mainfile(filepath=str(shot_blend))
    scene, layer = bpy.context.scene, bpy.context.view_layer
    root = next(child for child in scene.collection.children_recursive if kinds.kind_of(child) == "reconstruction")
    if bpy.app.version >= (5, 0):
        tree = scene.compositing_node_group = bpy.data.node_groups.new("mine", "CompositorNodeTree")
        tree.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
        output = tree.nodes.new("NodeGroupOutput")
    else:
        scene.use_nodes = True
        tree = scene.node_tree
        tree.nodes.clear()
        output = tree.nodes.new("CompositorNodeComposite")
    layers, mine = tree.nodes.new("CompositorNodeRLayers"), tree.nodes.new("CompositorNodeBlur")
    tree.links.new(layers.outputs["Image"], mine.inputs[0])
    tree.links.new(mine.outputs[0], output.inputs[0])
    film.set_up_compositor(scene, layer, root, filmed)
    assert [link.to_node.type for link in mine.outputs[0].links] == ["ALPHAOVER"]
    assert sum(node.type == "R_LAYERS" for node in tree.nodes) == 1


@pytest.mark.long
def test_film_command_applies_edits_and_reports_errors(shot_blend, backend_python):
    out = shot_blend.parent / "edited"

    def run(*words):
        return subprocess.run(
            [sys.executable, headless.__file__, "film", *map(str, words)],
            capture_output=True,
            text=True,
            timeout=300,
            env={**os.environ, "OBJECTGS_PYTHON": backend_python},
        )

    objects = shot_blend.parent / "wall" / "objects.json"
    edit_objects(objects, {1: {"removed": True}})
    try:
        ran = run(shot_blend, "--out", out, "--frames", "3,5-6", "--png", "--size", "40x20")
    finally:
        edit_objects(objects, {1: {"removed": None}})
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert len(read_shot(out / "shot.0003-0006.json").frames) == 3
    assert sorted(path.name for path in out.glob("*.exr")) == [f"splats.000{i}.exr" for i in (3, 5, 6)]
    image = pixels_of(out / "splats.0003.png")
    assert image.shape[:2] == (20, 40) and image[10, 4, 3] < 0.01 and image[10, 33, 3] > 0.98
    for words, expected in (
        ((shot_blend, "--out", out, "--frames", "x"), "--frames"),
        ((shot_blend, "--out", out, "--dir", out), "--dir"),
    ):
        ran = run(*words)
        assert ran.returncode == 2 and expected in ran.stderr and ran.stderr.count("\n") == 1, ran.stdout + ran.stderr


@pytest.fixture
def noting_backend(tmp_path, monkeypatch):
    """A stand-in for the backend that does nothing, and the file of its command lines."""
    calls, python = tmp_path / "calls", tmp_path / "python"
    python.write_text(f"""#!/bin/sh\necho "$@" >> '{calls}'\necho '{{"type": "done"}}'\n""")
    python.chmod(0o755)
    monkeypatch.setenv("OBJECTGS_PYTHON", str(python))
    yield calls
    bpy.ops.wm.read_factory_settings(use_empty=True)


def test_film_command_uses_the_folder_that_was_copied_with_the_file(shot_blend, noting_backend, tmp_path, capsys):
    bpy.ops.wm.open_mainfile(filepath=str(shot_blend))
    root = next(c for c in bpy.data.collections if blender_scene.kind_of(c) == "reconstruction")
    root[kinds.RELATIVE_FOLDER] = "wall"
    farm = tmp_path / "farm"
    farm.mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(farm / "shot.blend"), copy=True)

    def used():
        assert headless.main(["film", str(farm / "shot.blend"), "--out", str(tmp_path / "out")]) == 0
        return noting_backend.read_text().splitlines()[-1].split()[3], capsys.readouterr().out

    assert used()[0] == str(shot_blend.parent / "wall"), "nothing was copied yet"
    shutil.copytree(shot_blend.parent / "wall", farm / "wall")
    folder, output = used()
    assert folder == str(farm / "wall") and f"Using the folder {folder} instead" in output


@pytest.mark.skipif(bpy.app.version < (4, 5, 0), reason="offers relative paths for all properties")
def test_output_can_be_relative_to_the_blend(registered):
    options = type(bpy.context.scene.objectgs_film).bl_rna.properties["folder"]
    assert options.is_path_supports_blend_relative


def test_film_operator_says_if_frames_are_empty(root, registered, monkeypatch, capfd):
    monkeypatch.setenv("OBJECTGS_PYTHON", sys.executable)
    monkeypatch.setattr(background, "submit", lambda *_: {"FINISHED"})
    scene = bpy.context.scene
    scene.objectgs.active, scene.frame_end = root, 1
    bpy.ops.objectgs.use_folder()
    for is_excluded in (False, True):
        bpy.context.view_layer.layer_collection.children[root.name].exclude = is_excluded
        assert bpy.ops.objectgs.film_frames() == {"FINISHED"}
        assert ("Warning: Nothing of table top is shown" in capfd.readouterr().out) == is_excluded


def test_film_command_takes_a_view_layer_with_the_reconstruction(shot_blend, noting_backend, tmp_path, capsys):
    """And says if there is none."""
    bpy.ops.wm.open_mainfile(filepath=str(shot_blend))
    scene = bpy.context.scene
    root = next(c for c in bpy.data.collections if blender_scene.kind_of(c) == "reconstruction")
    pivot = ensure_pivot(root, 1)
    for frame in (1, 2):
        pivot.location.x += 1.0
        pivot.keyframe_insert("location", frame=frame)
    effects = scene.view_layers.new("effects")
    scene.view_layers[0].layer_collection.children[root.name].exclude = True

    def filmed():
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "layers.blend"))
        command = ["film", str(tmp_path / "layers.blend"), "--out", str(tmp_path / "out"), "--frames", "1-2"]
        assert headless.main(command) == 0
        frames = read_shot(tmp_path / "out" / "shot.0001-0002.json").frames
        return [frame.samples[0].objects for frame in frames], capsys.readouterr()

    places, output = filmed()
    assert [sorted(each) for each in places] == [[1, 2]] * 2 and "are empty" not in "".join(output)
    assert (places[1][1].maps - places[0][1].maps)[0, 0, 3] == pytest.approx(1.0), "it moves"
    effects = bpy.context.scene.view_layers["effects"]
    effects.layer_collection.children["wall"].exclude = True
    places, output = filmed()
    assert places == [{}, {}] and "Nothing of wall is shown in renders of the view layer ViewLayer" in "".join(output)


def test_film_command_tells_of_places_that_the_file_lacks(shot_blend, noting_backend, tmp_path, capsys):
    objects, command = shot_blend.parent / "wall" / "objects.json", ["film", str(shot_blend), "--out", str(tmp_path)]

    def told():
        assert headless.main([*command, "--frames", "1"]) == 0
        return f"wall does not show the edits in {objects}, which films use" in "".join(capsys.readouterr())

    assert not told()
    moved = np.eye(4)
    moved[0, 3] = 5.0
    edit_objects(objects, {1: {"transform": moved.tolist()}})
    try:
        assert told()
    finally:
        edit_objects(objects, {1: {"transform": None}})


def test_film_command_composes_with_a_view_layer_that_is_rendered(shot_blend, noting_backend, tmp_path, monkeypatch):
    """Also if another one of them has the reconstruction."""
    bpy.ops.wm.open_mainfile(filepath=str(shot_blend))
    layers, used = bpy.context.scene.view_layers, []
    layers[0].use = False
    layers.new("objects").layer_collection.children["wall"].exclude = True
    layers.new("splats")
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "layers.blend"))
    for name in ("set_up_compositor", "rendered_twice"):
        monkeypatch.setattr(filming.filming, name, lambda _scene, layer, *_: used.append(layer.name))
    command = ["film", str(tmp_path / "layers.blend"), "--out", str(tmp_path / "out"), "--frames", "1"]
    assert headless.main([*command, "--save", str(tmp_path / "joined.blend")]) == 0
    assert used == ["objects", "objects"]


def test_film_command_renders_only_missing_composites(shot_blend, noting_backend, tmp_path, monkeypatch, capsys):
    blend, out, written = shutil.copy(shot_blend, tmp_path), tmp_path / "out", []

    def write(_scene, path):
        written.append(path.name)
        path.touch()

    monkeypatch.setattr(filming, "write_picture", write)
    monkeypatch.setattr(filming.filming, "set_up_compositor", lambda *_: None)
    out.mkdir()
    for number in (1, 2):
        (out / f"splats.{number:04d}.exr").touch()

    def composed(*words):
        written.clear()
        command = ["film", str(blend), "--out", str(out), "--frames", "1-2", "--composite", "png", *words]
        assert headless.main(command) == 0
        return [name.split(".")[1] for name in written]

    def later(path, seconds):
        os.utime(path, (time.time() + seconds,) * 2)

    assert composed() == ["0001", "0002"]
    capsys.readouterr()
    assert composed() == [] and "2 of 2 composites exist already." in capsys.readouterr().out
    (out / "composite.0001.png").unlink()
    assert composed() == ["0001"]
    later(out / "splats.0002.exr", 100)
    assert composed() == ["0002"]
    later(out / "splats.0002.exr", -100)
    assert composed("--samples", "3") == ["0001", "0002"] and composed("--samples", "3") == []
    before = Path(blend).read_bytes()
    for _ in range(2):
        assert composed("--samples", "3", "--save", str(blend)) == []
    assert Path(blend).read_bytes() != before
    monkeypatch.setattr(sys, "argv", ["blender", "-b", "-y", "-P", "headless.py", "--", "film"])
    assert composed("--samples", "3") == ["0001", "0002"] and composed("--samples", "3") == []
    bpy.ops.wm.open_mainfile(filepath=str(blend))
    bpy.data.objects["before"].location.x += 1
    bpy.ops.wm.save_mainfile()
    assert composed("--samples", "3") == ["0001", "0002"]


def test_compositor_operator_says_what_it_changes_and_what_is_wrong(root, registered, monkeypatch, capfd):
    scene = bpy.context.scene
    scene.objectgs.active = root
    bpy.ops.objectgs.use_folder()
    instance = bpy.data.objects.new("second", None)
    instance.instance_type, instance.instance_collection = "COLLECTION", blender_scene.object_collections(root)[1]
    scene.collection.objects.link(instance)
    monkeypatch.setattr(film, "set_up_compositor", lambda *_: None)
    monkeypatch.setattr(blender_scene, "render_problem", lambda *_: "The colors change.")
    assert bpy.ops.objectgs.set_up_compositor() == {"FINISHED"}
    printed = capfd.readouterr().out
    assert "Film > Transparent and the pass Z are on" in printed
    assert "Warning: Renders show these twice" in printed and "Warning: The colors change." in printed


def test_compositor_operator_shows_the_matte_of_what_the_active_object_is_merged_into(root, registered, monkeypatch):
    bpy.context.scene.objectgs.active = root
    bpy.ops.objectgs.use_folder()
    mattes = []
    monkeypatch.setattr(film, "set_up_compositor", lambda *arguments: mattes.append(arguments[-1]))
    first, second = root.objectgs.objects[:2]
    root.objectgs.active_object = 0
    bpy.ops.objectgs.set_up_compositor()
    first.is_merged, first.merged_into = True, second.object_id
    bpy.ops.objectgs.set_up_compositor()
    assert mattes == [first.name, second.name]


@pytest.mark.long
def test_film_operators_use_panel_settings(shot_blend, backend_python, registered, monkeypatch, tmp_path):
    """Operators for film frames and the compositor use the panel's folder, and report why they fail."""
    monkeypatch.setenv("OBJECTGS_PYTHON", backend_python)
    bpy.ops.wm.open_mainfile(filepath=str(shot_blend))
    scene = bpy.context.scene
    root = next(child for child in scene.collection.children_recursive if kinds.kind_of(child) == "reconstruction")
    scene.objectgs.active = root
    bpy.ops.objectgs.use_folder()
    scene.objectgs_film.folder = str(tmp_path / "frames")
    with pytest.raises(RuntimeError, match="no film frames"):
        bpy.ops.objectgs.set_up_compositor()
    scene.objectgs_film.folder = "frames"
    with pytest.raises(RuntimeError, match="The output folder frames is relative"):
        bpy.ops.objectgs.film_frames()
    scene.objectgs_film.folder = str(tmp_path / "frames")
    other = bpy.data.collections.new("another")
    scene.collection.children.link(other)
    kinds.mark(other, "reconstruction")
    own = blender_scene.folder_of(root)
    assert folder_of(scene, own) == tmp_path / "frames" / own.name, "each has a folder of its own"
    bpy.data.collections.remove(other)
    assert folder_of(scene, own) == tmp_path / "frames"
    camera, scene.camera = scene.camera, None
    assert not bpy.ops.objectgs.film_frames.poll()
    scene.camera = camera
    scene.render.resolution_percentage = 50
    scene.render.use_motion_blur, scene.objectgs_film.subframes = True, 3
    assert bpy.ops.objectgs.film_frames() == {"FINISHED"}
    (frame,) = read_shot(tmp_path / "frames" / "shot.json").frames
    assert frame.number == 7 and len(frame.samples) == 3
    assert [path.name for path in (tmp_path / "frames").glob("*.exr")] == ["splats.0007.exr"]
    assert bpy.ops.objectgs.set_up_compositor() == {"FINISHED"} and blender_scene.has_frames(scene) and root.hide_render
    camera.data.type = "ORTHO"
    with pytest.raises(RuntimeError, match="orthographic"):
        bpy.ops.objectgs.film_frames()
