# SPDX-License-Identifier: GPL-3.0-or-later
"""What closes the places of removed objects: invented splats at the end of the carriers whose surface they continue,
and splats hidden that give way to them. The backend finds both; each says whose place it closes."""

from pathlib import Path

import bpy
import numpy as np

from ...backend.fill_file import CLOSES, INVENTED, fill_path
from ...backend.ply import read_vertices
from ...backend.protocol import Reconstruction
from . import carrier, preview
from .capture import origin_of
from .kinds import OBJECT_PARENT, SPLATS, folder_of, object_collections, part_of
from .object_collection import centre_of
from .objects_file import Objects
from .points import positions_of
from .splats import ids_of, splat_attributes

SHOWN_FILL = "objectgs_fill"
"""On a carrier's mesh that has `CLOSES`: the name of the file that it shows."""
INVENTED_COUNT = "objectgs_invented"
"""On the collection of a removed object: how many splats close its place, where that is known."""


def missing_fill(root: bpy.types.Collection, objects: Objects) -> Path | None:
    """The file that the edits ask for and that is not there yet; None where nothing is missing."""
    path = _path(root, objects)
    return None if path is None or path.is_file() else path


def show_fills(root: bpy.types.Collection, objects: Objects) -> None:
    """Close the places of removed objects as the edits ask for; while the file for these is missing, what is shown
    stays as far as its object is still to be filled.

    Raises InputError, before anything is changed, where files cannot be read or a carrier is in Edit Mode.
    """
    path = _path(root, objects)
    rows = read_vertices(path) if path is not None and path.is_file() else None
    filled = [entry.id for entry in objects.entries.values() if entry.removed and entry.fill]
    changes = []
    for object_id, collection in object_collections(root).items():
        thing = part_of(collection, SPLATS)
        if thing is None or thing.data.library is not None or "radiance:base" not in thing.data.attributes:
            continue
        closes = closed_places(thing.data)
        if rows is None:
            if not np.isin(closes, [0, *filled]).all():
                changes.append((collection, thing, np.where(np.isin(closes, filled), closes, 0), None, ""))
            continue
        own = rows[ids_of(rows) == object_id]
        shows = path.name if len(own) else ""
        if shows != (thing.data.get(SHOWN_FILL, "") if closes.any() else ""):
            changes.append((collection, thing, np.zeros_like(closes), own, shows))
    carrier.require_object_mode(thing for _, thing, *_ in changes)
    for collection, thing, closes, own, shows in changes:
        _keep(thing, closes)
        if shows:
            pivot = part_of(collection, OBJECT_PARENT)
            _put(thing, own, origin_of(root), np.zeros(3) if pivot is None else centre_of(pivot))
        thing.data[SHOWN_FILL] = shows
    for object_id, collection in object_collections(root).items():
        if rows is not None and object_id in filled:
            collection[INVENTED_COUNT] = int(((rows[CLOSES] == object_id) & (rows[INVENTED] != 0)).sum())
        elif INVENTED_COUNT in collection:
            del collection[INVENTED_COUNT]


def closed_places(mesh: bpy.types.Mesh) -> np.ndarray:
    """(n,) int64: for each splat of a carrier that closes the place of a removed object, or gives way to one that does,
    the ID of that object; 0 for all others."""
    if CLOSES not in mesh.attributes:
        return np.zeros(len(mesh.vertices), np.int64)
    return carrier.read(mesh, CLOSES).astype(np.int64) & 0xFFFFFFFF


def invented_splats(mesh: bpy.types.Mesh) -> np.ndarray:
    """(n,) bool: which splats of a carrier no photo shows."""
    if INVENTED not in mesh.attributes:
        return np.zeros(len(mesh.vertices), bool)
    return carrier.read(mesh, INVENTED)


def given_way(mesh: bpy.types.Mesh) -> np.ndarray:
    """(n,) bool: which splats of a carrier are hidden, since invented ones are in their place."""
    return (closed_places(mesh) != 0) & ~invented_splats(mesh)


def _path(root, objects: Objects) -> Path | None:
    return fill_path(Reconstruction(folder_of(root)), sorted(objects.entries.values(), key=lambda entry: entry.id))


