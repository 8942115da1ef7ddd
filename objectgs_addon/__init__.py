# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender side of ObjectGS.

Some of its packages also work without bpy, so this module does not import bpy.
"""

from __future__ import annotations

from types import ModuleType


def _modules() -> tuple[ModuleType, ...]:
    from . import drawing, panels
    from .blender import older_files, writing
    from .drawing import camera_errors, point_labels, splat_arrays
    from .film import properties as film
    from .panels import preferences
    from .running import file_preview, handlers, pointing, stroke_lines
    from .state import click_selection, properties

    return (
        writing,
        older_files,
        properties,
        film,
        preferences,
        handlers,
        pointing,
        file_preview,
        click_selection,
        splat_arrays,
        drawing,
        camera_errors,
        point_labels,
        stroke_lines,
        panels,
    )


def register() -> None:
    """Register properties, preferences, panels and handlers."""
    for module in _modules():
        module.register()


def unregister() -> None:
    """Unregister everything in reverse order; wait for background jobs to save and stop."""
    for module in reversed(_modules()):
        module.unregister()
