# SPDX-License-Identifier: GPL-3.0-or-later
"""The add-on's preferences: where the compute backend is, and where reconstructions go."""

import bpy
from bpy.props import EnumProperty, StringProperty

from . import job_display, locations, running


class Preferences(bpy.types.AddonPreferences):
    """What holds for every .blend."""

    bl_idname = locations.PACKAGE

    device: EnumProperty(name="For", default="cpu", items=[
        ("cpu", "Processor", "Works on every computer; 1.6 GB on disk"),
        ("cuda", "NVIDIA GPU", "Also brings the packages for NVIDIA graphics cards; several GB")])
    backend_python: StringProperty(
        name="Backend's Python", subtype="FILE_PATH",
        description="A Python that has the backend's packages already; empty: the one that Set Up Backend makes")
    base_python: StringProperty(
        name="Base Python", subtype="FILE_PATH",
        description="Python 3.11 to 3.13 that a new environment is made from; empty: Blender's own")
    reconstructions: StringProperty(
        name="Reconstructions", subtype="DIR_PATH",
        description="Where reconstructions are saved unless said otherwise; empty: in the extension's user folder")

    def draw(self, _context):
        layout = self.layout
        box = layout.box()
        box.label(text="Compute Backend", icon="SYSTEM")
        _draw_state(box)
        row = box.row()
        row.prop(self, "device", expand=True)
        if not bpy.app.online_access:
            box.label(text="To download it, allow online access: Preferences > System > Network", icon="INFO")
        row = box.row()
        row.operator("objectgs.set_up_backend", icon="IMPORT")
        row.operator("objectgs.check_backend", icon="CHECKMARK")
        row.operator("objectgs.remove_backend", icon="TRASH")
        column = box.column()
        column.use_property_split = True
        column.prop(self, "backend_python")
        column.prop(self, "base_python")
        column = layout.column()
        column.use_property_split = True
        column.prop(self, "reconstructions")


def _draw_state(layout) -> None:
    """Whether the backend works, or what goes on about it."""
    job = running.queue.of_folder(locations.environment_folder())
    if job is not None and not job.is_finished:
        job_display.draw_running(layout, job, running.queue.jobs.index(job))
        return
    sentence, icon = backend_state()
    job_display.write(layout, sentence, icon)
    if job is not None:
        job_display.draw_over(layout, job)


def backend_state() -> tuple[str, str]:
    """A sentence about the backend, and an icon."""
    return locations.backend_sentence(), "CHECKMARK" if locations.backend_python() is not None else "ERROR"


def register():
    bpy.utils.register_class(Preferences)


def unregister():
    bpy.utils.unregister_class(Preferences)
