# SPDX-License-Identifier: GPL-3.0-or-later
"""Scene settings for accurate renders of splats."""

from __future__ import annotations

from collections import Counter
from typing import Any

import bpy
from mathutils import Matrix

from ....backend.shared.errors import InputError
from ..cameras import use_camera, use_size
from ..kinds import CAMERA, FILM, KIND, SPLATS, capture_of, kind_of

VIEW_TRANSFORM = "Standard"
BOUNCES = 1024
"""Transparent bounces in Cycles; each splat in front of others needs one."""
FEWEST_BOUNCES = 64
"""With fewer, rays end in front of what is behind many splats, which then is black."""

SAMPLES = 256
"""Samples in Cycles in place of Blender's default, which is for light that bounces; splats emit theirs."""

WORKING_SPACE = "Linear Rec.709"
"""Color space of the splats' linear colors, which Blender takes for colors of its working space."""

SAME_PLACE = 1e-5
"""Largest difference between the matrices of instances and originals at the same place."""

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
    """Return a sentence about settings that `set_up_render` corrects for renders of a reconstruction; None if none is.

    Renders show a reconstruction that is hidden in them where the compositor shows its film frames.
    """
    if root.hide_render and not has_frames(scene):
        return None
    if scene.camera is None:
        return "The scene has no camera."
    transform = scene.view_settings.view_transform
    if transform != VIEW_TRANSFORM:
        return f"The view transform {transform} changes the colors of the photos."
    if (
        not root.hide_render
        and scene.render.engine == "CYCLES"
        and scene.cycles.transparent_max_bounces < FEWEST_BOUNCES
    ):
        count = scene.cycles.transparent_max_bounces
        return f"Rays pass through at most {count} splats, which leaves black fringes."
    return None


def scene_problems(scene: bpy.types.Scene, root: bpy.types.Collection) -> list[str]:
    """Return sentences about what makes Blender render a reconstruction wrongly and `set_up_render` does not change."""
    if root.hide_render:
        return []
    found = []
    camera, instance = scene.camera, _moved_instance(scene)
    if camera is not None and camera.type == "CAMERA" and camera.data.type == "ORTHO":
        found.append(f"{camera.name} is orthographic, for which splats are too narrow; set its Type to Perspective.")
    if instance is not None:
        found.append(
            f"{instance.name} is an instance, whose splats F12 turns wrongly; use Object > Apply > "
            "Make Instances Real, or film frames."
        )
    if hasattr(bpy.data, "colorspace") and bpy.data.colorspace.working_space != WORKING_SPACE:  # Blender 5.0 and newer
        found.append(
            f"The working space {bpy.data.colorspace.working_space} changes the colors of splats; set it to "
            f"{WORKING_SPACE} in Render Properties > Color Management."
        )
    return found


def compositor_of(scene: bpy.types.Scene) -> Any:
    """Return the scene's compositor node tree, or None."""
    return scene.compositing_node_group if hasattr(scene, "compositing_node_group") else scene.node_tree


def frames_node(tree: Any) -> Any:
    """Return the node of a compositor node tree that reads film frames; None without it, or without a tree."""
    nodes = tree.nodes if tree is not None else ()
    return next((node for node in nodes if node.get(KIND) == FILM and node.type == "IMAGE"), None)


def has_frames(scene: bpy.types.Scene) -> bool:
    """Return whether the scene's compositor shows film frames."""
    return frames_node(compositor_of(scene)) is not None


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


def _moved_instance(scene: bpy.types.Scene) -> bpy.types.Object | None:
    """Return an instance of a collection with splats at another place than theirs, or None.

    Modifiers, which turn splats to the camera, run at the place of the original.
    """
    instanced = _used_with_splats()
    for obj in scene.objects if instanced else ():  # Panels ask in each redraw, also of a scene with many objects.
        collection = obj.instance_collection if obj.instance_type == "COLLECTION" else None
        if collection in instanced and not obj.hide_render:
            moved = obj.matrix_world @ Matrix.Translation(-collection.instance_offset) - Matrix.Identity(4)
            if max(abs(value) for row in moved for value in row) > SAME_PLACE:
                return obj
    return None


def _used_with_splats() -> set[bpy.types.Collection]:
    """Return the collections with splats that have other users, as instances are, than what links or activates them."""
    above = (*bpy.data.collections, *(scene.collection for scene in bpy.data.scenes))
    links = Counter(child for collection in above for child in collection.children)
    settings = (getattr(scene, "objectgs", None) for scene in bpy.data.scenes)  # None if nothing is registered
    links.update(each.active for each in settings if each is not None and each.active is not None)
    used = [collection for collection in bpy.data.collections if collection.users > links[collection]]
    return {collection for collection in used if any(kind_of(part) == SPLATS for part in collection.all_objects)}
