# SPDX-License-Identifier: GPL-3.0-or-later
"""Files with names from older versions are opened with the current names."""

import zipfile
from pathlib import Path

import bpy
import numpy as np
import pytest
from objectgs.backend.shared.color.recolor import Recolor
from objectgs.backend.shared.formats.splat_ply import UNOBSERVED
from objectgs.backend.shared.reconstruction.objects import read_objects
from objectgs.objectgs_addon import scene as blender_scene
from objectgs.objectgs_addon.blender import older_files
from objectgs.objectgs_addon.scene import carrier, kinds, object_collection
from objectgs.objectgs_addon.scene.edits import axes, fills, recolor
from objectgs.objectgs_addon.scene.shading import modifiers, node_groups
from objectgs.objectgs_addon.scene.shading.materials import COLOR
from objectgs.objectgs_addon.state import object_edits

import headless

from .building import tetrahedron, write_folder, write_meshes

RED = (1.0, 0.0, 0.0)

EARLIER = Path(__file__).resolve().parents[1] / "data" / "earlier-reconstruction.zip"
"""Contains objectgs.blend, which the headless command `build` of an earlier version saved in Blender 4.2."""


@pytest.fixture
def extension(fresh):
    registered = headless.extension()
    registered.register()
    yield registered
    registered.unregister()


@pytest.fixture
def older_file(extension, tmp_path):
    """A file that uses the former version of every renamed name."""
    folder = write_folder(tmp_path / "table top")
    write_meshes(folder, {"1": tetrahedron(np.zeros(3))})
    scene = bpy.context.scene
    root = blender_scene.show_capture(scene, folder)
    blender_scene.show_result(root, folder)
    scene.objectgs.active = root
    object_edits.fill(root)
    with object_edits.without_callbacks():
        root.objectgs.objects[1].color = RED
    scene.objectgs.colors = "object"
    blender_scene.recolor(root, 1, Recolor(hue=0.3))
    mesh = splats_of(root).data
    carrier.write(mesh, fills.FILLS, "INT", np.arange(len(mesh.vertices)))
    carrier.write(mesh, UNOBSERVED, "BOOLEAN", np.ones(len(mesh.vertices), bool))
    blender_scene.object_collections(root)[1][fills.UNOBSERVED_COUNT] = 7
    give_former_names()
    assert set(former_names()) >= {*older_files.CUSTOM_PROPERTIES, "splat_colours"}
    assert color_attributes() == {"colour"}
    path = tmp_path / "older.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    bpy.ops.wm.read_factory_settings(use_empty=True)
    return path


def give_former_names() -> None:
    tables = ("CUSTOM_PROPERTIES", "KINDS", "GROUPS", "ATTRIBUTES", "NODE_ATTRIBUTES")
    with pytest.MonkeyPatch.context() as patch:
        for table in tables:
            names = getattr(older_files, table)
            patch.setattr(older_files, table, {name: former for former, name in names.items()})
        older_files.rename_all()


def splats_of(root, object_id=1):
    return kinds.part_of(blender_scene.object_collections(root)[object_id], "splats")


def color_attributes() -> set[str]:
    """Return the attribute names under which node groups store colors and materials read them."""
    found = set()
    for tree in (*bpy.data.node_groups, *(material.node_tree for material in bpy.data.materials)):
        for node in tree.nodes:
            if node.bl_idname == "ShaderNodeAttribute":
                found.add(node.attribute_name)
            elif node.bl_idname == "GeometryNodeStoreNamedAttribute" and node.data_type == "FLOAT_COLOR":
                found.add(node.inputs["Name"].default_value)
    return found - {"disc"}


