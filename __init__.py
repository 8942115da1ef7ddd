# SPDX-License-Identifier: GPL-3.0-or-later
"""ObjectGS for Blender, the root package of the extension.

Nothing is imported before `register()`, so that tools can import a checkout with any folder name.
"""


def register() -> None:
    """Register the classes, menus and handlers of the extension."""
    from . import objectgs_addon, operators  # type: ignore[attr-defined]  # mypy takes this file for a script.

    objectgs_addon.register()
    operators.register()


def unregister() -> None:
    """Unregister everything in reverse order."""
    from . import objectgs_addon, operators  # type: ignore[attr-defined]  # mypy takes this file for a script.

    operators.unregister()
    objectgs_addon.unregister()
