# SPDX-License-Identifier: GPL-3.0-or-later
"""The preferences of the extension: the compute backend, and folders of reconstructions and of models."""

import bpy
from bpy.props import EnumProperty, StringProperty

from ..environment import locations, online_access
from ..environment.worker.layout import GIGABYTES
from ..running import background, job_display


class Preferences(bpy.types.AddonPreferences):
    """Settings of the backend and of folders."""

    bl_idname = locations.PACKAGE

    device: EnumProperty(
        name="Device",
        default="cpu",
        items=[
            ("cpu", "CPU", f"Works on every computer; needs {GIGABYTES['cpu']:g} GB of free disk space"),
            (
                "cuda",
                "NVIDIA GPU",
                f"Also install packages for NVIDIA graphics cards; needs {GIGABYTES['cuda']:g} GB of free disk space",
            ),
        ],
    )
    backend_python: StringProperty(
        name="Backend Python",
        subtype="FILE_PATH",
        description="Python that has the packages of the backend. If empty, that of Set Up Backend is used",
    )
    base_python: StringProperty(
        name="Base Python",
        subtype="FILE_PATH",
        description="Python 3.11 to 3.13 for new environments. If empty, Blender's own, or one that is installed",
    )
    reconstructions: StringProperty(
        name="Reconstructions",
        subtype="DIR_PATH",
        description="Default folder of reconstructions, and of captures of photos in it. If empty, it is the folder "
        "ObjectGS in your home folder",
    )

    segmenter: StringProperty(
        name="Segmentation Model",
        subtype="DIR_PATH",
        description="Folder with a checkpoint of SAM, SAM 2.1 or EdgeTAM for the package transformers, config.json and "
        "weights. Strokes of Mark Objects then mark all that it segments by them. If empty, they mark what they cover",
    )

    detector: StringProperty(
        name="Detection Model",
        subtype="DIR_PATH",
        description="Folder with a checkpoint of Grounding DINO for the package transformers, with all its files. "
        "Import Masks finds objects by their names with it, unless the masks are made by SAM 3, which needs no other",
    )

    def draw(self, _context: bpy.types.Context) -> None:
        layout = self.layout
        box = layout.box()
        box.label(text="Compute Backend", icon="SYSTEM")
        _draw_state(box)
        row = box.row()
        row.prop(self, "device", expand=True)
        draw_online_access(box)
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
        column.prop(self, "segmenter")
        column.prop(self, "detector")
        row = column.row()
        row.alignment = "RIGHT"
        row.operator("objectgs.install_transformers", icon="IMPORT")


def draw_online_access(layout: bpy.types.UILayout) -> None:
    """Draw a button that allows the downloads of the set-up, or why they cannot be allowed; nothing if they are."""
    if bpy.app.online_access:
        return
    if online_access.can_be_allowed():
        job_display.write(layout, "The set-up downloads packages, and online access is off.", "INFO")
        layout.operator("objectgs.allow_online_access", icon="URL")
    else:
        job_display.write(layout, "The set-up downloads packages, and Blender was started with --offline-mode.", "INFO")


def _draw_state(layout: bpy.types.UILayout) -> None:
    """Draw the state of the backend and of its set-up."""
    job = background.queue.of_folder(locations.environment_folder())
    if job is not None and not job.is_finished:
        job_display.draw_running(layout, job, background.queue.jobs.index(job), background.queue.running)
        return
    sentence, icon = backend_state()
    job_display.write(layout, sentence, icon)
    if job is not None:
        job_display.draw_over(layout, job)


def backend_state() -> tuple[str, str]:
    """Return the state of the backend as a sentence and an icon."""
    return locations.backend_sentence(), "CHECKMARK" if locations.backend_python() is not None else "ERROR"


def register() -> None:
    bpy.utils.register_class(Preferences)


def unregister() -> None:
    bpy.utils.unregister_class(Preferences)
