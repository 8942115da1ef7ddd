# SPDX-License-Identifier: GPL-3.0-or-later
"""Select objects by what the user writes."""

import bpy
from bpy.props import BoolProperty, StringProperty

from ..objectgs_addon import finding, object_edits, scene, selection
from . import need


class FindObjects(bpy.types.Operator):
    bl_idname = "objectgs.find_objects"
    bl_label = "Find Objects"
    bl_description = "Select the objects whose names have these words, or parts of words, in them"
    bl_options = {"REGISTER", "UNDO"}

    query: StringProperty(name="Find", description="Words of the name; commas part alternatives: mug, red bowl")
    extend: BoolProperty(name="Extend", description="Keep what is selected already")

    @classmethod
    def poll(cls, context):
        return need.objects(cls, context)

    def invoke(self, context, _event):
        return context.window_manager.invoke_props_dialog(self)

    def execute(self, context):
        root = need.active_root(context)
        if not self.query.strip():
            self.report({"WARNING"}, "Write what to find")
            return {"CANCELLED"}
        candidates = [finding.Candidate(object_edits.from_stored(item.object_id), item.name)
                      for item in root.objectgs.objects]
        found = list(dict.fromkeys(
            object_edits.shown_as(root, object_id) for object_id in finding.find(self.query, candidates)))
        if not found:
            self.report({"WARNING"}, f"No object is called {self.query}")
            return {"CANCELLED"}
        collections = scene.object_collections(root)
        # The likeliest comes last, since the last becomes active.
        wanted = [collections[object_id] for object_id in reversed(found) if object_id in collections]
        if not selection.select_collections(context, wanted, self.extend):
            self.report({"WARNING"}, f"What is called {self.query} has nothing to select yet, or is hidden")
            return {"CANCELLED"}
        self.report({"INFO"}, f"{len(found)} found")
        return {"FINISHED"}


CLASSES = (FindObjects,)
