# SPDX-License-Identifier: GPL-3.0-or-later
"""Import photos or a video alone: where they were taken is computed in the background, and the capture is imported."""

import json
from pathlib import Path

import bpy
from bpy.props import CollectionProperty, EnumProperty, IntProperty, StringProperty

from ...backend.shared.errors import InputError
from ...backend.shared.formats.photos_source import PHOTOS, VIDEOS, PhotosSource, has_poses
from ...backend.shared.photos.former_model import undo_killed_run
from ...backend.shared.photos.source_files import has_poses_of
from ...objectgs_addon.blender import messages
from ...objectgs_addon.environment import locations
from ...objectgs_addon.running import background, results
from ..common import need
from ..common.import_dialog import ImportDialog
from ..common.reporting import reports_errors


class ImportPhotos(ImportDialog, bpy.types.Operator):
    bl_idname = "objectgs.import_photos"
    bl_label = "Import Photos"  # Panels have more room than the button of the file browser.
    bl_description = (
        "Compute where the photos of a folder, the selected photos or the frames of a video were taken, in the "
        "background, and import them. This takes some minutes for tens of photos, and longer for hundreds"
    )
    bl_options = {"REGISTER"}

    directory: StringProperty(name="Photos", subtype="DIR_PATH", description="Folder with the photos")
    files: CollectionProperty(
        name="Files", type=bpy.types.OperatorFileListElement, description="Photos or a video; if empty, all photos"
    )
    filter_glob: StringProperty(
        default=";".join(f"*{suffix}" for suffix in sorted(PHOTOS | VIDEOS)), options={"HIDDEN"}
    )
    # A plain string: the button of a DIR_PATH cannot open a second file browser.
    folder: StringProperty(
        name="Save To",
        description="Path of the folder for a copy of the photos with their cameras. If empty, it is named after the "
        "photos' folder, in the folder set in the preferences",
        options={"SKIP_SAVE"},
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
    calibration: StringProperty(
        name="Calibration",
        description="Path of COLMAP's cameras.bin or cameras.txt, or of its folder, if the lenses are known: a camera "
        "for each size of photos. If empty, lenses are computed, too",
        options={"SKIP_SAVE"},
    )
    features: EnumProperty(
        name="Features",
        description="Where the photos are compared",
        items=[
            ("auto", "Automatic", "In the whole photos, unless the background stands still while the objects turn"),
            ("objects", "On Objects", "On the objects of the masks alone"),
        ],
    )
    frames: IntProperty(
        name="Video Frames",
        description="Number of frames that are used of each video, the sharpest ones. 0: by how far the picture moves",
        min=0,
        soft_max=300,
    )

    def draw(self, _context: bpy.types.Context) -> None:
        self.layout.use_property_split = True
        self.layout.prop(self, "folder", placeholder="Automatic")
        self.layout.prop(self, "calibration", placeholder="None")
        if not self.calibration:
            self.layout.prop(self, "cameras")
        self.layout.prop(self, "features")
        self.layout.prop(self, "frames")
        names = self._names()
        every = "All photos here and in subfolders"
        self.layout.label(text=f"{len(names)} files" if len(names) > 1 else names[0] if names else every)

    @reports_errors
    def execute(self, context: bpy.types.Context) -> set[str]:
        sources = self._sources()
        capture = locations.absolute(self.folder) if self.folder else locations.new_capture(sources)
        capture = capture.resolve()
        need.require_unused(capture)
        calibration = Path(bpy.path.abspath(self.calibration)).resolve() if self.calibration else None
        if calibration is not None and not calibration.exists():
            raise InputError(f"{calibration} does not exist; choose another calibration")
        wanted = PhotosSource(
            sources, self.cameras, self.frames or None, features=self.features, calibration=calibration
        )
        again = {"operator": "objectgs.recompute_poses", "label": "Compute Poses Again", "capture": str(capture)}
        messages.settle("", again["operator"], capture=again["capture"])
        undo_killed_run(capture)
        if has_poses_of(capture, wanted):
            job = background.import_job(capture)
            need.require_unused(job.folder)
            messages.show(f"The poses of these photos are in {capture} already, and are imported as they are.", **again)
            return background.submit(job, context.scene, self.report)
        names = results.trained_on(capture) if has_poses(capture) else []
        if names:
            messages.show(
                f"The photos or settings are not those that the poses in {capture} were computed with, and the "
                f"training of {', '.join(names)} cannot go on with other poses. Compute the poses again, or go on with "
                "what was trained by Open Reconstruction.",
                source=json.dumps(wanted.as_dict()),
                **again,
            )
            return {"CANCELLED"}
        locations.reconstructions_folder()  # The import that follows after maybe hours must not fail by it.
        return background.submit(locations.sfm_job(capture, wanted), context.scene, self.report)

    def _sources(self) -> list[Path]:
        """Return the folder, or the files selected in it."""
        folder = Path(bpy.path.abspath(self.directory)).resolve() if self.directory else None
        if folder is None or not folder.is_dir():
            raise InputError(f"The folder {folder or 'of the photos'} does not exist; choose another")
        return sorted(folder / name for name in self._names()) or [folder]

    def _names(self) -> list[str]:
        """Return the names of the selected photos and videos; the file browser adds that of the open .blend.

        A single photo has no pose: a click on it, as on a file to be opened, is meant for all of the folder.
        """
        names = [file.name for file in self.files if Path(file.name).suffix.lower() in PHOTOS | VIDEOS]
        return [] if len(names) == 1 and Path(names[0]).suffix.lower() in PHOTOS else names


CLASSES = (ImportPhotos,)
