# SPDX-License-Identifier: GPL-3.0-or-later
"""Import Splats: those of other programs, as a reconstruction whose objects can be edited."""

from pathlib import Path

import bpy
from bpy.props import StringProperty

from ..objectgs_addon import locations, running
from . import need


class ImportSplats(bpy.types.Operator):
    bl_idname = "objectgs.import_splats"
    bl_label = "Import Splats"
    bl_description = ("Read Gaussian splats that another program trained. Their objects are those that the file names; "
                      "or, with the capture that they were trained on, those of its masks")
    bl_options = {"REGISTER"}

    filepath: StringProperty(name="File", subtype="FILE_PATH", options={"SKIP_SAVE"})
    filter_glob: StringProperty(default="*.ply", options={"HIDDEN"})
    # No folders to Blender, whose button for these refuses to open a second file browser.
    capture: StringProperty(name="Capture", description=(
        "Path of the folder with images/, sparse/0 and masks/ that the splats were trained on; empty: the file's own "
        "objects"))
    folder: StringProperty(name="Save To", description=(
        "Path of the reconstruction folder to make; empty: named as the file, in the folder that the preferences say"))

    @classmethod
    def poll(cls, _context):
        return need.backend(cls)

    def invoke(self, context, _event):
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def draw(self, _context):
        self.layout.use_property_split = True
        self.layout.prop(self, "capture", placeholder="Path, for objects")
        self.layout.prop(self, "folder", placeholder="Automatic")

    def execute(self, context):
        ply = Path(bpy.path.abspath(self.filepath)).resolve()
        if not self.filepath or not ply.is_file():
            self.report({"ERROR"}, f"The file {self.filepath} does not exist; choose another")
            return {"CANCELLED"}
        folder = Path(bpy.path.abspath(self.folder)).resolve() if self.folder else _folder_for(ply)
        sentence = need.in_use(folder)
        if sentence is not None:
            self.report({"ERROR"}, sentence)
            return {"CANCELLED"}
        arguments = ["import-splats", str(ply), "--out", str(folder)]
        if self.capture:
            arguments += ["--capture", str(Path(bpy.path.abspath(self.capture)).resolve())]
        job = locations.backend_job(f"Import {ply.name}", "import-splats", folder, *arguments)
        return running.submit(job, context.scene, self.report)


def _folder_for(ply: Path) -> Path:
    """A reconstruction folder that is not there yet, named as the file, or as its folder where that says more."""
    name = ply.parent.name if ply.stem.lower() in ("point_cloud", "splats", "splat") else ply.stem
    return locations.new_reconstruction(name, lambda folder: not folder.exists())


CLASSES = (ImportSplats,)