def _keep(thing, closes: np.ndarray) -> None:
    """Leave of what closes places on a carrier what `closes` (n,) names, and show again what gave way to the rest."""
    mesh = thing.data
    if CLOSES not in mesh.attributes:
        return
    stay = ~invented_splats(mesh) | (closes != 0)
    attributes = _attributes(mesh)
    attributes[CLOSES] = "INT", carrier.stored_ids(closes)
    attributes[preview.HIDDEN] = "BOOLEAN", _hidden_otherwise(mesh)
    _fill(thing, carrier.read(mesh, "position")[stay],
          {name: (kind, values[stay]) for name, (kind, values) in attributes.items()})


def _put(thing, rows: np.ndarray, origin: np.ndarray, centre: np.ndarray) -> None:
    """Hide the splats of a carrier that are among rows, and put those that are invented behind them. centre (3,): the
    origin of the carrier's coordinates in the reconstruction's, whose own is `origin` in the capture's."""
    mesh = thing.data
    is_put = rows[INVENTED] != 0
    positions, new = positions_of(rows, origin) - centre, splat_attributes(rows)
    before = _attributes(mesh)
    before[preview.HIDDEN] = "BOOLEAN", _hidden_otherwise(mesh)
    there = carrier.read(mesh, "position")
    taken = _among(_keys(there, before["radiance:base"][1]),
                   _keys(positions[~is_put], new["radiance:base"][1][~is_put]), rows[CLOSES][~is_put])
    count = int(is_put.sum())
    attributes = {}
    for name, (kind, values) in before.items():
        added = new[name][1][is_put] if name in new else np.zeros((count, *values.shape[1:]), values.dtype)
        attributes[name] = kind, np.concatenate([values, added])
    attributes[INVENTED] = "BOOLEAN", np.arange(len(there) + count) >= len(there)
    attributes[CLOSES] = "INT", carrier.stored_ids(np.concatenate([taken, rows[CLOSES][is_put]]))
    _fill(thing, np.concatenate([there, positions[is_put]]), attributes)


def _fill(thing, positions: np.ndarray, attributes: dict[str, tuple[str, np.ndarray]]) -> None:
    """Replace a carrier's splats; those that give way are hidden, and where none does, it is as it was captured."""
    closes, hidden = attributes[CLOSES][1] != 0, attributes[preview.HIDDEN][1]
    if closes.any():
        hidden = hidden | (closes & ~attributes[INVENTED][1])
        preview.bring_up_to_date(thing)
    else:
        del attributes[CLOSES], attributes[INVENTED]
    attributes[preview.HIDDEN] = "BOOLEAN", hidden
    if not hidden.any():
        del attributes[preview.HIDDEN]
    carrier.fill(thing.data, positions, attributes)


def _hidden_otherwise(mesh) -> np.ndarray:
    """(n,) bool: which splats are hidden for another reason than that invented ones are in their place."""
    hidden = carrier.read(mesh, preview.HIDDEN) if preview.HIDDEN in mesh.attributes else np.zeros(
        len(mesh.vertices), bool)
    return hidden & ~given_way(mesh)


def _attributes(mesh) -> dict[str, tuple[str, np.ndarray]]:
    """What the carrier's vertices carry beside their places, Blender's own flags aside."""
    return {attribute.name: (attribute.data_type, carrier.read(mesh, attribute.name)) for attribute in mesh.attributes
            if attribute.domain == "POINT" and attribute.data_type in carrier.KINDS
            and attribute.name != "position" and not attribute.name.startswith(".")}


def _keys(positions: np.ndarray, base: np.ndarray) -> np.ndarray:
    """(n,) what a splat is known again by, bit for bit: its place, and its colour without the opacity."""
    values = np.ascontiguousarray(np.hstack([positions.astype(np.float32), base[:, :3].astype(np.float32)]))
    return values.view(f"V{values.itemsize * 6}").reshape(-1)


def _among(keys: np.ndarray, wanted: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(n,) int64: for each key the value of the equal one among `wanted`, or 0."""
    known = dict(zip(wanted.tolist(), values.tolist()))
    return np.array([known.get(key, 0) for key in keys.tolist()], np.int64)
