# SPDX-License-Identifier: GPL-3.0-or-later
"""Import masks of other programs to the capture."""

from pathlib import Path

import bpy
from bpy.props import EnumProperty, StringProperty

from ...backend.shared.errors import InputError
from ...backend.shared.formats.photos_source import IMAGES
from ...objectgs_addon import scene
from ...objectgs_addon.environment import locations
from ...objectgs_addon.running import background
from ...objectgs_addon.state.folder_state import folder_state
from ..common import need
from ..common.import_dialog import ImportDialog
from ..common.jobs import STARTS_JOB
from ..common.reporting import reports_errors

_FILES = ("*.json", "*.xml")
_IMAGES = (*sorted(IMAGES), ".exr", ".npy", ".npz")
"""Suffixes of masks, of which one stands for the whole folder."""


class ImportMasks(ImportDialog, bpy.types.Operator):
    bl_idname = "objectgs.import_masks"
    bl_label = "Import Masks"
    bl_description = (
        "Import masks of the photos that another program made: a file of COCO, CVAT or Label Studio, or a folder of "
        "images, EXR with Cryptomatte, or JSON of Segment Anything. Segments of each photo are joined to objects. A "
        "folder with a checkpoint of SAM, SAM 2.1, EdgeTAM or SAM 3 makes the segments itself"
    )
    bl_options = STARTS_JOB

    filepath: StringProperty(name="Masks", subtype="FILE_PATH", description="File, or folder, with the masks")
    filter_glob: StringProperty(default=";".join([*_FILES, *(f"*{suffix}" for suffix in _IMAGES)]), options={"HIDDEN"})
    objects: EnumProperty(
        name="Objects",
        description="Which segments show the same object",
        items=[
            ("auto", "Automatic", "As the masks say, unless they do not, or contradict the points"),
            ("given", "As Given", "As the masks say"),
            ("find", "Find", "Segments that show the same points show the same object"),
        ],
    )

    names: StringProperty(
        name="Names",
        options={"SKIP_SAVE"},
        description="For a folder with a checkpoint: names of the objects to find, in English, with semicolons between "
        "them, such as red cup; book. SAM 3 finds them itself, and for others the Detection Model of the preferences "
        "does. If empty, all segments are found, without names",
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return need.work_on_capture(cls, context)

    def draw(self, _context: bpy.types.Context) -> None:
        self.layout.use_property_split = True
        self.layout.prop(self, "objects")
        self.layout.prop(self, "names")

    @reports_errors
    def execute(self, context: bpy.types.Context) -> set[str]:
        # Links are kept: the files of a model from Hugging Face are links to files with other names.
        given = Path(bpy.path.abspath(self.filepath)).absolute() if self.filepath else None
        if given is not None and given.parent.is_dir():
            # The file browser adds a name to the folder that it shows, and may take that of the open .blend.
            is_one_of_many = given.is_file() and given.suffix.lower() in (*_IMAGES, ".blend")
            given = given.parent if is_one_of_many or not given.exists() else given
        if given is None or not given.exists():
            raise InputError(f"{given or 'The file of the masks'} does not exist; choose another")
        root = need.active_root(context)
        folder = scene.folder_of(root)
        capture = folder_state(folder).capture
        job = locations.backend_job(
            f"Import masks of {root.name}",
            "masks",
            folder,
            "masks",
            str(capture),
            str(given),
            "--objects",
            self.objects,
            *locations.naming_options(self.names),
        )
        return background.submit(job, context.scene, self.report)


CLASSES = (ImportMasks,)
