# SPDX-License-Identifier: GPL-3.0-or-later
"""From the installed zip to objects that can be clicked, in a real window: import, vote, train, select, merge, undo."""

import subprocess

import pytest

from . import harness
from .harness import PACKAGE

PRELUDE = f"""
import sys
addon = sys.modules["{PACKAGE}.objectgs_addon"]
from {PACKAGE}.objectgs_addon import running, scene, object_edits
owner = bpy.context.scene
root = owner.objectgs.active
def call(operator, **options):
    with bpy.context.temp_override(**window_context()):
        return list(operator("INVOKE_DEFAULT", **options))
"""
IDLE = "all(job.is_finished for job in running.queue.jobs)"


def script(body: str) -> str:
    import textwrap

    return PRELUDE + textwrap.dedent(body)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """A small demo capture, rendered by the bpy wheel."""
    out = tmp_path_factory.mktemp("capture") / "demo"
    python = harness.ROOT / ".venv-bpy" / "bin" / "python"
    subprocess.run([python, "headless.py", "demo", out, "--views", "12", "--width", "160", "--height", "120",
                    "--samples", "4"], cwd=harness.ROOT, check=True, stdout=subprocess.DEVNULL)
    return out


@pytest.fixture(scope="module")
def window(blender, capture):
    """Blender with the backend set and the capture imported."""
    folder = blender.place / "reconstruction"
    blender.run(script(f"""
        with bpy.context.temp_override(**window_context()):
            result = list(bpy.ops.objectgs.import_capture(
                "EXEC_DEFAULT", directory={str(capture)!r}, folder={str(folder)!r}))
    """))
    blender.run("window_context()['area'].spaces.active.show_region_ui = True")
    wait(blender, "owner.objectgs.active is not None")
    blender.run("""
        for region in window_context()["area"].regions:
            if region.type == "UI":
                region.active_panel_category = "ObjectGS"
    """)
    return blender


def wait(blender, expression: str, timeout: float = 120.0):
    """Until an expression in the prelude's names is true."""
    import json
    import time

    deadline = time.monotonic() + timeout
    while time.monotonic() < deadline:
        value = blender.run(script(f"result = {expression}"))
        if value:
            return value
        time.sleep(0.3)
    raise harness.Failed(f"it never became true: {expression}; jobs: " + json.dumps(blender.run(script(
        "result = [(job.title, job.state.value, job.message, job.error) for job in running.queue.jobs]"))))


def test_import_shows_cameras_photos_and_points(window):
    kinds = window.run(script("""
        parts = [part for collection in root.children_recursive for part in collection.objects]
        cameras = [part for part in parts if scene.kind_of(part) == "camera"]
        points = [part for part in parts if scene.kind_of(part) == "points"]
        result = [len(cameras), sum(bool(camera.data.background_images) for camera in cameras),
                  len(points[0].data.vertices)]
    """))
    assert kinds[:2] == [12, 12] and kinds[2] > 100
    window.shot("1-imported")


def test_vote_fills_the_list(window):
    window.run(script("call(bpy.ops.objectgs.vote)"))
    wait(window, f"len(root.objectgs.objects) and {IDLE}")
    names = window.run(script("result = [item.name for item in root.objectgs.objects]"))
    assert {"mug", "table"} <= set(names) or len(names) >= 8
    window.shot("2-voted")


def test_training_shows_objects(window):
    window.run(script("""
        root.objectgs.minutes = 0.3
        call(bpy.ops.objectgs.train)
    """))
    wait(window, "running.queue.running is not None and running.queue.running.progress > 0.2")
    window.shot("3-training")
    wait(window, f"{IDLE} and len(scene.object_collections(root)) > 1", 180)
    counts = window.run(script("result = object_edits.splat_counts(root)"))
    assert sum(counts.values()) > 500
    window.shot("4-trained")


def test_nothing_heavy_is_loaded(window):
    assert window.run("import sys; result = sorted({'torch', 'numba', 'pycolmap', 'xatlas'} & set(sys.modules))") == []


def test_click_selects_the_whole_object(window):
    """A real click in the viewport on the middle of an object."""
    place = window.run(script("""
        from bpy_extras.view3d_utils import location_3d_to_region_2d
        import mathutils, numpy as np
        context = window_context()
        space = context["area"].spaces.active
        space.overlay.show_overlays = True
        small = [i for i in root.objectgs.objects if i.name not in ("table", "wall", "floor")]
        item = max(small, key=lambda i: i.splats)
        collection = scene.object_collections(root)[object_edits.from_stored(item.object_id)]
        splats = next(part for part in scene.parts_of(collection) if scene.kind_of(part) == "splats")
        for selected in bpy.context.selected_objects:
            selected.select_set(False)
        bpy.context.view_layer.objects.active = None
        for other in scene.object_collections(root).values():
            if other != collection:
                for part in other.objects:
                    part.hide_set(True)
        for part in root.children_recursive[0].objects:
            part.hide_set(True)
        with bpy.context.temp_override(**context):
            bpy.ops.view3d.view_axis(type="TOP")
        at = np.array([v.co for v in splats.data.vertices])
        middle = splats.matrix_world @ mathutils.Vector(np.median(at, axis=0))
        region3d = space.region_3d
        region3d.view_location = middle
        region3d.view_distance = 0.6
        region3d.update()
        spot = location_3d_to_region_2d(context["region"], region3d, middle)
        height = bpy.context.window_manager.windows[0].height
        result = [item.name, context["region"].x + spot.x, height - (context["region"].y + spot.y)]
    """))
    window.shot("5-before-click")
    window.click(place[1], place[2])
    selected = window.run(script("""
        result = sorted(scene.kind_of(part) for part in bpy.context.selected_objects)
    """))
    window.shot("6-clicked")
    assert "splats" in selected and "object_parent" in selected
    assert window.run(script("result = object_edits.active_item(root).name")) == place[0]
