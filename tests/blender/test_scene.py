# SPDX-License-Identifier: GPL-3.0-or-later
"""A reconstruction folder in Blender: exact cameras, points, splats in object collections, and updates in place."""

import json
import math
from pathlib import Path
from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Matrix, Vector
from objectgs.backend.shared.color.palette import to_linear
from objectgs.backend.shared.errors import InputError
from objectgs.backend.shared.formats.ply import write_vertices
from objectgs.backend.shared.reconstruction.objects import edit_objects
from objectgs.backend.shared.splats.spherical_harmonics import C0
from objectgs.objectgs_addon import scene as blender_scene
from objectgs.objectgs_addon.scene import cameras as camera_module
from objectgs.objectgs_addon.scene import carrier, kinds
from objectgs.objectgs_addon.scene.shading import modifiers, node_groups
from objectgs.objectgs_addon.scene.shading.materials import COLOR

from .building import HUGE, OBJECTS, K, look_at, splat_table, write_cameras, write_folder, write_points


@pytest.fixture
def folder(tmp_path) -> Path:
    return write_folder(tmp_path / "table top")


@pytest.fixture
def root(fresh, folder):
    """Root collection of the folder, with its result shown."""
    owner = bpy.context.scene
    shown = blender_scene.show_capture(owner, folder)
    blender_scene.show_result(shown, folder)
    return shown


def again(root, folder):
    return blender_scene.show_result(root, folder)


def part(root, object_id, kind):
    return kinds.part_of(blender_scene.object_collections(root)[object_id], kind)


def cameras_of(root):
    return sorted(
        (obj for obj in kinds.capture_of(root).objects if blender_scene.kind_of(obj) == "camera"),
        key=lambda obj: obj.name,
    )


def counts():
    return {
        name: len(getattr(bpy.data, name))
        for name in ("objects", "meshes", "collections", "cameras", "materials", "node_groups", "images")
    }


# Cameras.


@pytest.mark.parametrize("fy", [500.0, 501.5, 498.0])
def test_cameras_match_capture_projection(fresh, tmp_path, fy):
    origin = np.array([1000.0, -2000.0, 30.0])
    upright = np.eye(4)
    upright[:3, :3] = np.array(Matrix.Rotation(0.7, 3, "X")) @ np.array(Matrix.Rotation(0.3, 3, "Z"))
    upright[:3, 3] = 1.0, 2.0, 3.0
    views = [
        look_at(np.array(camera_center) + origin, origin) for camera_center in ((3, 0.5, 1), (-2, 3, 0.2), (0.1, -4, 3))
    ]
    intrinsics = K.copy()
    intrinsics[1, 1] = fy
    write_cameras(tmp_path, views, intrinsics, origin=origin, upright=upright)
    points = np.random.default_rng(0).uniform(-0.8, 0.8, (20, 3)) + origin
    write_points(tmp_path, points, np.zeros(20, int))
    owner = bpy.context.scene
    root = blender_scene.show_capture(owner, tmp_path)
    assert blender_scene.warnings_of(root) == []
    for camera, view in zip(cameras_of(root), views):
        blender_scene.use_camera(owner, camera)
        bpy.context.view_layer.update()
        seen = points @ view[:3, :3].T + view[:3, 3]
        pixels = (seen @ intrinsics.T)[:, :2] / seen[:, 2:]
        world = (points - origin) @ upright[:3, :3].T + upright[:3, 3]
        for place, pixel in zip(world, pixels):
            x, y, depth = world_to_camera_view(owner, camera, Vector(place))
            ours = x * owner.render.resolution_x, (1.0 - y) * owner.render.resolution_y
            assert ours == pytest.approx(pixel, abs=0.01)
            assert depth > 0


def test_camera_has_photo_and_sets_render_size(root, folder):
    owner = bpy.context.scene
    cameras = cameras_of(root)
    assert [camera.name for camera in cameras] == [f"{i:03}.png" for i in range(8)]
    assert owner.camera == cameras[0]
    assert (owner.render.resolution_x, owner.render.resolution_y) == (640, 480)
    assert [camera["held_out"] for camera in cameras] == [True] + [False] * 7
    for camera in cameras:
        image = camera.data.background_images[0].image
        assert camera.data.show_background_images
        assert Path(image.filepath) == folder / "images" / camera.name
        assert image.packed_file is None
        assert 0.05 < camera.data.display_size < 3


