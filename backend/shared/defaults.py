"""Defaults shared by the command line and Blender's panels."""

MAX_SIZE = 1600
"""Length of the longer side, in pixels, to which larger images are reduced."""

DETAIL = 0.45
"""How finely scenes are divided into suggested objects: the fraction of the trials that must agree on two being one."""

OVERLAP = 0.2
"""How far cells of a divided model reach into each other, relative to their size."""
