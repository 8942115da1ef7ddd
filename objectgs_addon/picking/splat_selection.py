# SPDX-License-Identifier: GPL-3.0-or-later
"""Selection of single splats: by regions of a viewport, and by what is selected already.

Only splats that are shown can be selected, and none of those that fill a hole, since they are computed anew. The
duplicates of an object share its splats and their selection.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import bpy
import numpy as np

from ...backend.shared.splats.picking import Cloud, PickObject, View, pick
from ...backend.shared.splats.regions import away_from_others, in_region, in_sphere, near_selected, to_camera
from ...backend.shared.splats.visibility import VISIBLE, Occlusion
from .. import drawing, scene
from ..drawing.splat_arrays import SplatArrays, arrays_of

SURFACE = 2.0
"""Thickness of a splat's surface relative to its largest scale; other splats of the surface do not hide it."""
GROWS_BY = 3.0
"""Distance by which the selection grows if none is given, relative to the median scale of the shown splats."""

Test = Callable[[SplatArrays, np.ndarray], np.ndarray]
"""Returns which of the visible splats of a carrier, placed by a matrix (4, 4), are meant: (N,) bool."""


def editable_parts(
    root: bpy.types.Collection, view_layer: bpy.types.ViewLayer, space: bpy.types.SpaceView3D | None = None
) -> list[bpy.types.Object]:
    """Return the carriers of a reconstruction whose splats are shown in a view layer, or in one of its viewports."""
    own = set(root.all_objects)
    own.update(obj for collection in scene.object_collections(root).values() for obj in collection.objects)
    return [
        part
        for part in drawing.splat_parts(view_layer, space)
        if part in own and part.data.library is None and not part.hide_select and arrays_of(part.data) is not None
    ]


def select(parts: Sequence[bpy.types.Object], test: Test, mode: str) -> int:
    """Select splats.

    Args:
        parts: the carriers of `editable_parts`.
        test: which splats are meant.
        mode: "SET", "ADD" or "SUBTRACT".

    Returns:
        The number of selected splats.

    Raises:
        InputError: A carrier is in Edit Mode.
    """
    scene.require_object_mode(parts)
    meant: dict[bpy.types.Mesh, np.ndarray] = {}
    for part in parts:
        arrays = arrays_of(part.data)
        found = test(arrays, np.array(part.matrix_world))
        meant[part.data] = meant[part.data] | found if part.data in meant else found
    count = 0
    for mesh, found in meant.items():
        before = scene.selected_splats(mesh)
        now = np.zeros(len(before), bool)
        vertices = arrays_of(mesh).vertices
        now[slice(None) if vertices is None else vertices] = found
        now &= ~scene.unobserved_splats(mesh)
        if mode != "SET":
            now = before | now if mode == "ADD" else before & ~now
        if not np.array_equal(now, before):
            scene.select_splats(mesh, now)
            drawing.selection_changed(mesh)
        count += int(now.sum())
    drawing.redraw()
    return count


def everything(arrays: SplatArrays, _matrix: np.ndarray) -> np.ndarray:
    """Select all splats: a test for `select`."""
    return np.ones(len(arrays.means), bool)


def within(view: View, region: np.ndarray) -> Test:
    """Return a test for the splats whose centers are in a region (height, width) of a view."""
    return lambda arrays, matrix: in_region(arrays.means, matrix, view, region)


def within_sphere(center: np.ndarray, radius: float) -> Test:
    """Return a test for the splats whose centers are in a sphere of the world."""
    return lambda arrays, matrix: in_sphere(arrays.means, matrix, center, radius)


def only_visible(test: Test, parts: Sequence[bpy.types.Object], view: View) -> Test:
    """Return a test for those splats of another test that no splats in front of them hide.

    Args:
        test: the other test.
        parts: the carriers whose splats hide others.
        view: the view in which they are seen.
    """
    occluders = [PickObject(0, _cloud_of(part), np.array(part.matrix_world)) for part in parts]
    occlusion = Occlusion(occluders, view, (0.0, 0.0, float(view.width), float(view.height)))

    def visible(arrays: SplatArrays, matrix: np.ndarray) -> np.ndarray:
        found = test(arrays, matrix)
        index = np.flatnonzero(found)
        stretch = float(np.linalg.norm(matrix[:3, :3], 2))
        thickness = SURFACE * stretch * arrays.scales[index].max(1, initial=0.0)
        found[index] = occlusion.light(to_camera(arrays.means[index], matrix, view), thickness) >= VISIBLE
        return found

    return visible


def occluders(view_layer: bpy.types.ViewLayer, space: bpy.types.SpaceView3D | None = None) -> list[bpy.types.Object]:
    """Return the carriers of all shown splats, which hide others."""
    return [part for part in drawing.splat_parts(view_layer, space) if arrays_of(part.data) is not None]


def depth_at(parts: Sequence[bpy.types.Object], view: View, x: float, y: float) -> float | None:
    """Return the depth of the splats at a pixel, from the upper left; None if there are none."""
    hit = pick([PickObject(0, _cloud_of(part), np.array(part.matrix_world)) for part in parts], view, x, y)
    return None if hit is None else hit.depth


def invert(parts: Sequence[bpy.types.Object]) -> int:
    """Select the splats that are not selected, and no others; return their number."""
    return _select_by_points(parts, lambda _points, selected: ~selected)


def grow(parts: Sequence[bpy.types.Object], distance: float) -> int:
    """Also select the splats within a distance in world units of selected ones; return how many are selected."""
    return _select_by_points(parts, lambda points, selected: near_selected(points, selected, distance))


def shrink(parts: Sequence[bpy.types.Object], distance: float) -> int:
    """Deselect the splats within a distance in world units of others; return the number of selected splats."""
    return _select_by_points(parts, lambda points, selected: away_from_others(points, selected, distance))


def usual_distance(parts: Sequence[bpy.types.Object]) -> float:
    """Return a distance in world units by which the selection of these splats may grow."""
    scales = [
        np.median(arrays_of(part.data).scales, axis=1)[::16]
        * abs(np.linalg.det(np.array(part.matrix_world))) ** (1 / 3)
        for part in parts
    ]
    together = np.concatenate([np.zeros(0), *scales])
    return GROWS_BY * float(np.median(together)) if len(together) else 1.0


def count_selected(parts: Sequence[bpy.types.Object]) -> int:
    """Return the number of selected splats."""
    masks = {part.data: drawing.selected_of(part.data) for part in parts}
    return sum(int(mask.sum()) for mask in masks.values() if mask is not None)


def _select_by_points(parts: Sequence[bpy.types.Object], chosen: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> int:
    """Select anew by the positions in the world (N, 3) and the selection (N,) of all shown splats."""
    arrays = [arrays_of(part.data) for part in parts]
    if not arrays:
        return 0
    matrices = [np.array(part.matrix_world) for part in parts]
    points = [own.means @ matrix[:3, :3].T + matrix[:3, 3] for own, matrix in zip(arrays, matrices)]
    before = [drawing.selected_of(part.data) for part in parts]
    masks: list[np.ndarray] = [
        np.zeros(len(own.means), bool) if mask is None else mask for own, mask in zip(arrays, before)
    ]
    after = chosen(np.concatenate(points), np.concatenate(masks))
    remaining = iter(np.split(after, np.cumsum([len(mask) for mask in masks])[:-1]))
    return select(parts, lambda _arrays, _matrix: next(remaining), "SET")


def _cloud_of(part: bpy.types.Object) -> Cloud:
    return arrays_of(part.data).cloud
