# SPDX-License-Identifier: GPL-3.0-or-later
"""Edits of objects in Blender: removal, colors, transforms and duplicates, in objects.json, after undo and reload."""

import itertools
import json
import math
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from mathutils import Matrix, Vector
from objectgs.backend.shared.color.recolor import Recolor
from objectgs.backend.shared.formats.mesh_ply import read_mesh
from objectgs.backend.shared.formats.ply import read_vertices, write_vertices
from objectgs.backend.shared.reconstruction.objects import edit_objects, read_objects
from objectgs.backend.shared.splats.spherical_harmonics import C0
from objectgs.objectgs_addon import drawing
from objectgs.objectgs_addon import scene as blender_scene
from objectgs.objectgs_addon.blender import messages, older_files, undo
from objectgs.objectgs_addon.drawing.splat_arrays import arrays_of
from objectgs.objectgs_addon.panels.edits import EditPanel
from objectgs.objectgs_addon.picking import selection
from objectgs.objectgs_addon.process.jobs import Job, State
from objectgs.objectgs_addon.running import background, handlers, results
from objectgs.objectgs_addon.scene import capture, carrier, kinds
from objectgs.objectgs_addon.scene.edits import fills, floaters, placement
from objectgs.objectgs_addon.scene.shading import modifiers, node_groups
from objectgs.objectgs_addon.scene.shading.graph import VERSION, Graph
from objectgs.objectgs_addon.scene.shading.materials import COLOR
from objectgs.objectgs_addon.state import click_selection, object_edits, object_list, visibility
from objectgs.operators.common.export_dialog import ExportDialog
from objectgs.operators.splats import import_splats

import headless

from .building import HUGE, OBJECTS, look_at, splat_table, tetrahedron, write_cameras, write_folder, write_meshes
from .drawn import texts_of

ORIGIN = np.array([100.0, -200.0, 30.0])
RECOLOR = Recolor(
    replace=(0.9, 0.2, 0.1),
    amount=0.6,
    hue=0.2,
    saturation=1.4,
    contrast=1.2,
    value=0.9,
    tint=(1.0, 0.8, 0.6),
    middle=0.4,
)


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """A rotated folder far from the origin, with meshes of objects 1 and 2; read-only."""
    place = write_folder(tmp_path_factory.mktemp("made") / "table top")
    upright = np.eye(4)
    upright[:3, :3] = np.array(Matrix.Rotation(0.7, 3, "X")) @ np.array(Matrix.Rotation(0.3, 3, "Z"))
    upright[:3, 3] = 1.0, 2.0, 3.0
    write_cameras(place, [look_at(ORIGIN + np.array([3, 0, 1]), ORIGIN)], origin=ORIGIN, upright=upright)
    splats = splat_table(np.resize([0, *OBJECTS], 200), degree=2)
    for axis, name in enumerate("xyz"):
        splats[name] += ORIGIN[axis]
    write_vertices(place / "splats.ply", splats)
    write_meshes(place, {"1": tetrahedron(ORIGIN + 0.5), "2": tetrahedron(ORIGIN - 0.5, 0.5)})
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
    yield bpy.context.scene.objectgs.active
    extension.unregister()


def active():
    """Return the reconstruction's collection, which undo replaces."""
    return bpy.context.scene.objectgs.active


def entry(root, object_id=1):
    return next(e for e in read_objects(blender_scene.folder_of(root) / "objects.json") if e.id == object_id)


def collection_of(root, object_id=1):
    return blender_scene.object_collections(root)[object_id]


def part(root, kind, object_id=1):
    return kinds.part_of(collection_of(root, object_id), kind)


def item(root, object_id=1):
    return object_list.item_of(root, object_id)


def activate(root, object_id) -> None:
    rows = [blender_scene.from_stored(row.object_id) for row in root.objectgs.objects]
    root.objectgs.active_object = rows.index(object_id)


def set_sliders(root, recolor=RECOLOR, object_id=1) -> None:
    for name in (*object_list.SLIDERS, *object_list.COLORS):
        setattr(item(root, object_id), name, getattr(recolor, name))


def show_again(root) -> None:
    assert bpy.ops.objectgs.show_result() == {"FINISHED"}


def encoded(linear) -> np.ndarray:
    linear = np.maximum(linear, 0.0)
    return np.where(linear > 0.0031308, 1.055 * linear ** (1 / 2.4) - 0.055, 12.92 * linear)


def evaluated_colors(obj) -> np.ndarray:
    """Return the colors (n, 4) of the points that geometry nodes generate from a splat object in the viewport."""
    if "vertices" not in obj.modifiers:
        # Mesh attributes can be read in all Blender versions.
        tree = bpy.data.node_groups.new("vertices", "GeometryNodeTree")
        for way in ("OUTPUT", "INPUT"):
            tree.interface.new_socket("Geometry", in_out=way, socket_type="NodeSocketGeometry")
        nodes = Graph(tree)
        vertices = nodes.node("GeometryNodePointsToVertices", {0: nodes.node("NodeGroupInput").outputs[0]})
        nodes.node("NodeGroupOutput", {0: vertices.outputs[0]})
        obj.modifiers.new("vertices", "NODES").node_group = tree
    return seen_colors(obj)


def seen_colors(obj) -> np.ndarray:
    """Return the vertex colors (n, 4) of the evaluated mesh."""
    evaluated = obj.evaluated_get(bpy.context.evaluated_depsgraph_get())
    mesh = evaluated.to_mesh()
    values = np.empty(4 * len(mesh.vertices), np.float32)
    mesh.attributes[COLOR].data.foreach_get("color", values)
    evaluated.to_mesh_clear()
    return values.reshape(-1, 4)


def show_faint(obj) -> None:
    modifiers.set_input(modifiers.modifier_of(obj, node_groups.SPLATS_GROUP), "Minimum Opacity", 0.0)
    obj.update_tag()


def rendered_quads(obj) -> np.ndarray:
    """Return the linear colors (n, 3) of the discs that a render shows."""
    for modifier in obj.modifiers:
        modifier.show_viewport = kinds.kind_of(modifier.node_group) == node_groups.RENDER_GROUP
    return seen_colors(obj).reshape(-1, 4, 4)[:, 0, :3]


def expected(colors, recolor=None) -> np.ndarray:
    """Return the expected encoded colors after recoloring."""
    if recolor is not None:
        matrix, offset = recolor.affine()
        colors = colors @ matrix.T + offset
    return np.maximum(colors, 0.0)


# Colors.


def test_viewport_colors_match_recolor(root):
    splats = part(root, "splats")
    blender_scene.show_kinds(root, "splats")
    show_faint(splats)
    raw = 0.5 + C0 * carrier.read(splats.data, "radiance:base")[:, :3].astype(float)
    before = carrier.read(splats.data, "radiance:base").copy()
    assert encoded(evaluated_colors(splats)[:, :3]) == pytest.approx(expected(raw), abs=2e-5)
    set_sliders(root)
    wanted = object_list.recolor_of(item(root))
    assert wanted.middle == pytest.approx(blender_scene.luma_of(collection_of(root)), abs=1e-5)
    assert encoded(evaluated_colors(splats)[:, :3]) == pytest.approx(expected(raw, wanted), abs=5e-5)
    assert np.array_equal(carrier.read(splats.data, "radiance:base"), before), "attributes are unchanged"
    assert bpy.ops.objectgs.reset_object(what="COLORS") == {"FINISHED"}
    assert blender_scene.recolor_of(collection_of(root)) is None
    assert encoded(evaluated_colors(splats)[:, :3]) == pytest.approx(expected(raw), abs=2e-5)


def test_rendered_colors_match_recolor(root):
    camera = next(obj for obj in root.all_objects if blender_scene.kind_of(obj) == "camera")
    bpy.context.scene.camera = camera
    blender_scene.show_kinds(root, "splats")
    splats = part(root, "splats")
    plain = encoded(rendered_quads(splats))
    assert len(plain) > 10
    # Negative colors are clamped in `plain`, so only the others can be compared.
    hue = Recolor(hue=0.25, value=0.5, middle=blender_scene.luma_of(collection_of(root)))
    item(root).hue, item(root).value = hue.hue, hue.value
    seen = encoded(rendered_quads(splats))
    positive = (plain > 1e-4).all(1)
    assert positive.sum() > 5
    assert seen[positive] == pytest.approx(expected(plain[positive], hue), abs=1e-4)


def test_texture_recolor_is_applied_and_reverted(root):
    mesh = part(root, "mesh")
    tree = mesh.data.materials[0].node_tree
    before = sorted((link.from_socket.name, link.to_socket.name) for link in tree.links)
    set_sliders(root)
    matrix, offset = object_list.recolor_of(item(root)).affine()
    (group,) = [node for node in tree.nodes if node.type == "GROUP"]
    for row, channel in zip(matrix, ("Red", "Green", "Blue")):
        assert np.array(group.inputs[f"Recolor {channel}"].default_value) == pytest.approx(row, abs=1e-6)
    assert np.array(group.inputs["Recolor Offset"].default_value) == pytest.approx(offset, abs=1e-6)
    (feeds,) = group.inputs["Color"].links
    assert feeds.from_node.type == "TEX_IMAGE"
    assert sorted(link.to_socket.name for link in group.outputs[0].links) == ["Base Color", "Surface"]
    bpy.ops.objectgs.reset_object(what="COLORS")
    assert sorted((link.from_socket.name, link.to_socket.name) for link in tree.links) == before
    assert not [node for node in tree.nodes if node.type == "GROUP"]


def test_solid_mode_shows_recolored_meshes(root, folder):
    def shown():
        colors = np.empty(4 * len(mesh.data.vertices), np.float32)
        mesh.data.color_attributes.active_color.data.foreach_get("color_srgb", colors)
        return colors.reshape(-1, 4)[:, :3]

    mesh = part(root, "mesh")
    captured = shown()
    bpy.ops.objectgs.duplicate_object()
    for amount in (0.3, 0.6):
        set_sliders(root, replace(RECOLOR, amount=amount))
        wanted = np.clip(expected(captured, object_list.recolor_of(item(root))), 0.0, 1.0)
        assert np.abs(wanted - captured).max() > 0.1
        assert shown() == pytest.approx(wanted, abs=1 / 255)
    write_meshes(folder, {"1": tetrahedron(ORIGIN + 0.5)})
    bpy.ops.objectgs.show_result()
    assert shown() == pytest.approx(wanted, abs=1 / 255), "a mesh that is made later is recolored, too"
    bpy.ops.objectgs.reset_object(what="COLORS")
    assert shown() == pytest.approx(captured) and len(mesh.data.color_attributes) == 1


def test_vertex_colors_of_the_user_stay_shown(root):
    mesh = part(root, "mesh").data
    mesh.color_attributes.active_color = mesh.color_attributes.new("own", "BYTE_COLOR", "CORNER")
    set_sliders(root)
    assert mesh.color_attributes.active_color_name == "own"
    mesh.color_attributes.remove(mesh.color_attributes["Col"])
    item(root).hue = 0.4
    assert [each.name for each in mesh.color_attributes] == ["own"]


def test_rendered_texture_has_recolored_color(root):
    """A plane with the shader's nodes as emission is rendered and compared with the mapped texel color."""
    mesh = part(root, "mesh")
    set_sliders(root)
    material = mesh.data.materials[0]
    tree = material.node_tree
    shader = next(node for node in tree.nodes if node.type == "BSDF_PRINCIPLED")
    emission = tree.nodes.new("ShaderNodeEmission")
    tree.links.new(shader.inputs["Base Color"].links[0].from_socket, emission.inputs["Color"])
    output = next(node for node in tree.nodes if node.type == "OUTPUT_MATERIAL")
    tree.links.new(emission.outputs[0], output.inputs["Surface"])
    stage = bpy.data.scenes.new("stage")
    plane = bpy.data.objects.new("plane", bpy.data.meshes.new("plane"))
    plane.data.from_pydata([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], [], [(0, 1, 2, 3)])
    plane.data.uv_layers.new(name="UVMap")
    plane.data.materials.append(material)
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    camera.location, camera.data.type, camera.data.ortho_scale = (0, 0, 2), "ORTHO", 1.0
    for obj in (plane, camera):
        stage.collection.objects.link(obj)
    stage.camera = camera
    blender_scene.prepare_render(stage)
    stage.render.engine, stage.cycles.samples, stage.cycles.use_denoising = "CYCLES", 1, False
    stage.render.dither_intensity = 0.0
    stage.render.resolution_x = stage.render.resolution_y = 4
    path = blender_scene.folder_of(root) / "plane.png"
    stage.render.filepath = str(path)
    bpy.ops.render.render(write_still=True, scene=stage.name)
    image = bpy.data.images.load(str(path))
    pixels = np.array(image.pixels[:]).reshape(-1, 4)[:, :3]
    wanted = expected(np.array([[200, 100, 50]]) / 255, object_list.recolor_of(item(root)))
    assert pixels == pytest.approx(np.repeat(np.clip(wanted, 0, 1), len(pixels), 0), abs=0.6 / 255)


