# SPDX-License-Identifier: GPL-3.0-or-later
"""Select objects by words of their names."""

import bpy
from bpy.props import BoolProperty, StringProperty

from ...objectgs_addon import scene
from ...objectgs_addon.picking import selection
from ...objectgs_addon.picking.name_search import find_by_name
from ...objectgs_addon.state import object_list
from ..common import need


class SelectByName(bpy.types.Operator):
    bl_idname = "objectgs.select_by_name"
    bl_label = "Select by Name"
    bl_description = "Select the objects whose names contain these words or parts of words"
    bl_options = {"REGISTER", "UNDO"}

    query: StringProperty(name="Name", description="Words of the name; commas separate alternatives: mug, red bowl")
    extend: BoolProperty(name="Extend", description="Keep the current selection")

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return need.listed_objects(cls, context) and need.object_mode(cls, context)

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        return context.window_manager.invoke_props_dialog(self)

    def execute(self, context: bpy.types.Context) -> set[str]:
        root = need.active_root(context)
        if not self.query.strip():
            self.report({"WARNING"}, "Enter a name")
            return {"CANCELLED"}
        names = {scene.from_stored(item.object_id): item.name for item in root.objectgs.objects}
        found = list(
            dict.fromkeys(object_list.merge_target(root, object_id) for object_id in find_by_name(self.query, names))
        )
        if not found:
            self.report({"WARNING"}, f"No object is called {self.query}")
            return {"CANCELLED"}
        collections = scene.object_collections(root)
        # The best match comes last, since the last becomes active.
        wanted = [collections[object_id] for object_id in reversed(found) if object_id in collections]
        if not selection.select_collections(context, wanted, self.extend):
            self.report({"WARNING"}, f"The objects called {self.query} are hidden or have no splats and no mesh yet")
            return {"CANCELLED"}
        self.report({"INFO"}, f"{len(found)} found")
        return {"FINISHED"}


CLASSES = (SelectByName,)
