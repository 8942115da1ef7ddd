# SPDX-License-Identifier: GPL-3.0-or-later
"""Set up the compute backend in its own environment, check it, add packages to it, and remove it."""

from typing import Any

import bpy
from bpy.props import IntProperty

from ...backend.shared.errors import InputError
from ...objectgs_addon.environment import environment, locations, online_access
from ...objectgs_addon.running import background, pointing
from ..common.reporting import reports_errors


def _idle(cls: Any) -> bool:
    if background.busy(locations.environment_folder()):
        cls.poll_message_set("The backend is being set up or checked")
        return False
    return True


def _online(cls: Any) -> bool:
    if not bpy.app.online_access:
        how = "Allow online access" if online_access.can_be_allowed() else "Start Blender without --offline-mode"
        cls.poll_message_set(f"{how} first; packages are downloaded")
        return False
    return True


class AllowOnlineAccess(bpy.types.Operator):
    bl_idname = "objectgs.allow_online_access"
    bl_label = "Allow Online Access"
    bl_description = (
        "Enable Preferences > System > Network > Allow Online Access, so that the packages of the backend can be "
        "downloaded. Other extensions may then use the network, too"
    )

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        if online_access.can_be_allowed():
            return True
        is_on = bpy.app.online_access
        cls.poll_message_set("Online access is allowed" if is_on else "Blender was started with --offline-mode")
        return False

    def execute(self, _context: bpy.types.Context) -> set[str]:
        online_access.allow()
        background.redraw()
        return {"FINISHED"}


class SetUpBackend(bpy.types.Operator):
    bl_idname = "objectgs.set_up_backend"
    bl_label = "Set Up Backend"
    bl_description = (
        "Download the packages of the compute backend (PyTorch and others) to a separate folder. "
        "Nothing else on this computer is changed"
    )

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        return _online(cls) and _idle(cls)

    @reports_errors
    def execute(self, context: bpy.types.Context) -> set[str]:
        if (chosen := locations.chosen_python()) is not None:
            raise InputError(f"The backend would go on using {chosen}; {locations.how_to_set_up()}")
        # Its process uses the present environment.
        pointing.stop()
        preferences = locations.preferences()
        device = preferences.device if preferences else "cpu"
        job = environment.set_up_job(locations.base_python(), locations.environment_folder(), device)
        return background.submit(job, context.scene, self.report)


class CheckBackend(bpy.types.Operator):
    bl_idname = "objectgs.check_backend"
    bl_label = "Check Backend"
    bl_description = "Run the backend on a tiny scene, and report what works and how fast this computer is"

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        if locations.backend_python() is None:
            cls.poll_message_set("There is no backend to check; set it up, or choose a Python that has it")
            return False
        return _idle(cls)

    def execute(self, context: bpy.types.Context) -> set[str]:
        job = environment.probe_job(locations.backend_python(), locations.environment_folder())
        return background.submit(job, context.scene, self.report)


class InstallTransformers(bpy.types.Operator):
    bl_idname = "objectgs.install_transformers"
    bl_label = "Install Transformers"
    bl_description = (
        "Download the package transformers for the backend (about 40 MB), which segmentation and detection models "
        "need. The models are not part of it"
    )

    number: IntProperty(name="Job", description="The failed job that is run again", options={"HIDDEN", "SKIP_SAVE"})

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        if locations.backend_python() is None:
            cls.poll_message_set("Set up the backend first")
            return False
        return _online(cls) and _idle(cls)

    def execute(self, context: bpy.types.Context) -> set[str]:
        return background.install_transformers(context.scene, self.report, self.number)


class RemoveBackend(bpy.types.Operator):
    bl_idname = "objectgs.remove_backend"
    bl_label = "Remove Backend"
    bl_description = "Delete the packages that Set Up Backend has downloaded. Reconstructions are kept"

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        if environment.inspect(locations.environment_folder()).state == "absent":
            cls.poll_message_set("The backend is not set up")
            return False
        if any(not job.is_finished for job in background.queue.jobs):
            cls.poll_message_set("Jobs are running or waiting; stop them first")
            return False
        return True

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        return context.window_manager.invoke_confirm(self, event)

    @reports_errors
    def execute(self, _context: bpy.types.Context) -> None:
        pointing.stop()
        try:
            environment.remove(locations.environment_folder())
        except OSError as error:
            raise InputError(
                f"{error.filename or locations.environment_folder()} cannot be removed "
                f"({error.strerror}); close the programs that use it and try again"
            ) from error


CLASSES = (AllowOnlineAccess, SetUpBackend, CheckBackend, InstallTransformers, RemoveBackend)