def test_recolor_is_stored_and_reloaded(root, folder):
    set_sliders(root)
    stored = entry(root).recolor
    assert stored.hue == 0.2 and stored.tint == (1.0, 0.8, 0.6) and stored.amount == 0.6
    assert blender_scene.recolor_of(collection_of(root)) == stored
    edit_objects(folder / "objects.json", {1: {"recolor": None}, 2: {"recolor": RECOLOR.stored()}})
    show_again(root)
    assert blender_scene.recolor_of(collection_of(root)) is None and not object_list.recolor_of(item(root)).changes
    assert blender_scene.recolor_of(collection_of(root, 2)) == RECOLOR
    assert object_list.recolor_of(item(root, 2)) == RECOLOR


def test_older_node_groups_are_replaced_for_recoloring(root):
    splats = part(root, "splats")
    modifier = modifiers.modifier_of(splats, node_groups.SPLATS_GROUP)
    modifiers.set_input(modifier, "Point Size", 0.25)
    newest = modifier.node_group
    older = newest.copy()
    older[VERSION] = 1
    for socket in list(older.interface.items_tree):
        if socket.name.startswith("Recolor "):
            older.interface.remove(socket)
    modifier.node_group = older
    modifiers.set_input(modifier, "Point Size", 0.25)
    show_again(root)
    assert modifier.node_group == older, "the older group suffices without recoloring"
    item(root).hue = 0.5
    assert modifier.node_group == newest
    assert modifiers.inputs_of(modifier)["Point Size"] == 0.25
    assert modifiers.inputs_of(modifier)["Material"] == splats.data.materials[0]


# Removal.


def test_object_is_removed_and_restored(root, folder):
    collection = collection_of(root)
    collection.hide_render = True
    part(root, "object_parent").location.x += 3.0
    where = part(root, "object_parent").matrix_basis.copy()
    activate(root, 1)
    assert bpy.ops.objectgs.remove_object() == {"FINISHED"}
    assert entry(root).removed and not entry(root).floaters and item(root).removed
    assert collection.hide_viewport and collection.hide_render and blender_scene.is_removed(collection)
    assert not part(root, "splats").visible_get()
    assert not bpy.ops.objectgs.remove_object.poll()
    show_again(root)
    assert collection_of(root) == collection and collection.hide_viewport
    assert bpy.ops.objectgs.restore_object() == {"FINISHED"}
    assert not entry(root).removed and not item(root).removed
    assert part(root, "object_parent").select_get() and bpy.context.object == part(root, "object_parent")
    assert not collection.hide_viewport and collection.hide_render, "the previous render visibility is restored"
    assert part(root, "object_parent").matrix_basis == where
    assert not bpy.ops.objectgs.restore_object.poll()


@pytest.mark.long
def test_floaters_match_backend_and_are_restored(root, folder, backend_python):
    activate(root, 1)
    bpy.ops.objectgs.remove_object(floaters=True)
    unlabeled = part(root, "splats", 0)
    hidden = blender_scene.hidden_splats(unlabeled.data)
    table = read_vertices(folder / "splats.ply")
    script = (
        "import sys, json; from pathlib import Path; from backend.export import read_splats;"
        "from backend.editing import apply_edits; from backend.shared.reconstruction.objects import read_objects;"
        "folder = Path(sys.argv[1]); splats = read_splats(folder / 'splats.ply')[0];"
        "kept = apply_edits(splats, read_objects(folder / 'objects.json'));"
        "print(json.dumps(kept.means[kept.object_ids == 0].astype(float).tolist()))"
    )
    ran = subprocess.run(
        [backend_python, "-c", script, folder], cwd=headless.ROOT, capture_output=True, text=True, check=True
    )
    kept = {tuple(row) for row in json.loads(ran.stdout)}
    rows = table[table["object_id"] == 0]
    wanted = [tuple(float(row[axis]) for axis in "xyz") not in kept for row in rows]
    assert 0 < hidden.sum() < len(hidden) and hidden.tolist() == wanted
    blender_scene.show_kinds(root, "splats")
    show_faint(unlabeled)
    assert len(evaluated_colors(unlabeled)) == (~hidden).sum()
    assert len(arrays_of(unlabeled.data).means) == (~hidden).sum(), "hidden splats are neither drawn nor picked"
    show_again(root)
    assert np.array_equal(blender_scene.hidden_splats(part(root, "splats", 0).data), hidden)
    bpy.ops.objectgs.restore_object(object="1")
    assert blender_scene.hidden_splats(unlabeled.data) is None
    assert len(evaluated_colors(unlabeled)) == len(rows)


def test_inside_hull_matches_box():
    rng = np.random.default_rng(3)
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 2) for z in (0, 3)], float) + 1000.0
    means = np.concatenate([corners, 1000.0 + rng.uniform(0, 1, (50, 3)) * (1, 2, 3)])
    points = 1000.0 + rng.uniform(-0.5, 1.5, (500, 3)) * (1, 2, 3)
    inside = ((points > 1000) & (points < 1000 + np.array([1, 2, 3]))).all(1)
    assert np.array_equal(floaters.inside_hull(points, means, np.ones(len(means))), inside)
    assert not floaters.inside_hull(points, corners[:4] * (1, 1, 0), np.ones(4)).any(), "a flat hull has no interior"
    assert not floaters.inside_hull(points, corners[:3], np.ones(3)).any()


# Transforms.


def independent(root, local) -> np.ndarray:
    """Compute capture coordinates (n, 3) of an object's vertices from its world matrix."""
    bpy.context.view_layer.update()
    parent = next(obj for obj in root.objects if blender_scene.kind_of(obj) == "parent")
    world = np.array(local.matrix_world, float)
    back = np.linalg.inv(np.array(parent.matrix_world, float))
    positions = np.empty(3 * len(local.data.vertices), np.float32)
    local.data.vertices.foreach_get("co", positions)
    positions = positions.reshape(-1, 3).astype(float)
    moved = positions @ (back @ world)[:3, :3].T + (back @ world)[:3, 3]
    return moved + ORIGIN


def in_capture(root, way) -> list[float]:
    """Return a displacement in the world in the axes of the capture."""
    return list(kinds.parent_of(root).matrix_world.to_3x3().inverted() @ Vector(way))


@pytest.mark.long
def test_transform_is_stored_in_capture_coordinates(root, folder, backend_python, tmp_path):
    parent = next(obj for obj in root.objects if blender_scene.kind_of(obj) == "parent")
    parent.matrix_world = Matrix.Scale(2.5, 4) @ parent.matrix_world  # as after setting a distance
    pivot = part(root, "object_parent")
    pivot.rotation_euler = (0.3, -0.4, 1.2)
    pivot.location += Vector((0.5, 1.0, -2.0))
    pivot.scale = (1.5, 1.5, 1.5)
    assert entry(root).transform is None
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "moved.blend"))
    assert entry(root).transform is not None and entry(root, 2).transform is None
    splats = part(root, "splats")
    blender_scene.show_kinds(root, "splats")
    ran = subprocess.run(
        [backend_python, "-m", "backend", "export", folder, "--out", tmp_path / "one.ply", "--objects", "1"],
        cwd=headless.ROOT,
        capture_output=True,
        text=True,
    )
    assert ran.returncode == 0, ran.stderr
    table = read_vertices(tmp_path / "one.ply")
    assert np.stack([table[axis] for axis in "xyz"], 1) == pytest.approx(independent(root, splats), abs=2e-4)


def test_a_move_of_a_turned_object_far_from_the_origin_is_stored(root):
    """There, the turn alone changes the translation by thousands of kilometers."""
    root[capture.ORIGIN] = [5e5, 5.4e6, 100.0]
    pivot = part(root, "object_parent")
    pivot.rotation_euler.z += 1.5
    blender_scene.store_placements(root)
    turned = np.array(entry(root).transform)
    blender_scene.store_placements(root)
    assert np.array_equal(entry(root).transform, turned)
    pivot.location.x += 0.5
    blender_scene.store_placements(root)
    moved = np.array(entry(root).transform) - turned
    assert np.abs(moved[:3, :3]).max() == 0 and np.linalg.norm(moved[:3, 3]) == pytest.approx(0.5, abs=1e-4)


def test_rounding_is_not_a_move(root):
    part(root, "object_parent").location.x += 3e-7
    assert "Not moved" in texts_of(EditPanel) and not blender_scene.is_moved(root, collection_of(root))
    part(root, "object_parent").location.x += 3e-4
    assert blender_scene.is_moved(root, collection_of(root))


def test_unmoved_objects_keep_exact_transform(root, folder):
    before = (folder / "objects.json").read_bytes()
    for collection in blender_scene.object_collections(root).values():
        assert np.array_equal(blender_scene.placement_of(root, collection), np.eye(4))
    blender_scene.store_placements(root)
    assert (folder / "objects.json").read_bytes() == before


def test_objects_scaled_to_nothing_keep_their_place_in_the_folder(root, folder):
    part(root, "object_parent").location.x += 1.0
    blender_scene.store_placements(root)
    stored = (folder / "objects.json").read_bytes()
    for scale in ((0.0, 0.0, 0.0), (0.0, 1.0, 1.0)):
        part(root, "object_parent").scale = scale
        blender_scene.store_placements(root)
        assert (folder / "objects.json").read_bytes() == stored
    part(root, "object_parent").scale = (2.0, 2.0, 2.0)
    blender_scene.store_placements(root)
    assert abs(np.linalg.det(np.array(entry(root).transform)[:3, :3])) == pytest.approx(8.0, rel=1e-4)


@pytest.mark.parametrize(
    "linear",
    [
        1.3 * np.array(Matrix.Rotation(1.0, 3, (1, 2, 3))),
        np.diag([1.0, 2.0, 0.5]),
        np.array([[1.0, 0.6, 0.0], [0.0, 1.0, 0.0], [0.2, 0.0, 1.0]]),
        np.diag([-1.0, 1.0, 1.0]),
    ],
)
def test_transforms_from_folder_are_shown_and_kept(root, folder, linear):
    place = np.eye(4)
    place[:3, :3] = linear
    place[:3, 3] = np.array([0.5, -1.0, 2.0]) + ORIGIN - linear @ ORIGIN
    edit_objects(folder / "objects.json", {1: {"transform": place.tolist()}})
    stored = (folder / "objects.json").read_bytes()
    before = independent(root, part(root, "splats"))
    show_again(root)
    after = independent(root, part(root, "splats"))
    assert after == pytest.approx(before @ place[:3, :3].T + place[:3, 3], abs=2e-4)
    assert blender_scene.placement_of(root, collection_of(root)) == pytest.approx(place, abs=1e-3)
    blender_scene.store_placements(root)
    show_again(root)
    assert (folder / "objects.json").read_bytes() == stored
    part(root, "object_parent").location.x += 1.0
    show_again(root)
    moved = independent(root, part(root, "splats"))
    assert not np.allclose(moved, after, atol=0.1), "transforms by the user are kept"
    blender_scene.store_placements(root)
    assert np.abs(np.array(entry(root).transform) - place).max() > 0.1
    assert bpy.ops.objectgs.reset_object(what="TRANSFORM") == {"FINISHED"}
    assert independent(root, part(root, "splats")) == pytest.approx(before, abs=2e-4)
    assert entry(root).transform is None


