# SPDX-License-Identifier: GPL-3.0-or-later
"""Open a reconstruction folder in the scene, and accept the one that a .blend names."""

import contextlib
from pathlib import Path

import bpy
from bpy.props import BoolProperty, StringProperty

from ...backend.shared.errors import InputError
from ...backend.shared.formats.regular_file import resolved
from ...objectgs_addon import scene
from ...objectgs_addon.environment import locations
from ...objectgs_addon.state import folder_trust, object_edits
from ..common import need
from ..common.reporting import reports_errors
from ..common.show_folder import show_folder


class OpenReconstruction(bpy.types.Operator):
    bl_idname = "objectgs.open_reconstruction"
    bl_label = "Open Reconstruction"
    bl_description = "Open a reconstruction folder, made in Blender or on the command line, in this scene"
    bl_options = {"REGISTER", "UNDO"}

    directory: StringProperty(name="Reconstruction", subtype="DIR_PATH")
    filter_folder: BoolProperty(default=True, options={"HIDDEN"})
    instead: BoolProperty(
        name="For Active Reconstruction",
        description="Show the folder in the active reconstruction's collection, instead of the folder used so far",
        options={"HIDDEN", "SKIP_SAVE"},
    )

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        with contextlib.suppress(InputError):
            if not self.directory and locations.reconstructions_folder().is_dir():
                self.directory = str(locations.reconstructions_folder() / "")
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    @reports_errors
    def execute(self, context: bpy.types.Context) -> None:
        folder = Path(bpy.path.abspath(self.directory)).resolve()
        root = next(
            (
                collection
                for collection in context.scene.collection.children_recursive
                if scene.kind_of(collection) == "reconstruction"
                and not scene.is_linked(collection)
                and _shows(collection, folder)
            ),
            None,
        )
        if root is not None:
            folder = scene.folder_of(root)
        if root is None and self.instead:
            root = need.active_root(context)
        if root is not None and folder_trust.is_in_question(root) and folder == folder_trust.offered(root):
            object_edits.accept(root, folder)
        show_folder(self, context, folder, root)


def _shows(root: bpy.types.Collection, folder: Path) -> bool:
    """Return whether a reconstruction is in a folder; one that is not accepted is compared as text, without a look."""
    stored = scene.folder_of(root)
    return stored == folder or (folder_trust.is_accepted(root) and resolved(stored) == resolved(folder))


class UseFolder(bpy.types.Operator):
    bl_idname = "objectgs.use_folder"
    bl_label = "Use This Folder"
    bl_description = (
        "Read and write this reconstruction folder from now on, and write the edits made in this file so far there"
    )
    bl_options = {"REGISTER", "UNDO"}

    folder: StringProperty(
        name="Folder", description="The folder; if empty, the one that the panel shows", options={"HIDDEN", "SKIP_SAVE"}
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not need.shown(cls, context):
            return False
        if folder_trust.is_in_question(need.active_root(context)):
            return True
        cls.poll_message_set("The folder of this reconstruction is in use already")
        return False

    @reports_errors
    def execute(self, context: bpy.types.Context) -> None:
        root = need.active_root(context)
        folder = Path(self.folder) if self.folder else folder_trust.offered(root)
        if not object_edits.accept(root, folder):
            self.report({"WARNING"}, f"{folder} is used until Blender is closed; it could not be remembered for later")


CLASSES = (OpenReconstruction, UseFolder)
