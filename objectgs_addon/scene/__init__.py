# SPDX-License-Identifier: GPL-3.0-or-later
"""A reconstruction folder as collections, cameras, points and splats in Blender. bpy and NumPy only, no operators."""

from .cameras import use_camera
from .capture import show_capture, warnings_of
from .carrier import require_object_mode
from .copies import duplicate, remove_copy
from .edits import is_removed, recolour, reset_place, show_edits, store_places
from .fills import INVENTED_COUNT, invented_splats, missing_fill, show_fills
from .floaters import hidden_splats
from .kinds import (
    collection_of,
    copies_of,
    folder_of,
    from_stored,
    kind_of,
    object_collections,
    object_id_of,
    parts_of,
    root_of,
    to_stored,
)
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
from .objects_file import Objects
from .orientation import orient_to_ground, scale_to_distance
from .places import into_capture, into_world, moved_by, place_of
from .points import colour_points_by
from .preview import prepare_render
from .recolouring import luma_of, recolour_of, with_own_textures
from .result import Shown, result_is_newer, show_objects, show_result

__all__ = [
    "INVENTED_COUNT", "SHOWS", "Objects", "Shown", "ShownMeshes", "bounds", "collection_of", "colour_points_by",
    "copies_of", "duplicate", "folder_of", "from_stored", "has_shown_meshes", "hidden_splats", "into_capture",
    "into_world", "invented_splats", "is_removed", "kind_of", "luma_of", "mark_asset", "missing_fill", "moved_by",
    "object_collections", "object_id_of", "object_meshes", "orient_to_ground", "parts_of", "place_of",
    "prepare_render", "recolour", "recolour_of", "remove_copy", "require_object_mode", "reset_place",
    "result_is_newer", "root_of", "scale_to_distance", "scene_meshes", "show_capture", "show_edits", "show_fills",
    "show_kinds", "show_meshes", "show_objects", "show_result", "shown_kinds", "store_places", "to_stored",
    "use_camera", "warnings_of", "with_own_textures",
]
