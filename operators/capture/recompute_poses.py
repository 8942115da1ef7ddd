# SPDX-License-Identifier: GPL-3.0-or-later
"""Compute the poses of a capture again: without the photos whose poses are weak, or of another set of photos."""

import json
from dataclasses import replace
from pathlib import Path

import bpy
from bpy.props import IntProperty, StringProperty

from ...backend.shared.errors import InputError
from ...backend.shared.formats.photos_source import PhotosSource, read_source
from ...objectgs_addon.blender import messages
from ...objectgs_addon.environment import locations
from ...objectgs_addon.running import background, results
from ..common import need
from ..common.reporting import reports_errors


class RecomputePoses(bpy.types.Operator):
    bl_idname = "objectgs.recompute_poses"
    bl_label = "Compute Poses Again"
    bl_description = "Compute the poses of other photos of this capture. Features and matches are kept"
    bl_options = {"REGISTER", "INTERNAL"}

    capture: StringProperty(name="Capture", subtype="DIR_PATH", options={"SKIP_SAVE"})
    leave_out: StringProperty(
        name="Leave Out", description="Further photos to leave out, a JSON list of names", default="[]",
        options={"SKIP_SAVE"},
    )  # fmt: skip
    photo_set: IntProperty(
        name="Set", description="Set of photos to use if nothing connects several, 1 for the largest. 0: as before",
        min=0, options={"SKIP_SAVE"},
    )  # fmt: skip
    source: StringProperty(
        name="Photos", description="Photos and settings as JSON, as in sfm/source.json. If empty, as before",
        options={"SKIP_SAVE"},
    )  # fmt: skip

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        return need.backend(cls)

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        names = results.trained_on(Path(self.capture))
        if not names:
            return self.execute(context)
        return context.window_manager.invoke_confirm(
            self,
            event,
            title="Compute the Poses Again?",
            message=f"The training of {', '.join(names)} cannot go on with other poses; it has to start over.",
            confirm_text="Compute Poses Again",
            icon="WARNING",
        )

    @reports_errors
    def execute(self, context: bpy.types.Context) -> set[str]:
        capture = Path(self.capture)
        source = PhotosSource.of(json.loads(self.source)) if self.source else read_source(capture)
        if source is None:
            raise InputError(f"{capture} was not made by Import Photos or Video; import the photos again")
        need.require_unused(capture)
        source = replace(
            source,
            leave_out=[*source.leave_out, *json.loads(self.leave_out)],
            set=self.photo_set or source.set,
        )
        messages.settle("", RecomputePoses.bl_idname, capture=self.capture)
        return background.submit(locations.sfm_job(capture, source), context.scene, self.report)


CLASSES = (RecomputePoses,)