def test_moved_parts_and_parented_pivots_are_included(root):
    pivot, splats = part(root, "object_parent"), part(root, "splats")
    before = independent(root, splats)
    splats.location.z += 0.5
    holder = bpy.data.objects.new("holder", None)
    bpy.context.scene.collection.objects.link(holder)
    holder.rotation_euler.x, holder.location.y = 0.5, 2.0
    bpy.context.view_layer.update()
    pivot.parent = holder
    after = independent(root, splats)
    place = blender_scene.placement_of(root, collection_of(root))
    assert after == pytest.approx(before @ place[:3, :3].T + place[:3, 3], abs=2e-4)
    wanted = np.eye(4)
    wanted[:3, 3] = 1.0, 0.0, 0.0
    placement.set_placement(root, collection_of(root), wanted)
    assert independent(root, splats) == pytest.approx(before + np.array([1, 0, 0]), abs=2e-4)


# Duplicates.


def test_other_objects_stay_active_in_edit_mode(root):
    """Where another one became active, it would stay in Edit Mode behind."""
    own = bpy.data.objects.new("own", bpy.data.meshes.new("own"))
    bpy.context.scene.collection.objects.link(own)
    names = ("duplicate_object", "separate_splats", "add_crop_box")
    assert all(getattr(bpy.ops.objectgs, name).poll() for name in names)
    bpy.context.view_layer.objects.active = own
    bpy.ops.object.mode_set(mode="EDIT")
    assert not any(getattr(bpy.ops.objectgs, name).poll() for name in names)
    bpy.ops.object.mode_set(mode="OBJECT")


def test_duplicate_shares_data_and_is_stored(root, folder):
    activate(root, 1)
    item(root).hue = 0.25
    assert bpy.ops.objectgs.duplicate_object() == {"FINISHED"}
    (copy,) = blender_scene.duplicates_of(root)[1]
    assert entry(root).copies == (tuple(tuple(row) for row in np.eye(4).tolist()),)
    for kind in ("splats", "mesh", "anchors"):
        assert kinds.part_of(copy, kind).data == part(root, kind).data
        assert kinds.part_of(copy, kind).parent == kinds.part_of(copy, "object_parent")
    assert selection.selected_collections(bpy.context, root) == [copy]
    kinds.part_of(copy, "object_parent").location.x += 4.0
    part(root, "object_parent").location.y += 1.0
    blender_scene.store_placements(root)
    ((*_, row),) = (np.array(place).T.tolist() for place in entry(root).copies)
    assert row[:3] == pytest.approx(in_capture(root, [4.0, 0.0, 0.0]), abs=1e-4)
    assert entry(root).transform is not None
    place = independent(root, kinds.part_of(copy, "splats"))
    splats = read_vertices(folder / "splats.ply")
    write_vertices(folder / "splats.ply", splats[: len(splats) // 2])
    show_again(root)
    (again,) = blender_scene.duplicates_of(root)[1]
    assert again == copy and len(kinds.part_of(copy, "splats").data.vertices) == 25
    assert independent(root, kinds.part_of(copy, "splats")) == pytest.approx(place[:25], abs=1e-4)
    visibility.toggle_solo(bpy.context.view_layer, root, 2)
    assert not kinds.part_of(copy, "object_parent").visible_get()
    visibility.toggle_solo(bpy.context.view_layer, root, 2)
    assert kinds.part_of(copy, "object_parent").visible_get()
    item(root).hue = -0.25
    assert drawing.collections_by_part()[kinds.part_of(copy, "splats")] == copy
    for collection in (copy, collection_of(root)):
        modifier = modifiers.modifier_of(kinds.part_of(collection, "splats"), node_groups.SPLATS_GROUP)
        row = Recolor(hue=-0.25, middle=item(root).middle).affine()[0][0]
        assert list(modifiers.inputs_of(modifier)["Recolor Red"]) == pytest.approx(row, abs=1e-5)
    blender_scene.show_kinds(root, "splats")
    assert kinds.part_of(copy, "mesh").hide_viewport and not kinds.part_of(copy, "splats").hide_viewport
    activate(root, 2)
    selection.select_collections(bpy.context, [copy])
    assert bpy.ops.objectgs.remove_object() == {"FINISHED"}
    assert entry(root).copies == () and not entry(root).removed and not blender_scene.duplicates_of(root)


def test_panel_is_about_the_selected_duplicate(root):
    activate(root, 1)
    name = item(root).name
    assert "duplicate of" not in texts_of(EditPanel) and "Colors of" not in texts_of(EditPanel)
    bpy.ops.objectgs.duplicate_object()
    (copy,) = blender_scene.duplicates_of(root)[1]
    part(root, "object_parent").location.y += 1.0
    drawn = texts_of(EditPanel)
    assert f"{copy.name} (duplicate of {name})" in drawn and "Not moved" in drawn
    assert f"Colors of {name} and its duplicate" in drawn
    kinds.part_of(copy, "object_parent").location.x += 4.0
    assert "Moved by 4" in texts_of(EditPanel)
    bpy.ops.objectgs.reset_object(what="TRANSFORM")
    assert entry(root).copies == (tuple(tuple(row) for row in np.eye(4).tolist()),)
    assert entry(root).transform is not None, "the original stays where it is"
    selection.select_collections(bpy.context, [collection_of(root)])
    assert "Moved by 1" in texts_of(EditPanel) and "duplicate of" not in texts_of(EditPanel)
    bpy.ops.objectgs.reset_object(what="TRANSFORM")
    assert entry(root).transform is None


def test_a_duplicate_that_the_user_moved_out_stays_stored(root):
    activate(root, 1)
    bpy.ops.objectgs.duplicate_object()
    (copy,) = blender_scene.duplicates_of(root)[1]
    kinds.part_of(copy, "object_parent").location.x += 4.0
    blender_scene.store_placements(root)
    stored = entry(root).copies
    bpy.context.scene.collection.children.link(copy)
    next(each for each in (root, *root.children_recursive) if copy.name in each.children).children.unlink(copy)
    blender_scene.store_placements(root)
    assert blender_scene.duplicates_of(root) == {1: [copy]} and len(stored) == 1 and entry(root).copies == stored


def test_duplicates_follow_folder(root, folder):
    first, second = np.eye(4), np.eye(4)
    first[0, 3], second[1, 3] = 2.0, 3.0
    edit_objects(folder / "objects.json", {1: {"copies": [first.tolist(), second.tolist()], "removed": True}})
    show_again(root)
    one, two = blender_scene.duplicates_of(root)[1]
    assert one.hide_render and two.hide_viewport, "duplicates are removed with their original"
    edit_objects(folder / "objects.json", {1: {"copies": [second.tolist()], "removed": None}})
    show_again(root)
    assert blender_scene.duplicates_of(root)[1] == [two] and not two.hide_render
    for obj in list(two.objects):
        bpy.data.objects.remove(obj)
    blender_scene.store_placements(root)
    assert entry(root).copies == () and not blender_scene.duplicates_of(root)


def test_blender_duplicates_become_stored_duplicates(root):
    blender_scene.show_kinds(root, "splats")
    selection.select_object(bpy.context, root, 1)
    chosen = set(bpy.context.selected_objects)
    bpy.ops.object.duplicate()
    twin = next(obj for obj in bpy.context.selected_objects if blender_scene.kind_of(obj) == "object_parent")
    assert twin not in chosen
    twin.location.x += 2.0
    blender_scene.store_placements(root)
    (copy,) = blender_scene.duplicates_of(root)[1]
    assert kinds.part_of(copy, "object_parent") == twin
    assert kinds.part_of(copy, "splats").data == part(root, "splats").data, "the duplicate shares the original's data"
    assert len([obj for obj in collection_of(root).objects if blender_scene.kind_of(obj) == "splats"]) == 1
    assert np.array(entry(root).copies[0])[:3, 3] == pytest.approx(in_capture(root, [2, 0, 0]), abs=1e-4)
    selection.select_object(bpy.context, root, 2)
    bpy.ops.object.select_all(action="DESELECT")
    part(root, "splats", 2).select_set(True)
    bpy.ops.object.duplicate()
    bpy.context.selected_objects[0].location.y += 1.0
    blender_scene.store_placements(root)
    assert np.array(entry(root, 2).copies[0])[:3, 3] == pytest.approx([0, 1, 0], abs=1e-4)
    place = independent(root, kinds.part_of(blender_scene.duplicates_of(root)[2][0], "splats"))
    assert place == pytest.approx(independent(root, part(root, "splats", 2)) + np.array([0, 1, 0]), abs=1e-4)


def test_an_older_blend_can_show_what_another_moved(root, folder, tmp_path):
    """Saving a move of one object does not hide those of others that another .blend or program has stored."""
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "older.blend"))
    part(root, "object_parent", 2).location.x += 1.0
    activate(root, 2)
    bpy.ops.objectgs.duplicate_object()
    stored = entry(root, 2)
    assert stored.transform is not None and stored.copies
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "older.blend"))
    part(active(), "object_parent").location.y += 1.0
    bpy.ops.wm.save_mainfile()
    assert entry(active()).transform is not None and entry(active(), 2) == stored
    show_again(active())
    moved = blender_scene.placement_of(active(), collection_of(active(), 2))
    assert moved == pytest.approx(np.array(stored.transform), abs=1e-4)
    assert len(blender_scene.duplicates_of(active())[2]) == 1
    assert entry(active()).transform is not None and entry(active(), 2) == stored


@pytest.mark.parametrize("way", ["scene", "collection"])
def test_moves_of_what_is_in_no_scene_are_not_stored(root, tmp_path, way):
    """Blender keeps a deleted scene's collections, and unlinked ones, until another file is opened."""
    if way == "scene":
        bpy.ops.scene.new(type="FULL_COPY")
    moved = active()
    assert (moved == root) == (way == "collection")
    part(moved, "object_parent").location.x += 5.0
    if way == "scene":
        bpy.ops.scene.delete()
    else:
        bpy.context.scene.collection.children.unlink(moved)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "some.blend"))
    assert moved.name in bpy.data.collections and entry(root).transform is None
    bpy.context.scene.collection.children.link(moved)
    bpy.ops.wm.save_mainfile()
    assert entry(root).transform is not None


def test_objects_left_out_keep_their_move(root):
    part(root, "object_parent").location.x += 1.0
    item(root).chosen = False
    assert 1 not in blender_scene.object_collections(root) and entry(root).left_out
    assert entry(root).transform is not None
    item(root).chosen = True
    assert np.array(entry(root).transform) == pytest.approx(blender_scene.placement_of(root, collection_of(root)))


@pytest.fixture
def told(monkeypatch) -> list:
    """What messages were shown, as (text, operator)."""
    texts = []
    monkeypatch.setattr(messages, "show", lambda text, kind="INFO", operator=None, **_: texts.append((text, operator)))
    return texts


@pytest.mark.parametrize(
    "change",
    [
        {"removed": True},
        {"recolor": RECOLOR.stored()},
        {"merged_into": 2},
        {"transform": np.diag([1.0, 2.0, 1.0, 1.0]).tolist()},
        {"copies": [np.eye(4).tolist()]},
    ],
    ids=lambda change: next(iter(change)),
)
def test_opening_an_older_blend_tells_of_newer_edits(root, folder, tmp_path, told, change):
    """Exports use the folder's edits, which the .blend does not show."""
    set_sliders(root, object_id=2)
    activate(root, 2)
    bpy.ops.objectgs.duplicate_object()
    part(root, "object_parent", HUGE).location.x += 1.0
    path = str(tmp_path / "some.blend")
    bpy.ops.wm.save_as_mainfile(filepath=path)
    bpy.ops.wm.open_mainfile(filepath=path)
    assert told == [], "the .blend shows the folder's edits"
    edit_objects(folder / "objects.json", {1: change})
    bpy.ops.wm.open_mainfile(filepath=path)
    ((text, operator),) = told
    assert "Reload Result" in text and operator == "objectgs.show_result"
    show_again(active())
    bpy.ops.wm.save_mainfile()
    bpy.ops.wm.open_mainfile(filepath=path)
    assert len(told) == 1


def test_films_and_exports_tell_of_edits_in_another_scene(root, folder, tmp_path, told, monkeypatch):
    """They use the place that the other scene has given the object last."""
    monkeypatch.setattr(background, "submit", lambda *_: {"FINISHED"})
    scene = bpy.context.scene
    scene.camera = next(obj for obj in scene.objects if obj.type == "CAMERA")
    scene.frame_end = 1

    def made():
        assert bpy.ops.objectgs.film_frames() == {"FINISHED"}
        assert bpy.ops.objectgs.export_splats(filepath=str(tmp_path / "all"), coordinates="capture") == {"FINISHED"}
        return [operator for text, operator in told if str(folder / "objects.json") in text]

    part(root, "object_parent", 2).location.x += 1.0
    assert made() == []
    bpy.ops.scene.new(type="FULL_COPY")
    part(active(), "object_parent").location.x += 5.0
    assert made() == []
    bpy.context.window_manager.windows[0].scene = scene
    assert active() == root and made() == ["objectgs.show_result"] * 2