def test_photos_are_loaded_once_without_a_search_for_each(fresh, folder, monkeypatch):
    (folder / "below").mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "below" / "own.blend"))
    own = bpy.data.images.load(str(folder / "images" / "002.png"))
    own.filepath = "//../images/002.png"
    asked = []

    class Images:
        """Blender's images, which note how they are loaded."""

        def __iter__(self):
            return iter(bpy.data.images)

        def load(self, path, check_existing=False):
            asked.append(check_existing)
            return bpy.data.images.load(path, check_existing=check_existing)

    data = SimpleNamespace(images=Images(), objects=bpy.data.objects, cameras=bpy.data.cameras)
    monkeypatch.setattr(camera_module, "bpy", SimpleNamespace(data=data, path=bpy.path))
    for _ in range(2):
        root = blender_scene.show_capture(bpy.context.scene, folder)
        photos = [camera.data.background_images[0].image for camera in cameras_of(root)]
        assert photos[2] == own and len(set(photos)) == 8 and asked == [False] * 7


def test_user_camera_and_render_size_are_kept(fresh, folder):
    owner = bpy.context.scene
    own = bpy.data.objects.new("own", bpy.data.cameras.new("own"))
    owner.collection.objects.link(own)
    owner.camera = own
    owner.render.resolution_x = 77
    view_transform = owner.view_settings.view_transform
    blender_scene.show_capture(owner, folder)
    assert owner.camera == own
    assert owner.render.resolution_x == 77
    assert owner.view_settings.view_transform == view_transform


def test_update_keeps_copied_cameras_and_the_render_size(root, folder):
    owner, capture = bpy.context.scene, kinds.capture_of(root)
    original = cameras_of(root)[2]
    copy = original.copy()
    copy.data = original.data.copy()
    copy.location, copy.data.lens = (7, 8, 9), 12
    capture.objects.link(copy)
    poses = json.loads((folder / "cameras.json").read_text())
    poses["cameras"][2]["viewmat"][2][3] += 0.5
    (folder / "cameras.json").write_text(json.dumps(poses))
    before = original.location.copy()
    owner.render.resolution_x, owner.render.resolution_percentage = 1920, 50
    blender_scene.show_capture(owner, folder)
    assert (original.location - before).length == pytest.approx(0.5, abs=1e-4)
    assert tuple(copy.location) == (7, 8, 9) and copy.data.lens == 12
    assert (owner.render.resolution_x, owner.render.resolution_percentage) == (1920, 50)
    # Where the size is still that of the photo, it follows the photo.
    blender_scene.use_camera(owner, original)
    for camera in poses["cameras"]:
        camera["width"] *= 2
    (folder / "cameras.json").write_text(json.dumps(poses))
    blender_scene.show_capture(owner, folder)
    assert owner.render.resolution_x == original["width"] == poses["cameras"][2]["width"]


def test_capture_that_was_moved_in_the_outliner_is_updated(root, folder):
    owner, capture = bpy.context.scene, kinds.capture_of(root)
    owner.collection.children.link(capture)
    root.children.unlink(capture)
    before = counts()
    assert blender_scene.show_capture(owner, folder) == root
    assert counts() == before and kinds.capture_of(root) == capture


def test_cameras_see_the_scene_whatever_its_size(root):
    cameras = cameras_of(root)
    assert all(camera.data.clip_end == 1000 for camera in cameras)
    blender_scene.scale_to_distance(root, (0, 0, 0), (1, 0, 0), 5000.0)
    assert all(camera.data.clip_end > 20 * 5000 for camera in cameras)
    assert all(0.01 < camera.data.clip_start <= 0.1 + 1e-6 for camera in cameras)
    blender_scene.scale_to_distance(root, (0, 0, 0), (5000, 0, 0), 0.001)
    assert all(camera.data.clip_start < 1e-4 for camera in cameras)


def test_pixel_aspect_and_missing_photos_are_reported(fresh, folder):
    content = json.loads((folder / "cameras.json").read_text())
    content["cameras"][3]["K"][1][1] *= 1.05
    (folder / "cameras.json").write_text(json.dumps(content))
    (folder / "images" / "005.png").unlink()
    shown = blender_scene.show_capture(bpy.context.scene, folder)
    shape, missing = blender_scene.warnings_of(shown)
    assert "pixel aspect ratios" in shape
    assert "1 of 8 images are missing" in missing and "005.png" in missing
    assert len(cameras_of(shown)[5].data.background_images) == 0


