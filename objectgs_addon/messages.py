# SPDX-License-Identifier: GPL-3.0-or-later
"""Telling the user something where no operator is there to report it: from a timer, a handler or a property."""

import textwrap

import bpy


def show(text: str, kind: str = "INFO") -> None:
    """A pop-up with `text` in a window, a line on the console without one. kind: INFO or ERROR."""
    print(f"ObjectGS: {text}")
    manager = bpy.context.window_manager
    if bpy.app.background or manager is None or not manager.windows:
        return

    def draw(menu, _context):
        for line in textwrap.wrap(text, 80):
            menu.layout.label(text=line)

    with bpy.context.temp_override(window=manager.windows[0]):
        manager.popup_menu(draw, title="ObjectGS", icon=kind)