def test_messages_about_newer_edits_name_each_reconstruction(root, folder, tmp_path, told):
    """The active one is the latest, since its button acts on it; those of others stay when it is pressed."""
    other = Path(shutil.copytree(folder, tmp_path / "other"))
    bpy.ops.objectgs.open_reconstruction(directory=str(other))
    bpy.context.scene.objectgs.active = root
    path = str(tmp_path / "some.blend")
    bpy.ops.wm.save_as_mainfile(filepath=path)
    for each in (folder, other):
        edit_objects(each / "objects.json", {1: {"removed": True}})
    bpy.ops.wm.open_mainfile(filepath=path)
    assert [str(place / "objects.json") in text for (text, _), place in zip(told, (other, folder))] == [True, True]
    shown = [messages.Message(text, operator=operator) for text, operator in told]
    messages._messages[:] = shown
    show_again(active())
    assert messages._messages == shown[:1]
    shutil.rmtree(other)
    show_again(active())
    bpy.ops.wm.save_mainfile()
    bpy.ops.wm.open_mainfile(filepath=path)
    assert len(told) == 2 and not messages._messages, "a missing folder has no newer edits"


def test_edits_of_rows_show_in_the_list_what_another_program_wrote(root, folder):
    edit_objects(folder / "objects.json", {1: {"removed": True}})
    item(root, 2).name = "crate"
    assert collection_of(root).hide_render and item(root).removed and item(root, 2).name == "crate"
    activate(root, 1)
    assert bpy.ops.objectgs.restore_object() == {"FINISHED"}
    assert not entry(root).removed and not collection_of(root).hide_render


# Blender's own operators.


@pytest.fixture
def parts_shown(root) -> list:
    """The pivot, the splats and the mesh of object 1, all visible."""
    blender_scene.show_kinds(root, "both")
    return [part(root, kind) for kind in ("object_parent", "splats", "mesh")]


def choose(*objs) -> None:
    bpy.ops.object.select_all(action="DESELECT")
    for obj in objs:
        obj.select_set(True)
    bpy.context.view_layer.objects.active = objs[0]
    bpy.context.view_layer.update()


def seen(parts) -> list[np.ndarray]:
    """Return the world coordinates (n, 3) of the vertices of parts other than pivots."""
    found = []
    for obj in parts[1:]:
        matrix = placement.matrix_to_world(obj)
        found.append(carrier.read(obj.data, "position") @ matrix[:3, :3].T + matrix[:3, 3])
    return found


def stay(parts, before) -> bool:
    return all(np.allclose(now, then, atol=1e-4) for now, then in zip(seen(parts), before))


def mesh_again(root, folder) -> None:
    """Show the same mesh of object 1 from newer files."""
    for path in (folder / "meshes").iterdir():
        os.utime(path, ns=(path.stat().st_mtime_ns + 5_000_000_000,) * 2)
    show_again(root)


def test_set_origin_is_not_a_move(root, folder, parts_shown):
    before, positions = seen(parts_shown), carrier.read(parts_shown[1].data, "position")
    choose(*parts_shown)
    bpy.ops.object.origin_set(type="ORIGIN_GEOMETRY")
    assert all(obj.location.length > 0.05 for obj in parts_shown[1:])
    blender_scene.store_placements(root)
    assert entry(root).transform is None and stay(parts_shown, before)
    assert carrier.read(parts_shown[1].data, "position") == pytest.approx(positions, abs=1e-6)
    assert parts_shown[2].location.length > 0.05, "a mesh keeps its origin"
    mesh_again(root, folder)
    blender_scene.store_placements(root)
    assert entry(root).transform is None and stay(parts_shown, before)
    choose(parts_shown[2])
    bpy.ops.object.origin_set(type="ORIGIN_GEOMETRY")
    bpy.ops.objectgs.reset_object(what="TRANSFORM")
    assert stay(parts_shown, before)


def test_applied_transforms_are_kept(root, folder, parts_shown):
    """Applying changes the positions of splats, but not their scale and rotation."""
    mesh = tetrahedron(ORIGIN + 0.5)
    for name in ("vertices", "normals", "colors"):
        setattr(mesh, name, np.tile(getattr(mesh, name), (2, 1)))
    write_meshes(folder, {"1": mesh})
    mesh_again(root, folder)
    positions = carrier.read(parts_shown[1].data, "position")
    parts_shown[0].scale = 2.0, 2.0, 2.0
    parts_shown[0].rotation_euler.z = 0.5
    parts_shown[0].location.x += 1.0
    before, place = seen(parts_shown), blender_scene.placement_of(root, collection_of(root))
    for properties in ({"location": False, "rotation": False}, {}):
        choose(*parts_shown)
        bpy.ops.object.transform_apply(**properties)
        assert np.abs(carrier.read(parts_shown[1].data, "position") - positions).max() > 1.0
        blender_scene.store_placements(root)
        assert np.array(entry(root).transform) == pytest.approx(place, abs=1e-3)
        assert carrier.read(parts_shown[1].data, "position") == pytest.approx(positions, abs=1e-5)
        assert stay(parts_shown, before)
    mesh_again(root, folder)
    assert stay(parts_shown, before)


def test_cleared_parents_stay_cleared(root, folder, parts_shown):
    parts_shown[0].location.x += 1.0
    parts_shown[2].data.vertices[1].co.x += 5.0
    before, place = seen(parts_shown), blender_scene.placement_of(root, collection_of(root))
    choose(*parts_shown)
    bpy.ops.object.parent_clear(type="CLEAR_KEEP_TRANSFORM")
    show_again(root)
    blender_scene.store_placements(root)
    assert not any(obj.parent for obj in parts_shown) and stay(parts_shown, before)
    assert np.array(entry(root).transform) == pytest.approx(place, abs=1e-3)
    wanted = np.eye(4)
    wanted[:3, 3] = 0.0, 0.0, 2.0
    placement.set_placement(root, collection_of(root), wanted)
    back = independent(root, parts_shown[1]) - (0.0, 0.0, 2.0)
    bpy.ops.objectgs.reset_object(what="TRANSFORM")
    assert entry(root).transform is None
    assert independent(root, parts_shown[1]) == pytest.approx(back, abs=1e-4)
    edit_objects(folder / "objects.json", {1: {"merged_into": 2}})
    show_again(root)
    assert parts_shown[2].parent == part(root, "object_parent", 2)
    assert np.array_equal(parts_shown[2].matrix_basis, np.eye(4))


def test_objects_moved_to_other_collections_take_their_own_along(root, parts_shown):
    owner, own, count = bpy.context.scene, collection_of(root), len(bpy.data.objects)
    places = [bpy.data.collections.new(name) for name in ("Props", "More")]
    for place in places:
        owner.collection.children.link(place)
    for target in (*places, owner.collection, collection_of(root, 2), root):
        choose(*parts_shown)
        bpy.ops.object.move_to_collection(collection_uid=target.session_uid)
        parts_shown[0].location.x += 1.0
        before = entry(root).transform
        blender_scene.store_placements(root)
        assert entry(root).transform != before
        show_again(root)
        assert collection_of(root) == own and len(bpy.data.objects) == count
        assert all(obj.users_collection == (own,) and obj.select_get() for obj in parts_shown)
        wanted = owner.collection if target == collection_of(root, 2) else target
        assert [each for each in (*bpy.data.collections, owner.collection) if own in each.children[:]] == [wanted]
    choose(parts_shown[2])
    bpy.ops.object.move_to_collection(collection_uid=places[0].session_uid)
    show_again(root)
    assert set(parts_shown[2].users_collection) == {own, places[0]} and len(bpy.data.objects) == count


def test_copied_meshes_are_left_to_the_user(root, folder, parts_shown):
    """A copy that was saved beside its mesh does not take its place."""
    place = bpy.data.collections.new("Retopo")
    bpy.context.scene.collection.children.link(place)
    choose(parts_shown[2])
    bpy.ops.object.duplicate()
    copy = bpy.context.active_object
    bpy.ops.object.move_to_collection(collection_uid=place.session_uid)
    blender_scene.store_placements(root)
    copy.data.vertices[0].co.x += 5.0
    bpy.data.objects.remove(parts_shown[2])
    blender_scene.store_placements(root)
    write_meshes(folder, {"1": tetrahedron(ORIGIN, 2.0)})
    show_again(root)
    assert copy.users_collection == (place,) and blender_scene.kind_of(copy) is None
    assert part(root, "mesh") is not None and part(root, "mesh") != copy
    assert copy.data.vertices[0].co.x - part(root, "mesh").data.vertices[0].co.x > 3.0
    edit_objects(folder / "objects.json", {1: {"merged_into": 2}})
    show_again(root)
    assert copy.users_collection == (place,)


def test_objects_parented_to_others_are_placed(root, folder, parts_shown):
    holder = bpy.data.objects.new("holder", None)
    bpy.context.scene.collection.objects.link(holder)
    holder.rotation_euler.x, holder.location.y, holder.parent = 0.5, 2.0, kinds.parent_of(root)
    before, captured = seen(parts_shown), floaters._places(parts_shown[1])
    box = np.array(blender_scene.add_crop_box(root, None).matrix_basis)
    choose(holder, *parts_shown)
    bpy.ops.object.parent_set(type="OBJECT", keep_transform=True)
    assert {obj.parent for obj in parts_shown} == {holder}
    blender_scene.store_placements(root)
    assert entry(root).transform is None
    assert np.array_equal(floaters._places(parts_shown[1]), captured)
    bpy.data.objects.remove(blender_scene.crop_box_of(root))
    assert np.array(blender_scene.add_crop_box(root, None).matrix_basis) == pytest.approx(box, abs=1e-5)
    own, count = collection_of(root), len(bpy.data.objects)
    bpy.context.scene.collection.children.link(own)
    root.children.unlink(own)
    holder.location.x += 1.0
    show_again(root)
    blender_scene.store_placements(root)
    assert collection_of(root) == own and len(bpy.data.objects) == count
    assert np.array(entry(root).transform)[:3, 3] == pytest.approx((1.0, 0.0, 0.0), abs=1e-3)
    bpy.ops.objectgs.reset_object(what="TRANSFORM")
    assert entry(root).transform is None and stay(parts_shown, before)


def test_objects_parented_to_pivots_of_others_are_placed(root, folder, parts_shown):
    """They are parts of their object, not of a copy that the other pivot belongs to."""
    before, tray = seen(parts_shown), part(root, "object_parent", 2)
    choose(tray, *parts_shown)
    bpy.ops.object.parent_set(type="OBJECT", keep_transform=True)
    assert {obj.parent for obj in parts_shown} == {tray}
    blender_scene.store_placements(root)
    assert entry(root).transform is None and stay(parts_shown, before)
    wanted = np.eye(4)
    wanted[:3, 3] = 0.0, 0.0, 2.0
    there = independent(root, parts_shown[1]) + wanted[:3, 3]
    edit_objects(folder / "objects.json", {1: {"transform": wanted.tolist()}})
    show_again(root)
    assert independent(root, parts_shown[1]) == pytest.approx(there, abs=1e-4)
    assert blender_scene.placement_of(root, collection_of(root)) == pytest.approx(wanted, abs=1e-4)
    bpy.ops.objectgs.reset_object(what="TRANSFORM")
    assert entry(root).transform is None and stay(parts_shown, before)


