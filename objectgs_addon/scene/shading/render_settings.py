# SPDX-License-Identifier: GPL-3.0-or-later
"""Scene settings for accurate renders of splats."""

from __future__ import annotations

import bpy

from ....backend.shared.errors import InputError
from ..cameras import use_camera, use_size
from ..kinds import CAMERA, capture_of, kind_of

VIEW_TRANSFORM = "Standard"
BOUNCES = 1024
"""Transparent bounces in Cycles; each splat in front of others needs one."""
FEWEST_BOUNCES = 64
"""With fewer, rays end in front of what is behind many splats, which then is black."""

SAMPLES = 256
"""Samples in Cycles in place of Blender's default, which is for light that bounces; splats emit theirs."""

_STARTUP_OBJECTS = {"Camera", "Cube", "Light"}
_STARTUP_VIEW = ("AgX", "None", 0.0, 1.0)
_STARTUP_SIZE = (1920, 1080, 100, 1.0, 1.0)
_STARTUP_BOUNCES = 8
_STARTUP_SAMPLES = 4096


def prepare_render(scene: bpy.types.Scene) -> None:
    """Set up a scene to render the captured colors and let rays pass through many splats.

    Do not call it for a user's own scene without being asked, since it changes the view transform and the Cycles
    bounces.

    Raises:
        InputError: Blender's color configuration lacks the view transform.
    """
    view = scene.view_settings
    try:
        view.view_transform = VIEW_TRANSFORM
    except TypeError as error:
        raise InputError(
            f"The color configuration has no view transform {VIEW_TRANSFORM}, which shows the colors of the photos; "
            "start Blender without OCIO in its environment, or choose a similar one in Render Properties."
        ) from error
    view.look, view.exposure, view.gamma = "None", 0.0, 1.0
    if hasattr(scene, "cycles"):
        scene.cycles.transparent_max_bounces = BOUNCES
        scene.cycles.max_bounces = max(scene.cycles.max_bounces, 4)
        if scene.cycles.samples == _STARTUP_SAMPLES:
            scene.cycles.samples = SAMPLES


def set_up_render(
    scene: bpy.types.Scene, root: bpy.types.Collection, active: bpy.types.Object | None = None, replace: bool = False
) -> bpy.types.Object | None:
    """Call `prepare_render`, and use the size of a capture camera's photo.

    Args:
        scene: the scene.
        root: the reconstruction's collection.
        active: an object; if it is a camera of the reconstruction, it becomes the scene's camera.
        replace: also replace another camera of the scene by the first one of the capture. Otherwise it is kept.

    Returns:
        The capture camera whose size is used, or None if the capture has no cameras.
    """
    prepare_render(scene)
    ours = _cameras(root)
    if not ours:
        return None
    chosen = active if active in ours else scene.camera if scene.camera in ours else ours[0]
    if replace or chosen == active or scene.camera is None:
        use_camera(scene, chosen)
    else:
        use_size(scene, chosen)
    return chosen


def render_problem(scene: bpy.types.Scene, root: bpy.types.Collection) -> str | None:
    """Return a sentence about what is wrong with the settings for renders of a reconstruction; None if nothing is."""
    if root.hide_render:
        return None
    if scene.camera is None:
        return "The scene has no camera."
    transform = scene.view_settings.view_transform
    if transform != VIEW_TRANSFORM:
        return f"The view transform {transform} changes the colors of the photos."
    if scene.render.engine == "CYCLES" and scene.cycles.transparent_max_bounces < FEWEST_BOUNCES:
        count = scene.cycles.transparent_max_bounces
        return f"Rays pass through at most {count} splats, which leaves black fringes."
    return None


def camera_problem(scene: bpy.types.Scene, root: bpy.types.Collection) -> str | None:
    """Return a sentence about a camera through which a reconstruction is rendered wrongly; None if there is none."""
    camera = scene.camera
    if root.hide_render or camera is None or camera.type != "CAMERA" or camera.data.type != "ORTHO":
        return None
    return f"{camera.name} is orthographic, for which splats are too narrow; set its Type to Perspective."


def is_untouched(scene: bpy.types.Scene) -> bool:
    """Return whether a scene is Blender's startup scene, in a file that has never been saved."""
    view, render = scene.view_settings, scene.render
    size = render.resolution_x, render.resolution_y, render.resolution_percentage
    return (
        not bpy.data.filepath
        and len(bpy.data.scenes) == 1
        and {obj.name for obj in scene.objects} <= _STARTUP_OBJECTS
        and (view.view_transform, view.look, view.exposure, view.gamma) == _STARTUP_VIEW
        and (*size, render.pixel_aspect_x, render.pixel_aspect_y) == _STARTUP_SIZE
        and (not hasattr(scene, "cycles") or scene.cycles.transparent_max_bounces == _STARTUP_BOUNCES)
    )


def _cameras(root: bpy.types.Collection) -> list[bpy.types.Object]:
    """Return the cameras of a capture, in the order of their photos."""
    capture = capture_of(root)
    cameras = [obj for obj in capture.objects if kind_of(obj) == CAMERA] if capture is not None else []
    return sorted(cameras, key=lambda obj: obj["objectgs_image"])
