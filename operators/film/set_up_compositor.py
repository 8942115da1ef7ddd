# SPDX-License-Identifier: GPL-3.0-or-later
"""Set up the compositor to combine film frames with Blender's own rendering."""

import bpy

from ...objectgs_addon import film, scene
from ...objectgs_addon.film.properties import folder_of
from ...objectgs_addon.state import object_list
from ..common import need
from ..common.reporting import reports_errors
from .output_folder import UsesOutputFolder


class SetUpCompositor(UsesOutputFolder, bpy.types.Operator):
    bl_idname = "objectgs.set_up_compositor"
    bl_label = "Set Up Compositor"
    bl_description = (
        "Combine the film frames with Blender's rendering by depth, with mattes of objects. The "
        "reconstruction itself is hidden in renders, so that it does not appear twice; Film > Transparent and the "
        "pass Z are switched on"
    )
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return need.reconstruction(cls, context)

    @reports_errors
    def execute(self, context: bpy.types.Context) -> None:
        root, owner = need.active_root(context), context.scene
        self.remember_output(context)
        item = object_list.shown_item(root)
        film.set_up_compositor(
            owner,
            context.view_layer,
            root,
            folder_of(owner, scene.folder_of(root)),
            item.name if item is not None else "",
        )
        self.report(
            {"INFO"},
            f"Renders show the film frames of {root.name} instead of its splats and meshes; Film > Transparent and the "
            "pass Z are on",
        )
        for problem in (film.rendered_twice(owner, context.view_layer, root), scene.render_problem(owner, root)):
            if problem is not None:
                self.report({"WARNING"}, problem)


CLASSES = (SetUpCompositor,)
