# SPDX-License-Identifier: GPL-3.0-or-later
"""Renders of splats from Blender's startup scene and from a scene of the user, in a window."""

import numpy as np
import pytest
from PIL import Image

from .first_show import COLOR, SIZE, open_reconstruction, open_startup_scene, script, wait, write_reconstruction


@pytest.fixture(scope="module")
def folder(blender, tmp_path_factory):
    return write_reconstruction(tmp_path_factory.mktemp("render") / "table")


def settings(window) -> list:
    return window.run(
        script("""
        render = owner.render
        result = [owner.view_settings.view_transform, owner.cycles.transparent_max_bounces, render.resolution_x,
                  render.resolution_y, owner.camera.name]
    """)
    )


def rendered(window, name: str) -> np.ndarray:
    """Render as F12 does, with Cycles and few samples; return sRGB colors (H, W, 3)."""
    path = window.folder / f"{name}.png"
    window.run(
        script(f"""
        owner.render.engine = "CYCLES"
        owner.cycles.samples, owner.cycles.use_denoising = 4, False
        owner.render.filepath = {str(path)!r}
        with bpy.context.temp_override(**window_context()):
            bpy.ops.render.render("EXEC_DEFAULT", write_still=True)
    """),
        timeout=300,
    )
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"), float) / 255


def test_startup_scene_renders_captured_colors(blender, folder):
    """The square is 40 layers of faint splats, more than Blender's default of 8 lets rays pass through."""
    open_startup_scene(blender)
    open_reconstruction(blender, folder)
    assert settings(blender) == ["Standard", 1024, *SIZE, "0.png"]
    blender.shot("render-startup")
    image = rendered(blender, "startup")
    assert image.shape == (SIZE[1], SIZE[0], 3)
    beside_ball = image[30:90, 45:55].reshape(-1, 3).mean(0)
    assert beside_ball == pytest.approx(COLOR, abs=0.03)


def test_scene_of_the_user_is_set_up_on_request(blender, folder):
    open_startup_scene(blender)
    blender.run("bpy.context.scene.render.resolution_x = 1000")
    open_reconstruction(blender, folder)
    before = settings(blender)
    assert before == ["AgX", 8, 1000, 1080, "Camera"]
    assert "AgX" in blender.run(script("result = scene.render_problem(owner, root)"))
    blender.shot("render-problem")
    blender.run(script("call(bpy.ops.objectgs.set_up_render)"))
    assert settings(blender) == ["Standard", 1024, *SIZE, "Camera"]
    assert blender.run(script("result = scene.render_problem(owner, root)")) is None
    blender.move(400, 500)
    blender.key("ctrl+z")
    wait(blender, "owner.view_settings.view_transform == 'AgX'")
    assert settings(blender) == before
    blender.key("ctrl+shift+z")
    wait(blender, "owner.view_settings.view_transform == 'Standard'")
