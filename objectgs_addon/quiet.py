# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender's own lines, kept out of a terminal's progress."""

import contextlib
import os
import sys

import bpy


@contextlib.contextmanager
def quiet():
    """What Blender prints for every picture and file goes nowhere; with a window, nothing is changed."""
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
