# SPDX-License-Identifier: GPL-3.0-or-later
"""Meshes in Blender: exact position, UVs, colors, material, updates in place, visibility, merges and faults."""

import json
import os
from pathlib import Path
from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from mathutils import Matrix
from objectgs.backend.shared.errors import InputError
from objectgs.backend.shared.formats.ply import write_vertices
from objectgs.backend.shared.reconstruction.lock import locked
from objectgs.backend.shared.reconstruction.objects import edit_objects
from objectgs.objectgs_addon import panels
from objectgs.objectgs_addon import scene as blender_scene
from objectgs.objectgs_addon.environment import locations
from objectgs.objectgs_addon.picking import selection
from objectgs.objectgs_addon.process.jobs import Job
from objectgs.objectgs_addon.running import background, results
from objectgs.objectgs_addon.scene import kinds
from objectgs.objectgs_addon.scene.meshes import export as mesh_export
from objectgs.objectgs_addon.state.folder_state import folder_state
from objectgs.objectgs_addon.state.next_step import next_step

import headless

from .building import (
    HUGE,
    OBJECTS,
    look_at,
    splat_table,
    tetrahedron,
    write_cameras,
    write_folder,
    write_meshes,
    write_png,
)
from .drawn import texts_of

ORIGIN = np.array([1000.0, -2000.0, 30.0])


@pytest.fixture
def folder(tmp_path) -> Path:
    """A folder far from the origin with meshes of objects 1 and 2; HUGE has none, with a reason."""
    place = write_folder(tmp_path / "table top")
    upright = np.eye(4)
    upright[:3, :3] = np.array(Matrix.Rotation(0.7, 3, "X")) @ np.array(Matrix.Rotation(0.3, 3, "Z"))
    upright[:3, 3] = 1.0, 2.0, 3.0
    write_cameras(place, [look_at(ORIGIN + np.array([3, 0, 1]), ORIGIN)], origin=ORIGIN, upright=upright)
    splats = splat_table(np.resize([0, *OBJECTS], 40))
    for axis, name in enumerate("xyz"):
        splats[name] += ORIGIN[axis]
    write_vertices(place / "splats.ply", splats)
    write_meshes(
        place,
        {
            "1": tetrahedron(ORIGIN + 0.5),
            "2": tetrahedron(ORIGIN - 0.5, 0.5),
            str(HUGE): "box was seen in one view only.",
        },
    )
    return place


@pytest.fixture
def root(fresh, folder):
    """Root collection of the folder, with its result shown."""
    shown = blender_scene.show_capture(bpy.context.scene, folder)
    assert blender_scene.show_result(shown, folder).warnings == []
    return shown


def parts(root, object_id, kind):
    collection = blender_scene.object_collections(root)[object_id]
    return [obj for obj in collection.objects if blender_scene.kind_of(obj) == kind]


def mesh_of(root, object_id):
    (obj,) = parts(root, object_id, "mesh")
    return obj


def rewrite(folder, rgb=(0, 255, 0), **meshes):
    """Write newer meshes with a new texture; by default, a larger mesh of object 1."""
    meshes = {key.removeprefix("_"): mesh for key, mesh in meshes.items()} or {"1": tetrahedron(ORIGIN, 2.0)}
    write_meshes(folder, meshes, rgb=rgb)
    for path in (folder / "meshes").iterdir():
        later = path.stat().st_mtime_ns + 5_000_000_000
        os.utime(path, ns=(later, later))


def coordinates(obj) -> np.ndarray:
    """Return the world coordinates (V, 3) of a mesh's vertices."""
    local = np.empty(3 * len(obj.data.vertices), np.float32)
    obj.data.vertices.foreach_get("co", local)
    matrix = np.array(obj.matrix_world)
    return local.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3]


def counts():
    return {name: len(getattr(bpy.data, name)) for name in ("objects", "meshes", "collections", "materials", "images")}


def shader_of(material):
    return next(node for node in material.node_tree.nodes if node.type == "BSDF_PRINCIPLED")


def image_of(material):
    return next(node for node in material.node_tree.nodes if node.type == "TEX_IMAGE").image


# What a mesh is.


def test_mesh_position_matches_file(root, folder):
    bpy.context.view_layer.update()
    upright = np.array(kinds.parent_of(root).matrix_world)
    for object_id, center, size in ((1, 0.5, 1.0), (2, -0.5, 0.5)):
        obj = mesh_of(root, object_id)
        expected = tetrahedron(ORIGIN + center, size).vertices - ORIGIN
        assert coordinates(obj) == pytest.approx(expected @ upright[:3, :3].T + upright[:3, 3], abs=2e-6)
        assert obj.parent == parts(root, object_id, "object_parent")[0]
        assert tuple(obj.matrix_basis.translation) == (0, 0, 0), "mesh and splats have the origin of the pivot"
        assert blender_scene.object_id_of(obj) == object_id
        assert blender_scene.root_of(obj, bpy.context.scene) == root
    assert parts(root, HUGE, "mesh") == []
    blender_scene.show_kinds(root, "both")
    bpy.context.view_layer.update()
    assert parts(root, 1, "splats")[0].matrix_world == mesh_of(root, 1).matrix_world


def test_mesh_data_matches_file(root):
    obj, given = mesh_of(root, 1), tetrahedron()
    mesh = obj.data
    assert [tuple(polygon.vertices) for polygon in mesh.polygons] == [tuple(face) for face in given.faces]
    assert [layer.name for layer in mesh.uv_layers] == ["UVMap"] and mesh.uv_layers.active.active_render
    assert np.array([entry.vector for entry in mesh.uv_layers["UVMap"].uv]) == pytest.approx(given.uvs.reshape(-1, 2))
    colors = mesh.color_attributes["Col"]
    assert (colors.data_type, colors.domain) == ("BYTE_COLOR", "POINT")
    assert np.array([entry.color_srgb for entry in colors.data])[:, :3] * 255 == pytest.approx(given.colors, abs=1e-3)
    assert mesh.color_attributes.active_color == colors
    unobserved = mesh.attributes["unobserved"]
    assert (unobserved.data_type, unobserved.domain) == ("BOOLEAN", "FACE")
    assert [entry.value for entry in unobserved.data] == list(given.unobserved)
    assert all(polygon.use_smooth for polygon in mesh.polygons)
    normals = np.array([entry.vector for entry in mesh.corner_normals])
    assert normals == pytest.approx(given.normals[given.faces.reshape(-1)], abs=0.01)
    assert not mesh.validate()
    assert (obj.name, mesh.name) == ("mug mesh", "mug mesh")


