# SPDX-License-Identifier: GPL-3.0-or-later
"""Film frames of a reconstruction: Blender's camera and objects as a shot, and the compositor nodes that combine the
frames with Blender's own rendering."""

from .compositing import has_frames, set_up_compositor, show_frames
from .shot import shot_of

__all__ = ["has_frames", "set_up_compositor", "shot_of", "show_frames"]
