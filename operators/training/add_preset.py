# SPDX-License-Identifier: GPL-3.0-or-later
"""Store the training's quality and settings as a preset."""

import bpy
from bl_operators.presets import AddPresetBase

from ...objectgs_addon.state import planning
from ..common import need


class AddTrainingPreset(AddPresetBase, bpy.types.Operator):
    bl_idname = "objectgs.add_training_preset"
    bl_label = "Add Training Preset"
    bl_description = "Store the quality and the settings of the training as a preset, or remove one"
    preset_menu = "OBJECTGS_PT_training_presets"
    preset_subdir = planning.PRESETS
    preset_defines = ("settings = bpy.context.scene.objectgs.active.objectgs",)
    preset_values = tuple(
        f"settings.{name}" for name in ("length", "minutes", "mode", "sh_degree", "primitive", "strategy", "max_size")
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return need.shown(cls, context)


CLASSES = (AddTrainingPreset,)