def test_material_uses_texture(root, folder):
    materials = [mesh_of(root, object_id).data.materials[0] for object_id in (1, 2)]
    assert materials[0] != materials[1]
    for material, name in zip(materials, ("1.png", "2.png")):
        shader = shader_of(material)
        image = shader.inputs["Base Color"].links[0].from_node.image
        assert Path(image.filepath) == folder / "meshes" / name
        assert image.colorspace_settings.name == "sRGB" and tuple(image.size) == (4, 4)
        assert shader.inputs["Roughness"].default_value > 0.5
        assert shader.inputs["Specular IOR Level"].default_value < 0.5
        assert tuple(image.pixels[:3]) == pytest.approx((200 / 255, 100 / 255, 50 / 255), abs=1e-3)


def test_moved_file_finds_its_textures(root, folder, tmp_path):
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "objectgs.blend"))
    folder.rename(tmp_path / "elsewhere")
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "elsewhere" / "objectgs.blend"))
    found = [image for image in bpy.data.images if blender_scene.kind_of(image) == "mesh_texture"]
    assert sorted(image.filepath for image in found) == ["//meshes/1.png", "//meshes/2.png"]
    assert all(tuple(image.size) == (4, 4) for image in found)


@pytest.mark.parametrize("moved", ["file", "folder"])
def test_textures_are_found_again_where_one_moved_alone(root, folder, tmp_path, moved):
    blend = tmp_path / "one.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(blend))
    if moved == "file":
        blend = blend.rename(folder / "two.blend")
    else:
        folder = folder.rename(tmp_path / "elsewhere")
    bpy.ops.wm.open_mainfile(filepath=str(blend))
    root = next(each for each in bpy.data.collections if blender_scene.kind_of(each) == "reconstruction")
    other, own = (image_of(mesh_of(root, object_id).data.materials[0]) for object_id in (1, 2))
    write_png(tmp_path / "own.png", (0, 255, 0))
    own.filepath = str(tmp_path / "own.png")
    assert other.size[0] == 0
    assert blender_scene.show_meshes(root, folder).updated == 1
    assert Path(bpy.path.abspath(other.filepath)) == folder / "meshes" / "1.png" and tuple(other.size) == (4, 4)
    assert Path(own.filepath) == tmp_path / "own.png", "a file that the user has chosen stays"
    assert blender_scene.show_meshes(root, folder).updated == 0


@pytest.mark.long
def test_mesh_asset_can_be_used_in_another_file(root, folder, tmp_path):
    """As when dropped from the asset browser, which appends the collection and adds an instance of it."""
    bpy.context.view_layer.update()
    before = coordinates(mesh_of(root, 1))
    collection = blender_scene.object_collections(root)[1]
    blender_scene.mark_asset(collection, parts(root, 1, "mesh"), "name")
    assert collection.asset_data is not None and [tag.name for tag in collection.asset_data.tags] == ["ObjectGS"]
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "library.blend"))
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    with bpy.data.libraries.load(str(tmp_path / "library.blend"), assets_only=True) as (there, wanted):
        assert there.collections == ["mug"]
        wanted.collections = ["mug"]
    dropped = bpy.data.objects.new("dropped", None)
    dropped.instance_type, dropped.instance_collection = "COLLECTION", wanted.collections[0]
    dropped.location = 10, 20, 30
    bpy.context.scene.collection.objects.link(dropped)
    (instance,) = [
        np.array(entry.matrix_world)
        for entry in bpy.context.evaluated_depsgraph_get().object_instances
        if entry.is_instance and blender_scene.kind_of(entry.object.original) == "mesh"
    ]
    obj = next(obj for obj in bpy.data.objects if blender_scene.kind_of(obj) == "mesh")
    local = np.array([vertex.co for vertex in obj.data.vertices])
    placed = local @ instance[:3, :3].T + instance[:3, 3]
    low, high = before.min(0), before.max(0)
    stand = np.array([*((low + high) / 2)[:2], low[2]])
    assert placed == pytest.approx(before - stand + (10, 20, 30), abs=1e-5), (
        "the asset is upright, in scale and has its origin at the base"
    )
    assert tuple(image_of(obj.data.materials[0]).size) == (4, 4)


# Updates in place.


def test_updated_meshes_keep_user_changes(root, folder):
    obj = mesh_of(root, 1)
    pivot = obj.parent
    ours = obj.data.materials[0]
    shader_of(ours).inputs["Roughness"].default_value = 0.1
    own = bpy.data.materials.new("own")
    obj.data.materials.append(own)
    obj.name, obj.data.name = "mine", "mine too"
    obj.location, pivot.scale = (1, 2, 3), (2, 2, 2)
    obj.modifiers.new("Decimate", "DECIMATE")
    obj.shape_key_add(name="Basis")
    obj.hide_render = True
    obj.hide_set(True)
    before, image = counts(), image_of(ours)
    rewrite(folder)
    shown = blender_scene.show_meshes(root, folder)
    assert (shown.meshes, shown.updated, shown.warnings) == (1, 1, [])
    assert mesh_of(root, 1) == obj and obj.parent == pivot
    assert obj.data.materials[:] == [ours, own]
    assert shader_of(ours).inputs["Roughness"].default_value == pytest.approx(0.1)
    assert (obj.name, obj.data.name) == ("mine", "mine too")
    assert tuple(obj.location) == (1, 2, 3) and tuple(pivot.scale) == (2, 2, 2)
    assert [modifier.type for modifier in obj.modifiers] == ["DECIMATE"]
    assert obj.hide_render and obj.hide_get()
    assert np.ptp([vertex.co for vertex in obj.data.vertices], axis=0) == pytest.approx([2, 2, 2])
    assert [layer.name for layer in obj.data.uv_layers] == ["UVMap"]
    assert image_of(ours) == image and tuple(image.pixels[:3]) == pytest.approx((0, 1, 0))
    after = counts()
    assert after == {
        **before,
        "objects": before["objects"] - 1,
        "meshes": before["meshes"] - 1,
        "materials": before["materials"] - 1,
        "images": before["images"] - 1,
    }, "the can no longer has a mesh"