def test_uncertain_cameras_are_marked(root, folder):
    """Errors of 1 pixel are typical; twice that is a third of the way to 3, and weak photos are at the end."""
    view_layer = bpy.context.view_layer
    assert not list(blender_scene.uncertain_cameras(view_layer, None))
    pixels = {"002.png": 2.0, "003.png": 4.0, "005.png": 1.4}
    report = {
        "figures": {f"{i:03}.png": {"error": pixels.get(f"{i:03}.png", 1.0)} for i in range(7)},
        "weak": {"006.png": "only 30 points determine its pose"},
    }
    (folder / "sfm").mkdir()
    (folder / "sfm" / "sfm.json").write_text(json.dumps(report))
    shown = blender_scene.show_capture(bpy.context.scene, folder, root)
    cameras = {camera.name: camera for camera in cameras_of(shown)}
    cameras["003.png"].hide_set(True)
    found = {camera.name: uncertainty for camera, uncertainty in blender_scene.uncertain_cameras(view_layer, None)}
    assert found == {"002.png": pytest.approx(1 / 3), "006.png": 1.0}
    assert "only 30 points" in cameras["006.png"]["weak_because"]
    (folder / "sfm" / "sfm.json").write_text('{"figures": {"002.png": 3}, "weak": []}')
    blender_scene.show_capture(bpy.context.scene, folder, root)
    assert not list(blender_scene.uncertain_cameras(view_layer, None)), "an invalid report tells nothing"


def test_removed_capture_cameras_are_deleted(root, folder):
    write_cameras(folder, [look_at((3, 0, 1)), look_at((0, 3, 1))])
    before = len(bpy.data.cameras)
    assert blender_scene.show_capture(bpy.context.scene, folder) == root
    assert [camera.name for camera in cameras_of(root)] == ["000.png", "001.png"]
    assert len(bpy.data.cameras) == before - 6


# Points.


def test_points_show_chosen_color(root, folder):
    points = kinds.points_of(root)
    mesh = points.data
    assert points.hide_render
    assert carrier.read(mesh, "photo")[0] == pytest.approx([*to_linear((200, 0, 0)), 1.0], abs=1e-6)
    ids = carrier.read(mesh, "object_id").astype(np.int64) & 0xFFFFFFFF
    assert set(ids) == {0, *OBJECTS}
    place = int(np.flatnonzero(ids == 2)[0])
    assert carrier.read(mesh, "object")[place] == pytest.approx([*to_linear((10, 20, 31)), 1.0], abs=1e-6)
    assert carrier.read(mesh, "margin")[0] == 0.5
    for by in ("object", "photo"):
        blender_scene.color_points_by(root, by)
        shown = points.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
        assert len(shown.polygons) == 8 * 30
        assert shown.attributes.active_color_name == by  # Solid shading shows it if its color is set to Attribute
        first = carrier.read(mesh, by)[:1]
        assert carrier.read(shown, COLOR)[1:7] == pytest.approx(np.repeat(first, 6, 0), abs=1e-6)
        assert shown.materials[0].name == "ObjectGS Points"


def test_new_vote_and_edits_update_points_and_names(root, folder):
    blender_scene.color_points_by(root, "object")
    edit_objects(folder / "objects.json", {1: dict(name="cup", color=[255, 0, 0])})
    write_points(folder, np.zeros((5, 3)), [1, 1, 1, 1, 2])
    blender_scene.show_objects(root, folder)
    mesh = kinds.points_of(root).data
    assert len(mesh.vertices) == 5
    assert carrier.read(mesh, "object")[0] == pytest.approx([1, 0, 0, 1])
    assert mesh.attributes.active_color_name == "object"
    collection = blender_scene.object_collections(root)[1]
    assert collection.name == "cup"
    assert {obj.name for obj in collection.objects} == {"cup", "cup splats", "cup anchors"}
    splats = part(root, 1, "splats")
    assert tuple(splats.color) == pytest.approx((1, 0, 0, 1))
    assert tuple(splats.data.materials[0].diffuse_color) == pytest.approx((1, 0, 0, 1))


# Objects.


