# SPDX-License-Identifier: GPL-3.0-or-later
"""Compute the poses of a capture again without the photos whose poses are weak."""

import json
from pathlib import Path

import bpy
from bpy.props import StringProperty

from ...backend.shared.errors import InputError
from ...backend.shared.formats.photos_source import read_source
from ...objectgs_addon.environment import locations
from ...objectgs_addon.running import background
from ..common import need
from ..common.reporting import reports_errors


class LeaveOutPhotos(bpy.types.Operator):
    bl_idname = "objectgs.leave_out_photos"
    bl_label = "Leave Out Weak Photos"
    bl_description = "Compute the poses again without these photos. Features and matches are kept"
    bl_options = {"REGISTER", "INTERNAL"}

    capture: StringProperty(name="Capture", subtype="DIR_PATH", options={"SKIP_SAVE"})
    names: StringProperty(name="Photos", description="A JSON list of names", options={"SKIP_SAVE"})

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        return need.backend(cls)

    @reports_errors
    def execute(self, context: bpy.types.Context) -> set[str]:
        capture = Path(self.capture)
        source = read_source(capture)
        if source is None:
            raise InputError(f"{capture} was not made by Import Photos or Video; import the photos again")
        need.require_unused(capture)
        job = locations.sfm_job(capture, source, leave_out=[*source.leave_out, *json.loads(self.names)])
        return background.submit(job, context.scene, self.report)


CLASSES = (LeaveOutPhotos,)
