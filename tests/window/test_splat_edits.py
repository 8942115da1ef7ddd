# SPDX-License-Identifier: GPL-3.0-or-later
"""The tool Select Splats in a real window: shapes, modifier keys, highlight, deletion and undo."""

import time
from itertools import pairwise

import numpy as np
import pytest

from backend.shared.reconstruction.edits.splat_edits import read_splat_edits
from backend.shared.reconstruction.folder import Reconstruction

from .test_drawing import color_at, folder, placement_of, script, wait, window  # noqa: F401

LEFT, RIGHT = (-0.5, 0.0, 0.2), (0.3, -0.2, 0.5)
"""Centers of the two balls; the right one has been moved."""

PICKED = """{scene.object_id_of(part): int(scene.selected_splats(part.data).sum())
             for part in bpy.context.view_layer.objects if scene.kind_of(part) == "splats"}"""


@pytest.fixture(scope="module")
def tool(window, folder):  # noqa: F811
    """Blender with the tool, Draw Splats, and an accepted folder."""
    window.run(
        script(f"""
        known = importlib.import_module("bl_ext.user_default.objectgs.objectgs_addon.environment.known_folders")
        known.remember(Path({str(folder)!r}))
        with bpy.context.temp_override(**window_context()):
            bpy.ops.wm.tool_set_by_id(name="objectgs.select_splats")
        for thing in bpy.context.view_layer.objects:
            thing.select_set(False)
        owner.objectgs.splat_radius = 25
        bpy.ops.ed.undo_push(message="tool")
    """)
    )
    return window


def settings(window, shape: str, depth: str = "THROUGH") -> None:  # noqa: F811
    window.run(script(f"owner.objectgs.splat_shape, owner.objectgs.splat_depth = {shape!r}, {depth!r}"))


def picked(window) -> dict[int, int]:  # noqa: F811
    """Return the number of selected splats of each object, without those of none."""
    return {int(i): count for i, count in window.run(script(f"result = {PICKED}")).items() if count}


def settled(window) -> dict[int, int]:  # noqa: F811
    """Return `picked` when it no longer changes."""
    before = None
    for _ in range(20):
        now = picked(window)
        if now == before:
            return now
        before = now
        time.sleep(0.4)
    return now


def trace(window, places) -> None:  # noqa: F811
    """Press the left button at the first place and release it at the last; each is waited for on a busy machine."""
    window.move(*places[0])
    window.run("")
    window._tool("xdotool", "mousedown", "1")
    window.run("")
    for before, after in pairwise(places):
        for fraction in (0.1, 0.5, 1.0):
            window.move(*(a + fraction * (b - a) for a, b in zip(before, after)))
            window.run("")
    window._tool("xdotool", "mouseup", "1")
    time.sleep(0.6)


def around(place, size: float) -> list[tuple[float, float]]:
    x, y = place
    return [(x - size, y - size), (x + size, y - size), (x + size, y + size), (x - size, y + size)]


def test_drags_select_splats_by_each_shape(tool):
    left, right = placement_of(tool, LEFT), placement_of(tool, RIGHT)
    settings(tool, "BRUSH", "VISIBLE")
    trace(tool, [(left[0] - 5, left[1]), (left[0] + 5, left[1])])
    seen = settled(tool)
    assert set(seen) == {1} and seen[1] > 10, "the wall behind the ball is hidden by it"
    settings(tool, "BRUSH")
    trace(tool, [(left[0] - 5, left[1]), (left[0] + 5, left[1])])
    through = settled(tool)
    assert set(through) == {1, 3} and through[1] > seen[1]
    tool.hold("shift")
    trace(tool, [right, (right[0] + 5, right[1])])
    tool.release("shift")
    both = settled(tool)
    assert both[2] > 10 and both[1] == through[1]
    tool.shot("splats-brush")
    tool.hold("ctrl")
    settings(tool, "BOX")
    trace(tool, [(left[0] - 120, left[1] - 120), (left[0] + 120, left[1] + 120)])
    tool.release("ctrl")
    assert 1 not in settled(tool) and both[2] / 2 < picked(tool)[2] <= both[2]
    settings(tool, "LASSO")
    trace(tool, around(left, 90))
    lassoed = settled(tool)
    assert lassoed[1] > through[1] and lassoed.get(2, 0) < both[2] / 2, "a new selection replaces the old one"
    settings(tool, "SPHERE")
    trace(tool, [left, (left[0] + 60, left[1]), (left[0] + 100, left[1])])
    round_it = settled(tool)
    assert round_it[1] > 100 and 3 not in round_it, "a sphere around the ball does not reach to the wall"
    tool.move(right[0], right[1] + 150)
    tool.key("alt+a")
    wait(tool, f"not any({PICKED}.values())")
    tool.key("ctrl+z")
    wait(tool, f"{PICKED}[1] > 0")


def test_the_key_f_changes_the_radius_of_the_brush(tool):
    left = placement_of(tool, LEFT)
    tool.move(*left)
    tool.key("f")
    tool.move(left[0] + 40, left[1])
    tool.run("")
    tool.click(left[0] + 60, left[1])
    wait(tool, "owner.objectgs.splat_radius != 25")
    tool.run(script("owner.objectgs.splat_radius = 25"))


def test_selected_splats_are_highlighted_deleted_and_restored_by_undo(tool, folder):  # noqa: F811
    left = placement_of(tool, LEFT)
    aside = (left[0], left[1] + 220)
    tool.move(*aside)
    tool.key("alt+a")
    wait(tool, f"not any({PICKED}.values())")
    plain = color_at(tool, left, "splats-plain")
    settings(tool, "BOX", "VISIBLE")
    trace(tool, [(left[0] - 130, left[1] - 130), (left[0] + 130, left[1] + 130)])
    settings(tool, "BOX")
    tool.move(*aside)
    count = settled(tool)
    assert count[1] > 20
    marked = color_at(tool, left, "splats-selected")
    assert np.abs(marked - plain).max() > 25.0, "selected splats are highlighted"
    assert marked[2] < max(marked[0], marked[1]), "in yellow"
    tool.key("x")
    wait(tool, f"not any({PICKED}.values())")
    edits = read_splat_edits(Reconstruction(folder))
    assert edits.deleted == sum(count.values())
    deleted = color_at(tool, left, "splats-deleted")
    assert np.abs(deleted - marked).max() > 10.0
    tool.key("ctrl+z")
    wait(tool, f"{PICKED}[1] == {count[1]}")
    assert not read_splat_edits(Reconstruction(folder))
    tool.key("ctrl+shift+z")
    wait(tool, f"not any({PICKED}.values())")
    assert read_splat_edits(Reconstruction(folder)).deleted == sum(count.values())
    tool.key("x")
    time.sleep(1.0)
    assert tool.run(script("result = sum(scene.kind_of(thing) == 'splats' for thing in bpy.data.objects)")) == 3
    tool.move(aside[0] + 300, aside[1])
    tool.key("Escape", "Escape")  # The first one closes the message that no splats are selected.
    wait(tool, "bpy.context.workspace.tools.from_space_view3d_mode('OBJECT').idname == 'builtin.select_box'")
