"""Defaults shared by the command line and Blender's panels."""

MAX_SIZE = 1600
"""Length of the longer side, in pixels, to which larger images are reduced."""
