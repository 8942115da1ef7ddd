# SPDX-License-Identifier: GPL-3.0-or-later
"""Fills of holes left by removed and moved objects.

The backend computes unobserved splats, appended to the carriers whose surface they continue, and the splats that they
replace, which are hidden. Both store the ID of the object.
"""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np

from ....backend.shared.formats.splat_ply import UNOBSERVED, ids_of
from ....backend.shared.reconstruction.fill import FILLS, FillRows, fill_path, read_fill
from ....backend.shared.reconstruction.folder import Reconstruction
from .. import carrier
from ..capture import origin_of
from ..kinds import OBJECT_PARENT, SPLATS, duplicates_of, folder_of, object_collections, part_of
from ..object_collection import center_of
from ..object_display import Objects
from ..shading.modifiers import update_groups
from ..shading.node_groups import COVERED, HIDDEN
from ..splats import positions_of, splat_attributes
from .placement import take_back
from .single_splats import deleted_splats

SHOWN_FILL = "objectgs_fill"
"""Custom property of a carrier's mesh: the name of the fill file that it shows."""
UNOBSERVED_COUNT = "objectgs_unobserved"
"""Custom property of an object's collection: the number of splats that fill its hole, if known."""
REPLACED = "objectgs_replaced"
"""Custom property of a carrier: a mesh is shown in its place. Only its splats that fill holes are shown then."""


def missing_fill(root: bpy.types.Collection, objects: Objects) -> Path | None:
    """Return the fill file that the edits require if it does not exist yet, else None."""
    path = _path(root, objects)
    return None if path is None or path.is_file() else path


def show_fills(root: bpy.types.Collection, objects: Objects, has_step: bool = True) -> None:
    """Show the fills that the edits require.

    While the file for these edits is missing, objects that still require a fill keep the splats shown so far, also if
    the carriers have been filled anew.

    Args:
        root: the reconstruction's collection.
        objects: the objects with the user's edits.
        has_step: whether the change is part of an undo step. After an undo it is not, and carriers are left as they
            are that Blender's operators have changed: only a step keeps their vertices and transforms together.

    Raises:
        InputError: A file cannot be read, or a carrier is in Edit Mode; nothing is changed.
    """
    path = _path(root, objects)
    rows = read_fill(path) if path is not None and path.is_file() else None
    filled = [entry.id for entry in objects.entries.values() if entry.fill]
    changes = []
    for object_id, collection in object_collections(root).items():
        obj = part_of(collection, SPLATS)
        if obj is None or obj.data.library is not None or "radiance:base" not in obj.data.attributes:
            continue
        fills = filled_objects(obj.data)
        if rows is None and not fills.any() and obj.data.get(SHOWN_FILL):
            own = _shown_before(root, obj, object_id, filled)
            changes.append((collection, obj, fills, own, obj.data[SHOWN_FILL] if own is not None else ""))
            continue
        if rows is None:
            if not np.isin(fills, [0, *filled]).all():
                changes.append((collection, obj, np.where(np.isin(fills, filled), fills, 0), None, ""))
            continue
        own = rows.select(ids_of(rows.splats) == object_id)
        shows = path.name if len(own.new) else ""
        if shows != (obj.data.get(SHOWN_FILL, "") if fills.any() else ""):
            changes.append((collection, obj, np.zeros_like(fills), own, shows))
    if not has_step:
        changes = [change for change in changes if np.array_equal(carrier.applied_map(change[1].data), np.eye(4))]
    carrier.require_object_mode(obj for _, obj, *_ in changes)
    for collection, obj, fills, own, shows in changes:
        take_back(obj.data)  # Splats that are filled anew no longer tell what was applied to them.
        _keep(obj, fills)
        if shows:
            pivot = part_of(collection, OBJECT_PARENT)
            _put(obj, own, origin_of(root), np.zeros(3) if pivot is None else center_of(pivot))
        obj.data[SHOWN_FILL] = shows
    for each in _in_place_of(root, [obj for _, obj, *_ in changes]):
        each.hide_viewport = each.hide_render = replace_by_mesh(each, True)
    for object_id, collection in object_collections(root).items():
        if rows is not None and object_id in filled:
            collection[UNOBSERVED_COUNT] = rows.count_new(object_id)
        elif UNOBSERVED_COUNT in collection:
            del collection[UNOBSERVED_COUNT]