def test_object_collections_have_splats_and_anchors(root, folder):
    collections = blender_scene.object_collections(root)
    assert {object_id: collection.name for object_id, collection in collections.items()} == {**OBJECTS, 0: "Background"}
    for object_id, collection in collections.items():
        assert collection.name in root.children
        assert blender_scene.kind_of(collection) == "object"
        assert blender_scene.object_id_of(collection) == object_id
        assert [blender_scene.kind_of(obj) for obj in blender_scene.parts_of(collection)] == [
            "object_parent",
            "splats",
            "anchors",
        ]
        for obj in blender_scene.parts_of(collection):
            assert blender_scene.object_id_of(obj) == object_id
            assert blender_scene.root_of(obj, bpy.context.scene) == root
        assert blender_scene.root_of(collection, bpy.context.scene) == root
        anchors = part(root, object_id, "anchors")
        assert anchors.hide_render and anchors.hide_viewport
        assert list(carrier.read(anchors.data, "splats")) == [7, 7]
        assert list(carrier.read(anchors.data, "opacity")) == [0.25, 0.25]
    assert blender_scene.folder_of(root) == folder
    assert kinds.object_id_of(root) is None
    assert blender_scene.kind_of(bpy.context.scene) is None


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_splat_attributes_match_blender_names(fresh, folder, degree):
    table = splat_table(np.resize([1, 2], 20), degree)
    write_vertices(folder / "splats.ply", table)
    owner = bpy.context.scene
    root = blender_scene.show_capture(owner, folder)
    shown = blender_scene.show_result(root, folder)
    assert (shown.objects, shown.splats, shown.warnings) == (3, 20, [])
    bpy.context.view_layer.update()
    rows = table[table["object_id"] == 2]
    splats = part(root, 2, "splats")
    mesh = splats.data
    world = carrier.read(mesh, "position") + np.array(splats.matrix_world.translation)
    assert world == pytest.approx(np.stack([rows["x"], rows["y"], rows["z"]], 1), abs=1e-5)
    base = carrier.read(mesh, "radiance:base")
    assert base[:, :3] == pytest.approx(np.stack([rows[f"f_dc_{i}"] for i in range(3)], 1))
    assert base[:, 3] == pytest.approx(1 / (1 + np.exp(-rows["opacity"])), abs=1e-6)
    assert carrier.read(mesh, "scale") == pytest.approx(np.exp(np.stack([rows[f"scale_{i}"] for i in range(3)], 1)))
    quaternion = np.stack([rows[f"rot_{i}"] for i in range(4)], 1)
    assert carrier.read(mesh, "rotation") == pytest.approx(
        quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True), abs=1e-6
    )
    higher = (degree + 1) ** 2 - 1
    assert f"radiance:sh_{higher + 1}" not in mesh.attributes
    for k in range(higher):
        assert carrier.read(mesh, f"radiance:sh_{k + 1}") == pytest.approx(
            np.stack([rows[f"f_rest_{channel * higher + k}"] for channel in range(3)], 1)
        )
    assert set(carrier.read(mesh, "object_id")) == {2}
    types = {a.name: a.data_type for a in mesh.attributes}
    assert (types["radiance:base"], types["rotation"], types["scale"]) == ("FLOAT_COLOR", "QUATERNION", "FLOAT_VECTOR")


def test_viewport_shows_points_or_ellipsoids(root):
    splats = part(root, 1, "splats")
    modifier = modifiers.modifier_of(splats, node_groups.SPLATS_GROUP)
    instances = [
        1
        for instance in bpy.context.evaluated_depsgraph_get().object_instances
        if instance.is_instance and instance.parent and instance.parent.original == splats
    ]
    assert len(instances) <= 1  # the point cloud itself
    modifiers.set_input(modifier, "Ellipsoids", True)
    splats.update_tag()
    instances = [
        1
        for instance in bpy.context.evaluated_depsgraph_get().object_instances
        if instance.is_instance and instance.parent and instance.parent.original == splats
    ]
    assert len(instances) == 10


def test_invalid_splats_are_left_out_and_reported(fresh, folder):
    table = splat_table(np.resize([1, 2], 20))
    table["x"][3], table["opacity"][4], table["scale_1"][5] = np.nan, np.inf, 200.0
    for i in range(4):
        table[f"rot_{i}"][6] = 0.0
    write_vertices(folder / "splats.ply", table)
    owner = bpy.context.scene
    root = blender_scene.show_capture(owner, folder)
    shown = blender_scene.show_result(root, folder)
    assert shown.splats == 16
    assert shown.warnings == [
        "4 of 20 splats in splats.ply are left out: they have NaN, infinite or too large values, or no rotation."
    ]


# Updates in place.