def test_user_material_is_kept_and_its_texture_updated(root, folder):
    obj = mesh_of(root, 1)
    own = bpy.data.materials.new("own")
    if own.node_tree is None:
        own.use_nodes = True
    image = image_of(obj.data.materials[0])
    own.node_tree.nodes.new("ShaderNodeTexImage").image = image
    obj.data.materials[0] = own
    image.pack()
    rewrite(folder)
    blender_scene.show_meshes(root, folder)
    assert obj.data.materials[:] == [own]
    assert image.packed_file is not None and tuple(image.pixels[:3]) == pytest.approx((0, 1, 0))


def test_packed_texture_is_kept_while_its_file_is_missing(root, folder):
    image = image_of(mesh_of(root, 1).data.materials[0])
    image.pack()
    (folder / "meshes" / "1.png").unlink()
    assert blender_scene.show_meshes(root, folder).warnings == []
    assert image.packed_file is not None and tuple(image.size) == (4, 4)
    write_png(folder / "meshes" / "1.png", (0, 255, 0))
    blender_scene.show_meshes(root, folder)
    assert image.packed_file is not None and tuple(image.pixels[:3]) == pytest.approx((0, 1, 0))


def test_unchanged_mesh_is_not_updated(root, folder):
    obj = mesh_of(root, 1)
    obj.data.vertices[0].co.x += 5
    moved = coordinates(obj)
    blender_scene.show_result(root, folder)
    assert blender_scene.show_meshes(root, folder).updated == 0
    assert coordinates(obj) == pytest.approx(moved)
    bpy.data.objects.remove(obj)
    assert blender_scene.show_meshes(root, folder).updated == 1, "a deleted mesh is shown again"


def later(path):
    """Change the time of a file alone, as copying and synchronizing a project do."""
    os.utime(path, ns=(path.stat().st_mtime_ns + 5_000_000_000,) * 2)


def test_edited_geometry_stays_where_only_times_or_the_texture_change(root, folder):
    obj = mesh_of(root, 1)
    obj.data.vertices[0].co.x += 5
    moved = coordinates(obj)
    image = image_of(obj.data.materials[0])
    for path in (folder / "meshes").iterdir():
        later(path)
    assert blender_scene.show_meshes(root, folder).updated == 0
    write_png(folder / "meshes" / "1.png", (0, 255, 0))
    later(folder / "meshes" / "1.png")
    assert blender_scene.show_meshes(root, folder).updated == 1
    assert tuple(image.pixels[:3]) == pytest.approx((0, 1, 0))
    assert coordinates(obj) == pytest.approx(moved)
    rewrite(folder)
    assert blender_scene.show_meshes(root, folder).updated == 1
    assert np.ptp(coordinates(obj), axis=0).max() < 4, "a new mesh replaces the geometry"


def test_stamps_of_earlier_versions_are_known(root, folder):
    """They are the times of both files."""
    obj = mesh_of(root, 1)
    obj.data.vertices[0].co.x += 5
    moved = coordinates(obj)
    files = [folder / "meshes" / name for name in ("1.ply", "1.png")]
    obj["objectgs_written"] = " ".join(str(path.stat().st_mtime_ns) for path in files)
    assert blender_scene.show_meshes(root, folder).updated == 0
    for path in files:
        later(path)
    assert blender_scene.show_meshes(root, folder).updated == 0, "it has taken over the content"
    assert coordinates(obj) == pytest.approx(moved)


def test_meshes_are_parented_to_restored_pivots(root, folder):
    bpy.context.view_layer.update()
    before = coordinates(mesh_of(root, 1))
    bpy.data.objects.remove(parts(root, 1, "object_parent")[0])
    bpy.data.collections.remove(blender_scene.object_collections(root)[2])
    blender_scene.show_capture(bpy.context.scene, folder)
    blender_scene.show_result(root, folder)
    bpy.context.view_layer.update()
    assert coordinates(mesh_of(root, 1)) == pytest.approx(before, abs=2e-6)
    assert len(mesh_of(root, 2).data.polygons) == 4


def test_restored_pivots_are_where_meshes_expect_them(root, folder):
    """The median of the splats changes with each training, and meshes are not read again."""
    mesh_of(root, 1).data.vertices[0].co.x += 5.0
    bpy.context.view_layer.update()
    before = [coordinates(parts(root, 1, kind)[0]) for kind in ("mesh", "splats")]
    splats = splat_table(np.resize([0, *OBJECTS], 40))
    for axis, name in enumerate("xyz"):
        splats[name] += ORIGIN[axis] + 0.25
    write_vertices(folder / "splats.ply", splats)
    bpy.data.objects.remove(parts(root, 1, "object_parent")[0])
    blender_scene.show_result(root, folder)
    bpy.context.view_layer.update()
    after = [coordinates(parts(root, 1, kind)[0]) for kind in ("mesh", "splats")]
    assert after[0] == pytest.approx(before[0], abs=2e-6)
    assert np.linalg.norm(after[1] - before[1], axis=1) == pytest.approx(0.25 * np.sqrt(3), abs=1e-3)


def test_mesh_names_and_colors_follow_objects(root, folder):
    edit_objects(folder / "objects.json", {1: dict(name="cup", color=[255, 0, 0])})
    blender_scene.show_objects(root, folder)
    obj = mesh_of(root, 1)
    assert (obj.name, obj.data.materials[0].name) == ("cup mesh", "cup mesh")
    assert tuple(obj.color) == tuple(obj.data.materials[0].diffuse_color) == pytest.approx((1, 0, 0, 1))


# Merged and left out.


