# SPDX-License-Identifier: GPL-3.0-or-later
"""The ObjectGS tab in the 3D viewport's sidebar, one module for each panel, and the line in the status bar."""

import bpy

from .capture import CapturePanel
from .display import DisplayPanel, DrawingPanel
from .edits import EditPanel
from .film import FilmPanel
from .jobs import JobsPanel, status_bar
from .meshes import MeshesPanel
from .objects import ObjectList, ObjectsPanel
from .plan import PlanPanel
from .splats import AssignMenu, SplatsPanel
from .train import SettingsPanel, TrainPanel

CLASSES = (
    ObjectList,
    CapturePanel,
    TrainPanel,
    PlanPanel,
    SettingsPanel,
    ObjectsPanel,
    EditPanel,
    AssignMenu,
    SplatsPanel,
    MeshesPanel,
    DrawingPanel,
    FilmPanel,
    DisplayPanel,
    JobsPanel,
)


def register() -> None:
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.STATUSBAR_HT_header.append(status_bar)


def unregister() -> None:
    bpy.types.STATUSBAR_HT_header.remove(status_bar)
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
