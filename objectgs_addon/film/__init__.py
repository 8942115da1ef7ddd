# SPDX-License-Identifier: GPL-3.0-or-later
"""Film of a reconstruction: cameras, shots from Blender's camera and objects, and compositor nodes for the frames."""

from .camera_path import make_path, new_camera
from .compositing import set_up_compositor, show_frames
from .limits import ignored_settings, rendered_twice
from .shot import shot_of

__all__ = [
    "ignored_settings",
    "make_path",
    "new_camera",
    "rendered_twice",
    "set_up_compositor",
    "shot_of",
    "show_frames",
]