def test_merged_objects_keep_meshes_until_remeshed(root, folder):
    bpy.context.view_layer.update()
    can, before = mesh_of(root, 2), coordinates(mesh_of(root, 2))
    edit_objects(folder / "objects.json", {2: dict(merged_into=1)})
    blender_scene.show_objects(root, folder)
    bpy.context.view_layer.update()
    assert can in parts(root, 1, "mesh") and len(parts(root, 1, "mesh")) == 2
    assert can.parent == parts(root, 1, "object_parent")[0] and blender_scene.object_id_of(can) == 1
    assert coordinates(can) == pytest.approx(before, abs=2e-6)
    assert 2 not in blender_scene.object_collections(root)

    write_meshes(folder, {"1": tetrahedron(ORIGIN), "2": tetrahedron(ORIGIN)}, ids={"1": [1, 2]})
    assert blender_scene.show_meshes(root, folder).meshes == 1
    assert mesh_of(root, 1) != can

    edit_objects(folder / "objects.json", {2: dict(merged_into=None)})
    warnings = blender_scene.show_result(root, folder).warnings
    assert len(warnings) == 1 and "mug" in warnings[0] and "extract it again" in warnings[0]
    assert parts(root, 1, "mesh") == [] and len(mesh_of(root, 2).data.polygons) == 4
    assert not parts(root, 1, "splats")[0].hide_render


def test_merging_in_the_other_direction_shows_one_mesh(root, folder):
    meshes = {"1": tetrahedron(ORIGIN), "2": tetrahedron(ORIGIN, 2.0)}
    write_meshes(folder, meshes, ids={"1": [1, 2], "2": [1, 2]})
    for kept, other in ((2, 1), (1, 2)):
        edit_objects(folder / "objects.json", {other: dict(merged_into=kept), kept: dict(merged_into=None)})
        blender_scene.show_objects(root, folder)
        assert mesh_of(root, kept)["objectgs_mesh"] == str(kept)


def test_split_objects_regain_meshes_and_materials(root, folder):
    can = mesh_of(root, 2)
    material = can.data.materials[0]
    for into in (1, None):
        edit_objects(folder / "objects.json", {2: dict(merged_into=into)})
        blender_scene.show_objects(root, folder)
    assert mesh_of(root, 2) == can and can.data.materials[:] == [material]
    assert len(parts(root, 1, "mesh")) == 1


def test_left_out_objects_have_no_mesh(root, folder):
    before = counts()
    edit_objects(folder / "objects.json", {2: dict(left_out=True)})
    blender_scene.show_objects(root, folder)
    assert 2 not in blender_scene.object_collections(root)
    assert counts()["images"] == before["images"] - 1


# What is shown.


def hidden(objs) -> set[bool]:
    return {value for obj in objs for value in (obj.hide_viewport, obj.hide_render)}


def test_show_kinds_switches_meshes_and_splats(root):
    assert blender_scene.shown_kinds(root) == "meshes", "meshes are shown by default if there are any"
    expected = {
        "splats": ({True}, {False}, {False}, {False}),
        "both": ({False}, {False}, {False}, {False}),
        "meshes": ({False}, {True}, {False}, {False}),
    }
    for which, (meshes, splats, without, rest) in expected.items():
        blender_scene.show_kinds(root, which)
        assert blender_scene.shown_kinds(root) == which
        for object_id in (1, 2):
            assert hidden(parts(root, object_id, "mesh")) == meshes
            assert hidden(parts(root, object_id, "splats")) == splats
        assert hidden(parts(root, HUGE, "splats")) == without, "an object without a mesh shows its splats"
        assert hidden(parts(root, 0, "splats")) == rest, "the background has no mesh"
        assert hidden(parts(root, 1, "anchors")) == {True}
    with pytest.raises(ValueError):
        blender_scene.show_kinds(root, "points")


def test_new_meshes_follow_shown_kind(root, folder):
    rewrite(folder, **{"_1": tetrahedron(ORIGIN), f"_{HUGE}": tetrahedron(ORIGIN)})
    blender_scene.show_meshes(root, folder)
    assert hidden(parts(root, HUGE, "mesh")) == {False} and hidden(parts(root, HUGE, "splats")) == {True}
    assert hidden(parts(root, 2, "splats")) == {False}, "its mesh was removed"
    blender_scene.show_kinds(root, "splats")
    rewrite(folder, _2=tetrahedron(ORIGIN))
    blender_scene.show_meshes(root, folder)
    assert hidden(parts(root, 2, "mesh")) == {True} and hidden(parts(root, 2, "splats")) == {False}


def test_objects_hidden_by_user_stay_hidden(root, folder):
    blender_scene.show_kinds(root, "both")
    objs = [*parts(root, 0, "splats"), *parts(root, 1, "splats"), mesh_of(root, 1)]
    for obj in objs:
        obj.hide_viewport = obj.hide_render = True
    rewrite(folder, _1=tetrahedron(ORIGIN), _2=tetrahedron(ORIGIN), **{f"_{HUGE}": tetrahedron(ORIGIN)})
    blender_scene.show_meshes(root, folder)
    blender_scene.show_result(root, folder)
    assert hidden(objs) == {True}


def test_splats_are_shown_until_meshes_exist(fresh, folder):
    (folder / "meshes" / "meshes.json").rename(folder / "later.json")
    root = blender_scene.show_capture(bpy.context.scene, folder)
    blender_scene.show_result(root, folder)
    assert blender_scene.shown_kinds(root) == "splats" and not blender_scene.has_shown_meshes(root)
    assert hidden(parts(root, 1, "splats")) == {False}
    (folder / "later.json").rename(folder / "meshes" / "meshes.json")
    assert blender_scene.show_meshes(root, folder).meshes == 2
    assert blender_scene.shown_kinds(root) == "meshes" and hidden(parts(root, 1, "splats")) == {True}


def test_scene_and_set_meshes_are_hidden_by_default(root, folder):
    write_meshes(
        folder,
        {
            "1": tetrahedron(ORIGIN),
            "scene": tetrahedron(ORIGIN + 1, 3.0),
            "pair": tetrahedron(ORIGIN),
            "77": tetrahedron(ORIGIN),
        },
        ids={"pair": [1, 2], "77": [1, 2]},
    )
    shown = blender_scene.show_meshes(root, folder)
    assert (shown.meshes, shown.warnings) == (4, [])
    whole = {obj.name: obj for obj in blender_scene.scene_meshes(root)}
    assert set(whole) == {"name of scene mesh", "name of pair mesh", "name of 77 mesh"}
    assert hidden(whole.values()) == {True}
    whole["name of scene mesh"].hide_viewport = False
    bpy.context.view_layer.update()
    upright = np.array(kinds.parent_of(root).matrix_world)
    expected = (tetrahedron((1, 1, 1), 3.0).vertices) @ upright[:3, :3].T + upright[:3, 3]
    assert coordinates(whole["name of scene mesh"]) == pytest.approx(expected, abs=2e-6)
    whole["name of pair mesh"].hide_viewport = False
    blender_scene.show_kinds(root, "both")
    assert not whole["name of pair mesh"].hide_viewport, "only the user changes their visibility"
    write_meshes(folder, {"1": tetrahedron(ORIGIN)})
    blender_scene.show_meshes(root, folder)
    assert blender_scene.scene_meshes(root) == []


