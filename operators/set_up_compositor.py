# SPDX-License-Identifier: GPL-3.0-or-later
"""Set Up Compositor: nodes that join film frames with Blender's own rendering."""

import bpy

from ..backend.protocol import InputError
from ..objectgs_addon import film, messages, object_edits, scene
from ..objectgs_addon.film.properties import folder_of
from . import need


class SetUpCompositor(bpy.types.Operator):
    bl_idname = "objectgs.set_up_compositor"
    bl_label = "Set Up Compositor"
    bl_description = ("Let the compositor join the film frames with Blender's rendering by depth, and offer mattes of "
                      "objects. The reconstruction itself is hidden for rendering, so that nothing is there twice")
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context):
        return need.reconstruction(cls, context)

    def execute(self, context):
        root, owner = need.active_root(context), context.scene
        item = object_edits.active_item(root)
        try:
            film.set_up_compositor(owner, context.view_layer, root, folder_of(owner, scene.folder_of(root)),
                                   item.name if item is not None else "")
        except (InputError, OSError, RuntimeError) as error:
            self.report({"ERROR"}, messages.sentence(error))
            return {"CANCELLED"}
        self.report({"INFO"}, f"Renders show the film frames of {root.name}; its splats and meshes in Blender are "
                              "hidden for rendering")
        return {"FINISHED"}


CLASSES = (SetUpCompositor,)
