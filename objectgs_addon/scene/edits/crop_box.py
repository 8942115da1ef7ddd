# SPDX-License-Identifier: GPL-3.0-or-later
"""The empty that shows the box to which the scene will be cropped."""

from __future__ import annotations

import bpy
import numpy as np
from mathutils import Matrix

from ....backend.shared.errors import InputError
from ....backend.shared.reconstruction.objects import Matrix as Rows
from ....backend.shared.reconstruction.objects import affine_map
from .. import carrier
from ..capture import origin_of
from ..kinds import CROP_BOX, OBJECT_PARENT, SPLATS, mark, object_collections, part_of, require_parent
from ..object_collection import center_of
from .placement import matrix_to_capture, matrix_to_world
from .single_splats import deleted_splats, selected_splats

COVERS = (1.0, 99.0)
"""Percentiles of the splats' positions along each axis that a new box reaches to."""


def crop_box_of(root: bpy.types.Collection) -> bpy.types.Object | None:
    """Return the crop box of a reconstruction, or None."""
    return part_of(root, CROP_BOX)


def add_crop_box(root: bpy.types.Collection, box: Rows | None) -> bpy.types.Object:
    """Add a crop box, or return the one that is there.

    Args:
        root: the reconstruction's collection.
        box: its map (4, 4) from the cube of -1 to 1 to capture coordinates; None for one in the axes of the world,
            around the selected splats or, if there are none, around those of all objects without outliers. Without
            objects it is around the background.

    Raises:
        InputError: The user deleted the reconstruction's parent empty, or there are no splats.
    """
    obj = crop_box_of(root)
    if obj is not None:
        return obj
    parent = require_parent(root)
    if box is None:
        local = np.linalg.inv(matrix_to_world(parent)) @ _around(root, matrix_to_world(parent))
    else:
        local = np.array(box)
        local[:3, 3] -= origin_of(root)
    obj = bpy.data.objects.new("Crop Box", None)
    mark(obj, CROP_BOX)
    obj.empty_display_type, obj.empty_display_size = "CUBE", 1.0
    obj.parent = parent
    needed = Matrix(local.tolist())
    obj.matrix_basis = needed
    if box is not None:
        # The rest, such as the shear of a box that was turned in a scaled parent.
        obj.matrix_parent_inverse = needed @ obj.matrix_basis.inverted()
    root.objects.link(obj)
    return obj


def box_of(root: bpy.types.Collection, obj: bpy.types.Object) -> Rows:
    """Return the map (4, 4) from the cube of -1 to 1 to capture coordinates that a crop box shows.

    Raises:
        InputError: The box has no volume.
    """
    try:
        return affine_map(matrix_to_capture(root, obj))
    except ValueError as error:
        raise InputError(f"{obj.name} has no volume; scale it up") from error


def _around(root: bpy.types.Collection, to_world: np.ndarray) -> np.ndarray:
    """Return the map (4, 4) from the cube of -1 to 1 to a box of the world around captured splats."""
    places, selected, is_object = [np.zeros((0, 3))], [np.zeros(0, bool)], [np.zeros(0, bool)]
    for object_id, collection in object_collections(root).items():
        part = part_of(collection, SPLATS)
        if part is not None:
            shown = ~deleted_splats(part.data)
            pivot = part_of(collection, OBJECT_PARENT)
            center = center_of(pivot) if pivot is not None else np.zeros(3)
            places.append(carrier.read(part.data, "position")[shown] + center)
            selected.append(selected_splats(part.data)[shown])
            is_object.append(np.full(int(shown.sum()), object_id != 0))
    points, chosen, of_objects = (np.concatenate(each) for each in (places, selected, is_object))
    if not len(points):
        raise InputError("There are no splats to crop")
    around = chosen if chosen.any() else of_objects if of_objects.any() else ~of_objects
    points = points[around] @ to_world[:3, :3].T + to_world[:3, 3]
    low, high = (points.min(0), points.max(0)) if chosen.any() else np.percentile(points, COVERS, axis=0)
    size = np.maximum(0.5 * (high - low), 1e-3 * max(float((high - low).max()), 1e-3))
    box = np.diag([*size, 1.0])
    box[:3, 3] = 0.5 * (low + high)
    return box
