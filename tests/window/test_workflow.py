# SPDX-License-Identifier: GPL-3.0-or-later
"""The whole workflow in a real window, from the installed zip: import, vote, train, select, merge and undo."""

import json
import subprocess
import textwrap
import time
from pathlib import Path

import pytest

from . import harness
from .harness import PACKAGE

PRELUDE = f"""
import sys
addon = sys.modules["{PACKAGE}.objectgs_addon"]
from {PACKAGE}.objectgs_addon import scene
from {PACKAGE}.objectgs_addon.running import background
from {PACKAGE}.objectgs_addon.state import object_list
owner = bpy.context.scene
root = owner.objectgs.active
def call(operator, **options):
    with bpy.context.temp_override(**window_context()):
        return list(operator("INVOKE_DEFAULT", **options))
"""
IDLE = "all(job.is_finished for job in background.queue.jobs)"


def script(body: str) -> str:
    return PRELUDE + textwrap.dedent(body)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """A small demo capture, rendered by the bpy wheel."""
    out = tmp_path_factory.mktemp("capture") / "demo"
    python = harness.ROOT / ".venv-bpy" / "bin" / "python"
    subprocess.run(
        [python, "headless.py", "demo", out, "--views", "12", "--width", "160", "--height", "120", "--samples", "4"],
        cwd=harness.ROOT,
        check=True,
        stdout=subprocess.DEVNULL,
    )
    return out


@pytest.fixture(scope="module")
def window(blender, capture):
    """Blender with the backend set and the capture imported."""
    import_capture(blender, capture, blender.folder / "reconstruction")
    return blender


def import_capture(blender, capture: Path, folder: Path) -> None:
    """Import a capture, wait for the jobs that follow, and show the tab."""
    blender.run(
        script(f"""
        with bpy.context.temp_override(**window_context()):
            result = list(bpy.ops.objectgs.import_capture(
                "EXEC_DEFAULT", directory={str(capture)!r}, folder={str(folder)!r}))
    """)
    )
    blender.run("window_context()['area'].spaces.active.show_region_ui = True")
    wait(blender, f"owner.objectgs.active is not None and {IDLE}")
    blender.run("""
        for region in window_context()["area"].regions:
            if region.type == "UI":
                region.active_panel_category = "ObjectGS"
    """)


def wait(blender, expression: str, timeout: float = 120.0):
    """Wait until an expression that can use the prelude's names is true, and return its value."""
    deadline = time.monotonic() + timeout
    while time.monotonic() < deadline:
        value = blender.run(script(f"result = {expression}"))
        if value:
            return value
        time.sleep(0.3)
    raise harness.Failed(
        f"condition timed out: {expression}; jobs: "
        + json.dumps(
            blender.run(
                script(
                    "result = [(job.title, job.state.value, job.message, job.error) for job in background.queue.jobs]"
                )
            )
        )
    )


def next_step(window) -> str:
    """Return the operator of the button that the first panel shows."""
    return window.run(
        script("""
        from bl_ext.user_default.objectgs.objectgs_addon.state import next_step
        result = next_step.next_step(root, owner).operator
    """)
    )


def test_import_shows_cameras_photos_and_points(window):
    kinds = window.run(
        script("""
        parts = [part for collection in root.children_recursive for part in collection.objects]
        cameras = [part for part in parts if scene.kind_of(part) == "camera"]
        points = [part for part in parts if scene.kind_of(part) == "points"]
        result = [len(cameras), sum(bool(camera.data.background_images) for camera in cameras),
                  len(points[0].data.vertices)]
    """)
    )
    assert kinds[:2] == [12, 12] and kinds[2] > 100
    window.shot("1-imported")


def test_objects_are_assigned_after_import(window):
    """The masks vote by themselves, and once more when asked."""
    wait(window, f"len(root.objectgs.objects) and {IDLE}")
    assert next_step(window) == "objectgs.train"
    window.run(script("call(bpy.ops.objectgs.assign_objects)"))
    wait(window, f"len(root.objectgs.objects) and {IDLE}")
    names = window.run(script("result = [item.name for item in root.objectgs.objects]"))
    assert {"mug", "table"} <= set(names) or len(names) >= 8
    assert window.run(script("result = owner.objectgs.colors")) == "object" and next_step(window) == "objectgs.train"
    window.shot("2-voted")


