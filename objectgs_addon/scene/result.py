# SPDX-License-Identifier: GPL-3.0-or-later
"""Collections of the objects of a reconstruction, created or updated in place from splats.ply and anchors.ply."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ...backend.shared.color.palette import to_linear
from ...backend.shared.errors import InputError
from ...backend.shared.formats.splat_ply import ids_of, read_blur
from ...backend.shared.reconstruction.edits.splat_edits import missing_sentence, read_splat_edits
from ...backend.shared.reconstruction.folder import Reconstruction
from . import carrier
from .capture import origin_of, put_capture_last
from .edits.axes import put_below
from .edits.floaters import mark_distant, mark_floaters, near_sphere_of
from .edits.recover import recover_parts
from .edits.show import show_edits
from .edits.single_splats import (
    captured_positions,
    edited_attributes,
    keys_of,
    remember_edits,
    select_splats,
    selected_splats,
    table_keys,
)
from .kinds import (
    ANCHORS,
    MESH,
    OBJECT_PARENT,
    SPLATS,
    adopt,
    capture_of,
    duplicates_of,
    folder_of,
    mark,
    object_collections,
    parent_of,
    part_of,
    parts_of,
    points_of,
)
from .meshes.show import apply_shown, update_meshes
from .object_collection import NAME, center_of, ensure_pivot, new_collection, paint, remove, remove_if_empty, rename
from .object_display import Objects
from .points import paint_points, read_points, show_points
from .shading.materials import splats_material
from .shading.modifiers import add_splats_modifiers, update_groups, use_material
from .shading.node_groups import HIDDEN
from .splats import (
    BLUR,
    anchor_attributes,
    median_scale,
    positions_of,
    read_anchors,
    read_splats,
    splat_attributes,
    unique_ids,
)

GROUPING = "objectgs_grouping"
SHOWN = "objectgs_shown"
"""Custom property of the root collection: the modification time of the shown splats.ply."""

LARGEST_POINT = 3.0
"""Largest radius of a point in the viewport relative to the median scale of the splats."""


@dataclass
class Shown:
    """Result of `show_result`: the numbers of objects (without the unlabeled rest), splats and anchors; warnings."""

    objects: int = 0
    splats: int = 0
    anchors: int = 0
    warnings: list[str] = field(default_factory=list)


def show_result(root: bpy.types.Collection, folder: Path) -> Shown:
    """Show splats.ply, anchors.ply and the meshes, with one collection per object after merges.

    Existing data is updated in place: transforms, modifiers, materials, visibility and the positions of collections in
    the hierarchy are kept. For objects that no longer have splats, carriers and empty collections are removed.

    Args:
        root: the reconstruction's collection.
        folder: the reconstruction folder.

    Returns:
        The counts of what is shown, and warnings, also about meshes that cannot be used.

    Raises:
        InputError: The folder's files cannot be used, or a part is in Edit Mode; nothing is changed.
    """
    folder = Path(folder)
    splats, warnings = read_splats(folder)
    blur = read_blur(Reconstruction(folder).splats)
    anchors, more = read_anchors(folder)
    objects = Objects.read(folder)
    edits = read_splat_edits(Reconstruction(folder))
    recover_parts(root)
    collections = object_collections(root)
    is_first = not collections
    carrier.require_object_mode(part for collection in collections.values() for part in parts_of(collection))

    origin = origin_of(root)
    applied = edits.apply(table_keys(splats) if edits else np.zeros(0), ids_of(splats), captured_positions(splats))
    splat_groups = _groups(splats, applied.object_ids, objects)
    anchor_groups = {} if anchors is None else _groups(anchors, ids_of(anchors), objects)
    selected, sphere = _selected_keys(collections), near_sphere_of(root)
    parent = parent_of(root)
    makers = _Makers(objects, LARGEST_POINT * median_scale(splats))
    shown = Shown(warnings=warnings + more)
    new = []
    for object_id in sorted(set(splat_groups) | set(anchor_groups)):
        own_splats = splat_groups.get(object_id, splats[:0])
        own_anchors = anchor_groups.get(object_id)
        collection = collections.pop(object_id, None)
        if collection is None:
            collection = new_collection(object_id, objects)
            adopt(collection, root, (OBJECT_PARENT, SPLATS, ANCHORS, MESH), object_id)
            new.append(collection)
        positions = positions_of(own_splats, origin)
        pivot = ensure_pivot(collection, parent, object_id, positions)
        obj = makers.part(collection, SPLATS, object_id, pivot)
        attributes = splat_attributes(own_splats) | edited_attributes(own_splats, edits)
        if HIDDEN in attributes:
            update_groups(obj)
        carrier.fill(obj.data, positions - center_of(pivot), attributes)
        obj.data[BLUR] = blur
        select_splats(obj.data, _among(keys_of(obj.data), selected))
        mark_floaters(obj, positions)
        mark_distant(obj, positions, sphere)
        shown.splats += len(own_splats)
        if own_anchors is not None:
            carrier.fill(
                makers.part(collection, ANCHORS, object_id, pivot).data,
                positions_of(own_anchors, origin) - center_of(pivot),
                anchor_attributes(own_anchors),
            )
            shown.anchors += len(own_anchors)
        elif anchors is not None:
            remove(part_of(collection, ANCHORS))
        rename(collection, objects.name(object_id))
        paint(collection, objects.rgb(object_id))
        shown.objects += object_id != 0
    for collection in collections.values():
        for kind in (SPLATS, ANCHORS):
            remove(part_of(collection, kind))
    try:
        shown.warnings += update_meshes(root, folder).warnings
    except InputError as error:
        shown.warnings.append(str(error))
    apply_shown(root, makers.changed)
    still_there = object_collections(root)
    for object_id in collections.keys() & still_there.keys():
        remove_if_empty(still_there[object_id])
    for collection in new:
        root.children.link(collection)
    if is_first:
        put_capture_last(root)
    show_edits(root, objects)
    root[GROUPING] = json.dumps(objects.grouping())
    root[SHOWN] = _written(folder)
    remember_edits(root, edits, applied.missing)
    if applied.missing:
        shown.warnings.append(missing_sentence(applied.missing, edits, Reconstruction(folder).splat_edits))
    return shown


def _selected_keys(collections: dict[int, bpy.types.Collection]) -> np.ndarray:
    """Return the sorted keys of the selected splats of objects, which stay selected while the splats are the same."""
    meshes = [part.data for each in collections.values() if (part := part_of(each, SPLATS)) is not None]
    return np.sort(np.concatenate([np.zeros(0, np.uint64), *(keys_of(mesh)[selected_splats(mesh)] for mesh in meshes)]))


def _among(keys: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Return which keys (n,) are among sorted ones, without sorting these for each object as NumPy would."""
    places = np.searchsorted(chosen, keys)
    found = places < len(chosen)
    found[found] = chosen[places[found]] == keys[found]
    return found