def replace_by_mesh(obj: bpy.types.Object, replaced: bool) -> bool:
    """Show only the splats of a carrier that fill a hole, or all of them again.

    Returns:
        Whether the carrier must be hidden, since none of its splats is shown.
    """
    fills = unobserved_splats(obj.data)
    if replaced:
        obj[REPLACED] = True
    elif REPLACED in obj:
        del obj[REPLACED]
    if replaced and fills.any():
        update_groups(obj)
        carrier.write(obj.data, COVERED, "BOOLEAN", ~fills)
        obj.data.update()
    elif COVERED in obj.data.attributes:
        obj.data.attributes.remove(obj.data.attributes[COVERED])
        obj.data.update()
    return replaced and not fills.any()


def _shown_before(
    root: bpy.types.Collection, obj: bpy.types.Object, object_id: int, filled: list[int]
) -> FillRows | None:
    """Return the splats of the fill file that a carrier has shown, for the objects in `filled`; None without any."""
    path = Reconstruction(folder_of(root)).cache / obj.data[SHOWN_FILL]
    if not filled or not path.is_file():
        return None
    rows = read_fill(path)
    own = rows.select((ids_of(rows.splats) == object_id) & np.isin(rows.fills, filled))
    return own if len(own.new) else None


def _in_place_of(root: bpy.types.Collection, carriers: list[bpy.types.Object]) -> list[bpy.types.Object]:
    """Return those of some carriers and of their duplicates that a mesh replaces."""
    meshes = {obj.data for obj in carriers}
    copies = (part_of(copy, SPLATS) for copies in duplicates_of(root).values() for copy in copies)
    duplicates = [obj for obj in copies if obj is not None and obj.data in meshes]
    return [obj for obj in (*carriers, *duplicates) if REPLACED in obj]


def filled_objects(mesh: bpy.types.Mesh) -> np.ndarray:
    """Return the (n,) int64 IDs of the objects whose fill adds or replaces each splat of a carrier; else 0."""
    if FILLS not in mesh.attributes:
        return np.zeros(len(mesh.vertices), np.int64)
    return carrier.read_ids(mesh, FILLS)


def unobserved_splats(mesh: bpy.types.Mesh) -> np.ndarray:
    """Return an (n,) bool mask of a carrier's unobserved splats, which fill a hole and are in none of the photos."""
    if UNOBSERVED not in mesh.attributes:
        return np.zeros(len(mesh.vertices), bool)
    return carrier.read(mesh, UNOBSERVED)


def given_way(mesh: bpy.types.Mesh) -> np.ndarray:
    """Return an (n,) bool mask of a carrier's splats that are hidden because unobserved splats replace them."""
    return (filled_objects(mesh) != 0) & ~unobserved_splats(mesh)


def _path(root: bpy.types.Collection, objects: Objects) -> Path | None:
    return fill_path(Reconstruction(folder_of(root)), sorted(objects.entries.values(), key=lambda entry: entry.id))


def _keep(obj: bpy.types.Object, fills: np.ndarray) -> None:
    """Keep only fill splats where `fills` (n,) is not 0, and show the splats replaced by the other fills again."""
    mesh = obj.data
    if FILLS not in mesh.attributes:
        return
    stay = ~unobserved_splats(mesh) | (fills != 0)
    attributes = _attributes(mesh)
    attributes[FILLS] = "INT", carrier.stored_ids(fills)
    attributes[HIDDEN] = "BOOLEAN", _hidden_otherwise(mesh)
    _fill(
        obj,
        carrier.read(mesh, "position")[stay],
        {name: (kind, values[stay]) for name, (kind, values) in attributes.items()},
    )


