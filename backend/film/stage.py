"""The edited splats of a moment: what objects.json says about colours and removals, what the shot says about places."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from .. import device
from ..editing.apply import apply_edits, transformed
from ..export.ply import read_splats
from ..model.splats import Splats, concatenate
from ..objects import SceneObject, read_objects
from ..protocol import Reconstruction, Reporter
from .shot import Frame, Placed, Sample, Shot

_FORMAT = 2
"""Of what is drawn and written: another number draws all frames anew."""

Tensors = dict[str, torch.Tensor]


class Stage:
    """The splats of a reconstruction, ready to be placed. names: of the objects, by the small integers that stand for
    them in pictures; ids (n,) uint32: their IDs."""

    def __init__(self, folder: Reconstruction, primitive: str, place: torch.device, reporter: Reporter) -> None:
        splats, warnings = read_splats(folder.splats)
        for warning in warnings:
            reporter.warning(warning)
        objects = read_objects(folder.objects) if folder.objects.exists() else []
        self.primitive = primitive
        self._place = place
        self._digest = _digest_of(folder.splats, objects, primitive)
        self._entries = {entry.id: entry for entry in objects}
        edited = apply_edits(splats, [replace(entry, transform=None, copies=()) for entry in objects])
        ids, slots = np.unique(edited.object_ids, return_inverse=True)
        self.ids = ids.astype(np.uint32)
        self.names = _names(ids.tolist(), self._entries)
        order = np.argsort(slots, kind="stable")
        ends = np.cumsum(np.bincount(slots, minlength=len(ids)))
        self._parts = {
            object_id: edited.select(order[ends[i - 1] if i else 0 : ends[i]])
            for i, object_id in enumerate(ids.tolist())
        }
        self._slots = {object_id: i for i, object_id in enumerate(ids.tolist())}
        self._moved: dict[int, tuple[bytes, Splats]] = {}
        self._drawn: tuple[Any, Splats, Tensors] | None = None

    def digest(self, shot: Shot, frame: Frame) -> str:
        """Changes with anything that the frame's picture depends on."""
        samples = [
            [sample.viewmat.tolist(), sample.K.tolist(), sample.clip,
             {str(key): sample.objects[key].stored() for key in sorted(sample.objects)}]
            for sample in frame.samples
        ]  # fmt: skip
        facts = [shot.width, shot.height, shot.pixel_aspect, shot.depth_scale, shot.only_named, frame.number, samples]
        return hashlib.sha256((self._digest + json.dumps(facts)).encode()).hexdigest()

    def at(self, sample: Sample, only_named: bool) -> Tensors:
        """What `rasterize` takes of the splats at a moment, on the device; ids are places in `names`."""
        wanted = {
            object_id: maps
            for object_id in self._parts
            if (maps := self._maps(object_id, sample, only_named)) is not None
        }
        key = {object_id: maps.tobytes() for object_id, maps in wanted.items()}
        if self._drawn is None or self._drawn[0] != key:
            parts = [self._moved_to(object_id, maps) for object_id, maps in wanted.items()]
            splats = concatenate(parts)
            self._drawn = key, splats, self._tensors(splats)
        _, splats, tensors = self._drawn
        depths = splats.means.astype(np.float64) @ sample.viewmat[2, :3] + sample.viewmat[2, 3]
        near_enough = depths <= sample.clip[1]
        if near_enough.all():
            return tensors
        kept = torch.from_numpy(near_enough).to(self._place)
        return {name: values[kept] for name, values in tensors.items()}

    def _maps(self, object_id: int, sample: Sample, only_named: bool) -> NDArray[np.float64] | None:
        """Where the object is, (n, 4, 4); None where it is not to be seen."""
        placed = sample.objects.get(object_id)
        if placed is None:
            placed = Placed(visible=not only_named)
        if not placed.is_seen:
            return None
        if placed.maps is not None:
            return placed.maps
        entry = self._entries.get(object_id)
        own = np.eye(4) if entry is None or entry.transform is None else np.array(entry.transform)
        return np.array([own, *(entry.copies if entry is not None else ())])

    def _moved_to(self, object_id: int, maps: NDArray[np.float64]) -> Splats:
        """The object at each of its places; the last answer is kept, as most objects stay where they are."""
        key = maps.tobytes()
        if object_id not in self._moved or self._moved[object_id][0] != key:
            part = self._parts[object_id]
            places = [part if np.array_equal(place, np.eye(4)) else transformed(part, place) for place in maps]
            self._moved[object_id] = key, places[0] if len(places) == 1 else concatenate(places)
        return self._moved[object_id][1]

    def _tensors(self, splats: Splats) -> Tensors:
        slots = np.array([self._slots[i] for i in np.unique(splats.object_ids).tolist()], np.int32)
        ids = slots[np.unique(splats.object_ids, return_inverse=True)[1]] if len(splats) else np.zeros(0, np.int32)
        arrays = {
            "quats": splats.quats, "scales": splats.scales, "opacities": splats.opacities, "sh": splats.sh,
        }  # fmt: skip
        tensors = {name: device.upload(values.astype(np.float32), self._place) for name, values in arrays.items()}
        means = splats.means if splats.means.dtype == np.float64 else splats.means.astype(np.float32)
        return {"means": device.upload(means, self._place), **tensors, "ids": device.upload(ids, self._place)}


def _digest_of(path: Path, objects: list[SceneObject], primitive: str) -> str:
    with open(path, "rb") as file:
        content = hashlib.file_digest(file, "sha256").hexdigest()
    drawn = [replace(entry, colour=(0, 0, 0), points=0) for entry in objects]
    return f"{_FORMAT} {content} {drawn!r} {primitive}"


def _names(ids: list[int], entries: dict[int, SceneObject]) -> list[str]:
    """A name for each object; equal ones get their ID behind them, since mattes are picked by name."""
    names = [entries[i].name if i in entries else "Unlabelled" if i == 0 else f"object {i}" for i in ids]
    return [f"{name} ({i})" if names.count(name) > 1 else name for name, i in zip(names, ids)]
