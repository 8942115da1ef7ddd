# SPDX-License-Identifier: GPL-3.0-or-later
"""Which splats the shader draws, and in which order.

An entry is a row (2,) float32 of the shader's table `order`: the index of a splat in the textures minus INDEX_OFFSET,
and its slot in the table of objects, plus SELECTED if the splat is selected.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ...backend.shared.splats.level_selection import PlacedLevels, marks_of_places, select
from ...backend.shared.splats.levels import Levels, Merged
from ...backend.shared.splats.picking import View
from .order import back_to_front
from .shaders import INDEX_OFFSET, SELECTED
from .splat_arrays import Labels, SplatArrays

PIXELS, MOST = 1.0, 750_000
"""Largest error of levels of detail, unless more than MOST splats had to be drawn."""


@dataclass(frozen=True)
class DrawnObject:
    """An object to draw.

    Attributes:
        splats: splats in local coordinates.
        matrix: (4, 4) local to world.
        recolor: (3, 4) affine map of colors.
        color: sRGB-encoded RGB that replaces the splats' colors but keeps their brightness, and its opacity.
        is_selected: outline it in the color of the selection.
        is_pointed_at: outline it in white.
        selected: (N,) bool, the splats that are drawn as selected; None if there are none.
        labels: colors of single splats; None if there are none.
        levels: the splats' levels of detail; None to draw them all.
    """

    splats: SplatArrays
    matrix: np.ndarray
    recolor: np.ndarray
    color: tuple[float, float, float, float]
    is_selected: bool = False
    is_pointed_at: bool = False
    selected: np.ndarray | None = None
    labels: Labels | None = None
    levels: Levels | None = None

    @property
    def slots(self) -> int:
        """Number of rows in the shader's table of objects: one for the object, and one for each color of labels."""
        return 1 if self.labels is None else 1 + len(self.labels.colors)

    @property
    def is_marked(self) -> bool:
        """Whether single splats are selected or labeled."""
        return self.selected is not None or self.labels is not None


class Entries(Protocol):
    """Entries of some objects, for one view after the other."""

    def holds(self, objs: Sequence[DrawnObject]) -> bool:
        """Return whether these entries are for the splats of these objects."""

    def update(self, objs: Sequence[DrawnObject], view: View) -> np.ndarray | None:
        """Return the entries (n, 2) for a view, the deepest first; None if they are the same as before."""


def entries_of(objs: Sequence[DrawnObject], starts: Mapping[int, int]) -> Entries:
    """Return the entries of objects; starts: identity of their splats -> index of the first one in the textures."""
    return _All(objs, starts) if all(obj.levels is None for obj in objs) else _Chosen(objs, starts)


class _All:
    """Entries of all splats."""

    def __init__(self, objs: Sequence[DrawnObject], starts: Mapping[int, int]) -> None:
        self._kept = _Kept(objs)
        self._splats = [obj.splats for obj in objs]
        counts = [len(splats.means) for splats in self._splats]
        self._entries = np.empty((sum(counts), 2), np.float32)
        self._depths = np.empty(len(self._entries), np.float32)
        ends = np.cumsum(counts)
        self._own = [slice(end - count, end) for end, count in zip(ends.tolist(), counts)]
        for obj, own, slot in zip(objs, self._own, self._kept.first_slots):
            self._entries[own, 0] = _indices(obj.splats, starts)
            self._entries[own, 1] = slot
        self._seen: np.ndarray | None = None
        self._order = np.zeros(0, np.int64)

    def holds(self, objs: Sequence[DrawnObject]) -> bool:
        return self._kept.holds(objs)

    def update(self, objs: Sequence[DrawnObject], view: View) -> np.ndarray | None:
        rows = view.viewmat[2] @ np.array([obj.matrix for obj in objs])
        # What is before the near plane is left out.
        seen = np.append(rows, [view.near, view.orthographic])
        moved = self._seen is None or not np.array_equal(seen, self._seen)
        marked = self._kept.has_other_marks(objs)
        if marked:
            for obj, own, slot in zip(objs, self._own, self._kept.first_slots):
                self._entries[own, 1] = _marks(obj, slot)
        if not marked and not moved:
            return None
        if moved:
            self._seen = seen
            for splats, row, own in zip(self._splats, rows.astype(np.float32), self._own):
                np.matmul(splats.means, row[:3], out=self._depths[own])
                self._depths[own] += row[3]
            self._order = back_to_front(self._depths, view.near, view.orthographic)
        return self._entries.take(self._order, axis=0)


