# SPDX-License-Identifier: GPL-3.0-or-later
"""Renders of splats and meshes: settings of the scene, and shading of meshes as captured."""

import bpy
import numpy as np
import pytest
from objectgs.backend.shared.formats.mesh_ply import Mesh
from objectgs.backend.shared.formats.ply import write_vertices
from objectgs.backend.shared.splats.spherical_harmonics import C0
from objectgs.objectgs_addon import scene as blender_scene
from objectgs.objectgs_addon.scene import kinds
from objectgs.objectgs_addon.scene.meshes import export
from objectgs.objectgs_addon.scene.shading import materials, render_settings
from objectgs.objectgs_addon.state import viewports

import headless

from .building import look_at, splat_table, write_cameras, write_meshes, write_objects, write_points

COLOR = (200, 100, 50)
SIZE = (32, 24)


@pytest.fixture
def folder(tmp_path):
    """A square at Z = 0 with sides of 2 and one color, as splats and as mesh, seen from above by two cameras."""
    place = tmp_path / "square"
    place.mkdir()
    intrinsics = np.array([[40.0, 0.0, 16.0], [0.0, 40.0, 12.0], [0.0, 0.0, 1.0]])
    write_cameras(place, [look_at((0.01, 0, 3)), look_at((1.0, 0, 3))], intrinsics, SIZE)
    write_points(place, np.zeros((1, 3)), [1])
    write_objects(place, {1: "square"})
    x, y = (grid.reshape(-1) for grid in np.meshgrid(np.linspace(-0.95, 0.95, 20), np.linspace(-0.95, 0.95, 20)))
    table = splat_table(np.ones(len(x), int), degree=0)
    table["x"], table["y"], table["z"], table["opacity"] = x, y, 0.0, 5.0
    for axis, scale in enumerate((0.1, 0.1, 0.001)):
        table[f"scale_{axis}"] = np.log(scale)
    for axis in range(4):
        table[f"rot_{axis}"] = float(axis == 0)
    for axis, channel in enumerate(COLOR):
        table[f"f_dc_{axis}"] = (channel / 255 - 0.5) / C0
    write_vertices(place / "splats.ply", table)
    corners = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], float)
    square = Mesh(
        vertices=corners,
        normals=np.tile(np.float32([0, 0, 1]), (4, 1)),
        colors=np.full((4, 3), 9, np.uint8),
        faces=np.array([(0, 1, 2), (0, 2, 3)], np.int32),
        uvs=np.full((2, 3, 2), 0.5, np.float32),
        unobserved=np.zeros(2, bool),
        texture="",
    )
    write_meshes(place, {"1": square}, rgb=COLOR)
    return place


@pytest.fixture
def shown(fresh, folder):
    root = blender_scene.show_capture(bpy.context.scene, folder)
    blender_scene.show_result(root, folder)
    return root


def rendered(path) -> np.ndarray:
    """Render with Cycles; return sRGB colors (H, W, 3)."""
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.device, scene.cycles.samples, scene.cycles.use_denoising = "CPU", 64, False
    scene.render.image_settings.file_format, scene.render.filepath = "PNG", str(path)
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(str(path))
    assert tuple(image.size) == SIZE
    pixels = np.array(image.pixels[:]).reshape(SIZE[1], SIZE[0], 4)[..., :3]
    bpy.data.images.remove(image)
    return pixels


def middle(pixels) -> np.ndarray:
    return pixels[8:16, 12:20].reshape(-1, 3).mean(0)


def material_of(root):
    return blender_scene.object_meshes(root)[1][0].data.materials[0]


def surface_of(root) -> str:
    output = next(node for node in material_of(root).node_tree.nodes if node.type == "OUTPUT_MATERIAL")
    return output.inputs["Surface"].links[0].from_node.type