def test_scene_without_objects_shows_scene_mesh(fresh, folder):
    write_vertices(folder / "splats.ply", splat_table(np.zeros(20, int)))
    write_meshes(folder, {"scene": tetrahedron(ORIGIN)})
    root = blender_scene.show_capture(bpy.context.scene, folder)
    blender_scene.show_result(root, folder)
    assert hidden(blender_scene.scene_meshes(root)) == {False} and hidden(parts(root, 0, "splats")) == {True}
    blender_scene.show_kinds(root, "splats")
    assert hidden(blender_scene.scene_meshes(root)) == {True} and hidden(parts(root, 0, "splats")) == {False}


def test_scene_mesh_is_exported_where_no_object_has_one(fresh, folder, tmp_path):
    write_vertices(folder / "splats.ply", splat_table(np.zeros(20, int)))
    write_meshes(folder, {"scene": tetrahedron(ORIGIN), "pair": tetrahedron(ORIGIN + 5)}, ids={"pair": [1, 2]})
    root = blender_scene.show_capture(bpy.context.scene, folder)
    blender_scene.show_result(root, folder)
    shown, other = sorted(blender_scene.scene_meshes(root), key=lambda mesh: "pair" in mesh.name)
    other.hide_render = True
    bpy.context.view_layer.update()
    assert mesh_export.export(root, tmp_path / "all.obj", "obj", None, False, False) == [tmp_path / "all.obj"]
    assert positions_in(tmp_path / "all.obj") == pytest.approx(coordinates(shown), abs=1e-4)
    (each,) = mesh_export.export(root, tmp_path / "each", "obj", None, True, False)
    assert each == tmp_path / "each" / "name_of_scene_mesh.obj" and each.is_file()
    with pytest.raises(InputError, match="choose All"):
        mesh_export.export(root, tmp_path / "one.obj", "obj", [1], False, False)


def positions_in(path) -> np.ndarray:
    """Return the vertices (V, 3) of an OBJ file, whose second axis is up, in Blender's axes."""
    lines = [line.split()[1:4] for line in path.read_text().splitlines() if line.startswith("v ")]
    return np.array(lines, float)[:, [0, 2, 1]] * [1, -1, 1]


def test_export_places_keyframed_meshes(root, tmp_path):
    """A click selects pivot and mesh, so that a keyframe is one of both."""
    mesh, pivot = mesh_of(root, 1), parts(root, 1, "object_parent")[0]
    for obj in (pivot, mesh):
        for path in ("location", "rotation_euler", "scale"):
            obj.keyframe_insert(path, frame=1)
    bpy.context.scene.frame_set(1)
    bpy.context.view_layer.update()
    expected = coordinates(mesh)
    mesh_export.export(root, tmp_path / "mug.glb", "glb", [1], False, False)
    before = set(bpy.data.objects)
    bpy.ops.import_scene.gltf(filepath=str(tmp_path / "mug.glb"))
    (found,) = [obj for obj in set(bpy.data.objects) - before if obj.type == "MESH"]
    bpy.context.view_layer.update()
    corners = np.array(sorted({tuple(np.round(corner, 4)) for corner in coordinates(found)}))
    assert corners == pytest.approx(np.array(sorted(map(tuple, expected))), abs=1e-3)
    assert found.animation_data is None and mesh.animation_data is not None


def corner_normals(obj) -> np.ndarray:
    """Return positions and normals (n, 6) of a mesh's corners in the world, rounded and sorted."""
    turn = np.array(obj.matrix_world)[:3, :3]
    places = coordinates(obj)[[loop.vertex_index for loop in obj.data.loops]]
    normals = np.array([loop.normal for loop in obj.data.loops]) @ turn.T
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return np.array(sorted({tuple(np.round(row, 3)) for row in np.hstack([places, normals])}))


def test_exported_objects_have_their_rotation_and_no_other(root, tmp_path):
    """That of the capture is part of the vertices, which duplicates share."""
    mesh, pivot = mesh_of(root, 1), parts(root, 1, "object_parent")[0]
    copy = blender_scene.duplicate(root, blender_scene.object_collections(root)[1])
    twin = kinds.part_of(copy, "object_parent")
    twin.location.x += 5.0
    twin.rotation_euler.z = 0.5
    bpy.context.view_layer.update()
    count = len(bpy.data.meshes)
    mesh_export.export(root, tmp_path / "mug.glb", "glb", [1], False, False)
    assert len(bpy.data.meshes) == count
    before = set(bpy.data.objects)
    bpy.ops.import_scene.gltf(filepath=str(tmp_path / "mug.glb"))
    bpy.context.view_layer.update()
    found = sorted(
        (obj for obj in set(bpy.data.objects) - before if obj.type == "MESH"), key=lambda obj: obj.location.x
    )
    assert len(found) == 2 and found[0].data == found[1].data
    for obj, source in zip(found, (pivot, twin), strict=True):
        assert np.array(obj.matrix_world) == pytest.approx(np.array(source.matrix_world), abs=1e-5)
    assert np.array(found[0].matrix_world)[:3, :3] == pytest.approx(np.eye(3), abs=1e-5)
    assert corner_normals(found[0]) == pytest.approx(corner_normals(mesh), abs=2e-3)


