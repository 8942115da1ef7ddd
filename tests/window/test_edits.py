# SPDX-License-Identifier: GPL-3.0-or-later
"""Edits of objects in a real window: a slider dragged, an object removed, both undone and redone."""

import json
import time

from .test_faults import assert_draws, folder, trained, wait_briefly, window  # noqa: F401
from .test_workflow import script

MOUSE = (600, 450)
"""Where the mouse is when the panel pops up under it."""
HUE = 141
"""How far below it the slider is."""


def edits(folder) -> dict:  # noqa: F811
    return json.loads((folder / "objects.json").read_text()).get("edits", {})


def hue(window) -> float:  # noqa: F811
    return window.run(script("result = root.objectgs.objects[0].hue"))


def drag(window, x: int, y: int, by: int) -> None:  # noqa: F811
    """Drag a slider slowly enough that Blender registers the start of the drag."""
    window.move(x - 10, y)
    window.move(x, y)
    time.sleep(1)
    window._tool("xdotool", "mousedown", "1")
    time.sleep(1)
    for step in range(1, 11):
        window._tool("xdotool", "mousemove", str(x + step * by // 10), str(y))
        time.sleep(0.2)


def test_slider_and_removal_are_undone_and_redone(window, folder):  # noqa: F811
    window.run(script("root.objectgs.active_object = 0"))
    first = window.run(script("result = str(scene.from_stored(root.objectgs.objects[0].object_id))"))
    window.move(*MOUSE)
    window.run("""
        with bpy.context.temp_override(**window_context()):
            bpy.ops.wm.call_panel(name="OBJECTGS_PT_edit", keep_open=True)
    """)
    time.sleep(1)
    drag(window, MOUSE[0], MOUSE[1] + HUE, 60)
    dragged = hue(window)
    assert dragged > 0.05, "the color is updated while the button is held"
    assert window.run(
        script(f"""
        recolor = scene.recolor_of(scene.object_collections(root)[{first}])
        result = abs(recolor.hue - {dragged}) < 1e-5
    """)
    )
    window.shot("edits-dragged")
    window._tool("xdotool", "mouseup", "1")
    window.move(200, 700)
    window.key("Escape")
    time.sleep(1)
    assert abs(edits(folder)[first]["recolor"]["hue"] - dragged) < 1e-5
    window.run(
        script("""
        with bpy.context.temp_override(**window_context()):
            bpy.ops.objectgs.remove_object("INVOKE_DEFAULT", True)
    """)
    )
    assert edits(folder)[first]["removed"]
    assert_draws(window)
    window.shot("edits-removed")
    window.move(400, 500)
    window.key("ctrl+z")
    wait_briefly(window, "not root.objectgs.objects[0].removed")
    assert "removed" not in edits(folder)[first] and edits(folder)[first]["recolor"]
    assert window.run(script(f"result = not scene.object_collections(root)[{first}].hide_viewport"))
    window.key("ctrl+z")
    wait_briefly(window, "root.objectgs.objects[0].hue == 0")
    assert first not in edits(folder)
    window.key("ctrl+shift+z")
    window.key("ctrl+shift+z")
    wait_briefly(window, "root.objectgs.objects[0].removed")
    assert edits(folder)[first]["removed"] and edits(folder)[first]["recolor"]
    assert_draws(window)
