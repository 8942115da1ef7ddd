# SPDX-License-Identifier: GPL-3.0-or-later
"""Splats in a real viewport: agreement with the backend's image, Blender's depth, picking and undo."""

import json
import math
import textwrap
import time
from dataclasses import replace

import numpy as np
import pytest
import torch

from backend.editing.apply import recolored, transformed
from backend.export import write_splats
from backend.model.splats import Splats
from backend.raster import Camera, rasterize
from backend.shared.color.recolor import Recolor
from backend.shared.formats.points_ply import LabeledPoints, write_points

from .harness import PACKAGE

SIZE = (240, 180)
K = [[200.0, 0, 118.0], [0, 200.0, 92.0], [0, 0, 1]]
MOVED = np.array([[0.0, -1.2, 0, 0.3], [1.2, 0, 0, -0.2], [0, 0, 1.2, 0.4], [0, 0, 0, 1]])
"""Rotation, scale and translation of object 2 in Blender."""

PRELUDE = f"""
import importlib, sys
import numpy as np
from pathlib import Path
scene = importlib.import_module("{PACKAGE}.objectgs_addon.scene")
drawing = importlib.import_module("{PACKAGE}.objectgs_addon.drawing")
picking = importlib.import_module("{PACKAGE}.backend.shared.splats.picking")
owner = bpy.context.scene
root = owner.objectgs.active
selected = lambda: sorted({{thing.users_collection[0].name for thing in bpy.context.view_layer.objects
                           if thing.select_get()}})
"""


def script(body: str) -> str:
    return PRELUDE + textwrap.dedent(body)


def three_points() -> LabeledPoints:
    """Three points of no object at the origin."""
    none = np.zeros(3, int)
    return LabeledPoints(np.zeros((3, 3)), np.zeros((3, 3), np.uint8), none, np.zeros(3), none)


def splats() -> Splats:
    """Return two balls of degree-3 splats side by side, object 1 on the left, and object 3 as a wall behind them."""
    rng = np.random.default_rng(0)
    balls = rng.normal(size=(600, 3)) * 0.12 + np.where(np.arange(600)[:, None] < 300, (-0.5, 0, 0.2), (0.5, 0, 0.2))
    wall = np.stack([rng.uniform(-2, 2, 400), np.full(400, 1.5), rng.uniform(-1, 2, 400)], 1)
    means = np.concatenate([balls, wall]).astype(np.float32)
    count = len(means)
    quats = rng.normal(size=(count, 4))
    scales = np.exp(rng.uniform(-4.5, -2.5, (count, 3)))
    scales[600:] = 0.15
    sh = rng.normal(size=(count, 16, 3)) * 0.12
    sh[:, 0] *= 8.0
    return Splats(
        means,
        quats / np.linalg.norm(quats, axis=1, keepdims=True),
        scales,
        np.concatenate([rng.uniform(0.2, 0.99, 600), np.full(400, 0.95)]),
        sh,
        np.repeat([1, 2, 3], [300, 300, 400]),
    )


def viewmat(camera_center=(0.3, -3.0, 0.8)) -> np.ndarray:
    """Return the viewmat of a camera at `camera_center` that looks at the center."""
    forward = np.array([0, 0, 0.2]) - camera_center
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, (0, 0, 1.0))
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    matrix[:3, 3] = -matrix[:3, :3] @ camera_center
    return matrix


@pytest.fixture(scope="module")
def folder(blender, tmp_path_factory):
    """A reconstruction with the splats, one for each Blender, since edits are stored in it."""
    place = tmp_path_factory.mktemp("drawing") / "balls"
    (place / "images").mkdir(parents=True)
    write_splats(place / "splats.ply", splats())
    write_points(place / "points.ply", three_points())
    camera = {
        "name": "0.png",
        "image": "images/0.png",
        "mask": None,
        "width": SIZE[0],
        "height": SIZE[1],
        "K": K,
        "viewmat": viewmat().tolist(),
        "held_out": True,
    }
    (place / "cameras.json").write_text(
        json.dumps(
            {
                "capture": str(place),
                "origin": [0.1, 0.2, 0.3],
                "cameras": [camera],
                "upright": {"rotation": np.eye(3).tolist(), "translation": [0.1, 0.2, 0.3]},
            }
        )
    )
    (place / "objects.json").write_text(
        json.dumps(
            {
                "edits": {},
                "objects": [
                    {"id": i, "name": name, "color": [200, 40 * i, 10], "points": 1}
                    for i, name in ((1, "left"), (2, "right"), (3, "wall"))
                ],
            }
        )
    )
    return place


