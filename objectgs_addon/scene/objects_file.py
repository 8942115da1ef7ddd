# SPDX-License-Identifier: GPL-3.0-or-later
"""What objects.json says about showing objects: names, colors, which are merged and which are left out."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...backend.shared.color.palette import UNLABELED, colors_of, to_linear
from ...backend.shared.reconstruction.folder import Reconstruction
from ...backend.shared.reconstruction.objects import SceneObject, default_name, merged, read_objects

_LINEAR = np.array([to_linear((value,))[0] for value in range(256)], np.float32)


def linear_colors(rgb: np.ndarray) -> np.ndarray:
    """(n, 3) uint8 sRGB -> (n, 4) float32 linear, opaque."""
    colors = np.ones((len(rgb), 4), np.float32)
    colors[:, :3] = _LINEAR[rgb]
    return colors


@dataclass(frozen=True)
class Objects:
    """entries: ID -> object with the user's edits; target: ID -> the ID that it is shown as."""

    entries: dict[int, SceneObject]
    target: dict[int, int]

    @classmethod
    def read(cls, folder: Path) -> "Objects":
        """objects.json of a folder; no objects where there was no vote yet, InputError where it is broken."""
        path = Reconstruction(folder).objects
        entries = read_objects(path) if path.exists() else []
        return cls({entry.id: entry for entry in entries}, merged(entries))

    def shown_as(self, object_id: int) -> int | None:
        """The ID whose collection shows `object_id`, or None where it is left out."""
        target = self.target.get(object_id, object_id)
        if any(at in self.entries and self.entries[at].left_out for at in (object_id, target)):
            return None
        return target

    def name(self, object_id: int) -> str:
        """The object's name; IDs that objects.json does not know get one, too."""
        return self.entries[object_id].name if object_id in self.entries else default_name(object_id)

    def rgb(self, object_id: int) -> tuple[int, int, int]:
        """The object's color, sRGB 0 .. 255."""
        if object_id in self.entries:
            red, green, blue = self.entries[object_id].color
            return red, green, blue
        red, green, blue = (int(value) for value in colors_of([object_id])[0])
        return red, green, blue

    def colors(self, ids: np.ndarray) -> np.ndarray:
        """(n,) IDs -> (n, 4) float32 linear: an object's color is that of what it is shown as, gray if left out."""
        if len(ids) == 0:
            return np.zeros((0, 4), np.float32)
        known, inverse = np.unique(ids, return_inverse=True)
        shown = [self.shown_as(int(object_id)) for object_id in known]
        rgb = np.array([UNLABELED if target is None else self.rgb(target) for target in shown], np.uint8)
        return linear_colors(rgb)[inverse.reshape(-1)]

    def grouping(self) -> dict[str, int | None]:
        """ID (as text) -> what it is shown as, of those that are not shown as themselves."""
        shown = {object_id: self.shown_as(object_id) for object_id in self.entries}
        return {str(object_id): target for object_id, target in shown.items() if target != object_id}