def check(root) -> None:
    collection = blender_scene.object_collections(root)[1]
    assert recolor.recolor_of(collection) == Recolor(hue=0.3)
    assert collection[fills.UNOBSERVED_COUNT] == 7
    pivot = kinds.part_of(collection, "object_parent")
    assert object_collection.CENTER in pivot and object_collection.center_of(pivot).any()
    mesh = splats_of(root).data
    assert fills.unobserved_splats(mesh).all() and fills.filled_objects(mesh).tolist() == list(
        range(len(mesh.vertices))
    )
    (shape,) = blender_scene.object_meshes(root)[1]
    assert "unobserved" in shape.data.attributes
    assert recolor.TEXTURE_GROUP in [kinds.kind_of(tree) for tree in bpy.data.node_groups]
    assert color_attributes() == {COLOR}


def test_older_file_keeps_all_values(older_file):
    bpy.ops.wm.open_mainfile(filepath=str(older_file))
    scene = bpy.context.scene
    root = scene.objectgs.active
    check(root)
    assert tuple(root.objectgs.objects[1].color) == RED and len(root.objectgs.objects) == 3
    assert scene.objectgs.colors == "object"
    older_files.rename_all()
    check(root)
    assert not former_names()


def former_names() -> list[str]:
    return [
        name
        for block in older_files._blocks()
        for name in (*block.keys(), *(older_files._stored_group(block) or {}))
        if name in older_files.CUSTOM_PROPERTIES or name in older_files.GROUPS
    ]


def test_older_file_can_be_recolored_and_updated(older_file):
    """Also if older and current node groups are used with the same material."""
    bpy.ops.wm.open_mainfile(filepath=str(older_file))
    root = bpy.context.scene.objectgs.active
    for tree in bpy.data.node_groups:
        if "objectgs_version" in tree:
            tree["objectgs_version"] -= 1
    splats = splats_of(root)
    modifiers.update_groups(splats)
    assert len([tree for tree in bpy.data.node_groups if kinds.kind_of(tree) == node_groups.SPLATS_GROUP]) == 2
    assert color_attributes() == {COLOR}
    assert blender_scene.recolor(root, 1, None)
    (texture,) = [
        n
        for m in blender_scene.object_meshes(root)[1]
        for n in m.data.materials[0].node_tree.nodes
        if n.type == "TEX_IMAGE"
    ]
    feeds = sorted(link.to_node.type for link in texture.outputs["Color"].links)
    assert feeds == ["BSDF_PRINCIPLED", "OUTPUT_MATERIAL"], "the recolor group was removed"


@pytest.mark.skipif(bpy.app.version < (4, 3, 0), reason="has no handler for appended data")
@pytest.mark.parametrize("link", [False, True])
def test_objects_of_older_file_can_be_appended_and_linked(older_file, link):
    with bpy.data.libraries.load(str(older_file), link=link) as (there, here):
        here.collections = list(there.collections)
    root = next(collection for collection in bpy.data.collections if kinds.kind_of(collection) == "reconstruction")
    check(root)


def test_current_file_is_unchanged(older_file):
    bpy.ops.wm.open_mainfile(filepath=str(older_file))
    before = {block: list(block.keys()) for block in older_files._blocks()}
    assert bpy.context.scene.objectgs.active is not None
    older_files.rename_all()
    assert {block: list(block.keys()) for block in older_files._blocks()} == before


@pytest.mark.skipif(bpy.app.version < (4, 2, 0), reason="is older than the Blender that saved the file, 4.2")
def test_a_file_that_an_earlier_version_saved_opens_and_is_updated(extension, tmp_path):
    zipfile.ZipFile(EARLIER).extractall(tmp_path)
    folder = tmp_path / "rec"
    saved = (folder / "objectgs.blend").read_bytes()
    assert b"objectgs_centre" in saved and b"objectgs_recolour" in saved
    bpy.ops.wm.open_mainfile(filepath=str(folder / "objectgs.blend"))
    root = bpy.context.scene.objectgs.active
    assert not former_names() and color_attributes() == {COLOR}
    collections = blender_scene.object_collections(root)
    assert {i: c.name for i, c in collections.items()} == dict(
        enumerate(("mug", "bottle", "ring", "table", "backdrop"), 1)
    )
    assert recolor.recolor_of(collections[1]).hue == 0.3 and collections[3][fills.UNOBSERVED_COUNT] == 0
    pivots = [kinds.part_of(collection, "object_parent") for collection in collections.values()]
    assert all(object_collection.center_of(pivot).any() for pivot in pivots)
    assert {i: len(found) for i, found in blender_scene.object_meshes(root).items() if found} == {1: 1, 2: 1}
    before = {i: len(splats_of(root, i).data.vertices) for i in collections}

    # The folder has moved since.
    root[kinds.FOLDER] = str(folder)
    shown = blender_scene.show_result(root, folder)
    assert (shown.objects, shown.splats, shown.warnings) == (5, sum(before.values()), [])
    object_edits.fill(root)
    mug, bottle, ring, *_ = root.objectgs.objects
    assert [row.name for row in (mug, bottle, ring)] == ["mug", "bottle", "ring"]
    assert ring.removed and ring.fill and mug.hue == pytest.approx(0.3)
    assert not former_names()