def _put(obj: bpy.types.Object, rows: FillRows, origin: np.ndarray, center: np.ndarray) -> None:
    """Append the unobserved splats in `rows` to a carrier, and hide its splats that match the other rows.

    Args:
        obj: the carrier.
        rows: splats of the fill file for this carrier.
        origin: (3,) origin of the reconstruction in capture coordinates.
        center: (3,) origin of the carrier in reconstruction coordinates.
    """
    mesh = obj.data
    is_put = rows.new
    positions, new = positions_of(rows.splats, origin) - center, splat_attributes(rows.splats)
    before = _attributes(mesh)
    before[HIDDEN] = "BOOLEAN", _hidden_otherwise(mesh)
    there = carrier.read(mesh, "position")
    taken = _among(
        _keys(there, before["radiance:base"][1]),
        _keys(positions[~is_put], new["radiance:base"][1][~is_put]),
        rows.fills[~is_put],
    )
    count = int(is_put.sum())
    attributes = {}
    for name, (kind, values) in before.items():
        added = new[name][1][is_put] if name in new else np.zeros((count, *values.shape[1:]), values.dtype)
        attributes[name] = kind, np.concatenate([values, added])
    attributes[UNOBSERVED] = "BOOLEAN", np.arange(len(there) + count) >= len(there)
    attributes[FILLS] = "INT", carrier.stored_ids(np.concatenate([taken, rows.fills[is_put]]))
    _fill(obj, np.concatenate([there, positions[is_put]]), attributes)


def _fill(obj: bpy.types.Object, positions: np.ndarray, attributes: dict[str, tuple[str, np.ndarray]]) -> None:
    """Replace a carrier's splats and hide the replaced ones; without fills, drop the fill attributes."""
    fills, hidden = attributes[FILLS][1] != 0, attributes[HIDDEN][1]
    if fills.any():
        hidden = hidden | (fills & ~attributes[UNOBSERVED][1])
        update_groups(obj)
    else:
        del attributes[FILLS], attributes[UNOBSERVED]
    attributes[HIDDEN] = "BOOLEAN", hidden
    if not hidden.any():
        del attributes[HIDDEN]
    carrier.fill(obj.data, positions, attributes)


def _hidden_otherwise(mesh: bpy.types.Mesh) -> np.ndarray:
    """Return an (n,) bool mask of the splats that are hidden for reasons other than a fill."""
    hidden = carrier.read(mesh, HIDDEN) if HIDDEN in mesh.attributes else np.zeros(len(mesh.vertices), bool)
    return (hidden & ~given_way(mesh)) | deleted_splats(mesh)


def _attributes(mesh: bpy.types.Mesh) -> dict[str, tuple[str, np.ndarray]]:
    """Return all point attributes of a carrier except positions and Blender's internal attributes."""
    return {
        attribute.name: (attribute.data_type, carrier.read(mesh, attribute.name))
        for attribute in mesh.attributes
        if attribute.domain == "POINT"
        and attribute.data_type in carrier.KINDS
        and attribute.name != "position"
        and not attribute.name.startswith(".")
    }


def _keys(positions: np.ndarray, base: np.ndarray) -> np.ndarray:
    """Return (n,) keys from the exact bits of the splats' positions and colors, without opacities."""
    values = np.ascontiguousarray(np.hstack([positions.astype(np.float32), base[:, :3].astype(np.float32)]))
    return values.view(f"V{values.itemsize * 6}").reshape(-1)


def _among(keys: np.ndarray, wanted: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return, for each key, the value of the equal key in `wanted`, or 0, as (n,) int64."""
    known = dict(zip(wanted.tolist(), values.tolist()))
    return np.array([known.get(key, 0) for key in keys.tolist()], np.int64)
