# SPDX-License-Identifier: GPL-3.0-or-later
"""Suppression of Blender's console output, which would disturb the progress shown in a terminal."""

from __future__ import annotations

import contextlib
import os
import sys
from typing import Any

import bpy


@contextlib.contextmanager
def quiet() -> Any:
    """Discard Blender's standard output in background mode; with a window, do nothing."""
    if not bpy.app.background:
        yield
        return
    sys.stdout.flush()
    try:
        kept = os.dup(1)
    except OSError:
        yield
        return
    sink = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(sink, 1)
        yield
    finally:
        sys.stdout.flush()
        os.dup2(kept, 1)
        os.close(kept)
        os.close(sink)
