# SPDX-License-Identifier: GPL-3.0-or-later
"""Set up the compute backend in an environment of its own, check it, and remove it."""

import bpy

from ..objectgs_addon import environment, locations, running


def _idle(cls) -> bool:
    if running.busy(locations.environment_folder()):
        cls.poll_message_set("The backend is being set up or checked")
        return False
    return True


class SetUpBackend(bpy.types.Operator):
    bl_idname = "objectgs.set_up_backend"
    bl_label = "Set Up Backend"
    bl_description = ("Download the compute backend's packages (PyTorch and others, 1.6 GB and more) into a folder of "
                      "their own. Nothing else on this computer is changed")

    @classmethod
    def poll(cls, _context):
        if not bpy.app.online_access:
            cls.poll_message_set("Allow Online Access in Preferences > System > Network first: packages are downloaded")
            return False
        return _idle(cls)

    def execute(self, context):
        preferences = locations.preferences()
        device = preferences.device if preferences else "cpu"
        job = environment.set_up_job(locations.base_python(), locations.environment_folder(), device)
        return running.submit(job, context.scene, self.report)


class CheckBackend(bpy.types.Operator):
    bl_idname = "objectgs.check_backend"
    bl_label = "Check Backend"
    bl_description = "Try everything on a tiny scene, and say what works and how fast the computer is"

    @classmethod
    def poll(cls, _context):
        if locations.backend_python() is None:
            cls.poll_message_set("There is no backend to check; set it up, or say which Python has it")
            return False
        return _idle(cls)

    def execute(self, context):
        job = environment.probe_job(locations.backend_python(), locations.environment_folder())
        return running.submit(job, context.scene, self.report)


class RemoveBackend(bpy.types.Operator):
    bl_idname = "objectgs.remove_backend"
    bl_label = "Remove Backend"
    bl_description = "Delete the packages that Set Up Backend has downloaded. Reconstructions stay"

    @classmethod
    def poll(cls, _context):
        if environment.inspect(locations.environment_folder()).state == "absent":
            cls.poll_message_set("Nothing was set up")
            return False
        return _idle(cls)

    def invoke(self, context, event):
        return context.window_manager.invoke_confirm(self, event)

    def execute(self, _context):
        try:
            environment.remove(locations.environment_folder())
        except OSError as error:
            self.report({"ERROR"}, f"{error.filename or locations.environment_folder()} cannot be removed "
                                   f"({error.strerror}); close what uses it and try again")
            return {"CANCELLED"}
        return {"FINISHED"}


CLASSES = (SetUpBackend, CheckBackend, RemoveBackend)
