# SPDX-License-Identifier: GPL-3.0-or-later
"""What film frames lack of Blender's renders, and what renders show of a reconstruction beside its film frames."""

from __future__ import annotations

import bpy

from ...backend.shared.reconstruction.shot import Shot
from .instances import instances_of, layer_paths

_MOST_NAMES = 5


def ignored_settings(scene: bpy.types.Scene, camera: bpy.types.Object | None = None) -> str | None:
    """Return a sentence about settings of Blender's renders that film frames do not have; None if there are none.

    camera: as for `shot_of`.
    """
    render = scene.render
    cameras = [camera] if camera else [scene.camera, *(marker.camera for marker in scene.timeline_markers)]
    blurred = {each.name for each in cameras if each is not None and each.type == "CAMERA" and each.data.dof.use_dof}
    found = [f"the depth of field of {name}" for name in sorted(blurred)]
    if render.use_border and render.use_crop_to_border:
        found.append("Crop to Render Region")
    if render.use_multiview:
        found.append("Stereoscopy")
    if _has_holdouts(scene):
        found.append("Holdout")
    words = [", ".join(found[:-1]), *found[-1:]]
    return f"Film frames of splats are rendered without {' and '.join(filter(None, words))}." if found else None


def empty_frames(shot: Shot, view_layer: bpy.types.ViewLayer, root: bpy.types.Collection) -> str | None:
    """Return a sentence if a shot of a reconstruction has no objects in any frame; None if it has some."""
    if any(sample.objects for frame in shot.frames for sample in frame.samples):
        return None
    return (
        f"Nothing of {root.name} is shown in renders of the view layer {view_layer.name}, so the film frames are "
        "empty; check what is excluded or hidden in the Outliner."
    )


def rendered_twice(scene: bpy.types.Scene, view_layer: bpy.types.ViewLayer, root: bpy.types.Collection) -> str | None:
    """Return a sentence about what renders show of a hidden reconstruction beside its film frames; None for nothing.

    Instances and collections outside the reconstruction's are not hidden with it.
    """
    names = {
        (instance.instancer or instance.pivot).name
        for instance in instances_of(scene, root, layer_paths(view_layer))
        if instance.is_seen() and not (instance.instancer and _contains(instance.instancer.instance_collection, root))
    }
    if not names:
        return None
    some = ", ".join(sorted(names)[:_MOST_NAMES]) + (", ..." if len(names) > _MOST_NAMES else "")
    return f"Renders show these twice, since they are outside the collection {root.name}: {some}; move them into it."


def _has_holdouts(scene: bpy.types.Scene) -> bool:
    if any(obj.is_holdout and not obj.hide_render for obj in scene.objects):
        return True
    found = (paths for view_layer in scene.view_layers for paths in layer_paths(view_layer).values())
    return any(path[-1].holdout and not path[-1].exclude for paths in found for path in paths)


def _contains(collection: bpy.types.Collection, other: bpy.types.Collection) -> bool:
    return other == collection or other in collection.children_recursive
