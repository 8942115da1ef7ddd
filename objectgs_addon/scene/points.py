# SPDX-License-Identifier: GPL-3.0-or-later
"""The capture's point cloud: a mesh carrier whose vertices are shown as points in one of two colorings."""

from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np

from ...backend.shared.errors import InputError
from ...backend.shared.formats.points_ply import LabeledPoints, read_shown_points
from ...backend.shared.reconstruction.folder import Reconstruction
from ...backend.shared.splats.floaters import far
from . import carrier
from .kinds import POINTS, kind_of, mark, part_of, points_of
from .object_display import Objects, linear_colors
from .shading.materials import points_material
from .shading.modifiers import modifier_of, set_input
from .shading.node_groups import FLOATING, POINTS_GROUP, points_group

SIZE = 0.004
"""Radius of a point relative to the diagonal of the box around the 5th to 95th percentiles of the points."""

COLORINGS = ("photo", "object")


def read_points(folder: Path) -> LabeledPoints:
    """Return the labeled points of a reconstruction folder.

    Raises:
        InputError: points.ply is missing or lacks required properties.
    """
    path = Reconstruction(folder).points
    if not path.is_file():
        raise InputError(f"{folder} has no points.ply; use Import Capture again.")
    return read_shown_points(path)


def point_numbers(folder: Path) -> np.ndarray:
    """Return the numbers (M,) of the points of a reconstruction folder, which are those of the shown vertices."""
    return np.arange(len(read_points(folder).xyz))


def show_points(
    capture: bpy.types.Collection,
    parent: bpy.types.Object,
    name: str,
    points: LabeledPoints,
    origin: np.ndarray,
    objects: Objects,
) -> None:
    """Create or update the Blender object of the point cloud in `capture`."""
    positions = points.xyz - origin
    obj = part_of(capture, POINTS)
    if obj is None:
        mesh = bpy.data.meshes.new(name)
        obj = bpy.data.objects.new(name, mesh)
        mark(obj, POINTS)
        obj.parent = parent
        obj.hide_render = True
        mesh.materials.append(points_material())
        modifier = obj.modifiers.new("ObjectGS Points", "NODES")
        modifier.node_group = points_group()
        set_input(modifier, "Size", SIZE * _diagonal(positions))
        set_input(modifier, "Material", mesh.materials[0])
        capture.objects.link(obj)
    active = obj.data.attributes.active_color_name
    carrier.fill(
        obj.data,
        positions,
        {
            "photo": ("FLOAT_COLOR", linear_colors(points.rgb)),
            "object": ("FLOAT_COLOR", objects.colors(points.ids)),
            "object_id": ("INT", carrier.stored_ids(points.ids)),
            "margin": ("FLOAT", points.margins),
            FLOATING: ("BOOLEAN", far(positions)),
        },
    )
    _activate(obj, active if active in COLORINGS else "photo")


def paint_points(root: bpy.types.Collection, objects: Objects) -> bool:
    """Show the colors of the objects on the points that are shown, without reading points.ply.

    Returns:
        False if there are no points, or if they do not have the IDs of their objects.

    Raises:
        InputError: The points are in Edit Mode.
    """
    obj = points_of(root)
    carrier.require_object_mode([obj])
    if obj is None or not carrier.has(obj.data, "object_id", "INT"):
        return False
    colors = objects.colors(carrier.read_ids(obj.data, "object_id"))
    if not carrier.has(obj.data, "object", "FLOAT_COLOR") or not np.array_equal(
        carrier.read(obj.data, "object"), colors
    ):
        carrier.write(obj.data, "object", "FLOAT_COLOR", colors)
        obj.data.update()
    return True


def shown_points(view_layer: bpy.types.ViewLayer, space: bpy.types.SpaceView3D) -> Iterator[bpy.types.Object]:
    """Yield the point clouds that a view layer shows in one of its viewports."""
    for obj in view_layer.objects:
        if kind_of(obj) == POINTS and obj.visible_get(view_layer=view_layer, viewport=space):
            yield obj


def color_points_by(root: bpy.types.Collection, by: str) -> None:
    """Color the point cloud by its photos ("photo") or its objects ("object")."""
    if by not in COLORINGS:
        raise ValueError(f"points cannot be colored by {by}")
    obj = points_of(root)
    if obj is None:
        return
    modifier = modifier_of(obj, POINTS_GROUP)
    if modifier is not None:
        set_input(modifier, "By Object", by == "object")
    if by in obj.data.attributes:
        _activate(obj, by)
    obj.update_tag()


def _activate(obj: bpy.types.Object, by: str) -> None:
    """Set the active color attribute, which Solid mode shows when its color type is Attribute."""
    obj.data.attributes.active_color_name = by


def _diagonal(positions: np.ndarray) -> float:
    if len(positions) < 2:
        return 1.0
    low, high = np.percentile(positions, [5, 95], axis=0)
    return float(np.linalg.norm(high - low)) or 1.0