@pytest.fixture(scope="module")
def window(blender, folder):
    """Blender that shows the reconstruction through its camera, with Draw Splats on and object 2 moved."""
    blender.run(
        script(f"""
        root = scene.show_capture(owner, Path({str(folder)!r}))
        scene.show_result(root, Path({str(folder)!r}))
        owner.objectgs.active = root
        importlib.import_module("{PACKAGE}.objectgs_addon.state.object_edits").fill(root)
        for thing in bpy.data.objects:
            if scene.kind_of(thing) in ("points", "camera"):
                thing.hide_set(True)
        import mathutils
        bpy.context.view_layer.update()
        pivot = next(part for part in scene.object_collections(root)[2].objects
                     if scene.kind_of(part) == "object_parent")
        pivot.matrix_world = mathutils.Matrix({MOVED.tolist()}) @ pivot.matrix_world
        space = window_context()["area"].spaces.active
        space.region_3d.view_perspective = "CAMERA"
        space.overlay.show_floor = space.overlay.show_axis_x = space.overlay.show_axis_y = False
        bpy.context.view_layer.update()
        owner.objectgs.draw_splats = True
        bpy.ops.ed.undo_push(message="shown")
    """)
    )
    return blender


def drawn(window, matrix=None, focal: float = 200.0, orthographic: bool = False) -> np.ndarray:
    """Return the viewport drawing's image (H, W, 4) of the camera's view or of another view."""
    path = window.folder / "drawn.npy"
    matrix = viewmat() if matrix is None else matrix
    window.run(
        script(f"""
        view = picking.View(np.array({matrix.tolist()}), {focal}, {focal}, 118.0, 92.0, {SIZE[0]}, {SIZE[1]},
                            orthographic={orthographic})
        near, far = 0.01, 2000.0
        projection = np.zeros((4, 4))
        projection[2, 2:] = -(far + near) / (far - near), -2 * far * near / (far - near)
        if {orthographic}:
            projection[2, 2:] = -2.0 / (far - near), -(far + near) / (far - near)
        np.save({str(path)!r}, drawing.picture(owner, bpy.context.view_layer, view, projection))
    """)
    )
    return np.load(path)


def backend_draws(without: int = 0, recolor: Recolor | None = None, camera: Camera | None = None) -> np.ndarray:
    """Return the backend's image (H, W, 4), with object 2 moved."""
    camera = camera or Camera(viewmat(), np.array(K), *SIZE)
    given = splats()
    parts = [subset(given, given.object_ids == i) for i in (1, 2, 3) if i != without]
    parts = [transformed(part, MOVED) if part.object_ids[0] == 2 else part for part in parts]
    if recolor is not None:
        parts = [recolored(part, recolor) if part.object_ids[0] == 3 else part for part in parts]
    arrays = [
        np.concatenate([getattr(part, name) for part in parts]).astype(np.float32)
        for name in ("means", "quats", "scales", "opacities", "sh")
    ]
    ids = torch.zeros(len(arrays[0]), dtype=torch.int32)
    rendered = rasterize(*map(torch.from_numpy, arrays), ids, camera)
    return np.concatenate([rendered.color.numpy(), rendered.alpha.numpy()[None]]).transpose(1, 2, 0)


def subset(splats: Splats, which) -> Splats:
    return Splats(
        *(getattr(splats, name)[which] for name in ("means", "quats", "scales", "opacities", "sh", "object_ids"))
    )


def psnr(first: np.ndarray, second: np.ndarray) -> float:
    return -10.0 * math.log10(((first - second) ** 2).mean() + 1e-12)


