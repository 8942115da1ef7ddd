# SPDX-License-Identifier: GPL-3.0-or-later
"""Strokes on the objects of a reconstruction that has no masks, and the list of these objects.

They are properties of the reconstruction's collection, so that undo removes a stroke, and the .blend keeps them.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ...backend.shared.color.palette import colors_of
from ...backend.shared.errors import InputError
from ...backend.shared.formats.json_file import read_json
from ...backend.shared.reconstruction.folder import Reconstruction
from ...backend.shared.splats.picking import View
from .. import scene

NOTHING = 0
"""ID of strokes on what belongs to no object."""

_FAR = 1e4
"""Distance, relative to the size of the view, from which an orthographic view is drawn in perspective instead."""

after_strokes: list[Callable[[bpy.types.Collection], object]] = []
"""Called with a reconstruction whose strokes have changed."""
after_colors: list[Callable[[bpy.types.Collection], object]] = []
"""Called with a reconstruction of which the color of a marked object was set."""


def strokes_changed(properties: Any, _context: bpy.types.Context = None) -> None:
    """Tell of changed strokes; an update of a property."""
    for action in after_strokes:
        action(properties.id_data)


def color_set(item: Any, _context: bpy.types.Context = None) -> None:
    """Tell of the color of a marked object; an update of a property."""
    for action in after_colors:
        action(item.id_data)


def strokes_of(root: bpy.types.Collection) -> list[dict[str, Any]]:
    """Return the strokes in the form of the backend's files of strokes."""
    return list(_parsed(root.objectgs.strokes))


@functools.lru_cache(maxsize=4)
def _parsed(text: str) -> list[dict[str, Any]]:
    """Return the strokes in a text; cached, since panels ask for them in each row of a list."""
    try:
        found = json.loads(text or "[]")
    except ValueError:
        return []
    return found if isinstance(found, list) else []


def content(root: bpy.types.Collection) -> dict[str, Any]:
    """Return the content of a file of strokes for the backend."""
    properties = root.objectgs
    names = {str(item.object_id): item.name for item in properties.marked if item.name}
    return {"objects": names, "everything": properties.everything, "strokes": strokes_of(root)}


def take_name(root: bpy.types.Collection, object_id: int, name: str) -> None:
    """Give a marked object the name that its row in the list of objects has got, if both have this stored ID."""
    for item in root.objectgs.marked:
        if item.object_id == object_id and item.name != name:
            item.name = name


def count(root: bpy.types.Collection, object_id: int) -> int:
    """Return the number of strokes on an object."""
    return sum(stroke["object"] == object_id for stroke in strokes_of(root))


def names_without_strokes(root: bpy.types.Collection) -> list[str]:
    """Return the names of the listed objects that no stroke marks, so that the next separation makes them background.

    Objects of single splats are none of these: a separation leaves them as they are. Nor are those that are merged.
    """
    strokes = strokes_of(root)
    marked = {NOTHING, *(stroke["object"] for stroke in strokes), *(stroke.get("merged") for stroke in strokes)}
    return [
        item.name
        for item in root.objectgs.objects
        if not item.separated and scene.from_stored(item.object_id) not in marked
    ]


def active_object(root: bpy.types.Collection) -> Any:
    """Return the row of the object that strokes are drawn on, or None."""
    properties = root.objectgs
    known = 0 <= properties.active_marked < len(properties.marked)
    return properties.marked[properties.active_marked] if known else None


def add_object(root: bpy.types.Collection) -> Any:
    """Add an object and make it the active one; return its row. An object without strokes is taken, if there is one."""
    properties = root.objectgs
    for index, item in enumerate(properties.marked):
        if not count(root, item.object_id):
            properties.active_marked = index
            return item
    used = {item.object_id for item in properties.marked} | {item.object_id for item in properties.objects}
    used |= {int(stroke["merged"]) for stroke in strokes_of(root) if "merged" in stroke}
    object_id = next(number for number in range(1, len(used) + 2) if number not in used)
    item = _add_row(root, object_id)
    properties.active_marked = len(properties.marked) - 1
    return item


def _add_row(root: bpy.types.Collection, object_id: int) -> Any:
    """Add an object to the list and return its row."""
    item = root.objectgs.marked.add()
    item.object_id, item.name = object_id, f"Object {object_id}"
    item.color = colors_of([object_id])[0] / 255.0
    return item


def set_proposed(root: bpy.types.Collection, proposed: dict[str, Any]) -> None:
    """Replace all strokes and objects by proposed ones.

    Args:
        root: the reconstruction's collection.
        proposed: the content of a file of strokes.

    Raises:
        KeyError, TypeError, ValueError: it is not valid.
    """
    properties = root.objectgs
    strokes = [_kept(each) for each in proposed["strokes"]]
    taken = {item.object_id for item in properties.objects}
    free = (number for number in itertools.count(1) if number not in taken)
    ids = {number: next(free) for number in sorted({stroke["object"] for stroke in strokes})}
    properties.marked.clear()
    for object_id in ids.values():
        _add_row(root, object_id)
    properties.active_marked = 0
    properties.everything = bool(proposed["everything"])
    _store(root, [{**stroke, "object": ids[stroke["object"]]} for stroke in strokes])


