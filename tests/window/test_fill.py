# SPDX-License-Identifier: GPL-3.0-or-later
"""The hole of a removed object in a real viewport: filled in the background, drawn, picked, undone and redone."""

import json
import time

import numpy as np
import pytest

from backend.export import write_splats
from backend.model.splats import Splats
from backend.shared.formats.points_ply import write_points
from backend.shared.splats.spherical_harmonics import C0

from .test_drawing import color_at, placement_of, three_points
from .test_workflow import IDLE, script, wait

BROWN = np.array([0.6, 0.4, 0.2])
MIDDLE = (0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def folder(blender, tmp_path_factory):
    """A reconstruction of a brown ground (object 2) with a hole under a blue box (object 1)."""
    place = tmp_path_factory.mktemp("fill") / "room"
    place.mkdir()
    rng = np.random.default_rng(0)
    ground = np.column_stack([rng.uniform(-1.5, 1.5, (9000, 2)), np.zeros(9000)])
    ground = ground[np.abs(ground).max(1) > 0.2]
    box = rng.uniform((-0.2, -0.2, 0), (0.2, 0.2, 0.4), (1500, 3))
    means, count = np.concatenate([box, ground]).astype(np.float32), len(box) + len(ground)
    is_box = np.arange(count) < len(box)
    sh = (np.where(is_box[:, None], (0.2, 0.3, 0.9), BROWN) - 0.5)[:, None] / C0
    write_splats(
        place / "splats.ply",
        Splats(
            means,
            np.tile([1.0, 0, 0, 0], (count, 1)),
            np.tile([0.04, 0.04, 0.002], (count, 1)),
            np.full(count, 0.95),
            sh,
            np.where(is_box, 1, 2),
        ),
    )
    write_points(place / "points.ply", three_points())
    (place / "cameras.json").write_text(
        json.dumps(
            {
                "capture": str(place),
                "origin": [0, 0, 0],
                "cameras": [],
                "upright": {"rotation": np.eye(3).tolist(), "translation": [0, 0, 0]},
            }
        )
    )
    (place / "objects.json").write_text(
        json.dumps(
            {
                "edits": {},
                "objects": [
                    {"id": 1, "name": "box", "color": [50, 80, 230], "points": 1},
                    {"id": 2, "name": "ground", "color": [150, 100, 50], "points": 1},
                ],
            }
        )
    )
    return place


@pytest.fixture(scope="module")
def window(blender, folder):
    """Blender with a top view of the reconstruction and Draw Splats enabled."""
    blender.run(
        script(f"""
        with bpy.context.temp_override(**window_context()):
            bpy.ops.objectgs.open_reconstruction("EXEC_DEFAULT", directory={str(folder)!r})
        owner.objectgs.draw_splats = True
        space = window_context()["area"].spaces.active
        space.overlay.show_overlays = False
        space.show_region_ui = True
        view = space.region_3d
        view.view_perspective, view.view_distance, view.view_location = "ORTHO", 3.0, (0.0, 0.0, 0.0)
        view.view_rotation = (1.0, 0.0, 0.0, 0.0)
        view.update()
        bpy.ops.ed.undo_push(message="opened")
    """)
    )
    time.sleep(1)
    blender.run("""
        for region in window_context()["area"].regions:
            if region.type == "UI":
                region.active_panel_category = "ObjectGS"
    """)
    return blender


def ground_splats(window) -> list[int]:
    """Return the number of the ground's splats, of unobserved splats among them, and of splats that they replace."""
    return window.run(
        script("""
        part = next(part for part in scene.object_collections(root)[2].objects if scene.kind_of(part) == "splats")
        hidden = scene.hidden_splats(part.data)
        result = [len(part.data.vertices), int(scene.unobserved_splats(part.data).sum()),
                  0 if hidden is None else int(hidden.sum())]
    """)
    )


def is_brown(window, name: str) -> bool:
    color = color_at(window, placement_of(window, MIDDLE), name) / 255.0
    return bool(np.abs(color - BROWN).max() < 0.1)


def test_hole_is_filled_in_background_and_follows_undo(window):
    before = ground_splats(window)
    assert before[1:] == [0, 0] and not is_brown(window, "fill-1-box")
    window.run(
        script("""
        root.objectgs.active_object = 0
        with bpy.context.temp_override(**window_context()):
            bpy.ops.objectgs.remove_object("INVOKE_DEFAULT", True)
    """)
    )
    assert not is_brown(window, "fill-2-removed")
    window.run(
        script("""
        with bpy.context.temp_override(**window_context()):
            bpy.ops.objectgs.fill_hole("INVOKE_DEFAULT", True)
    """)
    )
    wait(window, f"{IDLE} and not scene.missing_fill(root, scene.Objects.read(scene.folder_of(root)))")
    filled = ground_splats(window)
    assert filled[1] > 50 and filled[2] > 0 and filled[0] == before[0] + filled[1]
    assert is_brown(window, "fill-3-filled")
    picked = window.run(
        script(f"""
        x, y = {placement_of(window, MIDDLE)!r}
        region = window_context()["region"]
        with bpy.context.temp_override(**window_context()):
            bpy.ops.objectgs.pick_object("EXEC_DEFAULT", x=round(x - region.x),
                                         y=round(window_context()["window"].height - region.y - y))
        result = bpy.context.active_object.users_collection[0].name
    """)
    )
    assert picked == "ground"
    window.move(300, 500)
    for keys, wanted in (
        (["ctrl+z"], before),
        (["ctrl+shift+z"], filled),
        (["ctrl+z"] * 2, before),
        (["ctrl+shift+z"] * 2, filled),
    ):
        window.key(*keys)
        deadline = time.monotonic() + 20
        while ground_splats(window) != wanted and time.monotonic() < deadline:
            time.sleep(0.3)
        assert ground_splats(window) == wanted
    window.run(
        script("""
        with bpy.context.temp_override(**window_context()):
            bpy.ops.objectgs.restore_object("INVOKE_DEFAULT", True)
    """)
    )
    assert ground_splats(window) == before and not is_brown(window, "fill-4-restored")
