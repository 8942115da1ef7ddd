# SPDX-License-Identifier: GPL-3.0-or-later
"""ObjectGS inside Blender, and the demo capture that Blender renders itself.

Some packages of this folder also work without bpy, so it is not imported here.
"""

from __future__ import annotations

from types import ModuleType


def _modules() -> tuple[ModuleType, ...]:
    from . import drawing, panels
    from .blender import older_files, writing
    from .drawing import splat_arrays
    from .film import properties as film
    from .panels import preferences
    from .running import handlers
    from .state import click_selection, properties

    return (
        writing,
        older_files,
        properties,
        film,
        preferences,
        handlers,
        click_selection,
        splat_arrays,
        drawing,
        panels,
    )


def register() -> None:
    """Register properties, preferences, panels and handlers."""
    for module in _modules():
        module.register()


def unregister() -> None:
    """Unregister them; background jobs are stopped and have saved when this returns."""
    for module in reversed(_modules()):
        module.unregister()
