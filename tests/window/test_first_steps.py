# SPDX-License-Identifier: GPL-3.0-or-later
"""What a new user sees in a real window: online access, the progress of the first jobs, and the first save."""

import subprocess
import time
from pathlib import Path

import numpy as np
import pytest

from backend.export import write_splats
from backend.model.splats import Splats
from tests.backend.conftest import write_scene

from . import harness
from .first_show import sidebar
from .test_workflow import IDLE, script, wait

PREFERENCES = f'bpy.context.preferences.addons["{harness.PACKAGE}"].preferences'


@pytest.fixture(scope="module")
def window(blender):
    """Blender with the ObjectGS tab open."""
    blender.run("""
        area = window_context()["area"]
        area.spaces.active.show_region_ui = True
    """)
    time.sleep(1)
    blender.run("""
        for region in window_context()["area"].regions:
            if region.type == "UI":
                region.active_panel_category = "ObjectGS"
    """)
    time.sleep(1)
    return blender


def test_online_access_is_allowed_where_the_backend_is_missing(window):
    """The button stands beside the text, and the text names no button that is disabled."""
    state = script("""
        locations = sys.modules[f"{addon.__name__}.environment.locations"]
        result = [bpy.app.online_access, bpy.ops.objectgs.set_up_backend.poll(), locations.backend_sentence()]
    """)
    python = window.run(f"result = {PREFERENCES}.backend_python; {PREFERENCES}.backend_python = ''")
    try:
        online, can_set_up, sentence = window.run(state)
        assert not online and not can_set_up
        assert "allow online access, then press Set Up Backend" in sentence
        window.run(f"""
            with bpy.context.temp_override(**window_context()):
                bpy.ops.preferences.addon_show(module="{harness.PACKAGE}")
        """)
        time.sleep(1.5)
        window.shot("preferences-offline")
        window.run("""
            with bpy.context.temp_override(window=bpy.context.window_manager.windows[1]):
                bpy.ops.wm.window_close()
        """)
        time.sleep(1)
        x, top, bottom = sidebar(window)
        # The first button below the text; clicks on the text do nothing.
        for y in range(round(top) + 60, round(bottom), 10):
            window.click(x, y)
            if window.run("result = bpy.app.online_access"):
                break
        online, can_set_up, sentence = window.run(state)
        window.shot("panel-online")
        assert online and can_set_up and sentence.endswith("; press Set Up Backend.")
    finally:
        window.run(f"{PREFERENCES}.backend_python = {python!r}")


RECORD = """
    seen = bpy.app.driver_namespace["seen"] = []
    def note():
        job = background.queue.jobs[-1] if background.queue.jobs else None
        if job is not None:
            entry = [job.kind, job.state.value, job.progress, job.stage, job.message]
            if not seen or seen[-1] != entry:
                seen.append(entry)
        return 0.02
    bpy.app.driver_namespace["note"] = note
    bpy.app.timers.register(note)
"""


def seen_of(window, kind: str) -> list:
    """Return state, progress, stage and message of a kind of job whenever one of them changed."""
    found = window.run("result = bpy.app.driver_namespace['seen']")
    return [entry[1:] for entry in found if entry[0] == kind and entry[1] != "waiting"]


def check_progress(seen: list) -> None:
    shares = [share for _, share, *_ in seen]
    assert shares == sorted(shares)
    assert all(message for *_, message in seen), "a running job says what it does"
    assert all(share < 1 for state, share, *_ in seen if state == "running")


def test_first_jobs_name_their_stages(window, tmp_path):
    """Import is not complete while it works, and the first training compiles as a stage of its own."""
    scene = write_scene(tmp_path / "capture", views=9, size=(64, 48))
    window.run(script(RECORD))
    window.run(
        script(f"""
        with bpy.context.temp_override(**window_context()):
            bpy.ops.objectgs.import_capture(
                "EXEC_DEFAULT", directory={str(scene.folder)!r}, folder={str(tmp_path / "out")!r})
    """)
    )
    wait(window, f"owner.objectgs.active is not None and {IDLE}")
    imported = seen_of(window, "import")
    check_progress(imported)
    # A small capture may be read between two looks at the job.
    assert {stage for _, _, stage, _ in imported} & {"Preparing (1 of 2)", "Planning (2 of 2)"}
    window.run(script("root.objectgs.minutes = 1; call(bpy.ops.objectgs.train)"))
    wait(window, "background.queue.running is not None and background.queue.running.message.startswith('Compiling')")
    before = window.run(script("result = background.queue.running.progress"))
    wait(window, f"background.queue.running.progress > {before}")
    window.shot("compiling")
    window.run(script("call(bpy.ops.objectgs.stop_job)"))
    wait(window, IDLE)
    trained = seen_of(window, "train")
    check_progress(trained)
    assert {stage for _, _, stage, _ in trained if stage} == {"Preparing (1 of 3)"}
    window.run("bpy.app.timers.unregister(bpy.app.driver_namespace['note'])")


