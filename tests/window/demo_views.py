# SPDX-License-Identifier: GPL-3.0-or-later
"""What the manual's pictures show: the result of `make demo`, its sidebar, and views of its table."""

import time
from pathlib import Path

from .test_workflow import script


def view(blender, distance: float, height: float = 0.12, tilt: float = 68.0, turn: float = 30.0) -> None:
    """Look at the table from `distance` meters, with angles in degrees."""
    blender.run(f"""
        from math import radians
        from mathutils import Euler
        region = window_context()["area"].spaces.active.region_3d
        region.view_perspective = "PERSP"
        region.view_location = (0.0, 0.0, {height})
        region.view_distance = {distance}
        region.view_rotation = Euler((radians({tilt}), 0.0, radians({turn}))).to_quaternion()
    """)


def show_sidebar(blender) -> None:
    """Open the ObjectGS tab of the sidebar."""
    blender.run("window_context()['area'].spaces.active.show_region_ui = True")
    time.sleep(0.5)
    blender.run("""
        for region in window_context()["area"].regions:
            if region.type == "UI":
                region.active_panel_category = "ObjectGS"
    """)


def open_demo(blender, folder: Path) -> None:
    """Open the reconstruction, with cameras, points and the backdrop hidden."""
    blender.run(
        script(f"""
        with bpy.context.temp_override(**window_context()):
            bpy.ops.objectgs.open_reconstruction("EXEC_DEFAULT", directory={str(folder)!r})
        root = owner.objectgs.active
        for layer in bpy.context.view_layer.layer_collection.children[root.name].children:
            if scene.kind_of(layer.collection) == "capture" or layer.collection.name == "backdrop":
                layer.hide_viewport = True
    """),
        timeout=120,
    )
