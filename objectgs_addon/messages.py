# SPDX-License-Identifier: GPL-3.0-or-later
"""Telling the user something where no operator is there to report it: from a timer, a handler or a property."""

import errno
import textwrap

import bpy


def sentence(error: Exception) -> str:
    """An error as a plain sentence: what the system says about a file gets the file's name and what to do."""
    if not isinstance(error, OSError):
        return str(error)
    what = error.filename or "A file"
    full = error.errno in (errno.ENOSPC, getattr(errno, "EDQUOT", None))
    advice = "free some space and try again" if full else "check it and its permissions"
    return f"{what} cannot be read or written ({error.strerror or error}); {advice}."


def show(text: str, kind: str = "INFO") -> None:
    """A pop-up with `text` in a window, a line on the console without one. kind: INFO or ERROR."""
    print(f"ObjectGS: {text}", flush=True)
    manager = bpy.context.window_manager
    if bpy.app.background or manager is None or not manager.windows:
        return

    def draw(menu, _context):
        for line in textwrap.wrap(text, 80):
            menu.layout.label(text=line)

    with bpy.context.temp_override(window=manager.windows[0]):
        manager.popup_menu(draw, title="ObjectGS", icon=kind)