def test_update_keeps_user_changes(root, folder):
    owner = bpy.context.scene
    kitchen = bpy.data.collections.new("Kitchen")
    owner.collection.children.link(kitchen)
    mug = blender_scene.object_collections(root)[1]
    kitchen.children.link(mug)
    root.children.unlink(mug)
    pivot, splats, anchors = blender_scene.parts_of(mug)
    pivot.location, pivot.scale = (1, 2, 3), (2, 2, 2)
    mug.name, splats.name, root.name = "My mug", "mine", "Breakfast"
    splats.modifiers.new("own", "NODES")
    own = bpy.data.materials.new("own")
    splats.data.materials.append(own)
    modifiers.set_input(splats.modifiers[0], "Point Size", 3.0)
    splats.hide_render, anchors.hide_viewport = True, False
    parent = kinds.parent_of(root)
    parent.location = 5, 5, 5
    local = carrier.read(splats.data, "position")
    before = counts()

    table = splat_table(np.resize([0, *OBJECTS], 40))
    table["opacity"] += 1
    write_vertices(folder / "splats.ply", table)
    assert blender_scene.show_capture(owner, folder) == root
    again(root, folder)
    blender_scene.show_objects(root, folder)

    assert counts() == before
    assert blender_scene.object_collections(root)[1] == mug
    assert mug.name in kitchen.children and mug.name not in root.children
    assert (mug.name, splats.name, root.name) == ("My mug", "mine", "Breakfast")
    assert tuple(pivot.location) == (1, 2, 3) and tuple(pivot.scale) == (2, 2, 2)
    assert tuple(parent.location) == (5, 5, 5)
    assert [m.name for m in splats.modifiers] == ["ObjectGS Splats", "ObjectGS Render", "own"]
    assert own in splats.data.materials[:]
    assert splats.hide_render and not anchors.hide_viewport
    assert carrier.read(splats.data, "position") == pytest.approx(local)
    expected = 1 / (1 + np.exp(-table["opacity"][table["object_id"] == 1]))
    assert carrier.read(splats.data, "radiance:base")[:, 3] == pytest.approx(expected, abs=1e-6)
    assert blender_scene.root_of(splats, owner) == root
    assert blender_scene.root_of(mug, owner) == root


def test_result_of_different_size_replaces_previous_one(root, folder):
    write_vertices(folder / "splats.ply", splat_table(np.resize([0, *OBJECTS], 84), degree=0, seed=3))
    shown = again(root, folder)
    assert (shown.objects, shown.splats, shown.anchors) == (3, 84, 8)
    mesh = part(root, 1, "splats").data
    assert len(mesh.vertices) == 21
    assert "radiance:sh_1" not in mesh.attributes
    assert len(kinds.part_of(blender_scene.object_collections(root)[1], "splats").data.materials) == 1


def test_splats_have_the_filter_of_their_file(root, folder):
    for comments, blur in ((["low_pass 0.05"], 0.05), ([], 0.3)):
        write_vertices(folder / "splats.ply", splat_table(np.resize([1], 10)), comments)
        again(root, folder)
        assert blender_scene.blur_of(part(root, 1, "splats").data) == pytest.approx(blur)


def test_vanished_objects_are_removed_and_user_objects_kept(root, folder):
    cube = bpy.data.objects.new("cube", bpy.data.meshes.new("cube"))
    blender_scene.object_collections(root)[2].objects.link(cube)
    write_vertices(folder / "splats.ply", splat_table(np.resize([1], 10)))
    (folder / "anchors.ply").unlink()
    before = counts()
    shown = again(root, folder)
    assert shown.objects == 1
    collections = blender_scene.object_collections(root)
    assert set(collections) == {1, 2}
    assert {obj.name for obj in collections[2].objects} == {"can", "cube"}
    after = counts()
    assert before["meshes"] - after["meshes"] == 6  # splats and anchors of 0, 2 and the last
    assert before["materials"] - after["materials"] == 3
    assert before["collections"] - after["collections"] == 2


def test_merged_objects_share_collection_until_split(root, folder):
    edit_objects(folder / "objects.json", {2: dict(merged_into=1)})
    blender_scene.show_objects(root, folder)
    collections = blender_scene.object_collections(root)
    assert set(collections) == {0, 1, HUGE}
    splats = part(root, 1, "splats")
    assert len(splats.data.vertices) == 20
    assert sorted(carrier.read(splats.data, "object_id")) == [1] * 10 + [2] * 10
    edit_objects(folder / "objects.json", {2: dict(merged_into=None)})
    blender_scene.show_objects(root, folder)
    assert {
        object_id: len(part(root, object_id, "splats").data.vertices)
        for object_id in blender_scene.object_collections(root)
    } == {0: 10, 1: 10, 2: 10, HUGE: 10}