@pytest.mark.parametrize("is_alone", [False, True], ids=["whole", "alone"])
@pytest.mark.parametrize("with_holder", [False, True], ids=["cleared", "held"])
def test_duplicates_of_objects_without_pivots_above_are_stored_once(root, parts_shown, is_alone, with_holder):
    parts_shown[0].location.x += 1.0
    parts_shown[0].rotation_euler.z = 0.5
    if with_holder:
        holder = bpy.data.objects.new("holder", None)
        bpy.context.scene.collection.objects.link(holder)
        holder.rotation_euler.x, holder.location.y, holder.parent = 0.5, 2.0, kinds.parent_of(root)
        choose(holder, *parts_shown)
        bpy.ops.object.parent_set(type="OBJECT", keep_transform=True)
    else:
        choose(*parts_shown)
        bpy.ops.object.parent_clear(type="CLEAR_KEEP_TRANSFORM")
    choose(*(parts_shown[1:2] if is_alone else parts_shown))
    before = independent(root, parts_shown[1])
    bpy.ops.object.duplicate()
    for obj in bpy.context.selected_objects:
        obj.location.z += 2.0
    twin = next(obj for obj in bpy.context.selected_objects if blender_scene.kind_of(obj) == "splats")
    there = independent(root, twin)
    blender_scene.store_placements(root)
    (copy,), (stored,) = blender_scene.duplicates_of(root)[1], entry(root).copies
    own = [sorted(map(blender_scene.kind_of, each.objects)) for each in (collection_of(root), copy)]
    assert own == [["anchors", "mesh", "object_parent", "splats"]] * 2
    assert independent(root, kinds.part_of(copy, "splats")) == pytest.approx(there, abs=1e-4)
    captured = before - np.array(entry(root).transform)[:3, 3]
    captured = captured @ np.linalg.inv(np.array(entry(root).transform)[:3, :3]).T
    moved = captured @ np.array(stored)[:3, :3].T + np.array(stored)[:3, 3]
    assert moved == pytest.approx(there, abs=1e-3)


def fields(obj) -> tuple:
    return tuple(obj.location), tuple(obj.rotation_euler), tuple(obj.scale)


def test_transforms_of_objects_are_in_the_axes_of_the_world(root, folder, parts_shown):
    pivot = parts_shown[0]
    bpy.context.view_layer.update()
    at = pivot.matrix_world.translation
    captured = fields(pivot)
    assert captured[0] == pytest.approx(tuple(at), abs=1e-5) and captured[1:] == ((0.0,) * 3, (1.0,) * 3)
    expected = kinds.parent_of(root).matrix_world @ Vector(pivot["objectgs_center"])
    assert tuple(at) == pytest.approx(tuple(expected), abs=1e-5)
    assert all(fields(part) == ((0.0,) * 3, (0.0,) * 3, (1.0,) * 3) for part in parts_shown[1:])
    before, center = seen(parts_shown), np.array(at)
    pivot.location.x += 0.7
    pivot.scale.z = 2.0
    pivot.rotation_euler.z = math.pi / 2
    moved = [
        (points - center) * (1.0, 1.0, 2.0) @ np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]]) + center + (0.7, 0.0, 0.0)
        for points in before
    ]
    assert stay(parts_shown, moved)
    there, stored = independent(root, parts_shown[1]), fields(pivot)
    blender_scene.store_placements(root)
    place = np.array(entry(root).transform)
    edit_objects(folder / "objects.json", {1: {"transform": None}})
    show_again(root)
    assert fields(pivot) == captured and stay(parts_shown, before)
    captured_at = independent(root, parts_shown[1])
    assert there == pytest.approx(captured_at @ place[:3, :3].T + place[:3, 3], abs=2e-4)
    edit_objects(folder / "objects.json", {1: {"transform": place.tolist()}})
    show_again(root)
    assert np.array(fields(pivot)) == pytest.approx(np.array(stored), abs=1e-5) and stay(parts_shown, moved)
    choose(*parts_shown)
    bpy.ops.object.rotation_clear()
    bpy.ops.object.scale_clear()
    assert stay(parts_shown, [points + np.array((0.7, 0.0, 0.0)) for points in before])
    assert bpy.ops.objectgs.reset_object(what="TRANSFORM") == {"FINISHED"}
    assert fields(pivot) == captured and stay(parts_shown, before)


def test_transforms_of_duplicates_are_in_the_axes_of_the_world(root, parts_shown):
    choose(*parts_shown)
    bpy.ops.object.duplicate()
    twins = sorted(bpy.context.selected_objects, key=lambda obj: obj.type != "EMPTY")
    bpy.ops.objectgs.duplicate_object()
    parent, before = kinds.parent_of(root), seen(twins)
    twins[0].location.z += 1.0
    blender_scene.store_placements(root)
    assert stay(twins, [points + np.array((0.0, 0.0, 1.0)) for points in before])
    other = next(
        pivot
        for copy in blender_scene.duplicates_of(root)[1]
        if (pivot := kinds.part_of(copy, "object_parent")) != twins[0]
    )
    assert fields(other) == fields(parts_shown[0])
    there = [seen(parts) for parts in (twins, parts_shown)]
    move = Matrix.Translation((1, 2, 3)) @ Matrix.Rotation(0.4, 4, "Y") @ Matrix.Scale(1.5, 4)
    parent.matrix_world = move @ parent.matrix_world
    for parts, points in zip((twins, parts_shown), there):
        wanted = [each @ np.array(move)[:3, :3].T + np.array(move)[:3, 3] for each in points]
        assert stay(parts, wanted), "the parent empty carries all"
    show_again(root)
    assert entry(root).transform is None and not blender_scene.is_moved(root, collection_of(root))


@pytest.mark.parametrize("deed", ["ground", "distance"])
def test_transforms_stay_in_the_axes_of_the_world_after_orientation(root, folder, parts_shown, deed):
    moved = [part(root, kind, 2) for kind in ("object_parent", "splats", "mesh")]
    moved[0].location.x += 1.0
    moved[0].rotation_euler.z = 0.5
    lamp = bpy.data.objects.new("lamp", None)
    bpy.context.scene.collection.objects.link(lamp)
    lamp.parent, lamp.location = parts_shown[0], (0.1, 0.2, 0.3)
    animated = part(root, "object_parent", HUGE)
    animated.keyframe_insert("location", frame=1)
    blender_scene.store_placements(root)
    stored = (folder / "objects.json").read_bytes()
    parent, keyed = kinds.parent_of(root), fields(animated)
    relative = [placement.map_to(obj, parent) for obj in (*parts_shown[1:], *moved[1:], lamp, animated)]
    if deed == "ground":
        blender_scene.orient_to_ground(root, (0.0, 0.0, 0.0), (1.0, 0.0, 0.2), (0.0, 1.0, 0.1))
    else:
        blender_scene.scale_to_distance(root, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 3.0)
    bpy.context.view_layer.update()
    again = [placement.map_to(obj, parent) for obj in (*parts_shown[1:], *moved[1:], lamp, animated)]
    assert np.array(again) == pytest.approx(np.array(relative), abs=1e-5)
    place = (tuple(parts_shown[0].matrix_world.translation), (0.0,) * 3, (1.0,) * 3)
    assert np.array(fields(parts_shown[0])) == pytest.approx(np.array(place), abs=1e-5)
    before = seen(parts_shown)
    parts_shown[0].location.y += 0.7
    assert stay(parts_shown, [points + np.array((0.0, 0.7, 0.0)) for points in before])
    parts_shown[0].location.y -= 0.7
    assert fields(animated) == keyed
    blender_scene.store_placements(root)
    assert (folder / "objects.json").read_bytes() == stored


def test_typed_transforms_are_kept_when_the_capture_is_shown_again(root, folder, parts_shown):
    pivot = parts_shown[0]
    pivot.rotation_euler.z, pivot.scale.x = math.radians(270.0), -1.0
    blender_scene.store_placements(root)
    typed = fields(pivot)
    blender_scene.show_capture(bpy.context.scene, folder, root)
    assert fields(pivot) == typed
    show_again(root)
    assert fields(pivot) == typed


def test_empties_of_objects_are_drawn_in_the_size_of_their_objects(root, parts_shown):
    def drawn(pivot) -> float:
        bpy.context.view_layer.update()
        return pivot.empty_display_size * max(pivot.matrix_world.to_scale())

    before = drawn(parts_shown[0])
    blender_scene.scale_to_distance(root, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 0.05)
    assert drawn(parts_shown[0]) == pytest.approx(0.05 * before, rel=1e-4)
    bpy.data.objects.remove(parts_shown[0])
    show_again(root)
    assert drawn(part(root, "object_parent")) == pytest.approx(0.05 * before, rel=0.1), "made anew"


def test_deleted_pivots_and_parents_are_made_again_in_place(root, parts_shown):
    before = seen(parts_shown)
    bpy.data.objects.remove(parts_shown[0])
    show_again(root)
    parts_shown[0] = part(root, "object_parent")
    assert stay(parts_shown, before)
    bpy.data.objects.remove(kinds.parent_of(root))
    blender_scene.show_capture(bpy.context.scene, blender_scene.folder_of(root))
    assert stay(parts_shown, before) and not blender_scene.is_moved(root, collection_of(root))


# Undo.


def state(root) -> dict:
    """Return everything that edits change."""
    splats = part(root, "splats")
    hidden = blender_scene.hidden_splats(part(root, "splats", 0).data)
    return {
        "inputs": {
            m.name: {name: list(value) for name, value in modifiers.inputs_of(m).items() if name.startswith("Recolor")}
            for m in splats.modifiers
        },
        "nodes": sorted(node.type for node in part(root, "mesh").data.materials[0].node_tree.nodes),
        "places": [list(map(list, part(root, "object_parent", i).matrix_basis)) for i in (1, 2)],
        "flags": [(collection_of(root, i).hide_viewport, collection_of(root, i).hide_render) for i in (1, 2)],
        "hidden": None if hidden is None else hidden.tolist(),
        "copies": [len(copies) for copies in blender_scene.duplicates_of(root).values()],
        "sliders": object_list.recolor_of(item(root)).stored(),
        "removed": item(root).removed,
        "file": {
            e.id: (e.removed, e.floaters, e.fill, e.recolor, e.transform, e.copies)
            for e in read_objects(blender_scene.folder_of(root) / "objects.json")
        },
    }


def test_undo_leaves_what_another_program_wrote(root, folder):
    bpy.ops.ed.undo_push(message="begin")
    activate(active(), 1)
    set_sliders(active())
    bpy.ops.ed.undo_push(message="recolored")
    moved = np.eye(4)
    moved[:3, 3] = 1.0, 2.0, 3.0
    edit_objects(folder / "objects.json", {2: {"removed": True, "transform": moved.tolist()}})
    bpy.ops.ed.undo()
    mug, box = read_objects(folder / "objects.json")[:2]
    assert mug.id == 1 and mug.recolor is None, "what the undo has changed is written"
    assert box.id == 2 and box.removed and np.array_equal(box.transform, moved)


def test_undo_and_redo_restore_all_edits(root, tmp_path):
    def recolor():
        set_sliders(active())

    def move():
        part(active(), "object_parent", 2).location.x += 1.0
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "some.blend"))  # saving stores the transform

    def remove():
        activate(active(), 1)
        bpy.ops.objectgs.remove_object(floaters=True, fill=True)

    def copy():
        activate(active(), 2)
        bpy.ops.objectgs.duplicate_object()

    bpy.ops.ed.undo_push(message="begin")
    states = [state(active())]
    for step in (recolor, move, remove, copy):
        step()
        bpy.ops.ed.undo_push(message=step.__name__)
        states.append(state(active()))
    assert all(before != after for before, after in itertools.pairwise(states))
    for wanted in reversed(states[:-1]):
        bpy.ops.ed.undo()
        assert state(active()) == wanted
    for wanted in states[1:]:
        bpy.ops.ed.redo()
        assert state(active()) == wanted
    bpy.ops.ed.undo()
    bpy.ops.ed.undo()
    wanted = state(active())
    show_again(active())
    assert state(active()) == wanted, "the folder matches Blender's state"


@pytest.fixture
def steps(monkeypatch) -> list[str]:
    """Titles of the undo steps that the extension pushes, as in a window."""
    titles = []

    def push(title):
        titles.append(title)
        bpy.ops.ed.undo_push(message=title)

    bpy.context.preferences.edit.use_global_undo = True
    monkeypatch.setattr(undo, "push", push)
    return titles


def duplicate_in_blender() -> None:
    """Duplicate object 1 by Blender's own operator and move the duplicate, each with its undo step."""
    selection.select_object(bpy.context, active(), 1)
    bpy.ops.ed.undo_push(message="selected")
    bpy.ops.object.duplicate()
    twin = next(obj for obj in bpy.context.selected_objects if blender_scene.kind_of(obj) == "object_parent")
    twin.location.x += 2.0
    bpy.ops.ed.undo_push(message="duplicated")