def result_is_newer(root: bpy.types.Collection) -> bool:
    """Return whether the folder's splats.ply differs in modification time from the one shown."""
    written = _written(folder_of(root))
    return bool(written) and root.get(SHOWN) != written


def _written(folder: Path) -> str:
    """Return the modification time of splats.ply in ns, as a string since Blender's integers have 32 bits, or ""."""
    try:
        return str(Reconstruction(folder).splats.stat().st_mtime_ns)
    except OSError:
        return ""


def show_objects(root: bpy.types.Collection, folder: Path, is_vote: bool = True) -> None:
    """Update points and object collections from points.ply and objects.json after a vote or an edit.

    This updates names, colors and edits. If merges or left-out objects changed, it calls `show_result`.

    Args:
        root: the reconstruction's collection.
        folder: the reconstruction folder.
        is_vote: read points.ply again; after edits the points of many photos would keep the user waiting.
    """
    folder = Path(folder)
    objects = Objects.read(folder)
    capture, parent = capture_of(root), parent_of(root)
    is_there = capture is not None and parent is not None and Reconstruction(folder).points.is_file()
    if is_there and (is_vote or not paint_points(root, objects)):
        carrier.require_object_mode([points_of(root)])
        show_points(capture, parent, f"{root.name} points", read_points(folder), origin_of(root), objects)
    if (
        GROUPING in root
        and root[GROUPING] != json.dumps(objects.grouping())
        and (Reconstruction(folder).splats.is_file())
    ):
        show_result(root, folder)
        return
    copies = duplicates_of(root)
    for object_id, collection in object_collections(root).items():
        for each in (collection, *copies.get(object_id, ())):
            rename(each, objects.name(object_id))
            paint(each, objects.rgb(object_id))
    show_edits(root, objects)


