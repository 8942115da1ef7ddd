"""Defaults that the command line and Blender's panels have in common."""

MAX_SIZE = 1600
"""Longer side, in pixels, that images are reduced to."""
