# SPDX-License-Identifier: GPL-3.0-or-later
"""A scene of over a million splats in a real viewport: levels of detail are built, and the picture stays the same."""

import numpy as np
import pytest
from PIL import Image

from backend.export import write_splats
from backend.model.splats import Splats
from benchmarks.detail import town

from .harness import PACKAGE

COUNT = 1_100_000

PRELUDE = f"""
import importlib
from pathlib import Path
of = lambda name: importlib.import_module("{PACKAGE}.objectgs_addon." + name)
detail, entries, viewport = of("drawing.detail"), of("drawing.entries"), of("drawing.viewport")
owner = bpy.context.scene
"""


@pytest.fixture(scope="module")
def window(blender, tmp_path_factory):
    """Blender that shows a town from afar."""
    folder = tmp_path_factory.mktemp("town")
    means, quats, scales, opacities, harmonics = town(COUNT)
    write_splats(folder / "town.ply", Splats(means, quats, scales, opacities, harmonics, np.ones(COUNT, np.int64)))
    paths = {"filepath": str(folder / "town.ply"), "folder": str(folder / "town")}
    blender.run(f"result = list(bpy.ops.objectgs.import_splats('EXEC_DEFAULT', **{paths!r}))")
    blender.wait_for("any('radiance:base' in mesh.attributes for mesh in bpy.data.meshes)", timeout=400)
    blender.run(PRELUDE + "owner.objectgs.draw_splats = True")
    blender.run(
        """
        import mathutils
        context = window_context()
        space = context["area"].spaces.active
        space.overlay.show_overlays = False
        space.region_3d.view_perspective = "PERSP"
        space.region_3d.view_rotation = mathutils.Euler((1.1, 0, 0.6)).to_quaternion()
        space.region_3d.view_location, space.region_3d.view_distance = (0, 0, 0), 60.0
        """
    )
    return blender


def test_large_scene_is_drawn_with_levels_of_detail(window) -> None:
    window.wait_for(f"(exec({PRELUDE!r}, globals()), len(detail._built) and not detail.is_building())[1]", timeout=300)
    seconds = {}
    for name, most in (("27-all-splats", 10**9), ("28-levels-of-detail", 1_000_000)):
        seconds[name] = window.run(
            PRELUDE
            + f"""
detail.MOST = {most}
import time
with bpy.context.temp_override(**window_context()):
    bpy.ops.wm.redraw_timer(type="DRAW_WIN_SWAP", iterations=1)
    context = window_context()
    turn = context["area"].spaces.active.region_3d
    before, began = turn.view_distance, time.perf_counter()
    for step in range(3):
        turn.view_distance = before * (1.001 + step / 1000)
        bpy.ops.wm.redraw_timer(type="DRAW_WIN_SWAP", iterations=1)
    turn.view_distance = before
    bpy.ops.wm.redraw_timer(type="DRAW_WIN_SWAP", iterations=1)
result = (time.perf_counter() - began) / 4, viewport.renderer()._count
""",
            timeout=600,
        )
        window.shot(name)
    (_, every), (_, chosen) = seconds.values()
    assert every == COUNT and chosen < 760_000
    first, second = (
        np.asarray(Image.open(window.shots / f"{name}.png").convert("RGB"), float)[150:750, 300:1100]
        for name in seconds
    )
    assert np.abs(first - first.mean()).mean() > 5, "something is shown"
    error = ((first - second) ** 2).mean()
    assert 10 * np.log10(255**2 / error) > 28