def show_label(root: bpy.types.Collection, object_id: int, name: str, rgb: tuple[int, int, int]) -> None:
    """Show the name and the color, sRGB 0 .. 255, of an object and its duplicates without reading the folder."""
    collection = object_collections(root).get(object_id)
    for each in (collection, *duplicates_of(root).get(object_id, ())) if collection is not None else ():
        rename(each, name)
        paint(each, rgb)


def _groups(table: np.ndarray, object_ids: np.ndarray, objects: Objects) -> dict[int, np.ndarray]:
    """Map the IDs of collections to their rows of the table, in file order, without rows of left-out objects.

    Args:
        table: (n,) splats or anchors.
        object_ids: (n,) their IDs.
        objects: the objects with the user's edits.
    """
    ids, inverse = unique_ids(object_ids)
    shown = [objects.shown_as(int(object_id)) for object_id in ids]
    targets = sorted({target for target in shown if target is not None})
    place = {target: index for index, target in enumerate(targets)}
    # Small integers sort much faster.
    kind = np.uint16 if len(targets) < 1 << 16 else np.int64
    group = np.array([len(targets) if target is None else place[target] for target in shown], kind)[inverse]
    # Sort as bytes, since NumPy copies structured rows field by field.
    as_bytes = table.view(np.uint8).reshape(len(table), table.dtype.itemsize)
    rows = as_bytes[np.argsort(group, kind="stable")].reshape(-1).view(table.dtype)
    ends = np.cumsum(np.bincount(group, minlength=len(targets)))
    return {target: rows[ends[i - 1] if i else 0 : ends[i]] for i, target in enumerate(targets)}


class _Makers:
    """Factory for mesh carriers; later carriers of a kind are copies of the first, which is several times faster."""

    def __init__(self, objects: Objects, largest_point: float) -> None:
        self.objects = objects
        self.largest_point = largest_point
        self.changed: set[int] = set()
        """IDs of the objects whose splats carrier was created."""
        self._made: dict[str, bpy.types.Object] = {}

    def part(
        self, collection: bpy.types.Collection, kind: str, object_id: int, pivot: bpy.types.Object
    ) -> bpy.types.Object:
        """Return the carrier of a kind in `collection`, created if missing."""
        obj = part_of(collection, kind)
        if obj is not None:
            return obj
        name = f"{collection[NAME]} {kind}"
        mesh = bpy.data.meshes.new(name)
        first = self._made.get(kind)
        if first is None:
            obj = self._made[kind] = bpy.data.objects.new(name, mesh)
        else:
            obj = first.copy()
            obj.name, obj.data = name, mesh
        mark(obj, kind, object_id)
        if kind == SPLATS:
            self._update_appearance(obj, first, collection[NAME], to_linear(self.objects.rgb(object_id)))
            self.changed.add(object_id)
        elif first is None:
            # Setting these makes Blender visit every object in the file; copies inherit them.
            obj.hide_render = obj.hide_viewport = True
        put_below(obj, pivot)
        collection.objects.link(obj)
        return obj

    def _update_appearance(self, obj: bpy.types.Object, first: Any, name: str, color: Sequence[float]) -> None:
        if first is None:
            material = splats_material(name, color)
            add_splats_modifiers(obj, self.largest_point)
        else:
            material = first.data.materials[0].copy()
            material.name, material.diffuse_color = name, (*color, 1.0)
        obj.data.materials.append(material)
        use_material(obj, material)
