# SPDX-License-Identifier: GPL-3.0-or-later
"""User messages from timers, handlers and properties, which cannot report through an operator."""

from __future__ import annotations

import errno
import textwrap
from typing import Any

import bpy


def sentence(error: Exception) -> str:
    """Format an error as a sentence; for an OSError, include the file's name and a suggested remedy."""
    if not isinstance(error, OSError):
        return str(error)
    what = error.filename or "A file"
    full = error.errno in (errno.ENOSPC, getattr(errno, "EDQUOT", None))
    advice = "free some space and try again" if full else "check it and its permissions"
    return f"{what} cannot be read or written ({error.strerror or error}); {advice}."


def show(text: str, kind: str = "INFO") -> None:
    """Print a message to the console and, unless in background mode, show a pop-up; kind: INFO or ERROR."""
    print(f"ObjectGS: {text}", flush=True)
    manager = bpy.context.window_manager
    if bpy.app.background or manager is None or not manager.windows:
        return

    def draw(menu: Any, _context: bpy.types.Context) -> None:
        for line in textwrap.wrap(text, 80):
            menu.layout.label(text=line)

    with bpy.context.temp_override(window=manager.windows[0]):
        manager.popup_menu(draw, title="ObjectGS", icon=kind)