def test_drawing_matches_backend_image(window):
    """Includes a rotated object with harmonics of degree 3, and a hidden object."""
    image = drawn(window)
    assert 0.3 < image[..., 3].mean() < 1.0
    assert psnr(image, backend_draws()) > 40.0
    window.run(
        script("""
        for part in scene.object_collections(root)[1].objects:
            part.hide_set(True)
    """)
    )
    without = drawn(window)
    assert psnr(without, backend_draws(without=1)) > 40.0 > psnr(without, image)
    window.run(
        script("""
        for part in scene.object_collections(root)[1].objects:
            part.hide_set(False)
    """)
    )


def test_drawing_blurs_as_the_file_says(window, folder):
    """As other programs do, for which these splats were trained."""
    images, wanted = {}, {}
    for blur in (0.3, 0.05):
        write_splats(folder / "splats.ply", replace(splats(), blur=blur))
        window.run(script(f"scene.show_result(root, Path({str(folder)!r}))"))
        images[blur] = drawn(window)
        wanted[blur] = backend_draws(camera=Camera(viewmat(), np.array(K), *SIZE, blur=blur))
    for blur, other in ((0.3, 0.05), (0.05, 0.3)):
        assert psnr(images[blur], wanted[blur]) > max(40.0, psnr(images[blur], wanted[other]) + 3.0)


def test_orthographic_drawing_matches_distant_camera(window):
    """It equals the image of a very distant camera."""
    camera_center = np.array([200.0, -900.0, 300.0])
    far = float(np.linalg.norm(camera_center - (0, 0, 0.2)))
    lens = np.array([[50.0 * far, 0, 118.0], [0, 50.0 * far, 92.0], [0, 0, 1]])
    image = drawn(window, viewmat(camera_center), 50.0, orthographic=True)
    assert psnr(image, backend_draws(camera=Camera(viewmat(camera_center), lens, *SIZE))) > 35.0


def test_recolor_is_drawn(window):
    """The affine map applies to an object's colors in all directions."""
    window.run(
        script("""
        item = next(item for item in root.objectgs.objects if item.object_id == 3)
        item.hue, item.value = 0.3, 0.8
    """)
    )
    image = drawn(window)
    stored = window.run(script("result = scene.recolor_of(scene.object_collections(root)[3]).stored()"))
    assert (stored["hue"], stored["value"]) == pytest.approx((0.3, 0.8))
    window.run(
        script("""
        item = next(item for item in root.objectgs.objects if item.object_id == 3)
        item.hue, item.value = 0.0, 1.0
    """)
    )
    assert psnr(image, backend_draws(recolor=Recolor.of(stored))) > 40.0
    assert psnr(image, drawn(window)) < 30.0


def placement_of(window, point) -> tuple[float, float]:
    """Return the window position of a world point, in pixels from the upper left."""
    return tuple(
        window.run(
            script(f"""
        from bpy_extras.view3d_utils import location_3d_to_region_2d
        context = window_context()
        region = context["region"]
        at = location_3d_to_region_2d(region, context["area"].spaces.active.region_3d, {point!r})
        result = [region.x + at.x, context["window"].height - region.y - at.y]
    """)
        )
    )


def color_at(window, place, name: str) -> np.ndarray:
    """Return the mean color (3,) of a few pixels of a screenshot."""
    from PIL import Image

    time.sleep(1.5)
    shot = np.asarray(Image.open(window.shot(name)).convert("RGB"), float)
    x, y = (round(value) for value in place)
    return shot[y - 1 : y + 2, x - 1 : x + 2].mean((0, 1))


def test_drawing_respects_scene_depth(window):
    """The screen has the color of the photos; a cube hides what is behind it, but not what is in front."""
    wall = placement_of(window, (0.0, 1.5, 0.2))
    seen = color_at(window, wall, "11-drawn")
    off = window.run(
        script("""
        owner.objectgs.draw_splats = False
        result = [modifier.show_viewport for modifier in bpy.data.objects["left splats"].modifiers]
    """)
    )
    assert off == [True, False]
    window.run(script("owner.objectgs.draw_splats = True"))
    window.run(
        script("""
        bpy.ops.mesh.primitive_cube_add(size=0.2, location=(0, 1.0, 0.2))
        bpy.context.active_object.name = "cube"
    """)
    )
    hidden = color_at(window, wall, "12-cube-in-front")
    window.run(script("bpy.data.objects['cube'].location.y = 3.0"))
    again = color_at(window, wall, "13-cube-behind")
    window.run(script("bpy.data.objects.remove(bpy.data.objects['cube'])"))
    assert np.abs(seen - again).max() < 6.0 < np.abs(seen - hidden).max()


