# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators by theme: they read the context, call objectgs_addon and report to the user.

Small operators that belong together share a module.
"""

from __future__ import annotations

from typing import Any


def _classes() -> list[type]:
    from .capture import (
        analyze_capture,
        assign_objects,
        group_objects,
        import_capture,
        import_masks,
        import_photos,
        make_demo,
        open_reconstruction,
        orient,
        override_decision,
        recompute_poses,
    )
    from .film import cameras, film_frames, set_up_compositor, set_up_render
    from .marking import clean_labels, mark_object, marked_objects
    from .meshes import export_meshes, extract_meshes
    from .objects import (
        choose_objects,
        clean_floaters,
        duplicate_object,
        fill_hole,
        mark_assets,
        merge_objects,
        remove_object,
        reset_object,
        restore_object,
    )
    from .selection import pick_object, select_by_name, select_object, solo_object
    from .setup import set_up_backend
    from .splats import crop_scene, edit_splats, export_splats, import_splats, select_more, select_splats
    from .training import (
        add_preset,
        dismiss_message,
        pause_job,
        remove_finished_jobs,
        retry_job,
        show_preview,
        show_result,
        stop_job,
        train,
    )

    modules = (
        import_capture,
        import_photos,
        import_masks,
        recompute_poses,
        make_demo,
        assign_objects,
        clean_labels,
        analyze_capture,
        override_decision,
        group_objects,
        train,
        add_preset,
        mark_object,
        marked_objects,
        extract_meshes,
        pause_job,
        stop_job,
        remove_finished_jobs,
        dismiss_message,
        retry_job,
        show_result,
        show_preview,
        open_reconstruction,
        select_object,
        pick_object,
        select_by_name,
        solo_object,
        merge_objects,
        choose_objects,
        mark_assets,
        orient,
        remove_object,
        restore_object,
        fill_hole,
        clean_floaters,
        duplicate_object,
        reset_object,
        select_splats,
        select_more,
        edit_splats,
        crop_scene,
        export_splats,
        import_splats,
        export_meshes,
        cameras,
        film_frames,
        set_up_compositor,
        set_up_render,
        set_up_backend,
    )
    return [cls for module in modules for cls in module.CLASSES]


def _import_menu(menu: Any, _context: Any) -> None:
    menu.layout.operator("objectgs.import_photos", text="ObjectGS Photos or Video")
    menu.layout.operator("objectgs.import_capture", text="ObjectGS Capture (COLMAP and others)")
    menu.layout.operator("objectgs.import_splats", text="3D Gaussian Splats (.ply, .spz, .splat, .glb, .usd)")


def _export_menu(menu: Any, _context: Any) -> None:
    menu.layout.operator("objectgs.export_splats", text="ObjectGS Splats (.ply, .spz, .splat, .glb, .usdc)")
    menu.layout.operator("objectgs.export_meshes", text="ObjectGS Meshes (.glb, .usdc, .obj)")


def register() -> None:
    import bpy

    from ..objectgs_addon.picking import marking_tool, splats_tool
    from ..objectgs_addon.picking import tool as pick_tool

    for cls in _classes():
        bpy.utils.register_class(cls)
    bpy.types.TOPBAR_MT_file_import.append(_import_menu)
    bpy.types.TOPBAR_MT_file_export.append(_export_menu)
    pick_tool.register()  # The keymaps of tools need registered operators.
    splats_tool.register()
    marking_tool.register()


def unregister() -> None:
    import bpy

    from ..objectgs_addon.picking import marking_tool, splats_tool
    from ..objectgs_addon.picking import tool as pick_tool

    marking_tool.unregister()
    splats_tool.unregister()
    pick_tool.unregister()
    bpy.types.TOPBAR_MT_file_export.remove(_export_menu)
    bpy.types.TOPBAR_MT_file_import.remove(_import_menu)
    for cls in reversed(_classes()):
        bpy.utils.unregister_class(cls)
