"""`edit`: store the user's edits of objects in objects.json; splats.ply does not change."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ...editing import apply_splat_edits
from ...editing.placement import Placement, luma_of, middle_of
from ...export import read_splats
from ...model.splats import Splats
from ...shared.errors import InputError
from ...shared.reconstruction.edits.splat_edits import SplatEdits, read_splat_edits
from ...shared.reconstruction.folder import Reconstruction
from ...shared.reconstruction.objects import Matrix, SceneObject, edit_objects, find_object, members_of, read_objects
from ...shared.stopping import StoppingReporter
from ..cameras import read_upright
from ..folder import READ
from .fill import FILL, fill_holes

_NONE: dict[str, Any] = dict.fromkeys(("removed", "floaters", "fill", "cleaned", "recolor", "transform", "copies"))
"""Resets every edit of an object that this command makes."""


_CHANGES = ("reset", "restore", "remove", "restore_floaters", "clean_floaters", "recolor", "move", "duplicate")
"""Options that change objects; without them, the command lists edits and also works in a folder that is read-only."""


def edit(options: argparse.Namespace, reporter: StoppingReporter) -> None:
    """Store the edits of the options, fill the holes of removed and moved objects, and report all edits."""
    folder = Reconstruction(options.folder)
    if options.floaters and not options.remove:
        raise InputError("--floaters requires --remove, which selects the objects to remove.")
    if options.fill and not (options.remove or options.move):
        raise InputError("--fill requires --remove or --move, which selects the objects that leave holes.")
    reporter.expect({READ: ("Reading", 3.0), FILL: ("Filling", 20.0)})
    reporter.begin(READ, "Reading the objects")
    edited = 0

    def changes(objects: list[SceneObject]) -> dict[int, dict[str, Any]]:
        nonlocal edited
        found = _changes(options, _Edits(folder, objects, splats))
        edited = len(found)
        return found

    is_change = any(getattr(options, name) for name in _CHANGES)
    if is_change:
        folder.require_writable()
    # Read before objects.json is locked, since it can take long.
    needs_splats = options.recolor or options.move or options.duplicate
    splats = apply_splat_edits(read_splats(folder.splats)[0], folder)[0] if needs_splats else None
    if is_change:
        edit_objects(folder.objects, changes)
    new_splats = fill_holes(folder, reporter)
    # As one message, since a status display shows only the latest one.
    lines = [
        f"{e.id} {e.name}: {', '.join(_described(e, new_splats.get(e.id))) or 'as captured'}"
        for e in read_objects(folder.objects)
    ]
    lines += _splat_edits(read_splat_edits(folder))
    reporter.status("\n".join(lines) or "There are no objects.")
    reporter.done(objects=str(folder.objects), edited=edited, new_splats=sum(new_splats.values()))


def _changes(options: argparse.Namespace, wanted: _Edits) -> dict[int, dict[str, Any]]:
    """Return the changes that the options make, for `edit_objects`."""
    for entry in wanted.find_or_all(options.reset):
        wanted.change(entry, **_NONE)
    for entry in wanted.find(options.restore):
        wanted.change(entry, removed=None, floaters=None)
        if entry.transform is None:
            wanted.change(entry, fill=None)
    for entry in wanted.find(options.remove):
        wanted.change(entry, removed=True, floaters=options.floaters or None)
        if options.fill:
            wanted.change(entry, fill=True)
    for entry in wanted.find_or_all(options.restore_floaters):
        wanted.change(entry, cleaned=None)
    for entry in wanted.find_or_all(options.clean_floaters):
        wanted.change(entry, cleaned=True)
    for word, recolor in options.recolor:
        (entry,) = wanted.find([word])
        wanted.change(entry, recolor=replace(recolor, middle=luma_of(wanted.splats_of(entry))).stored())
    for word, values in options.move:
        (entry,) = wanted.find([word])
        wanted.change(entry, transform=wanted.transform(entry, Placement(**values)))
        if options.fill:
            wanted.change(entry, fill=True)
    for word, values in options.duplicate:
        (entry,) = wanted.find([word])
        wanted.change(entry, copies=[*wanted.copies(entry), wanted.transform(entry, Placement(**values))])
    return wanted.changes


class _Edits:
    """The changes of one command to the objects of a folder."""

    def __init__(self, folder: Reconstruction, objects: list[SceneObject], splats: Splats | None) -> None:
        self.folder = folder
        self.objects = objects
        self._splats = splats
        self.changes: dict[int, dict[str, Any]] = {}

    def find(self, words: Iterable[str]) -> Sequence[SceneObject]:
        return [find_object(self.objects, word, self.folder.objects) for word in words]

    def find_or_all(self, words: Sequence[str]) -> Sequence[SceneObject]:
        """Find the objects that are named; the word `all` stands for every object."""
        everything = any(word.casefold() == "all" for word in words)
        return self.objects if everything else self.find(words)

    def change(self, entry: SceneObject, **values: Any) -> None:
        self.changes.setdefault(entry.id, {}).update(values)

    def copies(self, entry: SceneObject) -> Sequence[Matrix]:
        """Return the duplicates of an object, including the changes so far."""
        return self.changes.get(entry.id, {}).get("copies", entry.copies) or ()

    def splats_of(self, entry: SceneObject) -> Splats:
        """Return the captured splats of an object, including those merged into it; InputError if there are none."""
        assert self._splats is not None
        own = self._splats.select(np.isin(self._splats.object_ids, members_of(self.objects, entry.id)))
        if len(own) == 0:
            raise InputError(f"{self.folder.splats} has no splats of {entry.name}, so it cannot be edited.")
        return own

    def transform(self, entry: SceneObject, placement: Placement) -> Matrix:
        return placement.matrix(middle_of(self.splats_of(entry)), read_upright(self.folder).rotation)


def _described(entry: SceneObject, new_splats: int | None) -> list[str]:
    """Describe the edits of an object; new_splats: number that fills its hole, None if it is not to be filled."""
    words = [f"merged into {entry.merged_into}"] if entry.merged_into is not None else []
    words += ["left out"] if entry.left_out else []
    if entry.removed:
        words.append("removed" + " with floaters" * entry.floaters)
    if entry.fill and new_splats == 0:
        words.append("its hole not filled, since there is no flat surface around it")
    elif entry.fill:
        words.append("its hole filled" + f" with {new_splats:,} new splats" * bool(new_splats))
    words += ["floaters hidden"] if entry.cleaned else []
    if entry.recolor:
        stored = entry.recolor.stored() or {}
        # Which is no option, but follows from the object.
        stored.pop("middle", None)
        words.append("recolored " + " ".join(f"{key}={_short(value)}" for key, value in stored.items()))
    if entry.transform:
        scale = abs(np.linalg.det(np.array(entry.transform)[:3, :3])) ** (1 / 3)
        words.append("moved" if abs(scale - 1) < 1e-6 else f"moved, scaled by {scale:.4g}")
    if entry.copies:
        words.append(f"{len(entry.copies)} cop{'y' if len(entry.copies) == 1 else 'ies'}")
    return words


def _splat_edits(edits: SplatEdits) -> list[str]:
    """Describe the edits of single splats on at most one line."""
    words = [f"{count:,} {what}" for count, what in ((edits.deleted, "deleted"), (edits.assigned, "assigned")) if count]
    words += ["cropped to a box"] if edits.crop is not None else []
    return [f"single splats: {', '.join(words)}"] if words else []


def _short(value: Any) -> str:
    return "/".join(map(_short, value)) if isinstance(value, list) else f"{value:.4g}"