def test_splats_and_meshes_render_alike_as_captured(shown, tmp_path):
    """In an unlit scene; lit meshes are black there."""
    scene = bpy.context.scene
    blender_scene.set_up_render(scene, shown)
    images = {}
    for kind in ("splats", "meshes"):
        blender_scene.show_kinds(shown, kind)
        images[kind] = rendered(tmp_path / f"{kind}.png")
        assert middle(images[kind]) == pytest.approx(np.array(COLOR) / 255, abs=0.02)
    assert middle(np.abs(images["splats"] - images["meshes"])).max() < 0.02
    blender_scene.shade_meshes(shown, "lit")
    assert middle(rendered(tmp_path / "lit.png")).max() < 0.01


def test_light_does_not_change_meshes_as_captured(shown, tmp_path):
    scene = bpy.context.scene
    blender_scene.set_up_render(scene, shown)
    sun = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
    sun.data.energy = 5.0
    scene.collection.objects.link(sun)
    assert middle(rendered(tmp_path / "captured.png")) == pytest.approx(np.array(COLOR) / 255, abs=0.01)
    blender_scene.shade_meshes(shown, "lit")
    assert middle(rendered(tmp_path / "lit.png"))[0] > 0.9


def test_shading_switches_materials_in_place(shown, folder):
    before = material_of(shown)
    assert blender_scene.shading_of(shown) == "captured" and surface_of(shown) == "TEX_IMAGE"
    blender_scene.shade_meshes(shown, "lit")
    assert material_of(shown) == before and surface_of(shown) == "BSDF_PRINCIPLED"
    blender_scene.show_result(shown, folder)
    assert surface_of(shown) == "BSDF_PRINCIPLED" and blender_scene.shading_of(shown) == "lit"
    blender_scene.shade_meshes(shown, "captured")
    assert surface_of(shown) == "TEX_IMAGE"
    with pytest.raises(ValueError, match="cannot be shaded"):
        blender_scene.shade_meshes(shown, "dark")


def test_materials_of_the_user_keep_their_shading(shown):
    """Another material, or another surface in the add-on's own."""
    mesh = blender_scene.object_meshes(shown)[1][0]
    tree = material_of(shown).node_tree
    glass = tree.nodes.new("ShaderNodeBsdfGlass")
    output = next(node for node in tree.nodes if node.type == "OUTPUT_MATERIAL")
    tree.links.new(glass.outputs[0], output.inputs["Surface"])
    own = bpy.data.materials.new("own")
    mesh.data.materials.append(own)
    for shading in ("lit", "captured"):
        blender_scene.shade_meshes(shown, shading)
        assert surface_of(shown) == "BSDF_GLASS" and mesh.data.materials[1] == own


def test_meshes_of_older_files_stay_lit(shown, folder):
    """Older files have lit materials and no choice."""
    blender_scene.shade_meshes(shown, "lit")
    del shown["objectgs_shading"]
    assert blender_scene.shading_of(shown) == "lit"
    blender_scene.show_result(shown, folder)
    assert surface_of(shown) == "BSDF_PRINCIPLED"


@pytest.mark.parametrize("shading", materials.SHADINGS)
def test_exports_contain_the_texture(shown, tmp_path, shading):
    blender_scene.shade_meshes(shown, shading)
    surface = surface_of(shown)
    for suffix in ("obj", "glb"):
        out = tmp_path / f"square.{suffix}"
        export.export(shown, out, suffix, None, per_object=False, in_capture=False)
        assert surface_of(shown) == surface
    assert "map_Kd" in (tmp_path / "square.mtl").read_text()
    assert b"baseColorTexture" in (tmp_path / "square.glb").read_bytes()
    assert b"KHR_materials_unlit" not in (tmp_path / "square.glb").read_bytes()


# Settings of the scene.


