# SPDX-License-Identifier: GPL-3.0-or-later
"""Take the screenshots in docs/ of the result of `make demo`, in the first Blender that `harness.blenders` finds.

.venv/bin/python -m tests.window.screenshots
"""

import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from PIL import Image

from . import harness
from .test_workflow import IDLE, script, wait

DEMO = harness.ROOT / "build" / "demo"
DOCS = harness.ROOT / "docs"
SIZE = (1280, 720)
QUALITY = 85

# Header of a panel that is open by default, in window pixels, with the panels above it closed.
TRAIN_HEADER = (1077, 256)
AWAY = (300, 850)
"""A mouse position without effect on the image."""


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


def save(blender, name: str) -> None:
    """Write a screenshot to docs/NAME.jpg."""
    blender.move(*AWAY)
    time.sleep(2.0)
    with Image.open(blender.shot(name)) as image:
        image.convert("RGB").resize(SIZE, Image.Resampling.LANCZOS).save(DOCS / f"{name}.jpg", quality=QUALITY)


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


def objects(blender) -> None:
    """Save a screenshot of meshes in object colors, one of them selected by a click."""
    view(blender, 1.5, turn=105.0)
    blender.click(*TRAIN_HEADER)
    spot = blender.run(
        script("""
        from bpy_extras.view3d_utils import location_3d_to_region_2d
        context = window_context()
        item = next(item for item in root.objectgs.objects if item.name == "monkey")
        collection = scene.object_collections(root)[scene.from_stored(item.object_id)]
        splats = next(part for part in scene.parts_of(collection) if scene.kind_of(part) == "splats")
        region, region3d = context["region"], context["area"].spaces.active.region_3d
        region3d.update()
        spots = [location_3d_to_region_2d(region, region3d, splats.matrix_world @ v.co) for v in splats.data.vertices]
        spots = sorted((spot for spot in spots if spot), key=lambda spot: spot.y)
        spot = spots[len(spots) // 2]
        result = [region.x + spot.x, context["window"].height - region.y - spot.y]
    """)
    )
    blender.click(*spot)
    save(blender, "objects")


def edited(blender) -> None:
    """Save a screenshot of meshes with recolored, removed and duplicated objects."""
    blender.run(
        script("""
        from mathutils import Matrix
        ids = {item.name: scene.from_stored(item.object_id) for item in root.objectgs.objects}
        rows = {item.name: item for item in root.objectgs.objects}
        scene.show_kinds(root, "meshes")
        from bl_ext.user_default.objectgs.objectgs_addon.state import object_edits
        object_edits.remove(root, [ids["ring"]], floaters=False)
        rows = {item.name: item for item in root.objectgs.objects}
        rows["monkey"].hue, rows["monkey"].saturation = 0.5, 1.2
        rows["books"].hue = 0.35
        def activate(name):
            root.objectgs.active_object = list(rows).index(name)
        activate("mug")
        with bpy.context.temp_override(**window_context()):
            bpy.ops.objectgs.duplicate_object("EXEC_DEFAULT")
        bpy.context.active_object.matrix_world = (
            Matrix.Translation((0.45, -0.1, 0.0)) @ bpy.context.active_object.matrix_world)
        activate("monkey")
        space = window_context()["area"].spaces.active
        space.shading.type = "MATERIAL"
        space.overlay.show_overlays = False
        for layer in bpy.context.view_layer.layer_collection.children[root.name].children:
            if layer.collection.name == "backdrop":
                layer.hide_viewport = False
    """)
    )
    view(blender, 1.1, tilt=75.0, turn=105.0)
    blender.run("""
        from mathutils import Vector
        for region in window_context()["area"].regions:
            if region.type == "UI":
                with bpy.context.temp_override(**{**window_context(), "region": region}):
                    for _ in range(12):
                        bpy.ops.view2d.scroll_down(deltay=-40)
    """)
    save(blender, "edited")


def training(blender, folder: Path) -> None:
    """Save a screenshot of a training at more than 70 % of its length."""
    blender.run(
        script(f"""
        with bpy.context.temp_override(**window_context()):
            bpy.ops.wm.read_homefile(use_empty=True, app_template="")
            bpy.ops.objectgs.import_capture(
                "EXEC_DEFAULT", directory={str(DEMO / "capture")!r}, folder={str(folder)!r})
    """)
    )
    wait(blender, f"{IDLE} and root is not None")
    show_sidebar(blender)
    blender.run(script("call(bpy.ops.objectgs.assign_objects)"))
    wait(blender, f"{IDLE} and len(root.objectgs.objects)")
    view(blender, 2.2, tilt=60.0, turn=105.0)
    blender.run(script("root.objectgs.minutes = 2; call(bpy.ops.objectgs.train)"))
    wait(blender, "(job := background.queue.running) is not None and job.step and job.progress > 0.7", 600)
    save(blender, "training")
    blender.run(script("call(bpy.ops.objectgs.stop_job)"))
    wait(blender, IDLE)


def main() -> None:
    """Take all screenshots."""
    subprocess.run(["make", "zip"], cwd=harness.ROOT, check=True, stdout=subprocess.DEVNULL)
    archive = max((harness.ROOT / "build").glob("objectgs-*.zip"), key=lambda path: path.stat().st_mtime)
    name, (command, variables) = next(iter(harness.blenders().items()))
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        shutil.copytree(DEMO, folder / "demo", ignore=shutil.ignore_patterns("capture", "cache", "*.blend"))
        blender = harness.Blender(command, variables, folder / "blender", harness.ROOT / "build" / "window" / name)
        try:
            blender.wait_for("True", timeout=120)
            blender.install(archive, Path(sys.executable))
            show_sidebar(blender)
            open_demo(blender, folder / "demo")
            objects(blender)
            edited(blender)
            training(blender, folder / "new" / "demo")
        finally:
            blender.close()


if __name__ == "__main__":
    main()
