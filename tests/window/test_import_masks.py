# SPDX-License-Identifier: GPL-3.0-or-later
"""Masks of another program in a real window: the job, and the objects that follow it by themselves."""

import shutil

from .test_workflow import IDLE, capture, import_capture, script, wait  # noqa: F401


def test_masks_of_a_folder_become_objects(blender, capture):  # noqa: F811
    plain, given, folder = (blender.folder / name for name in ("plain", "given-masks", "plain-splats"))
    shutil.copytree(capture, plain, ignore=shutil.ignore_patterns("masks", "labels.json", "truth"))
    shutil.copytree(capture / "masks", given)
    import_capture(blender, plain, folder)
    blender.run(
        script(f"""
        with bpy.context.temp_override(**window_context()):
            result = list(bpy.ops.objectgs.import_masks("EXEC_DEFAULT", filepath={str(given)!r}))
    """)
    )
    wait(blender, f"len(root.objectgs.objects) > 4 and {IDLE}", 120)
    blender.shot("masks-imported")
    assert (plain / "masks" / "masks.json").is_file()
