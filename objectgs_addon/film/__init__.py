# SPDX-License-Identifier: GPL-3.0-or-later
"""Film frames of a reconstruction: shots from Blender's camera and objects, and compositor nodes for the frames."""

from .compositing import has_frames, set_up_compositor, show_frames
from .shot import shot_of

__all__ = ["has_frames", "set_up_compositor", "shot_of", "show_frames"]