@pytest.mark.skipif(bpy.app.version < (4, 2, 0), reason="is older than the Blender that saved the file, 4.2")
def test_pivots_of_an_earlier_version_keep_their_axes_beside_new_ones(extension, tmp_path):
    zipfile.ZipFile(EARLIER).extractall(tmp_path)
    folder = tmp_path / "rec"
    bpy.ops.wm.open_mainfile(filepath=str(folder / "objectgs.blend"))
    root = bpy.context.scene.objectgs.active
    root[kinds.FOLDER] = str(folder)
    collections = blender_scene.object_collections(root)
    pivots = {i: kinds.part_of(collection, "object_parent") for i, collection in collections.items()}

    def world(object_id):
        return np.array(blender_scene.matrix_to_world(splats_of(root, object_id)))

    kinds.parent_of(root).rotation_euler = -1.1, 0.2, 0.3
    bpy.context.view_layer.update()
    before = {i: world(i) for i in collections}
    assert not any(axes.AXES in pivot for pivot in pivots.values())
    center = tuple(pivots[1].location)
    bpy.data.objects.remove(pivots.pop(4))
    blender_scene.show_result(root, folder)
    pivots[4] = kinds.part_of(collections[4], "object_parent")
    assert axes.AXES in pivots[4] and axes.AXES not in pivots[1]
    assert all(world(i) == pytest.approx(matrix, abs=1e-5) for i, matrix in before.items())
    assert [i for i in collections if blender_scene.is_moved(root, collections[i])] == [2]

    copies = {i: blender_scene.duplicate(root, collections[i]) for i in (1, 4)}
    turn = np.array(kinds.parent_of(root).matrix_world)[:3, :3]
    for copy in copies.values():
        kinds.part_of(copy, "object_parent").location.x += 1.0
    blender_scene.store_placements(root)
    entries = {entry.id: entry for entry in read_objects(folder / "objects.json")}
    shifts = [np.array(entries[i].copies[0])[:3, 3] for i in (1, 4)]
    assert entries[2].transform[0] == (1.0, 0.0, 0.0, 0.2)
    assert shifts[0] == pytest.approx((1.0, 0.0, 0.0), abs=1e-5), "in the axes of the capture"
    assert turn @ shifts[1] == pytest.approx((1.0, 0.0, 0.0), abs=1e-5), "in the axes of the world"

    pivots[1].location.x += 1.0
    assert blender_scene.placement_of(root, collections[1])[:3, 3] == pytest.approx((1.0, 0.0, 0.0), abs=1e-5)
    blender_scene.scale_to_distance(root, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 2.0)
    assert axes.AXES not in pivots[1] and tuple(pivots[4].matrix_basis.to_scale()) == pytest.approx((1.0,) * 3)
    blender_scene.reset_placement(root, collections[1])
    assert tuple(pivots[1].location) == pytest.approx(center, abs=1e-6)
    doubled = np.diag((2.0, 2.0, 2.0, 1.0))
    assert all(world(i) == pytest.approx(doubled @ matrix, abs=1e-5) for i, matrix in before.items())