def test_exported_scene_mesh_is_not_turned(fresh, folder, tmp_path, monkeypatch):
    write_vertices(folder / "splats.ply", splat_table(np.zeros(20, int)))
    write_meshes(folder, {"scene": tetrahedron(ORIGIN)})
    root = blender_scene.show_capture(bpy.context.scene, folder)
    blender_scene.show_result(root, folder)
    blender_scene.scale_to_distance(root, (0, 0, 0), (1, 0, 0), 2.0)
    (mesh,) = blender_scene.scene_meshes(root)
    mesh_export.export(root, tmp_path / "scene.glb", "glb", None, False, False)
    before = set(bpy.data.objects)
    bpy.ops.import_scene.gltf(filepath=str(tmp_path / "scene.glb"))
    bpy.context.view_layer.update()
    (found,) = [obj for obj in set(bpy.data.objects) - before if obj.type == "MESH"]
    assert np.array(found.matrix_world)[:3, :3] == pytest.approx(np.eye(3), abs=1e-5)
    assert corner_normals(found) == pytest.approx(corner_normals(mesh), abs=2e-3)
    counts = [len(bpy.data.meshes)]
    monkeypatch.setattr(mesh_export, "_write", lambda *_: counts.append(len(bpy.data.meshes)))
    mesh_export.export(root, tmp_path / "scene.obj", "obj", None, False, False)
    assert counts == counts[:1] * 2, "an OBJ file needs no copies"


def test_export_keeps_shear(root, tmp_path):
    mesh, pivot = mesh_of(root, 1), parts(root, 1, "object_parent")[0]
    pivot.rotation_euler.z = 0.6
    kinds.parent_of(root).scale = (1.0, 2.0, 0.5)
    bpy.context.view_layer.update()
    count = len(bpy.data.meshes)
    mesh_export.export(root, tmp_path / "mug.obj", "obj", [1], False, False)
    assert positions_in(tmp_path / "mug.obj") == pytest.approx(coordinates(mesh), abs=1e-4)
    assert len(bpy.data.meshes) == count


def test_exported_meshes_belong_to_the_user_where_they_are_imported(root, tmp_path):
    mesh_export.export(root, tmp_path / "mug.usdc", "usdc", [1], False, False)
    before = {*bpy.data.objects, *bpy.data.materials}
    bpy.ops.wm.usd_import(filepath=str(tmp_path / "mug.usdc"))
    found = {*bpy.data.objects, *bpy.data.materials} - before
    assert {each.id_type for each in found} == {"OBJECT", "MATERIAL"}
    assert not [name for each in found for name, _ in each.items() if "object" in name]


# Faults.


@pytest.mark.parametrize(
    ("corrupt", "sentence"),
    [
        (lambda path: path.unlink(), "2.ply cannot be read"),
        (lambda path: path.write_bytes(path.read_bytes()[:-1]), "2.ply is truncated"),
        (lambda path: path.write_bytes(b"ply\n"), "2.ply is not a mesh"),
    ],
)
def test_invalid_mesh_is_reported_and_others_are_updated(root, folder, corrupt, sentence):
    kept = mesh_of(root, 2)
    rewrite(folder, _1=tetrahedron(ORIGIN, 2.0), _2=tetrahedron(ORIGIN, 2.0))
    corrupt(folder / "meshes" / "2.ply")
    shown = blender_scene.show_meshes(root, folder)
    assert (shown.meshes, shown.updated) == (2, 1)
    assert len(shown.warnings) == 1 and sentence in shown.warnings[0] and shown.warnings[0].endswith(".")
    assert mesh_of(root, 2) == kept and len(kept.data.polygons) == 4


@pytest.mark.parametrize(
    "change",
    [lambda mesh: mesh.vertices.__setitem__((0, 0), np.nan), lambda mesh: setattr(mesh, "faces", mesh.faces[:0])],
)
def test_mesh_without_surface_is_reported(root, folder, change):
    bad = tetrahedron(ORIGIN)
    change(bad)
    if not len(bad.faces):
        bad.uvs, bad.unobserved = bad.uvs[:0], bad.unobserved[:0]
    rewrite(folder, _1=bad)
    (sentence,) = blender_scene.show_meshes(root, folder).warnings
    assert "1.ply contains no surface" in sentence


def test_degenerate_faces_are_removed(root, folder):
    strange = tetrahedron(ORIGIN)
    strange.faces[0] = 1, 1, 1
    strange.uvs[1], strange.normals[2] = np.nan, np.nan
    rewrite(folder, _1=strange)
    assert blender_scene.show_meshes(root, folder).warnings == []
    mesh = mesh_of(root, 1).data
    assert len(mesh.polygons) == 3 and not mesh.validate()


@pytest.mark.parametrize(
    "content",
    [
        "[]",
        "{",
        '{"meshes": {"1": 5}}',
        '{"meshes": {"1": {"file": "1.ply", "ids": 7}}}',
        '{"meshes": {"1": {"file": "1.ply", "ids": ["x"]}}}',
    ],
)
def test_invalid_mesh_list_changes_nothing(root, folder, content):
    (folder / "meshes" / "meshes.json").write_text(content)
    before = counts()
    with pytest.raises(InputError, match=r"meshes\.json"):
        blender_scene.show_meshes(root, folder)
    (sentence,) = blender_scene.show_result(root, folder).warnings
    assert "meshes.json" in sentence and counts() == before


def test_missing_texture_is_reported_and_loaded_later(fresh, folder):
    (folder / "meshes" / "1.png").rename(folder / "away.png")
    root = blender_scene.show_capture(bpy.context.scene, folder)
    (sentence,) = blender_scene.show_result(root, folder).warnings
    assert "1.png is missing" in sentence
    (folder / "away.png").rename(folder / "meshes" / "1.png")
    assert blender_scene.show_meshes(root, folder).warnings == []
    image = image_of(mesh_of(root, 1).data.materials[0])
    assert tuple(image.pixels[:3]) == pytest.approx((200 / 255, 100 / 255, 50 / 255), abs=1e-3)


def test_files_outside_folder_are_not_read(root, folder):
    rewrite(folder, _1=tetrahedron(ORIGIN))
    listed = folder / "meshes" / "meshes.json"
    content = json.loads(listed.read_text())
    content["meshes"]["1"]["file"] = "../secret/1.ply"
    listed.write_text(json.dumps(content))
    assert blender_scene.show_meshes(root, folder).warnings == []
    content["meshes"]["1"]["file"] = "../points.ply"
    listed.write_text(json.dumps(content))
    (sentence,) = blender_scene.show_meshes(root, folder).warnings
    assert str(folder / "meshes" / "points.ply") in sentence