def links() -> dict:
    """Return what is linked in which collection; pointers to data-blocks that undo has freed would crash here."""
    return {
        each.name: (sorted(child.name for child in each.children), sorted(obj.name for obj in each.objects))
        for each in (active(), *active().children_recursive)
    }


def test_undo_leaves_what_blender_duplicated_where_it_is(root, steps):
    """A collection that undo makes is in none of its steps, so that the next undo would free it alone."""
    bpy.ops.ed.undo_push(message="begin")
    before = links()
    duplicate_in_blender()
    duplicated = links()
    active().children[0].hide_render = True
    bpy.ops.ed.undo_push(message="hidden")
    bpy.ops.ed.undo()
    assert links() == duplicated and not blender_scene.duplicates_of(active()) and entry(active()).copies == ()
    bpy.ops.ed.undo()
    assert links() == before and steps == []
    bpy.ops.ed.redo()
    assert links() == duplicated
    object_edits.store_edits(active())
    assert len(blender_scene.duplicates_of(active())[1]) == len(entry(active()).copies) == 1


def test_stored_duplicates_of_blender_have_an_undo_step(root, steps, tmp_path):
    bpy.ops.ed.undo_push(message="begin")
    duplicate_in_blender()
    duplicated = links()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "some.blend"))
    stored, copies = links(), entry(active()).copies
    assert steps == ["Transforms and Duplicates"] and stored != duplicated and len(copies) == 1
    bpy.ops.wm.save_mainfile()
    assert steps == ["Transforms and Duplicates"], "there is nothing new to store"
    bpy.ops.ed.undo()
    assert links() == duplicated and entry(active()).copies == ()
    bpy.ops.ed.redo()
    assert links() == stored and entry(active()).copies == copies
    for obj in list(blender_scene.duplicates_of(active())[1][0].objects):
        bpy.data.objects.remove(obj)
    bpy.ops.ed.undo_push(message="deleted")
    bpy.ops.wm.save_mainfile()
    assert entry(active()).copies == () and not blender_scene.duplicates_of(active())
    bpy.ops.ed.undo()
    bpy.ops.ed.undo()
    assert links() == stored and entry(active()).copies == copies
    bpy.ops.ed.redo()
    assert entry(active()).copies == (), "what undo shows without its pivot is no duplicate"


def test_undo_after_saving_keeps_applied_transforms(root, steps, tmp_path):
    """Saving gives back to the transform what Apply took from it, in the mesh and in the object at once."""

    def splats():
        return part(active(), "splats")

    blender_scene.show_kinds(root, "both")
    bpy.ops.ed.undo_push(message="begin")
    splats().scale = 2.0, 2.0, 2.0
    choose(splats())
    bpy.ops.object.transform_apply(location=False, rotation=False)
    bpy.ops.ed.undo_push(message="applied")
    applied = seen([None, splats()])
    splats().location.x += 1.0
    bpy.ops.ed.undo_push(message="moved")
    moved = seen([None, splats()])
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "some.blend"))
    assert steps == ["Transforms and Duplicates"] and splats().scale.x == pytest.approx(2.0)
    for wanted in (moved, moved, applied):
        assert stay([None, splats()], wanted)
        bpy.ops.ed.undo()


def test_objects_moved_to_other_collections_again_have_an_undo_step(root, steps, tmp_path):
    """Their collection is then outside of the reconstruction's, and links change there."""
    for name in ("Props", "More"):
        bpy.context.scene.collection.children.link(bpy.data.collections.new(name))
    bpy.ops.ed.undo_push(message="begin")
    for count, name in enumerate(("Props", "More"), 1):
        choose(*(part(active(), kind) for kind in ("object_parent", "splats")))
        bpy.ops.object.move_to_collection(collection_uid=bpy.data.collections[name].session_uid)
        bpy.ops.ed.undo_push(message="moved")
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "some.blend"))
        assert len(steps) == count and collection_of(active()) in bpy.data.collections[name].children[:]
    bpy.ops.ed.undo()
    bpy.ops.ed.undo()
    assert collection_of(active()) in bpy.data.collections["Props"].children[:]


def test_written_colors_have_an_undo_step_only_with_new_duplicates(root, steps):
    bpy.ops.ed.undo_push(message="begin")
    item(active()).color = (1.0, 0.0, 0.0)
    assert steps == []
    duplicate_in_blender()
    holder = bpy.data.objects.new("holder", bpy.data.meshes.new("holder"))
    bpy.context.scene.collection.objects.link(holder)
    bpy.context.view_layer.objects.active = holder
    bpy.ops.object.mode_set(mode="EDIT")
    duplicated = links()
    item(active()).color = (0.0, 0.0, 1.0)
    assert steps == [] and links() == duplicated, "Edit Mode has undo steps of its own"
    bpy.ops.object.mode_set(mode="OBJECT")
    item(active()).color = (0.0, 1.0, 0.0)
    assert steps == ["Colors"] and len(blender_scene.duplicates_of(active())[1]) == 1


def test_edits_of_rows_are_undone_with_what_they_store(root, steps):
    """A step in the middle of an edit would have the new name already."""
    bpy.ops.ed.undo_push(message="begin")
    duplicate_in_blender()
    name = item(active()).name
    item(active()).name = "cup"
    bpy.ops.ed.undo_push(message="named")
    assert steps == [] and len(blender_scene.duplicates_of(active())[1]) == len(entry(active()).copies) == 1
    bpy.ops.ed.undo()
    assert item(active()).name == entry(active()).name == name


@pytest.mark.parametrize("change", ["duplicate", "remove", "reset"])
def test_operators_store_earlier_changes_in_an_undo_step_of_their_own(root, steps, change):
    activate(root, 1)
    bpy.ops.ed.undo_push(message="begin")
    if change == "remove":
        bpy.ops.objectgs.duplicate_object()
        copy = blender_scene.duplicates_of(active())[1][0]
    duplicate_in_blender()
    if change == "remove":
        selection.select_collections(bpy.context, [copy])
    part(active(), "object_parent").location.x += 1.0
    bpy.ops.ed.undo_push(message="moved")
    moved = seen([None, part(active(), "splats")])
    count = len(blender_scene.duplicates_of(active()).get(1, ()))
    if change == "duplicate":
        bpy.ops.objectgs.duplicate_object()
    elif change == "remove":
        bpy.ops.objectgs.remove_object()
    else:
        bpy.ops.objectgs.reset_object(what="TRANSFORM")
    bpy.ops.ed.undo_push(message="operator")
    assert steps == ["Transforms and Duplicates"]
    bpy.ops.ed.undo()
    assert len(blender_scene.duplicates_of(active())[1]) == len(entry(active()).copies) == count + 1
    assert stay([None, part(active(), "splats")], moved) and entry(active()).transform is not None


def test_remove_deletes_selected_duplicates_of_blender_alone(root):
    before = links()
    selection.select_object(bpy.context, root, 1)
    bpy.ops.object.duplicate()
    bpy.ops.objectgs.remove_object()
    assert links() == before and not entry(root).removed and entry(root).copies == ()


def test_hidden_splats_of_a_deleted_duplicate_are_not_shown(root, tmp_path):
    """Blender's Delete leaves what is hidden."""
    blender_scene.show_kinds(root, "meshes")
    activate(root, 1)
    bpy.ops.objectgs.duplicate_object()
    (copy,) = blender_scene.duplicates_of(root)[1]
    bpy.ops.object.select_all(action="DESELECT")
    for obj in copy.objects:
        if not obj.hide_viewport:
            obj.select_set(True)
    bpy.ops.object.delete()
    left = [obj for obj in copy.objects if kinds.kind_of(obj) == kinds.SPLATS]
    for which in ("splats", "both", "meshes"):
        blender_scene.show_kinds(root, which)
        assert [obj.hide_viewport and obj.hide_render for obj in left] == [True]
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "some.blend"))
    assert not blender_scene.duplicates_of(active()) and entry(active()).copies == ()


def test_undo_steps_look_only_at_what_is_of_the_extension(root):
    """Scenes may have tens of thousands of other objects."""
    before = undo._links()
    props = bpy.data.collections.new("Props")
    bpy.context.scene.collection.children.link(props)
    props.objects.link(bpy.data.objects.new("prop", None))
    assert undo._links() == before
    props.objects.link(part(root, "splats"))
    assert undo._links() != before


def test_duplicates_keep_their_parts_in_edit_mode(root):
    """Parts of the original may be in other collections then, until they can be recovered with an undo step."""
    blender_scene.show_kinds(root, "both")
    activate(root, 1)
    bpy.ops.objectgs.duplicate_object()
    (copy,) = blender_scene.duplicates_of(root)[1]
    there, splats, props = len(copy.objects), part(root, "splats"), bpy.data.collections.new("Props")
    bpy.context.scene.collection.children.link(props)
    props.objects.link(splats)
    collection_of(root).objects.unlink(splats)
    holder = bpy.data.objects.new("holder", bpy.data.meshes.new("holder"))
    bpy.context.scene.collection.objects.link(holder)
    selection.select_nothing(bpy.context)
    bpy.context.view_layer.objects.active = holder
    bpy.ops.object.mode_set(mode="EDIT")
    activate(root, 2)
    bpy.ops.objectgs.remove_object()
    assert len(copy.objects) == there and kinds.part_of(copy, "splats") is not None
    bpy.ops.object.mode_set(mode="OBJECT")
    bpy.ops.objectgs.restore_object(object="2")
    assert len(copy.objects) == there and part(root, "splats") == splats


def test_edits_survive_merge_and_split(root):
    part(root, "object_parent").location.x += 1.0
    item(root).hue = 0.1
    object_edits.merge(root, [1], 2)
    assert 1 not in blender_scene.object_collections(root)
    assert object_edits.split(root, 2) == 1
    moved = blender_scene.placement_of(root, collection_of(root))[:3, 3]
    assert moved == pytest.approx(in_capture(root, (1.0, 0.0, 0.0)), abs=1e-4)
    assert blender_scene.recolor_of(collection_of(root)).hue == 0.1


def test_rows_of_merged_objects_stay_active_when_clicked(root):
    """The click on a row selects the object that it is merged into, which Blender then announces as a click on that."""
    object_edits.merge(root, [1, HUGE], 2)
    activate(root, 1)
    assert selection.selected_ids(bpy.context, root) == [2]
    click_selection._active_changed()
    assert object_list.active_item(root) == item(root, 1)
    assert bpy.ops.objectgs.split_objects() == {"FINISHED"}
    assert entry(root).merged_into is None and entry(root, HUGE).merged_into == 2
    selection.select_object(bpy.context, root, 2)
    click_selection._active_changed()
    assert object_list.active_item(root) == item(root, 2)


def test_failed_write_reverts_color(root, folder):
    item(root).hue = 0.1
    (folder / "objects.json").write_text("{")
    item(root).hue = 0.3
    assert item(root).hue == pytest.approx(0.1)
    assert blender_scene.recolor_of(collection_of(root)).hue == pytest.approx(0.1)


# Files.


def test_headless_build_shows_edits(fresh, folder):
    place = np.eye(4)
    place[0, 3] = 2.0
    edit_objects(
        folder / "objects.json",
        {
            1: {"removed": True, "floaters": True},
            2: {"recolor": RECOLOR.stored(), "copies": [place.tolist()]},
            HUGE: {"transform": place.tolist()},
        },
    )
    ran = subprocess.run(
        [sys.executable, "headless.py", "build", folder], cwd=headless.ROOT, capture_output=True, text=True
    )
    assert ran.returncode == 0, ran.stderr
    bpy.ops.wm.open_mainfile(filepath=str(folder / "objectgs.blend"))
    root = next(c for c in bpy.data.collections if blender_scene.kind_of(c) == "reconstruction")
    assert blender_scene.is_removed(collection_of(root)) and collection_of(root).hide_render
    assert blender_scene.hidden_splats(part(root, "splats", 0).data) is not None
    assert blender_scene.recolor_of(collection_of(root, 2)) == RECOLOR
    assert len(blender_scene.duplicates_of(root)[2]) == 1
    assert blender_scene.placement_of(root, collection_of(root, HUGE)) == pytest.approx(place, abs=1e-4)


