# SPDX-License-Identifier: GPL-3.0-or-later
"""Mark the objects' collections as assets."""

from pathlib import Path

import bpy

from ...objectgs_addon import scene
from ...objectgs_addon.picking import selection
from ..common import need
from ..common.reporting import reports_errors


class MarkAssets(bpy.types.Operator):
    bl_idname = "objectgs.mark_assets"
    bl_label = "Mark as Assets"
    bl_description = (
        "Mark the selected objects that have a mesh, or all, as assets. They keep their size and up axis, and "
        "stand on the surface they are dropped on"
    )
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not need.listed_objects(cls, context):
            return False
        if scene.object_meshes(need.active_root(context)):
            return True
        cls.poll_message_set("There are no meshes yet; extract them first")
        return False

    @reports_errors
    def execute(self, context: bpy.types.Context) -> None:
        root = need.active_root(context)
        meshes = scene.object_meshes(root)
        selected = set(selection.selected_ids(context, root)) & set(meshes)
        collections = scene.object_collections(root)
        context.view_layer.update()
        for object_id in sorted(selected or meshes):
            scene.mark_asset(collections[object_id], meshes[object_id], _catalog_of(root))
        if bpy.data.filepath:
            scene.write_catalog(Path(bpy.data.filepath).parent, _catalog_of(root))
            self.report({"INFO"}, f"{len(selected or meshes)} objects marked as assets")
        else:
            self.report({"INFO"}, "Marked as assets; save the file and mark again to have a catalog of them")


def _catalog_of(root: bpy.types.Collection) -> str:
    """Return the name of a reconstruction's catalog, without characters that separate catalogs."""
    return root.name.replace(":", " ").replace("/", " ").strip() or "Objects"


CLASSES = (MarkAssets,)