def test_clicks_select_visible_objects(window):
    """Click, Shift-click, box select, undo and Esc work with the tool of the toolbar."""
    window.run(
        script("""
        with bpy.context.temp_override(**window_context()):
            bpy.ops.wm.tool_set_by_id(name="objectgs.pick")
        for thing in bpy.context.view_layer.objects:
            thing.select_set(False)
    """)
    )
    left = placement_of(window, (-0.5, 0.0, 0.2))
    wall = placement_of(window, (0.0, 1.5, 1.2))
    window.move(*left)
    time.sleep(1.0)
    window.click(*left)
    wait(window, "selected() == ['left']")
    window.shot("14-picked")
    window.move(*wall)
    window.hold("shift")
    window.click(*wall)
    wait(window, "selected() == ['left', 'wall']")
    window.click(*left)
    wait(window, "selected() == ['wall']")
    window.release("shift")
    window.key("ctrl+z")
    wait(window, "selected() == ['left', 'wall']")
    window.drag((left[0] - 30, left[1] - 30), (left[0] + 30, left[1] + 30))
    wait(window, "'left' in selected() and 'right' not in selected()")
    window.key("Escape")
    wait(window, "bpy.context.workspace.tools.from_space_view3d_mode('OBJECT').idname == 'builtin.select_box'")


def picture_of(window, name: str) -> np.ndarray:
    """Return a screenshot (H, W, 3) as float."""
    from PIL import Image

    time.sleep(1.5)
    return np.asarray(Image.open(window.shot(name)).convert("RGB"), float)


def around(shot: np.ndarray, place, reach: int = 110) -> np.ndarray:
    x, y = (round(value) for value in place)
    return shot[y - reach : y + reach, x - reach : x + reach]


def test_selection_is_outlined_and_keeps_its_colors(window):
    left = placement_of(window, (-0.5, 0.0, 0.2))
    select = """
        for thing in bpy.context.view_layer.objects:
            thing.select_set(False)
        bpy.context.view_layer.objects.active = None
        bpy.data.objects["left splats"].select_set({})
    """
    window.move(left[0], left[1] + 250)
    window.run(script(select.format(False)))
    before = around(picture_of(window, "15-not-selected"), left)
    window.run(script(select.format(True)))
    after = around(picture_of(window, "16-selected"), left)
    changed = np.abs(after - before).max(2) > 12
    assert 0.005 < changed.mean() < 0.25
    assert not changed[105:116, 105:116].any(), "the middle of the object keeps its colors"
    orange = after[changed]
    assert (orange[:, 0] > orange[:, 2] + 40).mean() > 0.4
    window.run(script(select.format(False)))


def test_pointing_outlines_until_the_mouse_leaves(window):
    window.run(
        script("""
        with bpy.context.temp_override(**window_context()):
            bpy.ops.wm.tool_set_by_id(name="objectgs.pick")
    """)
    )
    left = placement_of(window, (-0.5, 0.0, 0.2))
    is_pointing = "importlib.import_module(scene.__name__.replace('.scene', '.picking.tool')).is_pointing()"
    window.move(left[0] + 3, left[1])
    window.move(*left)
    wait(window, is_pointing)
    window.shot("17-pointed-at")
    outside = window.run(
        script("""
        area = next(area for area in bpy.context.window_manager.windows[0].screen.areas if area.type == "OUTLINER")
        result = [area.x + area.width / 2, bpy.context.window_manager.windows[0].height - area.y - area.height / 2]
    """)
    )
    window.move(*outside)
    wait(window, f"not {is_pointing}")
    window.move(left[0] + 3, left[1])
    window.move(*left)
    wait(window, is_pointing)
    window.run(
        script("""
        for part in scene.object_collections(root)[1].objects:
            part.hide_set(True)
    """)
    )
    wait(window, f"not {is_pointing}")
    window.run(
        script("""
        for part in scene.object_collections(root)[1].objects:
            part.hide_set(False)
        with bpy.context.temp_override(**window_context()):
            bpy.ops.wm.tool_set_by_id(name="builtin.select_box")
    """)
    )


