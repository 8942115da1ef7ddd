"""`edit`: what the user wants changed about objects, kept in objects.json; splats.ply stays as it is."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from ..editing.place import Placement, luma_of, middle_of
from ..export import read_splats
from ..model.splats import Splats
from ..objects import Matrix, SceneObject, edit_objects, find_object, merged, read_objects
from ..protocol import InputError, Reconstruction
from ..stopping import StoppingReporter
from .cameras import read_upright
from .filling import close_places

_NONE: dict[str, Any] = dict.fromkeys(("removed", "floaters", "fill", "recolour", "transform", "copies"))
"""Takes every edit of an object back that this command makes."""


def edit(options: argparse.Namespace, reporter: StoppingReporter) -> None:
    """Store the edits that are asked for, work out what closes the places of the removed, and say what is edited."""
    folder = Reconstruction(options.folder)
    for name in ("floaters", "fill"):
        if getattr(options, name) and not options.remove:
            raise InputError(f"--{name} goes with --remove, which says what is removed.")
    wanted = _Edits(folder)
    everything = [word for word in options.reset if word.casefold() == "all"]
    for entry in wanted.objects if everything else wanted.find(options.reset):
        wanted.change(entry, **_NONE)
    for entry in wanted.find(options.restore):
        wanted.change(entry, removed=None, floaters=None, fill=None)
    for entry in wanted.find(options.remove):
        wanted.change(entry, removed=True, floaters=options.floaters or None, fill=options.fill or None)
    for word, recolour in options.recolor:
        (entry,) = wanted.find([word])
        wanted.change(entry, recolour=replace(recolour, middle=luma_of(wanted.splats_of(entry))).stored())
    for word, values in options.move:
        (entry,) = wanted.find([word])
        wanted.change(entry, transform=wanted.place(entry, Placement(**values)))
    for word, values in options.duplicate:
        (entry,) = wanted.find([word])
        wanted.change(entry, copies=[*wanted.copies(entry), wanted.place(entry, Placement(**values))])
    if wanted.changes:
        edit_objects(folder.objects, wanted.changes)
    invented = close_places(folder, reporter)
    # As one message, since who shows the state of a job shows only the latest.
    lines = [
        f"{e.id} {e.name}: {', '.join(_described(e, invented.get(e.id))) or 'as captured'}"
        for e in read_objects(folder.objects)
    ]
    reporter.status("\n".join(lines) or "There are no objects.")
    reporter.done(objects=str(folder.objects), edited=len(wanted.changes), invented=sum(invented.values()))


class _Edits:
    """What one command changes, from what the folder holds."""

    def __init__(self, folder: Reconstruction) -> None:
        self.folder = folder
        self.objects = read_objects(folder.objects)
        self.changes: dict[int, dict[str, Any]] = {}

    def find(self, words: Iterable[str]) -> Sequence[SceneObject]:
        return [find_object(self.objects, word, self.folder.objects) for word in words]

    def change(self, entry: SceneObject, **values: Any) -> None:
        self.changes.setdefault(entry.id, {}).update(values)

    def copies(self, entry: SceneObject) -> Sequence[Matrix]:
        """The copies there are, with what was changed so far."""
        return self.changes.get(entry.id, {}).get("copies", entry.copies) or ()

    def splats_of(self, entry: SceneObject) -> Splats:
        """The splats of an object as captured, those merged into it among them; InputError where there are none."""
        ids = [i for i, target in merged(self.objects).items() if target == entry.id]
        own = self._splats.select(np.isin(self._splats.object_ids, ids))
        if len(own) == 0:
            raise InputError(f"{self.folder.splats} has no splats of {entry.name}, so they cannot be edited.")
        return own

    def place(self, entry: SceneObject, placement: Placement) -> Matrix:
        return placement.matrix(middle_of(self.splats_of(entry)), read_upright(self.folder).rotation)

    @cached_property
    def _splats(self) -> Splats:
        return read_splats(self.folder.splats)[0]


def _described(entry: SceneObject, invented: int | None) -> list[str]:
    """What is edited about an object, in words; invented: how many splats close its place, where that was asked for."""
    words = [f"merged into {entry.merged_into}"] if entry.merged_into is not None else []
    words += ["left out"] if entry.left_out else []
    if entry.removed:
        words.append("removed" + " with floaters" * entry.floaters)
        if entry.fill and invented == 0:
            words.append("nothing flat around it that could close its place")
        elif entry.fill:
            words.append("its place filled" + f" by {invented:,} invented splats" * bool(invented))
    if entry.recolour:
        stored = entry.recolour.stored() or {}
        words.append("recoloured " + " ".join(f"{key}={_short(value)}" for key, value in stored.items()))
    if entry.transform:
        scale = abs(np.linalg.det(np.array(entry.transform)[:3, :3])) ** (1 / 3)
        words.append("moved" if abs(scale - 1) < 1e-6 else f"moved, scaled by {scale:.4g}")
    if entry.copies:
        words.append(f"{len(entry.copies)} cop{'y' if len(entry.copies) == 1 else 'ies'}")
    return words


def _short(value: Any) -> str:
    return "/".join(map(_short, value)) if isinstance(value, list) else f"{value:.4g}"
