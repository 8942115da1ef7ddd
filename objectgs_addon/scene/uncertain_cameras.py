# SPDX-License-Identifier: GPL-3.0-or-later
"""Cameras whose poses, computed from photos alone, are less certain than those of the others."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import bpy

from ...backend.shared.formats.photos_source import PhotoError
from .kinds import CAMERA, kind_of

UNCERTAINTY, REASON = "uncertainty", "weak_because"
"""Properties of such cameras: from 0 to 1, and why the photo is weak, if it is."""
_FROM, _TO = 1.5, 3.0
"""Reprojection errors relative to the median photo's at which the uncertainty is 0 and 1; that of weak photos is 1."""


def mark_uncertain(capture: bpy.types.Collection, errors: Mapping[str, PhotoError]) -> None:
    """Store the uncertainty of the cameras in a capture's collection.

    Args:
        capture: the collection.
        errors: name of the photo -> its error; empty for captures whose poses are given.
    """
    known = sorted(each.pixels for each in errors.values())
    typical = known[len(known) // 2] if known else 0.0
    for obj in capture.objects:
        if kind_of(obj) != CAMERA:
            continue
        for name in (UNCERTAINTY, REASON):
            if name in obj:
                del obj[name]
        error = errors.get(obj["objectgs_image"])
        if error is None:
            continue
        excess = (error.pixels / typical - _FROM) / (_TO - _FROM) if typical > 0 else 0.0
        uncertainty = 1.0 if error.weak else min(max(excess, 0.0), 1.0)
        if uncertainty > 0:
            obj[UNCERTAINTY] = uncertainty
        if error.weak:
            obj[REASON] = error.weak


def uncertain_cameras(
    view_layer: bpy.types.ViewLayer, space: bpy.types.SpaceView3D | None
) -> Iterator[tuple[bpy.types.Object, float]]:
    """Yield the cameras with an uncertainty that a view layer or one of its viewports shows, and that uncertainty."""
    within = {} if space is None else {"viewport": space}
    for obj in view_layer.objects:
        if obj.type == "CAMERA" and UNCERTAINTY in obj and obj.visible_get(view_layer=view_layer, **within):
            yield obj, float(obj[UNCERTAINTY])
