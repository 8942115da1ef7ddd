# SPDX-License-Identifier: GPL-3.0-or-later
"""The objects of a reconstruction: a collection for each, with its splats and anchors, new or updated in place."""

import json
from dataclasses import dataclass, field
from pathlib import Path

import bpy
import numpy as np

from ...backend.palette import to_linear
from ...backend.protocol import Reconstruction
from . import carrier, preview
from .capture import origin_of
from .kinds import (
    ANCHORS,
    OBJECT,
    OBJECT_PARENT,
    SPLATS,
    adopt,
    capture_of,
    folder_of,
    kind_of,
    mark,
    object_collections,
    parent_of,
    part_of,
    parts_of,
    points_of,
)
from .objects_file import Objects
from .points import positions_of, read_points, show_points
from .splats import anchor_attributes, ids_of, middle_scale, read_anchors, read_splats, splat_attributes, unique_ids

NAME = "objectgs_name"
CENTRE = "objectgs_centre"
GROUPING = "objectgs_grouping"
SHOWN = "objectgs_shown"
"""On the root: when the splats.ply that it shows was written."""

LARGEST_POINT = 3.0
"""Largest radius of a point in the viewport relative to the size of the splats in the middle."""


@dataclass
class Shown:
    """What `show_result` put into Blender: how many objects (the unlabelled rest is none), splats and anchors."""

    objects: int = 0
    splats: int = 0
    anchors: int = 0
    warnings: list[str] = field(default_factory=list)


def show_result(root: bpy.types.Collection, folder: Path, scene: bpy.types.Scene) -> Shown:
    """Show splats.ply and anchors.ply: each object in its collection, merged ones in that of what they are shown as.

    What is there is updated in place: transforms, modifiers, materials, visibility and the place of collections stay
    as the user left them. Objects that have no splats any more lose theirs, and their collection where nothing else
    is in it. Raises InputError, before anything is changed, where the folder's files cannot be used.
    """
    folder = Path(folder)
    splats, warnings = read_splats(folder)
    anchors, more = read_anchors(folder)
    objects = Objects.read(folder)
    collections = object_collections(root)
    carrier.require_object_mode(part for collection in collections.values() for part in parts_of(collection))

    origin = origin_of(root)
    splat_groups = _groups(splats, objects)
    anchor_groups = {} if anchors is None else _groups(anchors, objects)
    parent = parent_of(root)
    makers = _Makers(objects, LARGEST_POINT * middle_scale(splats))
    shown = Shown(warnings=warnings + more)
    new = []
    for object_id in sorted(set(splat_groups) | set(anchor_groups)):
        own_splats = splat_groups.get(object_id, splats[:0])
        own_anchors = anchor_groups.get(object_id)
        collection = collections.pop(object_id, None)
        if collection is None:
            collection = _new_collection(object_id, objects)
            adopt(collection, root, (OBJECT_PARENT, SPLATS, ANCHORS), object_id)
            new.append(collection)
        positions = positions_of(own_splats, origin)
        pivot = _pivot(collection, parent, object_id, positions)
        carrier.fill(makers.part(collection, SPLATS, object_id, pivot).data, positions - _centre(pivot),
                     splat_attributes(own_splats))
        shown.splats += len(own_splats)
        if own_anchors is not None:
            carrier.fill(makers.part(collection, ANCHORS, object_id, pivot).data,
                         positions_of(own_anchors, origin) - _centre(pivot), anchor_attributes(own_anchors))
            shown.anchors += len(own_anchors)
        elif anchors is not None:
            _remove(part_of(collection, ANCHORS))
        _rename(collection, objects.name(object_id))
        _recolour(collection, objects.rgb(object_id))
        shown.objects += object_id != 0
    for collection in collections.values():
        _empty(collection)
    for collection in new:
        root.children.link(collection)
    root[GROUPING] = json.dumps(objects.grouping())
    root[SHOWN] = _written(folder)
    return shown


def result_is_newer(root: bpy.types.Collection) -> bool:
    """Whether the folder holds another splats.ply than the one that is shown."""
    written = _written(folder_of(root))
    return bool(written) and root.get(SHOWN) != written


def _written(folder: Path) -> str:
    """When splats.ply was written, in nanoseconds; Blender's integers are too short for that. Empty without one."""
    try:
        return str(Reconstruction(folder).splats.stat().st_mtime_ns)
    except OSError:
        return ""


def show_objects(root: bpy.types.Collection, folder: Path, scene: bpy.types.Scene) -> None:
    """Bring points and object collections into agreement with points.ply and objects.json, after a vote or an edit.

    Names and colours are set; where merges or left-out objects changed, splats are shown again as `show_result` does.
    """
    folder = Path(folder)
    objects = Objects.read(folder)
    capture, parent = capture_of(root), parent_of(root)
    if capture is not None and parent is not None and Reconstruction(folder).points.is_file():
        carrier.require_object_mode([points_of(root)])
        show_points(capture, parent, f"{root.name} points", read_points(folder), origin_of(root), objects)
    if GROUPING in root and root[GROUPING] != json.dumps(objects.grouping()) and (
            Reconstruction(folder).splats.is_file()):
        show_result(root, folder, scene)
        return
    for object_id, collection in object_collections(root).items():
        _rename(collection, objects.name(object_id))
        _recolour(collection, objects.rgb(object_id))