def test_left_out_objects_are_not_shown(root, folder):
    edit_objects(folder / "objects.json", {2: dict(left_out=True)})
    blender_scene.show_objects(root, folder)
    assert set(blender_scene.object_collections(root)) == {0, 1, HUGE}
    ids = carrier.read(kinds.points_of(root).data, "object_id")
    colors = carrier.read(kinds.points_of(root).data, "object")
    assert colors[ids == 2] == pytest.approx(np.repeat(colors[ids == 0][:1], np.count_nonzero(ids == 2), 0))


def test_deleted_parts_are_restored_with_next_result(root, folder):
    bpy.data.objects.remove(part(root, 1, "splats"))
    bpy.data.collections.remove(blender_scene.object_collections(root)[2])
    bpy.data.objects.remove(kinds.parent_of(root))
    blender_scene.show_capture(bpy.context.scene, folder)
    again(root, folder)
    assert len(part(root, 1, "splats").data.vertices) == 10
    assert len(part(root, 2, "splats").data.vertices) == 10
    assert part(root, HUGE, "object_parent").parent == kinds.parent_of(root)


def test_reconstructions_in_one_file_are_separate(root, folder, tmp_path):
    other_folder = tmp_path / "other"
    other_folder.mkdir()
    write_cameras(other_folder, [look_at((3, 0, 1))])
    write_points(other_folder, np.ones((3, 3)), [1, 1, 1])
    write_vertices(other_folder / "splats.ply", splat_table(np.resize([1], 4)))
    owner = bpy.context.scene
    other = blender_scene.show_capture(owner, other_folder, name="Second")
    blender_scene.show_result(other, other_folder)
    assert other != root and other.name == "Second"
    assert set(blender_scene.object_collections(other)) == {1}
    assert len(part(other, 1, "splats").data.vertices) == 4
    assert len(part(root, 1, "splats").data.vertices) == 10
    assert blender_scene.root_of(part(other, 1, "splats"), owner) == other
    assert blender_scene.root_of(bpy.data.objects.new("stranger", None), owner) is None


# Faults.


@pytest.mark.parametrize(
    ("name", "corrupt", "sentence"),
    [
        ("cameras.json", None, "is no reconstruction, since it has no cameras.json"),
        ("cameras.json", b"{}", "is not a valid list of cameras"),
        ("cameras.json", b"{", "cannot be read as JSON"),
        ("points.ply", None, "has no points.ply; use Import Capture again"),
        ("points.ply", b"ply\n", "no complete PLY header"),
        ("objects.json", b"[]", "is not a valid list of objects"),
    ],
)
def test_invalid_captures_change_nothing(fresh, folder, name, corrupt, sentence):
    (folder / name).unlink() if corrupt is None else (folder / name).write_bytes(corrupt)
    before = counts()
    with pytest.raises(InputError, match=sentence):
        blender_scene.show_capture(bpy.context.scene, folder)
    assert counts() == before


@pytest.mark.parametrize(
    ("name", "corrupt", "sentence"),
    [
        ("splats.ply", None, "has no splats.ply; train first"),
        ("splats.ply", "points.ply", "not one of Gaussian splats"),
        ("anchors.ply", "points.ply", "has no property scale_0"),
        ("splats.ply", "cut", "truncated"),
    ],
)
def test_invalid_results_change_nothing(root, folder, name, corrupt, sentence):
    path = folder / name
    if corrupt is None:
        path.unlink()
    elif corrupt == "cut":
        path.write_bytes(path.read_bytes()[:-1])
    else:
        path.write_bytes((folder / corrupt).read_bytes())
    before = counts()
    with pytest.raises(InputError, match=sentence):
        again(root, folder)
    assert counts() == before
    assert len(part(root, 1, "splats").data.vertices) == 10


def test_object_in_edit_mode_is_not_overwritten(root, folder):
    splats = part(root, 1, "splats")
    bpy.context.view_layer.objects.active = splats
    bpy.ops.object.mode_set(mode="EDIT")
    with pytest.raises(InputError, match="mug splats is in Edit Mode"):
        again(root, folder)
    bpy.ops.object.mode_set(mode="OBJECT")


def test_blend_file_without_folder_opens(root, folder, tmp_path):
    blend = tmp_path / "old.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(blend))
    folder.rename(tmp_path / "gone")
    bpy.ops.wm.open_mainfile(filepath=str(blend))
    owner = bpy.context.scene
    shown = next(child for child in owner.collection.children if blender_scene.kind_of(child) == "reconstruction")
    assert set(blender_scene.object_collections(shown)) == {0, *OBJECTS}
    blender_scene.color_points_by(shown, "object")
    with pytest.raises(InputError, match=r"no cameras\.json"):
        blender_scene.show_capture(owner, blender_scene.folder_of(shown), shown)
    with pytest.raises(InputError, match="train first"):
        again(shown, folder)


