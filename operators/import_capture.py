# SPDX-License-Identifier: GPL-3.0-or-later
"""Import a capture: cameras with their photos, and the point cloud."""

from pathlib import Path

import bpy
from bpy.props import IntProperty, StringProperty

from ..objectgs_addon import locations, running
from ..objectgs_addon.folder_state import folder_state
from . import need


class ImportCapture(bpy.types.Operator):
    bl_idname = "objectgs.import_capture"
    bl_label = "Import Capture"
    bl_description = "Read a folder with images/, a COLMAP model in sparse/0 and masks/: cameras, photos and points"
    bl_options = {"REGISTER"}

    directory: StringProperty(name="Capture", subtype="DIR_PATH", description="Folder with images/ and sparse/0")
    filter_folder: bpy.props.BoolProperty(default=True, options={"HIDDEN"})
    # No folder to Blender, whose button for these refuses to open a second file browser.
    folder: StringProperty(
        name="Save To",
        description="Path of the reconstruction folder, which may grow to gigabytes; empty: named as the capture, in "
                    "the folder that the preferences say")
    max_size: IntProperty(name="Image Size", default=1600, min=64, soft_max=8192,
                          description="Larger photos are reduced to this longest side, in pixels")

    @classmethod
    def poll(cls, _context):
        return need.backend(cls)

    def invoke(self, context, _event):
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def draw(self, _context):
        self.layout.use_property_split = True
        self.layout.prop(self, "folder", placeholder="Automatic")
        self.layout.prop(self, "max_size")

    def execute(self, context):
        capture = Path(bpy.path.abspath(self.directory)).resolve() if self.directory else None
        if capture is None or not capture.is_dir():
            self.report({"ERROR"}, f"The folder {capture or 'of the capture'} does not exist; choose another")
            return {"CANCELLED"}
        folder = Path(bpy.path.abspath(self.folder)).resolve() if self.folder else _folder_for(capture)
        sentence = need.in_use(folder)
        if sentence is not None:
            self.report({"ERROR"}, sentence)
            return {"CANCELLED"}
        job = locations.backend_job(f"Import {capture.name}", "import", folder, "import", str(capture), "--out",
                                    str(folder), "--max-size", str(self.max_size))
        return running.submit(job, context.scene, self.report)


def _folder_for(capture: Path) -> Path:
    """A reconstruction folder named as the capture (or as its parent where the capture's name says nothing).

    Numbered where that name belongs to another capture.
    """
    name = capture.name if capture.name.lower() not in ("capture", "colmap", "data") else capture.parent.name
    return locations.new_reconstruction(name, lambda folder: folder_state(folder).capture in (None, capture))


CLASSES = (ImportCapture,)
