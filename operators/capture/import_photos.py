# SPDX-License-Identifier: GPL-3.0-or-later
"""Import photos alone: where they were taken is computed in the background, and the capture is imported then."""

from pathlib import Path

import bpy
from bpy.props import BoolProperty, EnumProperty, StringProperty

from ...backend.shared.errors import InputError
from ...objectgs_addon.environment import locations
from ...objectgs_addon.running import background
from ..common import need
from ..common.import_dialog import ImportDialog
from ..common.reporting import reports_errors


class ImportPhotos(ImportDialog, bpy.types.Operator):
    bl_idname = "objectgs.import_photos"
    bl_label = "Import Photos"
    bl_description = (
        "Compute where the photos of a folder were taken, in the background, and import them. This takes minutes, and "
        "hours for hundreds of photos"
    )
    bl_options = {"REGISTER"}

    directory: StringProperty(name="Photos", subtype="DIR_PATH", description="Folder with the photos")
    filter_folder: BoolProperty(default=True, options={"HIDDEN"})
    filter_image: BoolProperty(default=True, options={"HIDDEN"})
    # A plain string: the button of a DIR_PATH cannot open a second file browser.
    folder: StringProperty(
        name="Save To",
        description="Path of the folder for a copy of the photos with their cameras. If empty, it is named after the "
        "photos' folder, in the folder set in the preferences",
    )
    cameras: EnumProperty(
        name="Cameras",
        description="Which photos share a camera and its focal length",
        items=[
            ("auto", "Automatic", "Photos of one folder with the same size, camera and focal length, as EXIF tells"),
            ("one", "One", "All photos"),
            ("each", "One per Photo", "None, as for photos by many people or a zoom lens"),
        ],
    )

    def draw(self, _context: bpy.types.Context) -> None:
        self.layout.use_property_split = True
        self.layout.prop(self, "folder", placeholder="Automatic")
        self.layout.prop(self, "cameras")

    @reports_errors
    def execute(self, context: bpy.types.Context) -> set[str]:
        photos = Path(bpy.path.abspath(self.directory)).resolve() if self.directory else None
        if photos is None or not photos.is_dir():
            raise InputError(f"The folder {photos or 'of the photos'} does not exist; choose another")
        capture = Path(bpy.path.abspath(self.folder)).resolve() if self.folder else locations.new_capture(photos)
        need.require_unused(capture)
        job = locations.backend_job(
            f"Photos of {locations.name_of_photos(photos)}",
            "sfm",
            capture,
            "sfm",
            str(photos),
            "--out",
            str(capture),
            "--cameras",
            self.cameras,
        )
        return background.submit(job, context.scene, self.report)


CLASSES = (ImportPhotos,)