# Orientation.


def test_orient_to_ground_places_points_below_cameras(root):
    parent = kinds.parent_of(root)
    parent.matrix_world = Matrix.Rotation(2.1, 4, "X") @ Matrix.Translation((1, 2, 3))
    bpy.context.view_layer.update()
    before = parent.matrix_world.copy()
    corners = [before @ Vector(corner) for corner in ((0, 0, -0.5), (1, 0, -0.5), (0, 1, -0.5))]
    for order in ((0, 1, 2), (2, 1, 0)):
        parent.matrix_world = before
        blender_scene.orient_to_ground(root, *(corners[i] for i in order))
        move = parent.matrix_world @ before.inverted()
        for corner in corners:
            assert (move @ corner).z == pytest.approx(0.0, abs=1e-5)
        bpy.context.view_layer.update()
        assert all(camera.matrix_world.translation.z > 0.5 for camera in cameras_of(root))
        center = sum(corners, Vector()) / 3
        assert tuple((move @ center).xy) == pytest.approx(tuple(center.xy), abs=1e-5)
    # Blender does not update what is excluded from the view layer.
    bpy.context.view_layer.layer_collection.children[root.name].children[kinds.capture_of(root).name].exclude = True
    parent.matrix_world = Matrix.Rotation(np.pi, 4, "X") @ before
    bpy.context.view_layer.update()
    turned = [parent.matrix_world @ before.inverted() @ corner for corner in corners]
    blender_scene.orient_to_ground(root, *turned)
    assert all(blender_scene.matrix_to_world(camera)[2, 3] > 0.5 for camera in cameras_of(root))
    with pytest.raises(InputError, match="one line"):
        blender_scene.orient_to_ground(root, (0, 0, 0), (1, 1, 1), (3, 3, 3))


def test_scale_to_distance_sets_point_distance(root):
    parent = kinds.parent_of(root)
    before = parent.matrix_world.copy()
    blender_scene.scale_to_distance(root, (1, 0, 0), (3, 0, 0), 0.5)
    move = parent.matrix_world @ before.inverted()
    assert (move @ Vector((3, 0, 0)) - move @ Vector((1, 0, 0))).length == pytest.approx(0.5)
    with pytest.raises(InputError, match="coincide"):
        blender_scene.scale_to_distance(root, (1, 1, 1), (1, 1, 1), 2.0)
    with pytest.raises(InputError, match="greater than 0"):
        blender_scene.scale_to_distance(root, (0, 0, 0), (1, 1, 1), 0.0)


# Renders.


def rendered(tmp_path, size=(33, 33)) -> np.ndarray:
    """Render with Cycles; return linear colors (H, W, 3) from the top row."""
    owner = bpy.context.scene
    blender_scene.prepare_render(owner)
    owner.render.engine = "CYCLES"
    owner.cycles.device, owner.cycles.samples, owner.cycles.use_denoising = "CPU", 64, False
    owner.cycles.pixel_filter_type, owner.cycles.filter_width = "BLACKMAN_HARRIS", 0.01
    owner.render.image_settings.file_format = "OPEN_EXR"
    owner.render.image_settings.color_depth = "32"
    owner.render.filepath = str(tmp_path / "picture.exr")
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(owner.render.filepath)
    pixels = np.array(image.pixels[:]).reshape(size[1], size[0], -1)[::-1, :, :3]
    bpy.data.images.remove(image)
    return pixels