def test_problems_of_render_settings_are_named(shown):
    scene = bpy.context.scene
    assert "view transform AgX" in blender_scene.render_problem(scene, shown)
    scene.camera.data.type = "ORTHO"
    (problem,) = blender_scene.scene_problems(scene, shown)
    assert "is orthographic" in problem
    scene.camera.data.type = "PERSP"
    assert not blender_scene.scene_problems(scene, shown)
    scene.view_settings.view_transform = "Standard"
    assert blender_scene.render_problem(scene, shown) is None
    scene.render.engine = "CYCLES"
    assert "at most 8 splats" in blender_scene.render_problem(scene, shown)
    camera, scene.camera = scene.camera, None
    assert "no camera" in blender_scene.render_problem(scene, shown)
    scene.camera = camera
    blender_scene.set_up_render(scene, shown)
    assert blender_scene.render_problem(scene, shown) is None
    scene.view_settings.view_transform = "Filmic"
    shown.hide_render = True
    assert blender_scene.render_problem(scene, shown) is None, "it is not rendered"


def test_problems_of_composites_of_film_frames_are_named(shown):
    scene = bpy.context.scene
    if hasattr(scene, "compositing_node_group"):
        tree = scene.compositing_node_group = bpy.data.node_groups.new("mine", "CompositorNodeTree")
    else:
        scene.use_nodes = True
        tree = scene.node_tree
    shown.hide_render = True
    assert blender_scene.render_problem(scene, shown) is None
    kinds.mark(tree.nodes.new("CompositorNodeImage"), kinds.FILM)
    assert "view transform AgX" in blender_scene.render_problem(scene, shown)
    camera, scene.camera = scene.camera, None
    assert "no camera" in blender_scene.render_problem(scene, shown)
    scene.camera, scene.view_settings.view_transform = camera, "Standard"
    scene.render.engine = "CYCLES"
    assert blender_scene.render_problem(scene, shown) is None, "film frames need no bounces"


def test_moved_instances_of_splats_are_named(shown):
    scene = bpy.context.scene
    instance = bpy.data.objects.new("second", None)
    instance.instance_type = "COLLECTION"
    instance.instance_collection = next(
        each for each in shown.children_recursive if kinds.part_of(each, kinds.SPLATS) is not None
    )
    scene.collection.objects.link(instance)
    bpy.context.view_layer.update()
    assert not blender_scene.scene_problems(scene, shown), "its splats are seen from the same side"
    instance.location.x = 1
    bpy.context.view_layer.update()
    (problem,) = blender_scene.scene_problems(scene, shown)
    assert problem.startswith("second is an instance")
    instance.hide_render = True
    assert not blender_scene.scene_problems(scene, shown)


def test_objects_are_looked_through_only_if_splats_are_instanced(fresh, folder):
    """The panel asks in each redraw, also of a scene with tens of thousands of instances of other things."""
    extension = headless.extension()
    extension.register()
    try:
        bpy.ops.objectgs.open_reconstruction(directory=str(folder))
        tree = bpy.data.collections.new("tree")
        instance = bpy.data.objects.new("instance", None)
        instance.instance_type, instance.instance_collection = "COLLECTION", tree
        bpy.context.scene.collection.objects.link(instance)
        assert render_settings._used_with_splats() == set()
        root = instance.instance_collection = bpy.context.scene.objectgs.active
        assert render_settings._used_with_splats() == {root}
    finally:
        extension.unregister()


@pytest.mark.skipif(bpy.app.version < (5, 0), reason="older versions render in one space")
def test_other_working_spaces_are_named(shown):
    bpy.ops.wm.set_working_color_space(working_space="ACEScg")
    (problem,) = blender_scene.scene_problems(bpy.context.scene, shown)
    assert "working space ACEScg" in problem
    bpy.ops.wm.set_working_color_space(working_space="Linear Rec.709")
    assert not blender_scene.scene_problems(bpy.context.scene, shown)


