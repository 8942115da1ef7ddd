# SPDX-License-Identifier: GPL-3.0-or-later
"""A reconstruction folder as collections, cameras, points and splats in Blender. bpy and NumPy only, no operators."""

from .cameras import use_camera
from .capture import show_capture, warnings_of
from .carrier import require_object_mode
from .kinds import folder_of, from_stored, kind_of, object_collections, object_id_of, parts_of, root_of, to_stored
from .meshes import (
    SHOWS,
    ShownMeshes,
    bounds,
    has_shown_meshes,
    mark_asset,
    object_meshes,
    scene_meshes,
    show_kinds,
    show_meshes,
    shown_kinds,
)
from .orientation import orient_to_ground, scale_to_distance
from .points import colour_points_by
from .preview import prepare_render
from .result import Shown, result_is_newer, show_objects, show_result

__all__ = [
    "SHOWS", "Shown", "ShownMeshes", "bounds", "colour_points_by", "folder_of", "from_stored", "has_shown_meshes",
    "kind_of", "mark_asset", "object_collections", "object_id_of", "object_meshes", "orient_to_ground", "parts_of",
    "prepare_render", "require_object_mode", "result_is_newer", "root_of", "scale_to_distance", "scene_meshes",
    "show_capture", "show_kinds", "show_meshes", "show_objects", "show_result", "shown_kinds", "to_stored",
    "use_camera", "warnings_of",
]