def restore(root: bpy.types.Collection, folder: Path) -> None:
    """Add the strokes of the latest separation in a folder to a reconstruction that has none; skip invalid files."""
    path = Reconstruction(folder).strokes
    if root.objectgs.strokes or not path.is_file():
        return
    with contextlib.suppress(InputError, KeyError, TypeError, ValueError, AttributeError):
        kept = read_json(path)
        strokes = [_kept(each) for each in kept["strokes"]]
        ids = sorted({stroke["object"] for stroke in strokes} - {NOTHING})
        names = {object_id: str(kept["objects"].get(str(object_id)) or f"Object {object_id}") for object_id in ids}
        everything = bool(kept["everything"])
        for object_id, name in names.items():
            _add_row(root, object_id).name = name
        root.objectgs.everything = everything
        _store(root, strokes)


def _kept(stroke: dict[str, Any]) -> dict[str, Any]:
    """Return what is kept of a stroke in a file; raises KeyError, TypeError or ValueError if it is not valid."""
    place = {"view": str(stroke["view"])} if "view" in stroke else {"camera": dict(stroke["camera"])}
    other: dict[str, Any] = {key: stroke[key] for key in ("part", "area", "exact") if key in stroke}
    return {**other, **place, "object": int(stroke["object"]), "points": stroke["points"]}


def merge_object(root: bpy.types.Collection, index: int, into: int) -> None:
    """Make an object of the list a part of another one, which gets what both are now; index, into: their rows.

    Its strokes keep the ID that it had, as `merged`.
    """
    properties = root.objectgs
    object_id, other = properties.marked[index].object_id, properties.marked[into].object_id
    first = 1 + max((_part_of(stroke) for stroke in strokes_of(root) if stroke["object"] == other), default=0)
    strokes = [
        {"merged": object_id, **stroke, "object": other, "part": first + _part_of(stroke)}
        if stroke["object"] == object_id
        else stroke
        for stroke in strokes_of(root)
    ]
    properties.marked.remove(index)
    properties.active_marked = into - (index < into)
    _store(root, strokes)


def _part_of(stroke: dict[str, Any]) -> int:
    return int(stroke.get("part", 0))


def remove_object(root: bpy.types.Collection, index: int) -> None:
    """Remove an object of the list with its strokes; what it was belongs to no object from then on."""
    properties = root.objectgs
    object_id = properties.marked[index].object_id
    _allow_nothing(root)
    properties.marked.remove(index)
    properties.active_marked = max(0, min(properties.active_marked, len(properties.marked) - 1))
    _store(root, [stroke for stroke in strokes_of(root) if stroke["object"] != object_id])


def add_stroke(
    root: bpy.types.Collection, object_id: int, view: View, points: Sequence[tuple[float, float]], area: bool
) -> None:
    """Add a stroke.

    Args:
        root: the reconstruction's collection.
        object_id: the object, or NOTHING.
        view: the view in the world that it was drawn in.
        points: its corners in pixels from the upper left.
        area: whether it encloses an area.
    """
    inside = [
        [round(min(max(x / view.width, 0.0), 1.0), 5), round(min(max(y / view.height, 0.0), 1.0), 5)] for x, y in points
    ]
    stroke = {"object": object_id, "camera": _camera(root, view), "points": inside}
    _store(root, [*strokes_of(root), {**stroke, "area": True} if area else stroke])


def remove_stroke(root: bpy.types.Collection, number: int) -> None:
    """Remove the stroke with a number, from 1; do nothing if there is none."""
    kept = strokes_of(root)
    if 1 <= number <= len(kept):
        _store(root, [*kept[: number - 1], *kept[number:]])


def clear(root: bpy.types.Collection) -> None:
    """Remove all strokes and objects."""
    _allow_nothing(root)
    root.objectgs.marked.clear()
    _store(root, [])


def _allow_nothing(root: bpy.types.Collection) -> None:
    if root.objectgs.everything:
        root.objectgs.everything = False


def _store(root: bpy.types.Collection, strokes: list[dict[str, Any]]) -> None:
    root.objectgs.strokes = json.dumps(strokes)


def _camera(root: bpy.types.Collection, view: View) -> dict[str, Any]:
    """Return the camera of a view in capture coordinates."""
    viewmat = view.viewmat @ scene.capture_to_world(root)
    scale = float(np.cbrt(abs(np.linalg.det(viewmat[:3, :3])))) or 1.0
    viewmat[:3] /= scale
    fx, fy = view.fx, view.fy
    if view.orthographic:
        # A camera far behind the view sees nearly the same.
        far = _FAR * view.width / (fx * scale)
        viewmat[2, 3] += far
        fx, fy = fx * scale * far, fy * scale * far
    return {
        "viewmat": viewmat.tolist(),
        "intrinsics": [fx, fy, view.cx, view.cy],
        "width": view.width,
        "height": view.height,
    }