def test_rendered_splat_matches_gaussian_and_view_color(fresh, tmp_path):
    """Every pixel of a degree-3 splat under a moved and rotated parent agrees with the formula."""
    view = look_at((2.0, -3.0, 1.5))
    intrinsics = np.array([[60.0, 0.0, 16.5], [0.0, 60.0, 16.5], [0.0, 0.0, 1.0]])
    write_cameras(tmp_path, [view], intrinsics, size=(33, 33))
    write_points(tmp_path, np.zeros((1, 3)), [1])
    table = splat_table([1], degree=3, seed=5)
    position = np.array([0.05, -0.1, 0.02])
    for axis, name in enumerate("xyz"):
        table[name] = position[axis]
    scales = np.array([0.35, 0.15, 0.1])
    for axis in range(3):
        table[f"scale_{axis}"] = np.log(scales[axis])
    table["opacity"] = np.log(0.8 / 0.2)
    for i in range(45):
        table[f"f_rest_{i}"] *= 0.1
    table["f_dc_0"], table["f_dc_1"], table["f_dc_2"] = 0.9, 0.2, -0.5
    write_vertices(tmp_path / "splats.ply", table)
    owner = bpy.context.scene
    root = blender_scene.show_capture(owner, tmp_path)
    blender_scene.show_result(root, tmp_path)
    kinds.parent_of(root).matrix_world = Matrix.Translation((3, 4, 5)) @ Matrix.Rotation(1.0, 4, "Y")
    image = rendered(tmp_path)

    rotation = np.array(_rotation(table))
    camera_center = -view[:3, :3].T @ view[:3, 3]
    v, u = np.mgrid[0:33, 0:33] + 0.5
    rays = np.stack([(u - 16.5) / 60.0, (v - 16.5) / 60.0, np.ones_like(u)], -1) @ view[:3, :3]
    start = (camera_center - position) @ rotation / scales
    rays = rays @ rotation / scales
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    squared = start @ start - (rays @ start) ** 2
    alpha = 0.8 * np.exp(-0.5 * squared)
    alpha[alpha < 1 / 255] = 0.0
    color = np.clip(0.5 + _harmonics(table, position - camera_center), 0.0, None)
    linear = np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)
    assert np.abs(image - alpha[..., None] * linear).max() < 0.002 * linear.max()
    assert image.max() > 0.5 * linear.max()


def _rotation(table):
    w, x, y, z = np.array([table[f"rot_{i}"][0] for i in range(4)], float) / np.linalg.norm(
        [table[f"rot_{i}"][0] for i in range(4)]
    )
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]


def _harmonics(table, direction):
    """Evaluate spherical harmonics of degree 0 to 3 with the textbook formulas."""
    x, y, z = direction / np.linalg.norm(direction)
    pi = math.pi
    basis = [
        math.sqrt(1 / (4 * pi)),
        -math.sqrt(3 / (4 * pi)) * y,
        math.sqrt(3 / (4 * pi)) * z,
        -math.sqrt(3 / (4 * pi)) * x,
        math.sqrt(15 / (4 * pi)) * x * y,
        -math.sqrt(15 / (4 * pi)) * y * z,
        math.sqrt(5 / (16 * pi)) * (3 * z * z - 1),
        -math.sqrt(15 / (4 * pi)) * x * z,
        math.sqrt(15 / (16 * pi)) * (x * x - y * y),
        -math.sqrt(35 / (32 * pi)) * y * (3 * x * x - y * y),
        math.sqrt(105 / (4 * pi)) * x * y * z,
        -math.sqrt(21 / (32 * pi)) * y * (5 * z * z - 1),
        math.sqrt(7 / (16 * pi)) * z * (5 * z * z - 3),
        -math.sqrt(21 / (32 * pi)) * x * (5 * z * z - 1),
        math.sqrt(105 / (16 * pi)) * z * (x * x - y * y),
        -math.sqrt(35 / (32 * pi)) * x * (x * x - 3 * y * y),
    ]
    coefficients = np.array(
        [[table[f"f_dc_{c}"][0], *(table[f"f_rest_{15 * c + k}"][0] for k in range(15))] for c in range(3)]
    )
    return coefficients @ basis


def test_nearer_splats_occlude_farther_ones(fresh, tmp_path):
    write_cameras(tmp_path, [look_at((0.0, -3.0, 0.0))], [[60, 0, 16.5], [0, 60, 16.5], [0, 0, 1]], size=(33, 33))
    write_points(tmp_path, np.zeros((1, 3)), [1])
    table = splat_table([1, 2], degree=0)
    for name in ("x", "z"):
        table[name] = 0.0
    table["y"] = 0.5, -0.5
    for i in range(3):
        table[f"scale_{i}"] = np.log(0.2)
        table[f"f_dc_{i}"] = -0.5 / C0
    table["f_dc_0"][0] = table["f_dc_1"][1] = 0.5 / C0
    table["opacity"] = 6.0
    write_vertices(tmp_path / "splats.ply", table)
    owner = bpy.context.scene
    root = blender_scene.show_capture(owner, tmp_path)
    blender_scene.show_result(root, tmp_path)
    red, green, _ = rendered(tmp_path)[16, 16]
    assert green > 0.98 and red < 0.02
