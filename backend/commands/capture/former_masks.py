"""The masks that an earlier run made: new ones keep their IDs and names, so that edits stay with their objects."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ...capture.files import mask_names, read_mask
from ...capture.made_masks import RECORD, is_made
from ...capture.names import read_names
from ...labels.association import Association, Seen
from ...labels.former_ids import ids_of_others, keep_ids
from ...shared.errors import InputError
from ...shared.formats.json_file import read_json
from ...shared.reconstruction.objects import default_name

_GRID = 128
"""Rows and columns of the pixels on which masks are compared."""


class FormerMasks(NamedTuple):
    """The masks of a capture that are replaced.

    Attributes:
        files: their files by photo, if they were made here.
        ids: their IDs by what the source calls an object, and by name.
        names: names by ID, also those of a capture whose masks were not made here.
        largest_id: the largest ID of any run.
    """

    files: dict[str, Path]
    ids: dict[Hashable, int]
    names: dict[int, str]
    largest_id: int

    def with_ids(
        self, association: Association, seen: Mapping[str, Seen], shapes: Mapping[str, Sequence[int]]
    ) -> Association:
        """Return the objects with the IDs that they have in these masks.

        Args:
            association: the objects.
            seen: the points that each photo shows.
            shapes: for each photo, the height and width of its segments.
        """
        ids = {}
        for index, (name, photo) in enumerate(seen.items()):
            mask = self._read(name)
            if mask is not None:
                rows, columns = (
                    at * own // whole for at, own, whole in zip(photo.xy.T[::-1], mask.shape, shapes[name])
                )
                ids[index] = mask[rows, columns]
        return keep_ids(association, list(seen.values()), ids, self.largest_id + 1)

    def others(self, masks: Iterable[tuple[str, np.ndarray]]) -> list[int]:
        """Return the IDs that these masks have for other objects than new masks, given with the names of the photos."""
        pairs = [np.zeros((2, 0), np.int64)]
        for name, mask in masks:
            former = self._read(name)
            if former is not None:
                pairs.append(np.stack([_sampled(mask), _sampled(former)]).reshape(2, -1))
        now, then = np.concatenate(pairs, axis=1)
        return ids_of_others(now, then)

    def named(
        self, names: Mapping[int, str], keys: Mapping[int, Hashable], others: Sequence[int] = ()
    ) -> dict[int, str]:
        """Return names by ID, of which those that are empty are replaced by the ones that the objects had.

        Args:
            names: names by ID.
            keys: by ID, what the source calls the object.
            others: the IDs that these masks have for other objects.
        """
        # Masks that were not made here have these IDs only if the source numbers its objects so.
        kept = {i for i in names if (i not in others if self.files else keys.get(i) == i)}
        return {i: name or (self.names.get(i) if i in kept else "") or default_name(i) for i, name in names.items()}

    def _read(self, photo: str) -> np.ndarray | None:
        """Read a mask; files that are damaged are replaced now, so they do not count."""
        if photo in self.files:
            with suppress(InputError):
                return read_mask(self.files[photo])
        return None


def read_former(capture: Path, photos: Sequence[str], kind: str) -> FormerMasks:
    """Return the masks that this command, or strokes, have made before.

    Args:
        capture: the capture's folder.
        photos: the photos that get masks.
        kind: the kind of the new masks; numbers of objects mean nothing in masks of another kind.
    """
    folder = capture / "masks"
    names: dict[int, str] = {}
    with suppress(InputError):
        names = read_names(capture)
    if not is_made(folder):
        return FormerMasks({}, {}, names, 0)
    there = {name: [folder / each for each in mask_names(name)[0] if (folder / each).is_file()] for name in photos}
    files = {name: paths[0] for name, paths in there.items() if paths}
    try:
        record = read_json(folder / RECORD)
        objects = [(int(entry["id"]), str(entry["name"]), _key_of(entry)) for entry in record["objects"]]
        ids: dict[Hashable, int] = {name: object_id for object_id, name, _ in objects}
        ids |= {key: i for i, _, key in objects if isinstance(key, str) or record["kind"] == kind}
        own = {object_id: names.get(object_id, name) for object_id, name, _ in objects}
        return FormerMasks(files, ids, own, int(record["largest_id"]))
    except (InputError, KeyError, TypeError, ValueError):
        # Of strokes, of an older version, or with IDs that a cleanup has found anew.
        former = FormerMasks(files, {name: object_id for object_id, name in names.items()}, names, 0)
        largest = [int(mask.max(initial=0)) for name in files if (mask := former._read(name)) is not None]
        return former._replace(largest_id=max([*names, *largest], default=0))


def _key_of(entry: Mapping[str, Any]) -> Hashable:
    """Return what the source called an object of masks.json; JSON has lists in place of tuples."""
    key = entry.get("key", str(entry["name"]))
    return tuple(key) if isinstance(key, list) else key


def _sampled(mask: np.ndarray) -> np.ndarray:
    """Return the IDs of a mask (h, w) on a grid that is the same for all sizes."""
    rows, columns = (np.linspace(0, size - 1, _GRID).astype(int) for size in mask.shape)
    return mask[np.ix_(rows, columns)].astype(np.int64)
