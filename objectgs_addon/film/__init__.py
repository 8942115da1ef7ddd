# SPDX-License-Identifier: GPL-3.0-or-later
"""Film of a reconstruction: cameras, shots from Blender's camera and objects, and compositor nodes for the frames."""

from .camera_path import make_path, new_camera
from .compositing import set_up_compositor, show_frames
from .instances import layer_of
from .limits import empty_frames, ignored_settings, rendered_twice
from .shot import shot_of

__all__ = [
    "empty_frames",
    "ignored_settings",
    "layer_of",
    "make_path",
    "new_camera",
    "rendered_twice",
    "set_up_compositor",
    "shot_of",
    "show_frames",
]
