# SPDX-License-Identifier: GPL-3.0-or-later
"""The file dialog of the exports: the file name follows the format, or names a folder."""

from pathlib import Path
from typing import Any

import bpy
from bpy.props import BoolProperty, EnumProperty, StringProperty

from ...backend.shared.errors import InputError
from ...objectgs_addon.state import object_list
from . import need


def objects_choice(all_objects: str) -> Any:
    """Return the property of the objects to export; `all_objects` describes the choice of all."""
    return EnumProperty(
        name="Objects",
        items=[
            ("ALL", "All", all_objects),
            ("SELECTED", "Selected", "The objects selected in the viewport, or the active one of the list"),
        ],
    )


class ExportDialog:
    """Mixin of operators with `format`, whose values are file suffixes, `objects` and `coordinates`."""

    filepath: StringProperty(name="File", subtype="FILE_PATH", options={"SKIP_SAVE"})
    check_existing: BoolProperty(default=True, options={"HIDDEN"})
    per_object: BoolProperty(name="One File per Object", description="Write a folder with one file per object")

    format: Any
    objects: Any
    layout: Any
    properties: Any

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        if not self.filepath:
            self.filepath = f"{bpy.path.clean_name(need.active_root(context).name)}.{self.format}"
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def check(self, _context: bpy.types.Context) -> bool:
        if not bpy.path.basename(self.filepath):  # The file browser gives the folder alone then.
            return False
        wanted = str(self._named(Path(self.filepath)))
        changed, self.filepath = wanted != self.filepath, wanted
        return changed

    def draw(self, _context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        layout.prop(self, "format")
        layout.prop(self, "objects", expand=True)
        layout.prop(self, "per_object")
        layout.prop(self, "coordinates")

    def choices(self, context: bpy.types.Context) -> tuple[Path, list[int] | None]:
        """The path to write and the IDs of the objects (None: all).

        Raises:
            InputError: no file is chosen, or no object is selected.
        """
        if not (self.filepath if self.per_object else bpy.path.basename(self.filepath)):
            raise InputError("Choose a file to write")
        ids = None
        if self.objects == "SELECTED":
            ids = object_list.require_chosen_ids(context, need.active_root(context))
        return self._named(Path(bpy.path.abspath(self.filepath)).resolve()), ids

    def _named(self, path: Path) -> Path:
        """Return the path with the suffix of the format or, for a folder, without a suffix."""
        suffixes = [item.identifier for item in self.properties.bl_rna.properties["format"].enum_items]
        bare = path.with_suffix("") if path.suffix[1:].lower() in suffixes else path
        return bare if self.per_object else bare.with_name(f"{bare.name}.{self.format}")