def test_training_shows_objects(window):
    window.run(
        script("""
        root.objectgs.length, root.objectgs.minutes = "minutes", 0.3
        call(bpy.ops.objectgs.train)
    """)
    )
    wait(window, "background.queue.running is not None and background.queue.running.progress > 0.2")
    window.shot("3-training")
    wait(window, f"{IDLE} and len(scene.object_collections(root)) > 1", 400)
    counts = window.run(script("result = object_list.splat_counts(root)"))
    assert sum(counts.values()) > 500
    drawn = window.run(
        script("""
        parts = [part for part in root.all_objects if scene.kind_of(part) == "splats"]
        result = [owner.objectgs.draw_splats, owner.objectgs.colors,
                  any(part.modifiers["ObjectGS Splats"].show_viewport for part in parts)]
    """)
    )
    assert drawn == [True, "photo", False], "splats are drawn in the colors of the photos, not as a preview"
    assert next_step(window) == "objectgs.clean_floaters"
    window.shot("4-trained")


def test_no_compute_packages_are_loaded(window):
    assert window.run("import sys; result = sorted({'torch', 'numba', 'pycolmap', 'xatlas'} & set(sys.modules))") == []


def test_click_selects_all_parts_of_object(window):
    """A real click in the viewport on the center of an object selects it."""
    place = window.run(
        script("""
        from bpy_extras.view3d_utils import location_3d_to_region_2d
        import mathutils, numpy as np
        context = window_context()
        space = context["area"].spaces.active
        space.overlay.show_overlays = True
        small = [i for i in root.objectgs.objects if i.name not in ("table", "backdrop")]
        item = max(small, key=lambda i: i.splats)
        collection = scene.object_collections(root)[scene.from_stored(item.object_id)]
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
        base = np.empty(4 * len(at), np.float32)
        splats.data.attributes["radiance:base"].data.foreach_get("color", base)
        top = at[np.argmax(base[3::4])]
        middle = splats.matrix_world @ mathutils.Vector(top)
        region3d = space.region_3d
        region3d.view_location = middle
        region3d.view_distance = 0.6
        region3d.update()
        spot = location_3d_to_region_2d(context["region"], region3d, middle)
        height = bpy.context.window_manager.windows[0].height
        result = [item.name, context["region"].x + spot.x, height - (context["region"].y + spot.y)]
    """)
    )
    window.shot("5-before-click")
    window.click(place[1], place[2])
    selected = []
    for _ in range(20):
        # Blender handles the click asynchronously.
        selected = window.run(
            script("""
            result = sorted(scene.kind_of(part) for part in bpy.context.selected_objects)
        """)
        )
        if len(selected) > 1:
            break
        time.sleep(0.5)
    window.shot("6-clicked")
    assert "splats" in selected and "object_parent" in selected
    assert window.run(script("result = object_list.active_item(root).name")) == place[0]


def test_merge_is_undone_redone_and_split(window):
    """objects.json follows the list through merge, undo, redo and split."""
    first = window.run(
        script("""
        from pathlib import Path
        from bl_ext.user_default.objectgs.backend.shared.reconstruction.objects import read_objects
        ids = [scene.from_stored(item.object_id) for item in root.objectgs.objects]
        result = [ids[0], ids[1], object_list.splat_counts(root)[ids[0]], object_list.splat_counts(root)[ids[1]]]
    """)
    )
    state = """
        from bl_ext.user_default.objectgs.backend.shared.reconstruction.objects import read_objects
        entry = next(entry for entry in read_objects(scene.folder_of(root) / "objects.json") if entry.id == {0})
        counts = object_list.splat_counts(root)
        result = [entry.merged_into, counts.get({0}, 0), counts[{1}]]
    """.format(*first)
    apart, together = [None, first[2], first[3]], [first[1], 0, first[2] + first[3]]
    window.run(
        script(f"""
        root.objectgs.active_object = 0
        for selected in bpy.context.selected_objects:
            selected.select_set(False)
        with bpy.context.temp_override(**window_context()):
            bpy.ops.ed.undo_push(message="before")
            bpy.ops.objectgs.merge_objects("EXEC_DEFAULT", True, into="{first[1]}")
    """)
    )
    assert window.run(script(state)) == together
    middle = window.run(
        "context = window_context(); r = context['region']; w = context['window']; "
        "result = [r.x + r.width / 3, w.height - r.y - r.height / 3]"
    )
    window.move(*middle)
    window.key("ctrl+z")
    assert window.run(script(state)) == apart
    window.key("ctrl+shift+z")
    assert window.run(script(state)) == together
    window.run(
        script("""
        with bpy.context.temp_override(**window_context()):
            bpy.ops.objectgs.split_objects("EXEC_DEFAULT", True)
    """)
    )
    assert window.run(script(state)) == apart


