# SPDX-License-Identifier: GPL-3.0-or-later
"""The question about the folder of a .blend from elsewhere, in a real window."""

import json
import shutil
from pathlib import Path

from .harness import PACKAGE
from .test_faults import assert_draws, trained, wait_briefly, window  # noqa: F401
from .test_workflow import script

FORGET = f"""
from {PACKAGE}.objectgs_addon.environment import known_folders
known_folders._path().unlink()
"""


def snapshot(folder: Path) -> dict:
    return {
        path.relative_to(folder): (path.stat().st_mtime_ns, path.read_bytes() if path.is_file() else None)
        for path in [folder, *folder.rglob("*")]
    }


def test_the_panel_asks_before_the_folder_is_used(window, trained):  # noqa: F811
    folder = Path(shutil.copytree(trained, window.folder / "theirs"))
    window.run(
        script(f"""
        with bpy.context.temp_override(**window_context()):
            bpy.ops.objectgs.open_reconstruction("EXEC_DEFAULT", directory={str(folder)!r})
        bpy.ops.wm.save_as_mainfile(filepath={str(window.folder / "theirs.blend")!r})
    """)
        + FORGET
    )
    before = snapshot(folder)
    window.run(f"bpy.ops.wm.open_mainfile(filepath={str(window.folder / 'theirs.blend')!r})")
    window.run("""
        for region in window_context()["area"].regions:
            if region.type == "UI":
                region.active_panel_category = "ObjectGS"
    """)
    assert_draws(window)
    window.shot("foreign-asked")
    window.run(
        script("""
        with bpy.context.temp_override(**window_context()):
            bpy.ops.ed.undo_push(message="opened")
            root.objectgs.objects[0].hue = 0.2
            root.objectgs.objects[1].name = "cup"
            bpy.ops.ed.undo_push(message="edited")
    """)
    )
    window.move(400, 500)
    window.key("ctrl+z")
    wait_briefly(window, "root.objectgs.objects[0].hue == 0")
    window.key("ctrl+shift+z")
    wait_briefly(window, "root.objectgs.objects[1].name == 'cup'")
    window.run("bpy.ops.wm.save_mainfile()")
    assert_draws(window)
    window.shot("foreign-edited")
    assert snapshot(folder) == before
    assert not window.run(script("result = bpy.ops.objectgs.show_result.poll()"))
    window.run(
        script("""
        with bpy.context.temp_override(**window_context()):
            bpy.ops.objectgs.use_folder("INVOKE_DEFAULT", True)
    """)
    )
    assert_draws(window)
    window.shot("foreign-accepted")
    edits = json.loads((folder / "objects.json").read_text())["edits"]
    assert sorted(map(sorted, edits.values())) == [["name"], ["recolor"]]
    assert window.run(script("result = bpy.ops.objectgs.show_result.poll()"))
    window.run(f"bpy.ops.wm.open_mainfile(filepath={str(window.folder / 'theirs.blend')!r})")
    assert_draws(window)
    assert window.run(script("result = bpy.ops.objectgs.show_result.poll()")), "it is asked once"
