# SPDX-License-Identifier: GPL-3.0-or-later
"""A reconstruction folder shown as collections, cameras, points and splats in Blender; contains no operators."""

from .cameras import use_camera, widen_clipping
from .capture import capture_to_world, show_capture, warnings_of
from .carrier import require_object_mode
from .edits.crop_box import add_crop_box, box_of, crop_box_of
from .edits.duplicates import duplicate, remove_duplicate
from .edits.fills import UNOBSERVED_COUNT, missing_fill, show_fills, unobserved_splats
from .edits.floaters import floater_counts, floating_splats, hidden_splats, update_floaters
from .edits.placement import (
    distance_moved,
    is_moved,
    matrix_of_root,
    matrix_to_capture,
    matrix_to_world,
    placement_of,
    reset_placement,
)
from .edits.recolor import luma_of, recolor_of, with_own_textures
from .edits.show import Places, is_removed, places_of, recolor, show_edits, shows_places, store_placements
from .edits.single_splats import (
    ShownEdits,
    delete_splats,
    deleted_splats,
    keys_of,
    remember_edits,
    select_splats,
    selected_splats,
    shown_edits,
)
from .kinds import (
    collection_of,
    duplicates_of,
    folder_of,
    from_stored,
    is_in_file,
    is_linked,
    kind_of,
    link_folder,
    object_collections,
    object_id_of,
    only_of,
    parts_of,
    root_of,
    to_stored,
)
from .meshes.assets import bounds, mark_asset, write_catalog
from .meshes.shading import shade_meshes, shading_of
from .meshes.show import (
    SHOWS,
    ShownMeshes,
    has_shown_meshes,
    meshes_are_newer,
    object_meshes,
    scene_meshes,
    show_kinds,
    show_meshes,
    shown_kinds,
)
from .object_display import Objects
from .orientation import orient_to_ground, scale_to_distance
from .points import color_points_by, point_numbers, shown_points
from .result import Shown, result_is_newer, show_label, show_objects, show_result
from .shading.materials import SHADINGS
from .shading.render_settings import (
    has_frames,
    is_untouched,
    prepare_render,
    render_problem,
    scene_problems,
    set_up_render,
)
from .splats import blur_of, splat_keys
from .uncertain_cameras import uncertain_cameras

__all__ = [
    "SHADINGS",
    "SHOWS",
    "UNOBSERVED_COUNT",
    "Objects",
    "Places",
    "Shown",
    "ShownEdits",
    "ShownMeshes",
    "add_crop_box",
    "blur_of",
    "bounds",
    "box_of",
    "capture_to_world",
    "collection_of",
    "color_points_by",
    "crop_box_of",
    "delete_splats",
    "deleted_splats",
    "distance_moved",
    "duplicate",
    "duplicates_of",
    "floater_counts",
    "floating_splats",
    "folder_of",
    "from_stored",
    "has_frames",
    "has_shown_meshes",
    "hidden_splats",
    "is_in_file",
    "is_linked",
    "is_moved",
    "is_removed",
    "is_untouched",
    "keys_of",
    "kind_of",
    "link_folder",
    "luma_of",
    "mark_asset",
    "matrix_of_root",
    "matrix_to_capture",
    "matrix_to_world",
    "meshes_are_newer",
    "missing_fill",
    "object_collections",
    "object_id_of",
    "object_meshes",
    "only_of",
    "orient_to_ground",
    "parts_of",
    "placement_of",
    "places_of",
    "point_numbers",
    "prepare_render",
    "recolor",
    "recolor_of",
    "remember_edits",
    "remove_duplicate",
    "render_problem",
    "require_object_mode",
    "reset_placement",
    "result_is_newer",
    "root_of",
    "scale_to_distance",
    "scene_meshes",
    "scene_problems",
    "select_splats",
    "selected_splats",
    "set_up_render",
    "shade_meshes",
    "shading_of",
    "show_capture",
    "show_edits",
    "show_fills",
    "show_kinds",
    "show_label",
    "show_meshes",
    "show_objects",
    "show_result",
    "shown_edits",
    "shown_kinds",
    "shown_points",
    "shows_places",
    "splat_keys",
    "store_placements",
    "to_stored",
    "uncertain_cameras",
    "unobserved_splats",
    "update_floaters",
    "use_camera",
    "warnings_of",
    "widen_clipping",
    "with_own_textures",
    "write_catalog",
]