def _groups(table: np.ndarray, objects: Objects) -> dict[int, np.ndarray]:
    """ID of a collection -> its rows of the table, in the file's order; rows of left-out objects are in none."""
    ids, inverse = unique_ids(ids_of(table))
    shown = [objects.shown_as(int(object_id)) for object_id in ids]
    targets = sorted({target for target in shown if target is not None})
    place = {target: index for index, target in enumerate(targets)}
    # Small integers sort much faster.
    kind = np.uint16 if len(targets) < 1 << 16 else np.int64
    group = np.array([len(targets) if target is None else place[target] for target in shown], kind)[inverse]
    # As bytes, since rows of named fields are copied field by field.
    as_bytes = table.view(np.uint8).reshape(len(table), table.dtype.itemsize)
    rows = as_bytes[np.argsort(group, kind="stable")].reshape(-1).view(table.dtype)
    ends = np.cumsum(np.bincount(group, minlength=len(targets)))
    return {target: rows[ends[i - 1] if i else 0:ends[i]] for i, target in enumerate(targets)}


def _new_collection(object_id: int, objects: Objects) -> bpy.types.Collection:
    collection = bpy.data.collections.new(objects.name(object_id))
    mark(collection, OBJECT, object_id)
    collection[NAME] = objects.name(object_id)
    return collection


def _pivot(collection, parent, object_id: int, positions: np.ndarray) -> bpy.types.Object:
    """The object's own parent empty, at its splats' centre when made; the user may move it."""
    pivot = part_of(collection, OBJECT_PARENT)
    if pivot is None:
        pivot = bpy.data.objects.new(collection[NAME], None)
        mark(pivot, OBJECT_PARENT, object_id)
        pivot.empty_display_type = "PLAIN_AXES"
        centre, size = np.zeros(3), 1.0
        if len(positions):
            centre = np.median(positions, axis=0)
            size = 0.5 * float(np.median(np.linalg.norm(positions - centre, axis=1))) or 1.0
        pivot.empty_display_size = size
        pivot[CENTRE] = centre.tolist()
        pivot.location = centre
        pivot.parent = parent
        collection.objects.link(pivot)
    elif pivot.parent is None:
        pivot.parent = parent
    return pivot


class _Makers:
    """Makes mesh carriers; the second of a kind is a copy of the first, which is several times faster."""

    def __init__(self, objects: Objects, largest_point: float) -> None:
        self.objects = objects
        self.largest_point = largest_point
        self._made: dict[str, bpy.types.Object] = {}

    def part(self, collection, kind: str, object_id: int, pivot) -> bpy.types.Object:
        """The carrier of a kind in `collection`, made where there is none."""
        thing = part_of(collection, kind)
        if thing is not None:
            if thing.parent is None:
                thing.parent = pivot  # The user deleted the one before.
            return thing
        name = f"{collection[NAME]} {kind}"
        mesh = bpy.data.meshes.new(name)
        first = self._made.get(kind)
        if first is None:
            thing = self._made[kind] = bpy.data.objects.new(name, mesh)
        else:
            thing = first.copy()
            thing.name, thing.data = name, mesh
        mark(thing, kind, object_id)
        if kind == SPLATS:
            self._dress(thing, first, collection[NAME], to_linear(self.objects.rgb(object_id)))
        elif first is None:
            # Blender visits every object of the file for each of these settings; copies have them.
            thing.hide_render = thing.hide_viewport = True
        thing.parent = pivot
        collection.objects.link(thing)
        return thing

    def _dress(self, thing, first, name: str, colour) -> None:
        if first is None:
            material = preview.splats_material(name, colour)
            preview.add_splats_modifiers(thing, self.largest_point)
        else:
            material = first.data.materials[0].copy()
            material.name, material.diffuse_color = name, (*colour, 1.0)
        thing.data.materials.append(material)
        preview.use_material(thing, material)


def _centre(pivot) -> np.ndarray:
    """Where the pivot was made, in the reconstruction's coordinates: the origin of its children's."""
    return np.array(pivot.get(CENTRE, (0.0, 0.0, 0.0)), np.float64)


def _rename(collection, name: str) -> None:
    """Give collection and parts a new name from objects.json; names that the user gave in Blender stay else."""
    if collection.get(NAME) == name:
        return
    collection[NAME] = collection.name = name
    for thing in parts_of(collection):
        kind = kind_of(thing)
        thing.name = name if kind == OBJECT_PARENT else f"{name} {kind}"
        if thing.data is not None:
            thing.data.name = thing.name
        for material in _materials(thing):
            material.name = name


def _recolour(collection, rgb: tuple[int, int, int]) -> None:
    colour = (*to_linear(rgb), 1.0)
    for thing in parts_of(collection):
        thing.color = colour
        for material in _materials(thing):
            material.diffuse_color = colour


def _materials(thing) -> list[bpy.types.Material]:
    """The materials that we made for a splats object."""
    if kind_of(thing) != SPLATS or thing.data is None:
        return []
    return [material for material in thing.data.materials if kind_of(material) == "splats_material"]


def _empty(collection) -> None:
    """Take splats and anchors out of a collection, and remove it where only its own empty is left."""
    for kind in (SPLATS, ANCHORS):
        _remove(part_of(collection, kind))
    pivot = part_of(collection, OBJECT_PARENT)
    others = [thing for thing in collection.objects if thing != pivot]
    if others or collection.children or (pivot is not None and pivot.children):
        return
    _remove(pivot)
    bpy.data.collections.remove(collection)


def _remove(thing) -> None:
    """Remove an object with its mesh and our materials, where nothing else uses them."""
    if thing is None:
        return
    mesh, materials = thing.data, _materials(thing)
    bpy.data.objects.remove(thing)
    if mesh is not None and mesh.users == 0:
        bpy.data.meshes.remove(mesh)
    for material in materials:
        if material.users == 0:
            bpy.data.materials.remove(material)