def test_extracted_meshes_replace_splats(window):
    """Two objects become meshes in the background; the others still show their splats."""
    chosen = window.run(
        script("""
        properties = root.objectgs
        small = sorted((i for i in properties.objects if i.name not in ("table", "backdrop")), key=lambda i: -i.splats)
        chosen = [scene.from_stored(item.object_id) for item in small[:2]]
        for selected in bpy.context.selected_objects:
            selected.select_set(False)
        for object_id, collection in scene.object_collections(root).items():
            for part in collection.objects:
                part.hide_set(False)
                part.select_set(object_id in chosen)
        properties.mesh_objects, properties.mesh_faces, properties.texture_size = "selected", 3000, "1024"
        call(bpy.ops.objectgs.extract_meshes)
        result = chosen
    """)
    )
    wait(window, "background.queue.running is not None and background.queue.running.progress > 0.1", 240)
    window.shot("7-extracting")
    wait(window, f"{IDLE} and bool(scene.object_meshes(root))", 300)
    shown = window.run(
        script("""
        result = {object_id: [[scene.kind_of(part), part.visible_get(), len(part.data.polygons)]
                              for part in collection.objects if scene.kind_of(part) in ("splats", "mesh")]
                  for object_id, collection in scene.object_collections(root).items() if object_id}
    """)
    )
    for object_id, parts in shown.items():
        found = {kind: (visible, faces) for kind, visible, faces in parts}
        assert ("mesh" in found) == (int(object_id) in chosen)
        assert found["splats"][0] != (int(object_id) in chosen)
        if "mesh" in found:
            visible, faces = found["mesh"]
            assert visible and 100 < faces <= 3000
    assert window.run(script("result = [root.objectgs.shown, background.queue.jobs[-1].error]")) == ["meshes", None]
    window.run("""
        context = window_context()
        context["area"].spaces.active.shading.type = "MATERIAL"
        with bpy.context.temp_override(**context):
            bpy.ops.view3d.view_selected()
    """)
    time.sleep(5)
    window.shot("8-meshes")
    window.run("window_context()['area'].spaces.active.shading.type = 'SOLID'")


def test_training_pauses_resumes_and_stops(window):
    """A paused training does not advance, a stopped one is saved, and undo in between does no harm."""
    window.run(script("root.objectgs.minutes = 5; call(bpy.ops.objectgs.train)"))
    wait(window, "background.queue.running is not None and background.queue.running.step")
    window.run(script("call(bpy.ops.objectgs.pause_job)"))
    wait(window, "background.queue.running.state.value == 'paused' and background.queue.running.message == 'Paused'")
    first = window.run(script("result = background.queue.running.step"))
    window.shot("9-paused")
    window.key("ctrl+z")
    time.sleep(1.5)
    assert window.run(script("result = background.queue.running.step")) == first
    window.run(script("call(bpy.ops.objectgs.resume_job)"))
    wait(window, f"background.queue.running.step > {first}")
    window.run(script("call(bpy.ops.objectgs.stop_job)"))
    wait(window, IDLE)
    assert window.run(script("result = background.queue.jobs[-1].state.value")) == "stopped"
    assert window.run(
        script(f"""
        from bl_ext.user_default.objectgs.objectgs_addon.state.folder_state import folder_state
        result = folder_state(scene.folder_of(root)).steps >= {first}
    """)
    )


def test_reopened_file_finds_running_job(window):
    """The file is saved, replaced by an empty one, and reopened while training runs."""
    path = window.folder / "scene.blend"
    window.run(
        script(f"""
        root.objectgs.minutes = 30
        call(bpy.ops.objectgs.train)
        bpy.ops.wm.save_as_mainfile(filepath={str(path)!r})
    """)
    )
    wait(window, "background.queue.running is not None and background.queue.running.step")
    window.run("bpy.ops.wm.read_homefile(use_empty=False)")
    time.sleep(1)
    before = window.run(script("result = background.queue.running.step"))
    window.run(f"bpy.ops.wm.open_mainfile(filepath={str(path)!r})")
    wait(window, f"background.job_of(root) is background.queue.running and background.queue.running.step > {before}")
    window.shot("10-reopened")
    # Timers and drawing also run right after a file is opened, while the context is still empty.
    for pause in (0.0, 0.2, 0.5, 0.8):
        window.run("bpy.ops.wm.read_homefile(use_empty=False)")
        time.sleep(pause)
        window.run(f"bpy.ops.wm.open_mainfile(filepath={str(path)!r})")
    wait(window, "background.job_of(root) is background.queue.running")


def test_quitting_saves_training(window):
    """If Blender quits during training, the training is saved and its process ends."""

    folder = Path(window.run(script("result = str(scene.folder_of(root))")))
    pid = window.run(script("result = background.queue.running._process.pid"))
    window.run("bpy.ops.wm.save_mainfile()")
    assert window.quit() == 0
    deadline = time.monotonic() + 20
    while Path(f"/proc/{pid}").exists() and time.monotonic() < deadline:
        time.sleep(0.2)
    assert not Path(f"/proc/{pid}").exists() and not (folder / ".lock").exists()
