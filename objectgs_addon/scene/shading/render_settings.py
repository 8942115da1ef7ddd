# SPDX-License-Identifier: GPL-3.0-or-later
"""Settings of a scene for faithful renders of splats."""

from __future__ import annotations

import bpy


def prepare_render(scene: bpy.types.Scene) -> None:
    """Render colors as they were captured, and let rays pass many splats.

    Changes the scene's view transform and Cycles' bounces, so it is never called for a user's own scene.
    """
    scene.view_settings.view_transform = "Standard"
    scene.view_settings.look = "None"
    scene.view_settings.exposure = 0.0
    scene.view_settings.gamma = 1.0
    if hasattr(scene, "cycles"):
        scene.cycles.transparent_max_bounces = 1024
        scene.cycles.max_bounces = max(scene.cycles.max_bounces, 4)
