# SPDX-License-Identifier: GPL-3.0-or-later
"""What can be done: one file a verb. Each reads the context, calls objectgs_addon and reports."""


def _classes():
    from . import (
        choose_objects,
        close_place,
        duplicate_object,
        export_meshes,
        export_splats,
        extract_meshes,
        film_frames,
        find_objects,
        import_capture,
        import_splats,
        make_demo,
        mark_assets,
        merge_objects,
        orient,
        pause_job,
        pick_object,
        plan,
        remove_object,
        reset_object,
        restore_object,
        select_object,
        set_up_backend,
        set_up_compositor,
        show_preview,
        show_result,
        solo_object,
        stop_job,
        train,
        vote,
    )

    modules = (import_capture, make_demo, vote, plan, train, extract_meshes, pause_job, stop_job, show_result,
               show_preview, select_object, pick_object, find_objects, solo_object, merge_objects, choose_objects,
               mark_assets, orient, remove_object, restore_object, close_place, duplicate_object,
               reset_object, export_splats, import_splats, export_meshes, film_frames, set_up_compositor,
               set_up_backend)
    return [cls for module in modules for cls in module.CLASSES]


def _import_menu(menu, _context):
    menu.layout.operator("objectgs.import_capture", text="ObjectGS Capture (COLMAP)")
    menu.layout.operator("objectgs.import_splats", text="3D Gaussian Splats (.ply)")


def _export_menu(menu, _context):
    menu.layout.operator("objectgs.export_splats", text="ObjectGS Splats (.ply, .spz, .splat)")
    menu.layout.operator("objectgs.export_meshes", text="ObjectGS Meshes (.glb, .usdc, .obj)")


def register():
    import bpy

    from ..objectgs_addon import pick_tool

    for cls in _classes():
        bpy.utils.register_class(cls)
    bpy.types.TOPBAR_MT_file_import.append(_import_menu)
    bpy.types.TOPBAR_MT_file_export.append(_export_menu)
    pick_tool.register()  # Its keys can only be given to operators that are there.


def unregister():
    import bpy

    from ..objectgs_addon import pick_tool

    pick_tool.unregister()
    bpy.types.TOPBAR_MT_file_export.remove(_export_menu)
    bpy.types.TOPBAR_MT_file_import.remove(_import_menu)
    for cls in reversed(_classes()):
        bpy.utils.unregister_class(cls)
