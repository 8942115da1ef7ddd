# SPDX-License-Identifier: GPL-3.0-or-later
"""ObjectGS for Blender: the extension's root.

Nothing is imported before `register()`, so that tools may import a checkout of any folder name.
"""


def register():
    """Add the extension's classes, menus and handlers to Blender."""
    from . import objectgs_addon, operators

    objectgs_addon.register()
    operators.register()


def unregister():
    """Take everything back, in the opposite order."""
    from . import objectgs_addon, operators

    operators.unregister()
    objectgs_addon.unregister()
