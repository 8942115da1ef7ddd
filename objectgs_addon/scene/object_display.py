# SPDX-License-Identifier: GPL-3.0-or-later
"""Names and colors that objects are displayed with, and the collections that show them, as objects.json says."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...backend.shared.color.palette import UNLABELED, colors_of, to_linear
from ...backend.shared.reconstruction.folder import Reconstruction
from ...backend.shared.reconstruction.objects import SceneObject, default_name, read_objects, shown_as

_LINEAR = np.array([to_linear((value,))[0] for value in range(256)], np.float32)


def linear_colors(rgb: np.ndarray) -> np.ndarray:
    """Convert (n, 3) uint8 sRGB to (n, 4) float32 opaque linear RGBA."""
    colors = np.ones((len(rgb), 4), np.float32)
    colors[:, :3] = _LINEAR[rgb]
    return colors


@dataclass(frozen=True)
class Objects:
    """Objects of a reconstruction.

    Attributes:
        entries: ID -> object with the user's edits.
        shown: ID -> ID of the object that shows it, or None if it is left out.
    """

    entries: dict[int, SceneObject]
    shown: dict[int, int | None]

    @classmethod
    def read(cls, folder: Path) -> "Objects":
        """Read objects.json of a folder; without the file (before the first vote) there are no objects.

        Raises:
            InputError: objects.json is invalid.
        """
        path = Reconstruction(folder).objects
        entries = read_objects(path) if path.exists() else []
        return cls({entry.id: entry for entry in entries}, shown_as(entries))

    def shown_as(self, object_id: int) -> int | None:
        """Return the ID of the object whose collection shows `object_id`, or None if the object is left out."""
        return self.shown.get(object_id, object_id)

    def name(self, object_id: int) -> str:
        """Return the object's name, or a default name if the ID is not in objects.json."""
        return self.entries[object_id].name if object_id in self.entries else default_name(object_id)

    def rgb(self, object_id: int) -> tuple[int, int, int]:
        """Return the object's color, sRGB 0 .. 255."""
        if object_id in self.entries:
            red, green, blue = self.entries[object_id].color
            return red, green, blue
        red, green, blue = (int(value) for value in colors_of([object_id])[0])
        return red, green, blue

    def colors(self, ids: np.ndarray) -> np.ndarray:
        """Return (n, 4) float32 linear RGBA for (n,) IDs; merged objects share a color, left-out objects are gray."""
        if len(ids) == 0:
            return np.zeros((0, 4), np.float32)
        known, inverse = np.unique(ids, return_inverse=True)
        shown = [self.shown_as(int(object_id)) for object_id in known]
        rgb = np.array([UNLABELED if target is None else self.rgb(target) for target in shown], np.uint8)
        return linear_colors(rgb)[inverse.reshape(-1)]

    def grouping(self) -> dict[str, int | None]:
        """Map the IDs (as strings) of merged and left-out objects to the result of `shown_as`."""
        return {str(object_id): target for object_id, target in self.shown.items() if target != object_id}