@pytest.mark.parametrize("way", ["opened", "appended", "opened before"])
def test_files_built_without_a_window_get_the_list_of_objects(root, folder, tmp_path, told, way):
    if way == "appended" and bpy.app.version < (4, 3, 0):
        pytest.skip("has no handler for appended data")
    path, extension = tmp_path / "built.blend", headless.extension()
    root.objectgs.objects.clear()
    bpy.context.scene.objectgs.active = None
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    if way == "appended":
        bpy.ops.wm.read_factory_settings(use_empty=True)
        bpy.ops.wm.append(directory=f"{path}/Collection/", filename="table top")
    else:
        if way == "opened before":
            extension.unregister()
        bpy.ops.wm.open_mainfile(filepath=str(path))
        if way == "opened before":
            extension.register()
            assert active() is None
            handlers._enabled()  # as its timer, which Blender without a window lacks
    assert [row.name for row in active().objectgs.objects] == [
        each.name for each in read_objects(folder / "objects.json")
    ]
    assert not told


@pytest.mark.long
def test_splats_are_exported_where_blender_shows_them(root, folder, backend_python, tmp_path):
    bpy.ops.objectgs.set_ground(points=(0, 0, 1, 1, 0.2, 1, 0, 1, 1.5))
    bpy.ops.objectgs.set_distance(points=(0, 0, 0, 1, 0, 0), distance=2.5)
    part(root, "object_parent", 2).location.x += 1.0
    options = {"filepath": str(tmp_path / "all"), "coordinates": "blender"}
    assert bpy.ops.objectgs.export_splats(**options) == {"FINISHED"}
    table = read_vertices(tmp_path / "all.ply")
    exported = np.stack([table[axis] for axis in "xyz"], 1)
    for object_id in (1, 2):
        splats = part(root, "splats", object_id)
        matrix = placement.matrix_to_world(splats)
        shown = carrier.read(splats.data, "position") @ matrix[:3, :3].T + matrix[:3, 3]
        np.testing.assert_allclose(exported[table["object_id"] == object_id], shown, atol=1e-4)


def test_splats_that_blender_shows_as_a_point_are_not_exported(root, monkeypatch, tmp_path):
    monkeypatch.setenv("OBJECTGS_PYTHON", sys.executable)
    kinds.parent_of(root).scale = (0.0, 0.0, 0.0)
    bpy.context.view_layer.update()
    with pytest.raises(RuntimeError, match="is scaled to zero by its parent; set a scale other than zero"):
        bpy.ops.objectgs.export_splats(filepath=str(tmp_path / "all"), coordinates="blender")


@pytest.mark.parametrize("folder_alone", ["/home/x/", "/"])
def test_export_dialog_leaves_a_folder_without_a_file_name_alone(root, folder_alone):
    class Dialog(ExportDialog):
        filepath, format, per_object = folder_alone, "obj", False
        properties = SimpleNamespace(bl_rna=bpy.ops.objectgs.export_meshes.get_rna_type())

    dialog = Dialog()
    assert dialog.check(None) is False and dialog.filepath == folder_alone
    with pytest.raises(RuntimeError, match="Choose a file to write"):
        bpy.ops.objectgs.export_meshes(filepath=folder_alone, format="obj")


@pytest.mark.long
def test_exported_splats_have_edits_and_can_be_imported(root, folder, backend_python, tmp_path):
    activate(root, 1)
    bpy.ops.objectgs.remove_object()
    part(root, "object_parent", 2).location.x += 1.0
    assert bpy.ops.objectgs.export_splats(filepath=str(tmp_path / "all"), coordinates="capture") == {"FINISHED"}
    table = read_vertices(tmp_path / "all.ply")
    assert set(table["object_id"].tolist()) == {0, 2, HUGE}
    for kind in ("glb", "usdc"):
        bpy.ops.objectgs.export_splats(filepath=str(tmp_path / "all"), format=kind)
        assert (tmp_path / f"all.{kind}").stat().st_size > 10_000
    moved = np.array(entry(root, 2).transform)[:3, 3]
    assert moved == pytest.approx(in_capture(root, (1.0, 0.0, 0.0)), abs=1e-4)
    assert bpy.ops.objectgs.import_splats(filepath=str(tmp_path / "all.ply"), folder=str(tmp_path / "again")) == {
        "FINISHED"
    }
    other = active()
    assert other != root and set(blender_scene.object_collections(other)) == {0, 2, HUGE}


@pytest.mark.parametrize(
    ("file", "name"),
    [
        ("garden/point_cloud/iteration_30000/point_cloud.ply", "garden"),
        ("garden/exports/splat/splat.ply", "garden"),
        ("garden/export_30000.ply", "garden"),
        ("scans/garden.ply", "garden"),
        ("scans/iteration_best.spz", "iteration_best"),
    ],
)
def test_imported_splats_are_named_after_their_scene(file, name):
    assert import_splats._folder_for(Path("/home") / file).name == name


@pytest.mark.parametrize("kind", ["spz", "splat"])
@pytest.mark.long
def test_splats_of_other_formats_can_be_imported(root, folder, backend_python, tmp_path, kind):
    assert bpy.ops.objectgs.export_splats(filepath=str(tmp_path / "all"), format=kind, coordinates="capture") == {
        "FINISHED"
    }
    path = tmp_path / f"all.{kind}"
    assert bpy.ops.objectgs.import_splats(filepath=str(path), folder=str(tmp_path / "again")) == {"FINISHED"}
    other = active()
    assert other != root and set(blender_scene.object_collections(other)) == {0}
    found, wanted = (read_vertices(made / "splats.ply") for made in (tmp_path / "again", folder))
    for axis in "xyz":
        np.testing.assert_allclose(np.sort(found[axis]), np.sort(wanted[axis]), atol=1e-4)


@pytest.mark.parametrize("suffix", ["glb", "usdc", "obj"])
def test_exported_meshes_have_edits(root, tmp_path, suffix):
    blender_scene.show_kinds(root, "splats")
    item(root).hue = 0.3
    activate(root, 1)
    bpy.ops.objectgs.duplicate_object()
    before = {name: len(getattr(bpy.data, name)) for name in ("objects", "meshes", "materials", "images", "scenes")}
    window = bpy.context.window_manager.windows[0]
    layer, own = bpy.context.scene.view_layers[0], bpy.context.scene.view_layers.new("mine")
    window.view_layer = own
    assert bpy.ops.objectgs.export_meshes(filepath=str(tmp_path / "all"), format=suffix, coordinates="capture") == {
        "FINISHED"
    }
    assert window.view_layer == own
    window.view_layer = layer
    assert (tmp_path / f"all.{suffix}").stat().st_size > 100
    assert {name: len(getattr(bpy.data, name)) for name in before} == before
    if suffix == "obj":
        lines = (tmp_path / "all.obj").read_text().splitlines()
        places = np.array([line.split()[1:4] for line in lines if line.startswith("v ")], float)
        expected = read_mesh(blender_scene.folder_of(root) / "meshes" / "1.ply").vertices
        assert len(places) == 12 and places[:4] == pytest.approx(expected, abs=1e-3)
        assert all(path.name.startswith("all_") for path in tmp_path.glob("*.png"))
        assert "map_Kd" in (tmp_path / "all.mtl").read_text()
        texture = next(tmp_path.glob("*recolored*.png"))
        image = bpy.data.images.load(str(texture))
        wanted = expected_texel = np.array([200, 100, 50]) / 255
        matrix, offset = object_list.recolor_of(item(root)).affine()
        wanted = np.clip(matrix @ expected_texel + offset, 0, 1)
        assert image.pixels[:3] == pytest.approx(wanted, abs=0.6 / 255)
    assert bpy.ops.objectgs.export_meshes(filepath=str(tmp_path / "each"), format=suffix, per_object=True) == {
        "FINISHED"
    }
    assert {path.name for path in (tmp_path / "each").glob(f"*.{suffix}")} == {f"mug.{suffix}", f"can.{suffix}"}


@pytest.mark.parametrize("is_turned", [False, True])
def test_exported_meshes_have_the_names_of_the_scene(root, tmp_path, is_turned):
    activate(root, 1)
    bpy.ops.objectgs.duplicate_object()
    if is_turned:
        part(root, "object_parent").rotation_euler.z = 0.6
        kinds.parent_of(root).scale.y = 2.0  # Shear needs a copy of the mesh.
        bpy.context.view_layer.update()
    blocks = [*bpy.data.objects, *bpy.data.meshes, *bpy.data.materials]
    before = [block.name for block in blocks]
    assert bpy.ops.objectgs.export_meshes(filepath=str(tmp_path / "all"), format="glb") == {"FINISHED"}
    assert [block.name for block in blocks] == before
    content = (tmp_path / "all.glb").read_bytes()
    header = json.loads(content[20 : 20 + int.from_bytes(content[12:16], "little")])
    found = {key: sorted(each["name"] for each in header[key]) for key in ("nodes", "meshes", "materials")}
    assert found["nodes"] == ["can mesh", "mug mesh", "mug mesh.001"]
    assert found["meshes"][:2] == found["materials"] == ["can mesh", "mug mesh"]


@pytest.mark.parametrize("names", [("box 1", "box.1"), ("Mug", "mug")])
def test_exported_textures_of_similar_names_are_kept_apart(root, tmp_path, names):
    for object_id, name in zip((1, 2), names, strict=True):
        image = part(root, "mesh", object_id).data.materials[0].node_tree.nodes["Image Texture"].image
        image.name = name
        image.pixels[:] = [float(object_id == 1), 0.0, 0.0, 1.0] * (len(image.pixels) // 4)
    assert bpy.ops.objectgs.export_meshes(filepath=str(tmp_path / "all"), format="obj") == {"FINISHED"}
    textures = [path for path in tmp_path.iterdir() if path.suffix == ".png"]
    assert len({path.name.casefold() for path in textures}) == 2
    reds = {round(bpy.data.images.load(str(path)).pixels[0]) for path in textures}
    assert reds == {0, 1}, "each object has its own texture"


def test_rotation_by_right_angle(root):
    """A rotation about the center has a known result."""
    pivot = part(root, "object_parent")
    pivot.rotation_euler.z = math.pi / 2
    place = blender_scene.placement_of(root, collection_of(root))
    turn = np.array(kinds.parent_of(root).matrix_world)[:3, :3]
    wanted = turn.T @ np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]) @ turn
    assert place[:3, :3] == pytest.approx(wanted, abs=1e-6)
    middle = np.array(pivot["objectgs_center"]) + ORIGIN
    assert place[:3, :3] @ middle + place[:3, 3] == pytest.approx(middle, abs=1e-4)


# Filled holes of removed objects.


FILL_HOLES = """
import json, sys
from backend.commands.objects.fill import fill_holes
from backend.editing import apply_edits
from backend.export import read_splats
from backend.shared.reconstruction.objects import edit_objects, read_objects
from backend.shared.events import Reporter
from backend.shared.reconstruction.folder import Reconstruction
from backend.shared.stopping import StoppingReporter, StopRequest
folder = Reconstruction(sys.argv[1])
splats = read_splats(folder.splats)[0]
shown = []
for ids in ([1], [1, int(sys.argv[2])]):
    edit_objects(folder.objects, {i: {"removed": True, "fill": True} for i in ids})
    fill_holes(folder, StoppingReporter(Reporter(), StopRequest()))
    kept = apply_edits(splats, read_objects(folder.objects))
    shown.append(kept.means[kept.object_ids == 2].astype(float).tolist())
    edit_objects(folder.objects, {i: {"removed": None, "fill": None} for i in ids})
edit_objects(folder.objects, {1: {"fill": True}})
fill_holes(folder, StoppingReporter(Reporter(), StopRequest()))
edit_objects(folder.objects, {1: {"fill": None}})
print(json.dumps(shown))
"""