def wait(window, expression: str) -> None:
    """Wait until an expression that can use the prelude's names is true."""
    deadline = time.monotonic() + 20
    while not window.run(script(f"result = {expression}")):
        assert time.monotonic() < deadline, window.run(script("result = selected()"))
        time.sleep(0.3)


def test_mesh_in_front_is_picked(window):
    """A mesh behind is not picked; a click on the background deselects everything."""
    x, y = window.run(
        script("""
        from bpy_extras.view3d_utils import location_3d_to_region_2d
        context = window_context()
        result = list(location_3d_to_region_2d(
            context["region"], context["area"].spaces.active.region_3d, (-0.5, 0.0, 0.2)))
    """)
    )
    picks = []
    for at in (-1.0, 3.0):
        window.run(
            script(f"""
            import mathutils
            bpy.ops.mesh.primitive_cube_add(size=0.1)
            cube = bpy.context.active_object
            cube.name = "cube"
            camera_center, ball = mathutils.Vector((0.3, -3.0, 0.8)), mathutils.Vector((-0.5, 0.0, 0.2))
            cube.location = ball + (camera_center - ball).normalized() * -({at})
            bpy.context.view_layer.update()
        """)
        )
        picks.append(
            window.run(
                script(f"""
            with bpy.context.temp_override(**window_context()):
                bpy.ops.objectgs.pick_object("EXEC_DEFAULT", x={round(x)}, y={round(y)})
            result = bpy.context.active_object.name
            bpy.data.objects.remove(bpy.data.objects["cube"])
        """)
            )
        )
    assert picks == ["cube", "left"]
    window.run("""
        with bpy.context.temp_override(**window_context()):
            bpy.ops.objectgs.pick_object("EXEC_DEFAULT", x=5, y=5)
    """)
    assert window.run(script("result = selected()")) == []


def test_select_by_name_finds_objects(window):
    window.run(
        script("""
        with bpy.context.temp_override(**window_context()):
            bpy.ops.objectgs.select_by_name("EXEC_DEFAULT", query="RIG, wall")
    """)
    )
    assert window.run(script("result = [selected(), bpy.context.active_object.name]")) == [["right", "wall"], "wall"]


def test_drawing_survives_undo_and_reopening(window):
    """Drawing continues after undo and in a reopened file; disabling the extension restores the modifiers."""
    before = drawn(window)
    window.run(script("bpy.ops.ed.undo_push(message='before')"))
    window.run(
        script("""
        bpy.data.objects["left"].location.x += 1.0
        bpy.context.view_layer.update()
        bpy.ops.ed.undo_push(message="moved")
    """)
    )
    assert psnr(drawn(window), before) < 30.0
    window.run("with bpy.context.temp_override(**window_context()): bpy.ops.ed.undo()")
    assert psnr(drawn(window), before) > 60.0
    path = window.folder / "drawn.blend"
    window.run(f"bpy.ops.wm.save_as_mainfile(filepath={str(path)!r})")
    window.run("bpy.ops.wm.read_homefile(use_empty=True)")
    window.run(f"bpy.ops.wm.open_mainfile(filepath={str(path)!r})")
    time.sleep(1.0)
    assert psnr(drawn(window), before) > 60.0
    states = window.run(
        script(f"""
        result = [[m.show_viewport for m in bpy.data.objects["left splats"].modifiers]]
        bpy.ops.preferences.addon_disable(module="{PACKAGE}")
        result.append([m.show_viewport for m in bpy.data.objects["left splats"].modifiers])
    """)
    )
    assert states == [[False, False, True], [True, False]]
    assert window.quit() == 0
