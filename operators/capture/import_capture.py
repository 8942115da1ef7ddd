# SPDX-License-Identifier: GPL-3.0-or-later
"""Import the cameras, photos and points of a capture."""

from pathlib import Path

import bpy
from bpy.props import BoolProperty, StringProperty

from ...backend.shared.errors import InputError
from ...objectgs_addon.environment import locations
from ...objectgs_addon.running import background
from ...objectgs_addon.state.folder_state import reconstruction_for
from ...objectgs_addon.state.properties import image_size
from ..common.import_dialog import ImportDialog
from ..common.jobs import folder_to_import_to
from ..common.reporting import reports_errors


class ImportCapture(ImportDialog, bpy.types.Operator):
    bl_idname = "objectgs.import_capture"
    bl_label = "Import Capture"
    bl_description = (
        "Import the cameras, photos and points of a folder with images/, masks/ and a COLMAP model in sparse/0, or a "
        "file with the cameras: transforms.json, or an export of Metashape, RealityScan or Bundler"
    )
    bl_options = {"REGISTER"}

    directory: StringProperty(name="Capture", subtype="DIR_PATH", description="Folder with images/ and cameras")
    filter_folder: BoolProperty(default=True, options={"HIDDEN"})
    # A plain string: the button of a DIR_PATH cannot open a second file browser.
    folder: StringProperty(
        name="Save To",
        description="Path of the reconstruction folder, which may grow to gigabytes. If empty, it is named after the "
        "capture, in the folder set in the preferences",
        options={"SKIP_SAVE"},
    )
    max_size: image_size()

    def draw(self, _context: bpy.types.Context) -> None:
        self.layout.use_property_split = True
        self.layout.prop(self, "folder", placeholder="Automatic")
        self.layout.prop(self, "max_size")

    @reports_errors
    def execute(self, context: bpy.types.Context) -> set[str]:
        capture = Path(bpy.path.abspath(self.directory)).resolve() if self.directory else None
        if capture is None or not capture.is_dir():
            raise InputError(f"The folder {capture or 'of the capture'} does not exist; choose another")
        folder = folder_to_import_to(
            self.folder, lambda: reconstruction_for(capture, locations.new_reconstruction), capture
        )
        job = locations.backend_job(
            f"Import {capture.name}",
            "import",
            folder,
            "import",
            str(capture),
            "--out",
            str(folder),
            "--max-size",
            str(self.max_size),
        )
        return background.submit(job, context.scene, self.report)


CLASSES = (ImportCapture,)
