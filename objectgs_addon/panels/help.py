# SPDX-License-Identifier: GPL-3.0-or-later
"""A short help, opened by the question mark of the first panel, with a button that opens the manual."""

from __future__ import annotations

import bpy

from ..environment.extension import ROOT

MANUAL = ROOT / "docs" / "manual" / "manual.html"
STEPS = (
    ("Import Photos or Video", "IMAGE_DATA", "computes where they were taken"),
    ("Import Capture", "IMPORT", "reads photos and their cameras"),
    ("Train", "PLAY", "turns the photos into splats; stop at any time"),
    ("Mark Objects", "GREASEPENCIL", "without masks: draw over each object"),
    ("Separate Objects", "CHECKMARK", "gives each marked object its splats"),
    ("Clean Floaters", "BRUSH_DATA", "hides stray splats"),
    ("Edit", "OUTLINER_COLLECTION", "changes the object that you click"),
    ("Extract Meshes", "MESH_DATA", "for shadows, physics, other programs"),
    ("Set Up Render", "SCENE", "before F12, to keep the photos' colors"),
)


class HelpPanel(bpy.types.Panel):
    bl_idname = "OBJECTGS_PT_help"
    bl_label = "ObjectGS Help"
    bl_description = "Steps from photos to objects, and the manual"
    bl_space_type = "VIEW_3D"
    # A panel of a header is shown by its button alone.
    bl_region_type = "HEADER"
    bl_ui_units_x = 17

    def draw(self, _context: bpy.types.Context) -> None:
        layout = self.layout
        layout.label(text="From Photos to Objects")
        column = layout.column(align=True)
        for name, icon, purpose in STEPS:
            column.label(text=f"{name}: {purpose}", icon=icon)
        column = layout.column(align=True)
        column.label(text="The large button at the top is the next step.")
        column.label(text="Tooltips say why a button cannot be pressed.")
        layout.operator("wm.path_open", text="Open Manual", icon="HELP").filepath = str(MANUAL)
