# SPDX-License-Identifier: GPL-3.0-or-later
"""Presets of the training's quality and settings, in the header of the Settings panel."""

import bpy
from bl_ui.utils import PresetPanel

from ...state import planning


class TrainingPresets(PresetPanel, bpy.types.Panel):
    bl_idname = "OBJECTGS_PT_training_presets"
    bl_label = "Training Presets"
    preset_subdir = planning.PRESETS
    preset_operator = "script.execute_preset"
    preset_add_operator = "objectgs.add_training_preset"
