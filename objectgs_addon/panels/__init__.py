# SPDX-License-Identifier: GPL-3.0-or-later
"""The ObjectGS tab in the 3D viewport's sidebar, one module for each panel, and the line in the status bar."""

import bpy

from .capture import AddMenu, CapturePanel
from .edits import EditPanel, draw_context_menu
from .export import ExportPanel
from .help import HelpPanel
from .jobs import JobsPanel, status_bar
from .meshes import MeshesPanel
from .objects import MarkedList, MarkingPanel, ObjectList, ObjectsPanel
from .placement import PlacementPanel
from .render import FilmPanel, RenderPanel
from .splats import AssignMenu, SplatsPanel
from .training.plan import PlanPanel
from .training.presets import TrainingPresets
from .training.train import DetailsPanel, SettingsPanel, TrainPanel

CLASSES = (
    AddMenu,
    HelpPanel,
    ObjectList,
    CapturePanel,
    PlacementPanel,
    ObjectsPanel,
    MarkedList,
    MarkingPanel,
    TrainPanel,
    DetailsPanel,
    PlanPanel,
    TrainingPresets,
    SettingsPanel,
    EditPanel,
    AssignMenu,
    SplatsPanel,
    MeshesPanel,
    RenderPanel,
    FilmPanel,
    ExportPanel,
    JobsPanel,
)
"""In the order from the capture to the result."""


def register() -> None:
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.STATUSBAR_HT_header.append(status_bar)
    bpy.types.VIEW3D_MT_object_context_menu.prepend(draw_context_menu)


def unregister() -> None:
    bpy.types.VIEW3D_MT_object_context_menu.remove(draw_context_menu)
    bpy.types.STATUSBAR_HT_header.remove(status_bar)
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
