# SPDX-License-Identifier: GPL-3.0-or-later
"""What ObjectGS holds and shows inside Blender, and the demo capture that Blender renders itself.

bpy is imported only where it is needed, since some of these modules serve outside of Blender too.
"""


def _modules():
    from . import (
        click_selection,
        drawing,
        object_list,
        panels,
        preferences,
        properties,
        running,
        splat_arrays,
        writing,
    )
    from .film import properties as film

    return (writing, properties, film, preferences, object_list, running, click_selection, splat_arrays, drawing,
            panels)


def register():
    """Add properties, preferences, lists, panels and handlers."""
    for module in _modules():
        module.register()


def unregister():
    """Take them back; background jobs are told to stop and have saved when this returns."""
    for module in reversed(_modules()):
        module.unregister()