@pytest.fixture(scope="module")
def filled_ground(made, tmp_path_factory, backend_python) -> tuple[Path, list[np.ndarray]]:
    """A folder with a flat ground (object 2) around a box (object 1), and another box, with cached fills for removal of
    the first box and of both, and for a move of the first; and the positions of the ground's splats after removals."""
    folder = Path(shutil.copytree(made, tmp_path_factory.mktemp("filled") / "table top"))
    rng = np.random.default_rng(0)
    flat = np.column_stack([rng.uniform(-1, 1, (4000, 2)), np.zeros(4000)])
    flat = flat[np.abs(flat).max(1) > 0.15]
    box = rng.uniform((-0.15, -0.15, 0), (0.15, 0.15, 0.3), (400, 3))
    splats = splat_table(np.repeat([2, 1, HUGE], [len(flat), len(box), len(box)]), degree=1)
    for axis, name in enumerate("xyz"):
        splats[name] = np.concatenate([flat, box, box + np.array([0.7, 0.7, 0.0])])[:, axis] + ORIGIN[axis]
    splats["opacity"], splats["rot_0"] = 3.0, 1.0
    for name, value in (("rot_1", 0), ("rot_2", 0), ("rot_3", 0), ("scale_0", -3), ("scale_1", -3), ("scale_2", -7)):
        splats[name] = value
    write_vertices(folder / "splats.ply", splats)
    ran = subprocess.run(
        [backend_python, "-c", FILL_HOLES, folder, str(HUGE)],
        cwd=headless.ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    return folder, [np.array(means) for means in json.loads(ran.stdout)]


@pytest.fixture
def ground(filled_ground, folder) -> Path:
    """A copy of the `filled_ground` folder."""
    return Path(shutil.copytree(filled_ground[0], folder, dirs_exist_ok=True))


def surface(root) -> dict:
    """Return all attributes of the ground's splat object."""
    mesh = part(root, "splats", 2).data
    return {name: (kind, values.tobytes()) for name, (kind, values) in fills._attributes(mesh).items()} | {
        "position": carrier.read(mesh, "position").tobytes()
    }


def test_hole_is_filled_and_reopened(ground, filled_ground, root):
    """Drawing and picking show exactly what the backend exports, also after the splats are reloaded."""
    blender_scene.show_kinds(root, "splats")
    captured, count = surface(root), item(root, 2).splats
    luma = blender_scene.luma_of(collection_of(root, 2))
    activate(root, 1)
    assert bpy.ops.objectgs.remove_object(fill=True) == {"FINISHED"}
    one = surface(root)
    mesh = part(root, "splats", 2).data
    assert blender_scene.unobserved_splats(mesh).sum() == collection_of(root)[blender_scene.UNOBSERVED_COUNT] > 20
    assert item(root, 2).splats == count and blender_scene.luma_of(collection_of(root, 2)) == luma
    activate(root, HUGE)
    bpy.ops.objectgs.remove_object(fill=True)
    assert set(fills.filled_objects(mesh).tolist()) == {0, 1, HUGE}
    there = blender_scene.matrix_to_capture(root, part(root, "splats", 2))
    drawn = [arrays_of(mesh).means @ there[:3, :3].T + there[:3, 3]]
    bpy.ops.objectgs.restore_object(object=str(HUGE))
    drawn.insert(0, arrays_of(mesh).means @ there[:3, :3].T + there[:3, 3])
    for found, wanted in zip(drawn, filled_ground[1]):
        assert np.allclose(found, wanted, atol=1e-4) and len(found) < len(mesh.vertices), "some splats are replaced"
    assert surface(root) == one, "the earlier fill is reused"
    show_again(root)
    assert surface(root) == one
    assert not bpy.ops.objectgs.fill_hole.poll(), "the active object is not removed"
    activate(root, 1)
    bpy.ops.objectgs.fill_hole(filled=False)
    assert surface(root) == captured and blender_scene.is_removed(collection_of(root))
    bpy.ops.objectgs.fill_hole()
    assert surface(root) == one
    bpy.ops.objectgs.restore_object(object="1")
    assert surface(root) == captured and blender_scene.UNOBSERVED_COUNT not in collection_of(root)


def test_export_of_meshes_tells_of_fills(ground, root, tmp_path, told):
    """Meshes do not have them."""
    activate(root, 1)
    bpy.ops.objectgs.remove_object(fill=True)
    out = str(tmp_path / "all")
    bpy.ops.objectgs.export_meshes(filepath=out, format="obj")
    bpy.ops.objectgs.restore_object(object="1")
    bpy.ops.objectgs.export_meshes(filepath=out, format="obj")
    first, second = (text for text, _ in told if text.startswith(f"Wrote {out}"))
    assert first.endswith("are not in meshes, which continue flat surfaces on their own.")
    assert "holes" not in second


def test_hole_of_moved_object_is_filled(ground, root):
    """The fill is that of the removed object, and is taken back as the object returns."""
    blender_scene.show_kinds(root, "splats")
    captured = surface(root)
    activate(root, 1)
    assert not bpy.ops.objectgs.fill_hole.poll() and "fill_hole" not in texts_of(EditPanel)
    part(root, "object_parent").location.x += 0.5
    assert "objectgs.fill_hole" in texts_of(EditPanel)
    bpy.ops.objectgs.fill_hole()
    filled = surface(root)
    assert filled != captured and entry(root).fill and not blender_scene.is_removed(collection_of(root))
    assert entry(root).transform is not None, "another program sees why there is a hole"
    assert "splats fill the hole" in texts_of(EditPanel)
    bpy.ops.objectgs.remove_object()
    assert surface(root) == filled, "the hole stays filled"
    bpy.ops.objectgs.restore_object(object="1")
    assert surface(root) == filled and entry(root).fill and not entry(root).removed
    bpy.ops.objectgs.fill_hole(filled=False)
    assert surface(root) == captured
    bpy.ops.objectgs.fill_hole()
    assert surface(root) == filled
    bpy.ops.objectgs.reset_object(what="TRANSFORM")
    assert surface(root) == captured and not entry(root).fill


def test_fills_arrive_where_splats_were_captured(ground, root):
    """Also before the splats get back what was applied to them."""
    blender_scene.show_kinds(root, "splats")
    edit_objects(ground / "objects.json", {1: {"removed": True, "fill": True}})
    results.show_fill(root)
    obj, filled = part(root, "splats", 2), surface(root)
    before = seen([None, obj])
    edit_objects(ground / "objects.json", {1: {"removed": None, "fill": None}})
    results.show_fill(root)
    choose(obj)
    bpy.ops.object.origin_set(type="ORIGIN_CURSOR")
    assert obj.location.length > 1.0
    edit_objects(ground / "objects.json", {1: {"removed": True, "fill": True}})
    results.show_fill(root)
    assert stay([None, obj], before) and obj.location.length < 1e-5
    positions = [np.frombuffer(each["position"], np.float32) for each in (filled, surface(root))]
    assert positions[1] == pytest.approx(positions[0], abs=1e-5)


def test_fills_shown_after_undo_leave_applied_transforms(ground, root):
    """No undo step would keep the vertices and the transform together; the next edit shows the fill."""
    blender_scene.show_kinds(root, "splats")
    obj = part(root, "splats", 2)
    choose(obj)
    bpy.ops.object.origin_set(type="ORIGIN_CURSOR")
    before, place = surface(root), obj.location.copy()
    edit_objects(ground / "objects.json", {1: {"removed": True, "fill": True}})
    results.show_fill(root, has_step=False)
    assert surface(root) == before and obj.location == place
    object_edits.fill(root)
    item(root, 2).name = "floor"
    assert surface(root) != before and obj.location.length < 1e-5


def test_waiting_fill_says_for_what(ground, root, monkeypatch):
    """A training that runs keeps the hole open until it ends or is stopped."""
    jobs = [Job(title, kind, ground, [], ground) for title, kind in (("Train table", "train"), ("Fill", "fill"))]
    jobs[0].state = State.PAUSED
    activate(root, 1)
    object_edits.remove(root, [1], False, True)
    del collection_of(root)[blender_scene.UNOBSERVED_COUNT]
    with monkeypatch.context() as changed:
        changed.setattr(background.queue, "jobs", jobs)
        assert "The hole is filled when Train table has ended; stop it to fill it now." in texts_of(EditPanel)


def test_edits_act_on_what_the_panel_names(root):
    """A hidden object cannot be selected, so that its row leaves nothing selected that edits would act on."""
    activate(root, 2)
    assert selection.selected_ids(bpy.context, root) == [2]
    for obj in collection_of(root, 1).objects:
        obj.hide_set(True)
    activate(root, 1)
    assert selection.selected_ids(bpy.context, root) == []
    bpy.ops.objectgs.remove_object()
    assert entry(root, 1).removed and not entry(root, 2).removed
    selection.select_object(bpy.context, root, 2)
    selection.select_object(bpy.context, root, HUGE, extend=True)
    activate(root, HUGE)
    assert texts_of(EditPanel).startswith(item(root, HUGE).name)
    selection.select_object(bpy.context, root, 2, extend=True)
    assert texts_of(EditPanel).startswith("2 selected objects")


@pytest.mark.long
def test_outdated_fill_is_hidden_until_recomputed(ground, root, monkeypatch):
    """An object's fill disappears with its edit at once; other fills stay until newer ones exist."""
    captured = surface(root)
    object_edits.remove(root, [1, HUGE], False, True)
    python = os.environ["OBJECTGS_PYTHON"]
    monkeypatch.setenv("OBJECTGS_PYTHON", str(ground / "no-python"))
    object_edits.restore(root, [1])
    assert set(fills.filled_objects(part(root, "splats", 2).data).tolist()) == {0, HUGE}
    assert blender_scene.missing_fill(root, blender_scene.Objects.read(ground)) is not None
    stale = surface(root)
    monkeypatch.setenv("OBJECTGS_PYTHON", python)
    show_again(root)
    assert blender_scene.missing_fill(root, blender_scene.Objects.read(ground)) is None, (
        "fill was requested and completed"
    )
    assert surface(root).keys() == stale.keys()
    object_edits.restore(root, [HUGE])
    assert surface(root) == captured


def test_fills_of_earlier_version_are_updated_and_restored(ground, root):
    captured = surface(root)
    object_edits.remove(root, [1], False, True)
    mesh, filled = part(root, "splats", 2).data, surface(root)
    mesh.attributes["unobserved"].name, mesh.attributes["fills"].name = "invented", "closes"
    mesh["objectgs_fill"] = "fill-of-an-earlier-version.ply"
    collection_of(root)["objectgs_invented"] = collection_of(root).pop(blender_scene.UNOBSERVED_COUNT)
    older_files.rename_all()
    assert set(fills.filled_objects(mesh).tolist()) == {0, 1} and fills.unobserved_splats(mesh).any()
    show_again(root)
    assert surface(root) == filled
    object_edits.restore(root, [1])
    assert surface(root) == captured


def test_fill_stays_beside_meshes(ground, root):
    """A mesh that replaces the splats of an object leaves those that fill a hole in it."""
    blender_scene.show_kinds(root, "splats")
    captured, obj = surface(root), part(root, "splats", 2)
    object_edits.remove(root, [1], False, True)
    filled = surface(root)
    blender_scene.show_kinds(root, "meshes")
    new = blender_scene.unobserved_splats(obj.data)
    assert not obj.hide_viewport and not obj.hide_render
    assert np.array_equal(blender_scene.hidden_splats(obj.data), ~new)
    assert np.array_equal(arrays_of(obj.data).vertices, np.flatnonzero(new))
    show_faint(obj)
    assert len(evaluated_colors(obj)) == new.sum()
    show_again(root)
    assert np.array_equal(blender_scene.hidden_splats(obj.data), ~new)
    object_edits.restore(root, [1])
    assert obj.hide_viewport and obj.hide_render and blender_scene.hidden_splats(obj.data) is None
    object_edits.remove(root, [1], False, True)
    assert not obj.hide_viewport and np.array_equal(blender_scene.hidden_splats(obj.data), ~new)
    blender_scene.show_kinds(root, "splats")
    assert surface(root) == filled
    object_edits.restore(root, [1])
    assert surface(root) == captured


def test_fill_stays_until_recomputed_after_other_edits(ground, root, monkeypatch):
    """Cleaning objects, and splats that are shown anew, leave a fill in place until the newer one exists."""
    blender_scene.show_kinds(root, "splats")
    object_edits.remove(root, [1], False, True)
    mesh, filled = part(root, "splats", 2).data, surface(root)
    monkeypatch.setenv("OBJECTGS_PYTHON", str(ground / "no-python"))
    object_edits.clean_floaters(root, [2, HUGE], True)
    assert blender_scene.missing_fill(root, blender_scene.Objects.read(ground)) is not None
    assert (fills.filled_objects(mesh) == 1).any() and surface(root)["position"] == filled["position"]
    blender_scene.show_result(root, ground)
    assert (fills.filled_objects(mesh) == 1).any() and surface(root)["position"] == filled["position"]