class _Chosen:
    """Entries of the levels of detail that a view needs, and of all splats of objects without levels."""

    def __init__(self, objs: Sequence[DrawnObject], starts: Mapping[int, int]) -> None:
        self._kept = _Kept(objs)
        indices = {id(obj.splats): _indices_of_places(obj, starts) for obj in objs}
        self._indices = [indices[id(obj.splats)] for obj in objs]
        self._means = [obj.splats.means if obj.levels is None else obj.levels.means for obj in objs]
        self._slots: list[np.float32 | np.ndarray] = [np.float32(slot) for slot in self._kept.first_slots]
        self._mixed: list[np.ndarray | None] = [None] * len(objs)
        self._budget = max(MOST - sum(len(obj.splats.means) for obj in objs if obj.levels is None), MOST // 2)
        self._seen: np.ndarray | None = None

    def holds(self, objs: Sequence[DrawnObject]) -> bool:
        return self._kept.holds(objs)

    def update(self, objs: Sequence[DrawnObject], view: View) -> np.ndarray | None:
        marked = self._kept.has_other_marks(objs)
        if marked:
            for number, (obj, slot) in enumerate(zip(objs, self._kept.first_slots)):
                self._slots[number], self._mixed[number] = _marks(obj, slot), None
                if obj.levels is not None and obj.is_marked:
                    self._slots[number], self._mixed[number] = marks_of_places(obj.levels, self._slots[number])
        matrices = np.array([obj.matrix for obj in objs])
        lens = (view.fx, view.fy, view.cx, view.cy, view.width, view.height, view.near, view.orthographic)
        seen = np.concatenate([view.viewmat.ravel(), matrices.ravel(), lens])
        if not marked and self._seen is not None and np.array_equal(seen, self._seen):
            return None
        self._seen = seen
        with_levels = [
            PlacedLevels(obj.levels, obj.matrix, mixed)
            for obj, mixed in zip(objs, self._mixed)
            if obj.levels is not None
        ]
        chosen = iter(select(with_levels, view, PIXELS, self._budget))
        rows = (view.viewmat[2] @ matrices).astype(np.float32)
        depths, indices, slots = [], [], []
        for obj, row, own_means, own_indices, slot in zip(objs, rows, self._means, self._indices, self._slots):
            places = None if obj.levels is None else next(chosen)
            depths.append(_taken(own_means, places) @ row[:3] + row[3])
            indices.append(_taken(own_indices, places))
            slots.append(_taken(slot, places) if isinstance(slot, np.ndarray) else np.full(len(depths[-1]), slot))
        order = back_to_front(_joined(depths), view.near, view.orthographic)
        entries = np.empty((len(order), 2), np.float32)
        entries[:, 0] = _joined(indices).take(order)
        entries[:, 1] = _joined(slots).take(order)
        return entries


def _taken(values: np.ndarray, places: np.ndarray | None) -> np.ndarray:
    """Return the rows at places; None: all."""
    return values if places is None else values.take(places, axis=0)


def _joined(parts: list[np.ndarray]) -> np.ndarray:
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


class _Kept:
    """Splats, slots and marks of objects, to find out whether others have the same."""

    def __init__(self, objs: Sequence[DrawnObject]) -> None:
        self._objs = [(obj.splats, obj.levels, obj.slots) for obj in objs]
        self.first_slots = np.cumsum([0, *(obj.slots for obj in objs)])[:-1].tolist()
        self._marks: list[tuple[np.ndarray | None, Labels | None]] = [(None, None)] * len(objs)

    def holds(self, objs: Sequence[DrawnObject]) -> bool:
        return len(objs) == len(self._objs) and all(
            obj.splats is splats and obj.levels is levels and obj.slots == slots
            for obj, (splats, levels, slots) in zip(objs, self._objs)
        )

    def has_other_marks(self, objs: Sequence[DrawnObject]) -> bool:
        """Keep the marks of objects; return whether they differ from those kept before."""
        before, self._marks = self._marks, [(obj.selected, obj.labels) for obj in objs]
        return any(now is not then for pair in zip(before, self._marks) for then, now in zip(*pair))


def _indices(arrays: SplatArrays | Merged, starts: Mapping[int, int]) -> np.ndarray:
    """Return the first numbers of the entries of splats or merged splats, in their order."""
    start = starts[id(arrays)] - INDEX_OFFSET
    return np.arange(start, start + len(arrays.means)).astype(np.float32)


def _indices_of_places(obj: DrawnObject, starts: Mapping[int, int]) -> np.ndarray:
    """Return the first numbers of the entries of an object's splats, or of the places of its levels."""
    own = _indices(obj.splats, starts)
    if obj.levels is None:
        return own
    return np.concatenate([own[obj.levels.order], _indices(obj.levels.merged, starts)])


def _marks(obj: DrawnObject, slot: int) -> np.float32 | np.ndarray:
    """Return the second number of the entries of an object's splats, whose first slot is given."""
    marks = np.float32(slot) if obj.labels is None else (slot + obj.labels.of_splats).astype(np.float32)
    return marks if obj.selected is None else marks + np.float32(SELECTED) * obj.selected.astype(np.float32)
