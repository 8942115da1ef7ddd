# SPDX-License-Identifier: GPL-3.0-or-later
"""Scene settings for accurate renders of splats."""

from __future__ import annotations

import bpy


def prepare_render(scene: bpy.types.Scene) -> None:
    """Set up a scene to render the captured colors and let rays pass through many splats.

    Do not call it for a user's own scene, since it changes the view transform and the Cycles bounces.
    """
    scene.view_settings.view_transform = "Standard"
    scene.view_settings.look = "None"
    scene.view_settings.exposure = 0.0
    scene.view_settings.gamma = 1.0
    if hasattr(scene, "cycles"):
        scene.cycles.transparent_max_bounces = 1024
        scene.cycles.max_bounces = max(scene.cycles.max_bounces, 4)