def test_set_up_render_uses_selected_camera_of_capture(fresh, folder):
    extension = headless.extension()
    extension.register()
    try:
        scene = bpy.context.scene
        own = bpy.data.objects.new("own", bpy.data.cameras.new("own"))
        scene.collection.objects.link(own)
        scene.camera = own
        bpy.ops.objectgs.open_reconstruction(directory=str(folder))
        assert scene.view_settings.view_transform == "AgX" and scene.render.resolution_x == 1920, "the user's scene"
        bpy.ops.objectgs.set_up_render()
        assert scene.camera == own and (scene.render.resolution_x, scene.render.resolution_y) == SIZE
        assert scene.view_settings.view_transform == "Standard" and scene.cycles.transparent_max_bounces >= 1024
        second = kinds.capture_of(scene.objectgs.active).objects["001.png"]
        bpy.context.view_layer.objects.active = second
        second.select_set(True)
        bpy.ops.objectgs.set_up_render()
        assert scene.camera == second
    finally:
        extension.unregister()


@pytest.mark.parametrize("change", ["nothing", "resolution", "view", "object", "saved", "bounces"])
def test_startup_scene_alone_is_set_up_by_itself(folder, tmp_path, change):
    bpy.ops.wm.read_factory_settings()
    scene = bpy.context.scene
    before = scene.camera
    if change == "resolution":
        scene.render.resolution_x = 1000
    elif change == "view":
        scene.view_settings.exposure = 1.0
    elif change == "object":
        scene.collection.objects.link(bpy.data.objects.new("own", None))
    elif change == "bounces":
        scene.cycles.transparent_max_bounces = 9
    elif change == "saved":
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "own.blend"))
    root = viewports.show_first(scene, folder)
    if change == "nothing":
        assert blender_scene.render_problem(scene, root) is None
        assert scene.camera.name == "000.png" and (scene.render.resolution_x, scene.render.resolution_y) == SIZE
        for obj in scene.objects:
            obj.hide_set(False)  # As Show Hidden Objects does.
        assert not any(scene.objects[name].visible_get() for name in ("Cube", "Light", "Camera"))
        assert all(scene.objects[name].hide_render for name in ("Cube", "Light"))
    else:
        assert all(scene.objects[name].visible_get() for name in ("Cube", "Light", "Camera"))
        assert scene.view_settings.view_transform == "AgX" and scene.camera == before
    bpy.ops.wm.read_factory_settings(use_empty=True)


def test_lines_to_parents_are_hidden_unless_the_user_has_some(fresh, folder):
    bpy.ops.wm.read_factory_settings()

    def lines():
        areas = [area for screen in bpy.data.screens for area in screen.areas if area.type == "VIEW_3D"]
        return {area.spaces.active.overlay.show_relationship_lines for area in areas}

    bpy.data.objects["Cube"].parent = bpy.data.objects["Light"]
    root = viewports.show_first(bpy.context.scene, folder)
    assert True in lines()
    bpy.data.objects["Cube"].parent = None
    bpy.data.collections.remove(root)
    for obj in [obj for obj in bpy.data.objects if kinds.kind_of(obj)]:
        bpy.data.objects.remove(obj)
    viewports.show_first(bpy.context.scene, folder)
    assert lines() == {False}


@pytest.mark.parametrize("size", [2000.0, 1e-3])
def test_viewports_see_the_whole_of_a_large_or_tiny_scene(registered, folder, size):
    bpy.ops.wm.read_factory_settings()
    write_cameras(folder, [look_at((size * np.cos(angle), size * np.sin(angle), size / 3)) for angle in range(6)])
    bpy.ops.objectgs.open_reconstruction(directory=str(folder))
    areas = [area for screen in bpy.data.screens for area in screen.areas if area.type == "VIEW_3D"]
    spaces = [area.spaces.active for area in areas]
    assert spaces and all(space.clip_start < 0.02 * size and space.clip_end > 5 * size for space in spaces)
    bpy.ops.objectgs.set_distance(points=(0, 0, 0, 1, 0, 0), distance=1e4)
    assert all(space.clip_end > 5e4 * size for space in spaces)
    bpy.ops.wm.read_factory_settings(use_empty=True)