def test_mesh_in_edit_mode_is_not_overwritten(root, folder):
    bpy.context.view_layer.objects.active = mesh_of(root, 1)
    bpy.ops.object.mode_set(mode="EDIT")
    rewrite(folder)
    with pytest.raises(InputError, match="mug mesh is in Edit Mode"):
        blender_scene.show_meshes(root, folder)
    bpy.ops.object.mode_set(mode="OBJECT")


def test_mesh_in_edit_mode_is_not_exported(root, tmp_path):
    """Blender has its vertices elsewhere."""
    bpy.context.view_layer.objects.active = mesh_of(root, 1)
    bpy.ops.object.mode_set(mode="EDIT")
    out = tmp_path / "new" / "mug.obj"
    with pytest.raises(InputError, match="mug mesh is in Edit Mode"):
        mesh_export.export(root, out, "obj", None, False, False)
    assert not out.parent.exists()
    bpy.ops.object.mode_set(mode="OBJECT")


@pytest.mark.parametrize("mode", ["SCULPT", "VERTEX_PAINT", "WEIGHT_PAINT", "TEXTURE_PAINT"])
def test_mesh_in_a_mode_that_keeps_its_vertices_is_exported(root, tmp_path, mode):
    bpy.context.view_layer.objects.active = mesh_of(root, 1)
    bpy.ops.object.mode_set(mode=mode)
    (path,) = mesh_export.export(root, tmp_path / "mug.obj", "obj", [1], False, False)
    assert "\nf " in path.read_text()
    bpy.ops.object.mode_set(mode="OBJECT")


# Operators and panels.


@pytest.fixture
def active(fresh, folder, monkeypatch, tmp_path):
    """Root collection of the folder in the registered extension, with a fake backend Python."""
    extension = headless.extension()
    extension.register()
    python = tmp_path / "python"
    python.write_text("")
    monkeypatch.setenv("OBJECTGS_PYTHON", str(python))
    bpy.ops.objectgs.open_reconstruction(directory=str(folder))
    yield bpy.context.scene.objectgs.active
    extension.unregister()


@pytest.fixture
def submitted(monkeypatch):
    """Backend arguments of each submitted job; jobs do not run."""
    jobs = []

    def submit(job, owner, report):
        jobs.append([str(word) for word in job.command[job.command.index("backend") + 1 : -1]])
        return {"FINISHED"}

    monkeypatch.setattr(background, "submit", submit)
    monkeypatch.setattr("objectgs.operators.common.need.training", lambda *_: True)
    return jobs


def test_extract_meshes_uses_panel_settings(active, submitted, folder):
    extract, properties = bpy.ops.objectgs.extract_meshes, active.objectgs
    extract()
    properties.mesh_faces, properties.texture_size, properties.mesh_closed = 5000, "2048", False
    properties.mesh_scene = True
    extract()
    properties.mesh_scene, properties.mesh_objects = False, "selected"
    mesh_of(active, 2).select_set(True)
    bpy.context.view_layer.objects.active = mesh_of(active, 2)
    extract()
    for obj in bpy.context.selected_objects:
        obj.select_set(False)
    properties.active_object = 0
    for obj in bpy.context.selected_objects:
        obj.select_set(False)
    extract()
    options = ["--faces", "5000", "--open", "--texture-size", "2048"]
    named = ["mesh", str(folder), "--faces", "5000"]
    assert submitted[0] == ["mesh", str(folder), "--faces", "20000"]
    assert submitted[1] == [*named, "--objects", "1", "2", str(HUGE), "--scene", *options[2:]]
    assert submitted[2] == [*named, "--objects", "2", *options[2:]]
    assert submitted[3] == [*named, "--objects", "1", *options[2:]]


def test_extract_meshes_requires_training(active):
    assert not bpy.ops.objectgs.extract_meshes.poll(), "the reconstruction is not trained"
    with pytest.raises(RuntimeError, match="train first"):
        bpy.ops.objectgs.extract_meshes()


def test_finished_job_shows_meshes(active, folder, monkeypatch):
    properties = active.objectgs
    assert properties.shown == "meshes"
    properties.shown = "splats"
    assert hidden(parts(active, 1, "splats")) == {False} and blender_scene.shown_kinds(active) == "splats"
    rewrite(folder)
    job = locations.backend_job("Meshes", "mesh", blender_scene.folder_of(active), "mesh")
    background._submitted_in[job] = bpy.context.scene.session_uid
    background.finish(job)
    assert properties.shown == "meshes" and hidden(parts(active, 1, "mesh")) == {False}
    assert properties.objects[0].faces == 4 and properties.objects[1].faces == 0
    properties.shown = "both"
    background.finish(job)
    assert properties.shown == "both", "the user's choice is kept if it includes meshes"


def test_interrupted_meshing_is_named_after_reopening(active):
    folder = blender_scene.folder_of(active)
    path = folder / "meshes" / "meshes.json"
    kept = json.loads(path.read_text())
    assert "interrupted" not in texts_of(panels.meshes.MeshesPanel)
    path.write_text(json.dumps({**kept, "waiting": ["5", "6"]}))
    assert "interrupted, and 2 meshes are missing. Extract Meshes continues" in texts_of(panels.meshes.MeshesPanel)
    with locked(folder):
        assert "interrupted" not in texts_of(panels.meshes.MeshesPanel), "another program makes them"


def test_selected_objects_stay_outlined_when_meshes_replace_splats(active, folder):
    active.objectgs.shown = "splats"
    assert selection.select_object(bpy.context, active, 1)
    splats, (other,) = parts(active, 1, "splats")[0], parts(active, 2, "splats")
    assert splats.select_get() and not mesh_of(active, 1).select_get()
    rewrite(folder, _1=tetrahedron(ORIGIN, 2.0), _2=tetrahedron(ORIGIN))
    job = Job("Meshes", "mesh", folder, ["true"], folder)
    assert results.SHOW_BY_KIND["mesh"](job, bpy.context.scene)
    assert mesh_of(active, 1).select_get() and not mesh_of(active, 2).select_get()
    active.objectgs.shown = "splats"
    assert splats.select_get() and not mesh_of(active, 1).select_get() and not other.select_get()