def test_saving_does_not_render_splats(window, tmp_path):
    """In Material Preview, with a camera, Blender would render the file's preview image from the splats."""
    folder, rng, count = tmp_path / "splats", np.random.default_rng(0), 30000
    folder.mkdir()
    path = tmp_path / "splats.ply"
    write_splats(
        path,
        Splats(
            rng.uniform(-1, 1, (count, 3)).astype(np.float32),
            np.tile([1.0, 0, 0, 0], (count, 1)),
            np.full((count, 3), 0.02),
            np.full(count, 0.9),
            rng.uniform(-1, 1, (count, 1, 3)),
            np.ones(count, np.int64),
        ),
    )
    subprocess.run(
        [Path(harness.ROOT, ".venv", "bin", "python"), "-m", "backend", "import-splats", path, "--out", folder],
        cwd=harness.ROOT,
        check=True,
        stdout=subprocess.DEVNULL,
    )
    window.run(
        script(f"""
        with bpy.context.temp_override(**window_context()):
            bpy.ops.objectgs.open_reconstruction("EXEC_DEFAULT", directory={str(folder)!r})
        camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
        camera.location = (0, 0, 6)
        owner.collection.objects.link(camera)
        owner.camera = camera
        window_context()["area"].spaces.active.shading.type = "MATERIAL"
    """),
        timeout=300,
    )
    time.sleep(10)
    window.run("result = 1", timeout=300)
    saved = tmp_path / "saved.blend"
    seconds, kind = window.run(
        f"""
        import time
        began = time.perf_counter()
        with bpy.context.temp_override(**window_context()):
            bpy.ops.wm.save_as_mainfile(filepath={str(saved)!r})
        result = [time.perf_counter() - began, bpy.context.preferences.filepaths.file_preview_type]
    """,
        timeout=600,
    )
    window.run("window_context()['area'].spaces.active.shading.type = 'SOLID'")
    assert seconds < 4 and kind == "AUTO", "the user's preference is restored"


MESSAGES = """
    messages = sys.modules[f"{addon.__name__}.blender.messages"]
    latest = messages.latest()
    result = None if latest is None else [latest.text, latest.operator, latest.label, messages.count()]
"""


def test_failed_import_is_one_message_until_it_is_dismissed(window, tmp_path):
    """Photos without cameras are refused by a message with a button, which the panel shows instead of a pop-up."""
    scene = write_scene(tmp_path / "capture", masks=False)
    photos = tmp_path / "photos"
    (scene.folder / "images").rename(photos)
    for _ in range(2):
        window.run(
            script(f"""
            bpy.ops.objectgs.import_capture("EXEC_DEFAULT", directory={str(photos)!r})
        """)
        )
        wait(window, IDLE)
        time.sleep(1)
    text, operator, label, count = window.run(script(MESSAGES))
    assert "6 photos, but not where they were taken" in text and count == 1
    assert (operator, label) == ("objectgs.import_photos", "Import Photos of This Folder...")
    time.sleep(1)
    window.shot("message")
    window.run("bpy.ops.objectgs.dismiss_message()")
    assert window.run(script(MESSAGES)) is None


def test_capture_without_masks_trains_as_one_scene(window, tmp_path):
    scene = write_scene(tmp_path / "plain", masks=False, views=9)
    folder = tmp_path / "reconstruction"
    window.run(
        script(f"""
        bpy.ops.objectgs.import_capture("EXEC_DEFAULT", directory={str(scene.folder)!r}, folder={str(folder)!r})
    """)
    )
    wait(window, f"{IDLE} and owner.objectgs.active is not None")
    time.sleep(1)
    window.shot("without-masks")
    assert window.run(
        script("""
        steps = sys.modules[f"{addon.__name__}.state.next_step"]
        trust = sys.modules[f"{addon.__name__}.state.folder_trust"]
        result = [steps.next_step(root, owner).operator, steps.has_masks(trust.state_of(root))]
    """)
    ) == ["objectgs.train", False]
