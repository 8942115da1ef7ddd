# SPDX-License-Identifier: GPL-3.0-or-later
"""Gaussian splats in the 3D viewports as they are: sorted, blended, and with the colours of the direction.

`order` sorts, `renderer` draws arrays with the programs in `shaders`, `gather` makes arrays of Blender's objects, and
`viewport` draws in the viewports.
"""

from .gather import owners, shown, splat_parts
from .viewport import picture, point_at, redraw, register, show, trouble, unregister

__all__ = [
    "owners", "picture", "point_at", "redraw", "register", "show", "shown", "splat_parts", "trouble",
    "unregister",
]
