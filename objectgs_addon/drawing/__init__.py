# SPDX-License-Identifier: GPL-3.0-or-later
"""Drawing of Gaussian splats in the 3D viewports: sorted, alpha-blended, with view-dependent colors.

`gather` lists the objects to draw, `splat_arrays` caches their splats as arrays, `detail` has their levels of detail
built, `entries` chooses those for a view, `order` sorts them, `renderer` draws them with the shaders in `shaders`, and
`viewport` composites the result over the viewports.
"""

from .gather import collections_by_part, placed_parts, shown, splat_parts
from .splat_arrays import selected_of, selection_changed, show_labels, splats_changed
from .viewport import failure, picture, point_at, redraw, register, switch, unregister

__all__ = [
    "collections_by_part",
    "failure",
    "picture",
    "placed_parts",
    "point_at",
    "redraw",
    "register",
    "selected_of",
    "selection_changed",
    "show_labels",
    "shown",
    "splat_parts",
    "splats_changed",
    "switch",
    "unregister",
]
