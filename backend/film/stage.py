"""The edited splats at a sample time: colors and removals from objects.json, transforms from the shot."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..editing import apply_edits, apply_splat_edits, transformed
from ..export.ply import read_splats
from ..model.splats import Splats, concatenate
from ..raster import devices
from ..shared.class_table import ClassTable
from ..shared.events import Reporter
from ..shared.formats.regular_file import open_regular
from ..shared.reconstruction.edits.splat_edits import digest_of, read_splat_edits
from ..shared.reconstruction.folder import Reconstruction
from ..shared.reconstruction.objects import SceneObject, default_name, read_objects
from ..shared.reconstruction.shot import Frame, Placed, Sample, Shot

_FORMAT = 4
"""Version of the renders and files; a change causes all frames to be rendered again."""

Tensors = dict[str, torch.Tensor]


class Stage:
    """The splats of a reconstruction with their edits, to be rendered with the transforms of a sample.

    Attributes:
        names: names of the objects by class index; the rendered IDs are class indices.
        primitive: "3d" or "2d".
        blur: variance of the low-pass filter of the splats.
    """

    def __init__(self, folder: Reconstruction, primitive: str, device: torch.device, reporter: Reporter) -> None:
        splats, warnings = read_splats(folder.splats)
        splats, more = apply_splat_edits(splats, folder)
        for warning in warnings + more:
            reporter.warning(warning)
        objects = read_objects(folder.objects) if folder.objects.exists() else []
        self.primitive = primitive
        self.blur = splats.blur
        self._device = device
        self._digest = _digest_of(folder, objects, primitive)
        self._entries = {entry.id: entry for entry in objects}
        edited = apply_edits(splats, [replace(entry, transform=None, copies=()) for entry in objects], reporter)
        self.classes = ClassTable(edited.object_ids)
        ids, slots = self.classes.ids, self.classes.classes_of(edited.object_ids)
        self.names = _names(ids.tolist(), self._entries)
        order = np.argsort(slots, kind="stable")
        ends = np.cumsum(np.bincount(slots, minlength=len(ids)))
        self._parts = {
            object_id: edited.select(order[ends[i - 1] if i else 0 : ends[i]])
            for i, object_id in enumerate(ids.tolist())
        }
        self._moved: dict[int, tuple[bytes, Splats]] = {}
        self._drawn: tuple[Any, Splats, Tensors] | None = None

    def digest(self, shot: Shot, frame: Frame) -> str:
        """Return a digest of everything that the frame's image depends on."""
        samples = [
            [sample.viewmat.tolist(), sample.K.tolist(), sample.clip,
             {str(key): sample.objects[key].stored() for key in sorted(sample.objects)}]
            for sample in frame.samples
        ]  # fmt: skip
        facts = [shot.width, shot.height, shot.pixel_aspect, shot.depth_scale, shot.only_named, frame.number, samples]
        return hashlib.sha256((self._digest + json.dumps(facts)).encode()).hexdigest()

    def at(self, sample: Sample, only_named: bool) -> Tensors:
        """Return the splats of a sample.

        Args:
            sample: The sample with its camera, transforms and visibility.
            only_named: Leave out objects that the sample does not list.

        Returns:
            Arguments of `rasterize` on the device; ids are indices in `names`.
        """
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
        kept = torch.from_numpy(near_enough).to(self._device)
        return {name: values[kept] for name, values in tensors.items()}

    def _maps(self, object_id: int, sample: Sample, only_named: bool) -> NDArray[np.float64] | None:
        """Return the transforms (n, 4, 4) of an object and its duplicates; None if it is not visible."""
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
        """Return the splats of an object under each of its transforms; the last ones are cached."""
        key = maps.tobytes()
        if object_id not in self._moved or self._moved[object_id][0] != key:
            part = self._parts[object_id]
            places = [part if np.array_equal(place, np.eye(4)) else transformed(part, place) for place in maps]
            self._moved[object_id] = key, places[0] if len(places) == 1 else concatenate(places)
        return self._moved[object_id][1]

    def _tensors(self, splats: Splats) -> Tensors:
        ids = self.classes.classes_of(splats.object_ids).astype(np.int32)
        arrays = {
            "quats": splats.quats, "scales": splats.scales, "opacities": splats.opacities, "sh": splats.sh,
        }  # fmt: skip
        tensors = {name: devices.upload(values.astype(np.float32), self._device) for name, values in arrays.items()}
        means = splats.means if splats.means.dtype == np.float64 else splats.means.astype(np.float32)
        return {"means": devices.upload(means, self._device), **tensors, "ids": devices.upload(ids, self._device)}


def _digest_of(folder: Reconstruction, objects: list[SceneObject], primitive: str) -> str:
    with open_regular(folder.splats) as file:
        content = hashlib.file_digest(file, "sha256").hexdigest()
    drawn = [replace(entry, color=(0, 0, 0), points=0) for entry in objects]
    return f"{_FORMAT} {content} {drawn!r} {primitive} {digest_of(read_splat_edits(folder))}"


def _names(ids: list[int], entries: dict[int, SceneObject]) -> list[str]:
    """Return a name for each object; equal names get their ID, since mattes are selected by name."""
    names = [entries[i].name if i in entries else default_name(i) for i in ids]
    counts, taken = Counter(names), set(names)
    for at, i in enumerate(ids):
        if counts[names[at]] > 1:
            while names[at] in taken:
                names[at] += f" ({i})"
            taken.add(names[at])
    return names
