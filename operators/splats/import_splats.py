# SPDX-License-Identifier: GPL-3.0-or-later
"""Import splats of other programs as a reconstruction whose objects can be edited."""

import re
from pathlib import Path

import bpy
from bpy.props import StringProperty

from ...backend.shared.errors import InputError
from ...objectgs_addon.environment import locations
from ...objectgs_addon.running import background
from ..common.import_dialog import ImportDialog
from ..common.jobs import folder_to_import_to
from ..common.reporting import reports_errors

_GENERIC = re.compile(r"(iteration|point_cloud|splats?|ply|exports?)(_\d+)?")
"""Names that training programs give to the files and folders of all scenes."""


class ImportSplats(ImportDialog, bpy.types.Operator):
    bl_idname = "objectgs.import_splats"
    bl_label = "Import Splats"
    bl_description = (
        "Import Gaussian splats that were trained by another program. Their objects come from the file or, with the "
        "capture that they were trained on, from its masks"
    )
    bl_options = {"REGISTER"}

    filepath: StringProperty(name="File", subtype="FILE_PATH", options={"SKIP_SAVE"})
    filter_glob: StringProperty(default="*.ply;*.spz;*.splat;*.glb;*.usd;*.usda;*.usdc;*.usdz", options={"HIDDEN"})
    # Plain strings: the button of a DIR_PATH cannot open a second file browser.
    capture: StringProperty(
        name="Capture",
        description=(
            "Path of the folder with images/, cameras and masks/ that the splats were trained on. If empty, the "
            "objects of the file are used"
        ),
        options={"SKIP_SAVE"},
    )
    folder: StringProperty(
        name="Save To",
        description=(
            "Path of the new reconstruction folder. If empty, it is named after the file, in the folder set in the "
            "preferences"
        ),
        options={"SKIP_SAVE"},
    )

    def draw(self, _context: bpy.types.Context) -> None:
        self.layout.use_property_split = True
        self.layout.prop(self, "capture", placeholder="Path, for objects")
        self.layout.prop(self, "folder", placeholder="Automatic")

    @reports_errors
    def execute(self, context: bpy.types.Context) -> set[str]:
        path = Path(bpy.path.abspath(self.filepath)).resolve()
        if not self.filepath or not path.is_file():
            raise InputError(f"The file {self.filepath} does not exist; choose another")
        folder = folder_to_import_to(self.folder, lambda: _folder_for(path))
        arguments = ["import-splats", str(path), "--out", str(folder)]
        if self.capture:
            arguments += ["--capture", str(Path(bpy.path.abspath(self.capture)).resolve())]
        job = locations.backend_job(f"Import {path.name}", "import-splats", folder, *arguments)
        return background.submit(job, context.scene, self.report)


def _folder_for(path: Path) -> Path:
    """Return a new reconstruction folder named after the file, or after the next folder that has no generic name."""
    names = [path.stem, *(folder.name for folder in path.parents)]
    name = next((name for name in names if name and not _GENERIC.fullmatch(name.lower())), path.stem)
    return locations.new_reconstruction(name, lambda folder: not folder.exists())


CLASSES = (ImportSplats,)