def test_outlines_of_many_objects_are_kept_without_a_search_for_each(active, monkeypatch):
    """Nor is a view layer evaluated in which nothing is selected."""

    def fails(*_):
        raise AssertionError

    monkeypatch.setattr(blender_scene, "collection_of", fails)
    selection.select_shown_parts(SimpleNamespace(objects=SimpleNamespace(selected=[]), update=fails), active)
    active.objectgs.shown = "splats"
    selection.select_object(bpy.context, active, 1)
    active.objectgs.shown = "meshes"
    assert mesh_of(active, 1).select_get() and not mesh_of(active, 2).select_get()


def test_panel_tells_which_mode_shows_textures(active):
    window = bpy.context.window_manager.windows[0]
    area = next(area for area in window.screen.areas if area.type == "VIEW_3D")
    for mode, shown, told in (("SOLID", "meshes", True), ("SOLID", "splats", False), ("MATERIAL", "both", False)):
        area.spaces.active.shading.type, active.objectgs.shown = mode, shown
        with bpy.context.temp_override(window=window, area=area):
            assert ("choose Material Preview" in texts_of(panels.meshes.MeshesPanel)) is told


def test_meshes_made_after_saving_are_offered(active, folder, tmp_path):
    made = {path: path.read_bytes() for path in (folder / "meshes").iterdir()}
    differ = "The meshes in the folder differ from those shown. objectgs.show_result"
    assert differ not in texts_of(panels.meshes.MeshesPanel)
    for path in made:
        path.unlink()
    bpy.ops.objectgs.show_result()
    del active["objectgs_show"], active["objectgs_shown_meshes"]
    bpy.ops.objectgs.clean_floaters(everything=True)
    bpy.ops.objectgs.set_up_render()
    assert differ not in texts_of(panels.meshes.MeshesPanel)
    for path, content in made.items():
        path.write_bytes(content)
    assert differ in texts_of(panels.meshes.MeshesPanel)
    assert next_step(active, bpy.context.scene).operator == "objectgs.show_result"
    bpy.ops.objectgs.show_result()
    assert mesh_of(active, 1).name == "mug mesh" and differ not in texts_of(panels.meshes.MeshesPanel)
    assert next_step(active, bpy.context.scene).operator == "objectgs.film_frames"
    rewrite(folder)
    assert differ in texts_of(panels.meshes.MeshesPanel)
    del active["objectgs_shown_meshes"]
    assert differ not in texts_of(panels.meshes.MeshesPanel), "of an older version, whose meshes may be these"


def test_folder_state_counts_outdated_meshes(folder):
    state = folder_state(folder)
    assert (state.meshes, state.stale_meshes) == (2, 2)
    assert folder_state(folder.parent).meshes == 0


def test_only_meshes_that_would_be_made_again_are_outdated(active, folder):
    assert "2 of 2 meshes were made at another step" in texts_of(panels.meshes.MeshesPanel)
    write_meshes(
        folder, {key: tetrahedron(ORIGIN) for key in ("1", "2", "scene", "both")}, ids={"scene": None, "both": [1, 2]}
    )
    edit_objects(folder / "objects.json", {2: dict(merged_into=1)})
    assert "1 of 4 meshes were made at another step" in texts_of(panels.meshes.MeshesPanel)
    active.objectgs.mesh_scene = True
    assert "2 of 4 meshes were made at another step" in texts_of(panels.meshes.MeshesPanel)
    active.objectgs.mesh_scene = False
    edit_objects(folder / "objects.json", {1: dict(left_out=True)})
    assert "made at another step" not in texts_of(panels.meshes.MeshesPanel)
    active.objectgs.objects.clear()
    assert "1 of 4 meshes were made at another step" in texts_of(panels.meshes.MeshesPanel)


def test_mark_assets_sets_origin_at_base(active):
    bpy.ops.objectgs.mark_assets()
    marked = {collection.name for collection in bpy.data.collections if collection.asset_data}
    assert marked == {"mug", "can"}
    mesh_of(active, 1).location.z += 1
    mesh_of(active, 1).select_set(True)
    bpy.ops.objectgs.mark_assets()
    bpy.context.view_layer.update()
    low = min(place[2] for place in coordinates(mesh_of(active, 1)))
    assert blender_scene.object_collections(active)[1].instance_offset[2] == pytest.approx(low, abs=1e-5)


def test_points_are_hidden_when_result_is_opened(active):
    assert kinds.points_of(active).hide_viewport


def test_marked_objects_have_a_catalog(active, tmp_path):
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "set.blend"))
    catalogs = tmp_path / "blender_assets.cats.txt"
    catalogs.write_text("VERSION 1\n11111111-1111-1111-1111-111111111111:Mine:Mine\n")
    for _ in range(2):
        assert bpy.ops.objectgs.mark_assets() == {"FINISHED"}
    lines = catalogs.read_text().splitlines()
    assert len(lines) == 3 and lines[1].endswith("Mine:Mine")
    uuid, path, _ = lines[2].split(":")
    marked = [each for each in bpy.data.collections if each.asset_data is not None]
    assert marked and {each.asset_data.catalog_id for each in marked} == {uuid}
    assert path == f"ObjectGS/{active.name}"


def test_training_presets_store_and_restore_settings(active):
    properties = active.objectgs
    properties.length, properties.primitive, properties.max_size = "preview", "2d", 900
    assert bpy.ops.objectgs.add_training_preset(name="Discs") == {"FINISHED"}
    properties.length, properties.primitive, properties.max_size = "standard", "3d", 1600
    (path,) = (
        path / "objectgs" / "training" / "Discs.py"
        for path in map(Path, bpy.utils.preset_paths(""))
        if (path / "objectgs" / "training" / "Discs.py").exists()
    )
    exec(path.read_text(), {"bpy": bpy})
    path.unlink()
    assert (properties.length, properties.primitive, properties.max_size) == ("preview", "2d", 900)


def test_training_presets_open_from_the_header_of_settings():
    """A popover shows nothing, and reports an error at each redraw, if there is no panel of its name."""
    shown = []
    row = SimpleNamespace(popover=lambda panel, **_: shown.append(panel), emboss="NORMAL")
    header = SimpleNamespace(layout=SimpleNamespace(row=lambda: row, popover=row.popover))
    panels.training.train.SettingsPanel.draw_header_preset(header, bpy.context)
    assert len(shown) == 1 and shown[0] in {cls.bl_idname for cls in panels.CLASSES}
