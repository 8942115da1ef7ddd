# SPDX-License-Identifier: GPL-3.0-or-later
"""What the exports' file dialogs share: the file's name follows the format, and may be a folder's."""

from pathlib import Path

import bpy
from bpy.props import BoolProperty, StringProperty

from ..objectgs_addon import object_edits
from . import need


class ExportDialog:
    """Of an operator that has `format`, whose values are the files' suffixes, `objects` and `coordinates`, too."""

    filepath: StringProperty(name="File", subtype="FILE_PATH", options={"SKIP_SAVE"})
    check_existing: BoolProperty(default=True, options={"HIDDEN"})
    per_object: BoolProperty(name="A File Each", description="A folder with a file for each object")

    def invoke(self, context, _event):
        if not self.filepath:
            self.filepath = f"{bpy.path.clean_name(need.active_root(context).name)}.{self.format}"
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def check(self, _context):
        wanted = str(self._named(Path(self.filepath)))
        changed, self.filepath = wanted != self.filepath, wanted
        return changed

    def draw(self, _context):
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        layout.prop(self, "format")
        layout.prop(self, "objects", expand=True)
        layout.prop(self, "per_object")
        layout.prop(self, "coordinates")

    def chosen(self, context) -> tuple[Path, list[int] | None] | None:
        """Where to write to, and the IDs of the objects (None: all); None, and the user knows why, where either is
        missing."""
        if not self.filepath:
            self.report({"ERROR"}, "Choose a file to write")
            return None
        ids = None
        if self.objects == "SELECTED":
            ids = object_edits.chosen_ids(context, need.active_root(context))
            if not ids:
                self.report({"ERROR"}, "No object is selected; select one in the viewport or in the list")
                return None
        return self._named(Path(bpy.path.abspath(self.filepath)).resolve()), ids

    def _named(self, path: Path) -> Path:
        """The path with the format's suffix, or, of a folder, without any."""
        suffixes = [item.identifier for item in self.properties.bl_rna.properties["format"].enum_items]
        bare = path.with_suffix("") if path.suffix[1:].lower() in suffixes else path
        return bare if self.per_object else bare.with_name(f"{bare.name}.{self.format}")
