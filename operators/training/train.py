# SPDX-License-Identifier: GPL-3.0-or-later
"""Train the splats, in the background."""

import bpy
from bpy.props import BoolProperty

from ...backend.shared.errors import InputError
from ...backend.shared.expectation import PRESET_STEPS
from ...objectgs_addon import scene
from ...objectgs_addon.environment import locations
from ...objectgs_addon.running import background
from ...objectgs_addon.state import planning
from ...objectgs_addon.state.folder_state import folder_state
from ..common import need
from ..common.jobs import STARTS_JOB
from ..common.reporting import reports_errors


class Train(bpy.types.Operator):
    bl_idname = "objectgs.train"
    bl_label = "Train"
    bl_description = "Train the splats in the background, continuing an earlier training"
    bl_options = STARTS_JOB

    restart: BoolProperty(
        name="Retrain", options={"SKIP_SAVE"}, description="Discard the existing training and start over"
    )

    @classmethod
    def description(cls, _context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        return "Discard the existing training and start over" if properties.restart else cls.bl_description

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return need.work_on_capture(cls, context)

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if self.restart:
            return context.window_manager.invoke_confirm(
                self,
                event,
                title="Discard the Training?",
                message="The existing training is deleted and starts over.",
                confirm_text="Retrain",
                icon="WARNING",
            )
        state = folder_state(scene.folder_of(need.active_root(context)))
        if state.trained and not state.steps:
            self.restart = True
            return context.window_manager.invoke_confirm(
                self,
                event,
                title="Replace the Splats?",
                message="There is no training that can go on, and a new one replaces the splats.",
                confirm_text="Train",
                icon="WARNING",
            )
        return self.execute(context)

    @reports_errors
    def execute(self, context: bpy.types.Context) -> set[str]:
        root = need.active_root(context)
        properties = root.objectgs
        folder = scene.folder_of(root)
        state = folder_state(folder)
        by_clock = properties.length == "minutes"
        if by_clock and not self.restart and state.trained and state.seconds >= 60.0 * properties.minutes:
            raise InputError(
                f"It was already trained for {state.seconds / 60:.1f} minutes; raise Minutes to "
                "extend the training, or use Retrain"
            )
        steps = PRESET_STEPS.get(properties.length)
        if steps is not None and not self.restart and state.trained and state.steps >= steps:
            raise InputError(
                f"It was already trained for {state.steps:,} steps; choose a longer Quality to extend the training, or "
                "use Retrain"
            )
        length = ("--minutes", f"{properties.minutes:g}") if by_clock else ("--preset", properties.length)
        arguments = ["train", str(state.capture), "--out", str(folder), *length, *planning.arguments(root)]
        if self.restart:
            arguments.append("--restart")
        job = locations.backend_job(f"Train {root.name}", "train", folder, *arguments)
        return background.submit(job, context.scene, self.report)


CLASSES = (Train,)
