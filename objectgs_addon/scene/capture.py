# SPDX-License-Identifier: GPL-3.0-or-later
"""The collection of a reconstruction with its capture: parent empty, cameras and points."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix

from ...backend.shared.errors import InputError
from ...backend.shared.formats.photos_source import read_photo_errors
from ...backend.shared.reconstruction.cameras import read_cameras
from . import carrier
from .cameras import has_size, show_cameras, use_camera, use_size, widen_clipping
from .edits.axes import put_below, renew_axes
from .kinds import (
    CAMERA,
    CAPTURE,
    MESH,
    OBJECT_PARENT,
    PARENT,
    POINTS,
    RECONSTRUCTION,
    adopt,
    capture_of,
    folder_of,
    is_linked,
    kind_of,
    link_folder,
    mark,
    object_id_of,
    parent_of,
    points_of,
)
from .object_display import Objects
from .points import read_points, show_points
from .uncertain_cameras import mark_uncertain

ORIGIN = "objectgs_origin"
UPRIGHT = "objectgs_upright"
WARNINGS = "objectgs_warnings"

_LAYER_FLAGS = ("exclude", "hide_viewport", "holdout", "indirect_only")


def show_capture(
    scene: bpy.types.Scene, folder: Path, root: bpy.types.Collection | None = None, name: str | None = None
) -> bpy.types.Collection:
    """Show the cameras and points of a reconstruction folder.

    Args:
        scene: the scene that receives a new collection.
        folder: the reconstruction folder.
        root: collection to update; by default the scene's collection of the same folder, or else a new one.
        name: name of a new collection; by default the folder's name.

    Returns:
        The reconstruction's collection.

    Raises:
        InputError: The folder's files cannot be used, or the points are in Edit Mode; nothing is changed.
    """
    folder = Path(os.path.abspath(folder))  # noqa: PTH100 - without links resolved, as `folder_of` returns it
    if any("\ud800" <= character <= "\udfff" for character in str(folder)):
        raise InputError(f"{str(folder)!r} is not valid Unicode, which Blender cannot store; rename the folder.")
    cameras = read_cameras(folder)
    points = read_points(folder)
    objects = Objects.read(folder)
    if root is None:
        root = next(
            (
                child
                for child in scene.collection.children_recursive
                if kind_of(child) == RECONSTRUCTION and not is_linked(child) and folder_of(child) == folder
            ),
            None,
        )
    if root is not None:
        carrier.require_object_mode([points_of(root)])

    is_new = root is None
    if root is None:
        root = bpy.data.collections.new(name or folder.name)
        mark(root, RECONSTRUCTION)
    link_folder(root, folder)
    root[ORIGIN] = cameras.origin.tolist()
    parent = _stand_up(root, cameras.upright, cameras.views)
    capture = capture_of(root)
    new_capture = capture is None
    if capture is None:
        capture = bpy.data.collections.new(f"{root.name} capture")
        mark(capture, CAPTURE)
        adopt(capture, root, (CAMERA, POINTS))
    before = {part.session_uid for part in capture.objects}
    shot = scene.camera if scene.camera is not None and kind_of(scene.camera) == CAMERA else None
    follows_photo = shot is not None and has_size(scene, shot)
    root[WARNINGS] = "\n".join(show_cameras(capture, parent, cameras))
    mark_uncertain(capture, {} if cameras.capture is None else read_photo_errors(cameras.capture))
    show_points(capture, parent, f"{root.name} points", points, cameras.origin, objects)

    # Linked last, since Blender updates all view layers for each link below a scene.
    if new_capture:
        root.children.link(capture)
    if is_new or not any(root in other.collection.children_recursive for other in bpy.data.scenes):
        scene.collection.children.link(root)
    ours = [obj for obj in capture.objects if kind_of(obj) == CAMERA]
    widen_clipping(root, [camera.data for camera in ours if camera.session_uid not in before])
    if ours and scene.camera is None:
        use_camera(scene, min(ours, key=lambda obj: obj["objectgs_image"]))
    elif scene.camera in ours and follows_photo:
        use_size(scene, scene.camera)
    return root


def put_capture_last(root: bpy.types.Collection) -> None:
    """Move the capture behind the other collections in the outliner; visibility and selection are kept."""
    capture = capture_of(root)
    if capture is None or capture not in root.children[:-1]:
        return
    owners = [scene for scene in bpy.data.scenes if root in scene.collection.children_recursive]
    before = [[getattr(layer, name) for name in _LAYER_FLAGS] for layer in _layer_collections(owners, capture)]
    # While another collection contains the objects, view layers keep what is selected and hidden.
    holder = bpy.data.collections.new(capture.name)
    holder.children.link(capture)
    for scene in owners:
        scene.collection.children.link(holder)
    root.children.unlink(capture)
    root.children.link(capture)
    bpy.data.collections.remove(holder)
    for layer, flags in zip(_layer_collections(owners, capture), before):
        for name, value in zip(_LAYER_FLAGS, flags):
            if getattr(layer, name) != value:
                setattr(layer, name, value)


def _layer_collections(
    scenes: list[bpy.types.Scene], collection: bpy.types.Collection
) -> list[bpy.types.LayerCollection]:
    """Return the layer collections of a collection in all view layers of scenes."""
    above = [layer.layer_collection for scene in scenes for layer in scene.view_layers]
    found = []
    while above:
        layer = above.pop()
        if layer.collection == collection:
            found.append(layer)
        above.extend(reversed(layer.children))
    return found


def warnings_of(root: bpy.types.Collection) -> list[str]:
    """Return the camera warnings of the last `show_capture`."""
    text = root.get(WARNINGS, "")
    return text.split("\n") if text else []


def origin_of(root: bpy.types.Collection) -> np.ndarray:
    """Return the (3,) origin that is subtracted from the capture's coordinates."""
    return np.array(root.get(ORIGIN, (0.0, 0.0, 0.0)), np.float64)


def capture_to_world(root: bpy.types.Collection) -> np.ndarray:
    """Return the (4, 4) map from the capture's coordinates to the world, where objects that are not moved are."""
    parent = parent_of(root)
    world = np.eye(4) if parent is None else np.array(parent.matrix_world, np.float64)
    world[:3, 3] -= world[:3, :3] @ origin_of(root)
    return world


def _stand_up(root: bpy.types.Collection, upright: np.ndarray, views: Any) -> bpy.types.Object:
    """Return the parent empty, created if missing and set to `upright` unless the user has moved it."""
    parent = parent_of(root)
    wanted = Matrix(upright.tolist())
    if parent is None:
        parent = bpy.data.objects.new(root.name, None)
        mark(parent, PARENT)
        parent.empty_display_type = "ARROWS"
        centers = np.array([-view.viewmat[:3, :3].T @ view.viewmat[:3, 3] for view in views]).reshape(-1, 3)
        parent.empty_display_size = 0.05 * float(np.linalg.norm(np.ptp(centers, axis=0))) if len(centers) > 1 else 1.0
        root.objects.link(parent)
        for obj in root.all_objects:
            of_all = kind_of(obj) == MESH and object_id_of(obj) is None
            if obj.parent is None and (of_all or kind_of(obj) in (CAMERA, POINTS, OBJECT_PARENT)):
                put_below(obj, parent)
    elif list(parent.get(UPRIGHT, ())) != _numbers(parent.matrix_basis):
        return parent
    parent.matrix_basis = wanted
    parent[UPRIGHT] = _numbers(parent.matrix_basis)
    renew_axes(root, parent)
    return parent


def _numbers(matrix: Matrix) -> list[float]:
    return [value for row in matrix for value in row]
