"""Mapping between object IDs, which may be any numbers, and class indices, which are contiguous from 0."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

LARGEST_ID = 2**32 - 1
"""Largest object ID; 0 is "no object"."""


class ClassTable:
    """The classes of a set of objects, in the order of their IDs.

    Attributes:
        ids: (C,) int64, ascending: the object ID of each class. A trained model's table begins with 0, "no object".
    """

    def __init__(self, ids: ArrayLike) -> None:
        self.ids: NDArray[np.int64] = np.unique(np.asarray(ids, np.int64))
        self._ids_and_none = np.append(self.ids, 0)

    def __len__(self) -> int:
        return len(self.ids)

    def classes_of(self, ids: ArrayLike) -> NDArray[np.int64]:
        """Return the class index of each object ID.

        Args:
            ids: integers >= 0 of any shape.

        Returns:
            int64 of the same shape; -1 for IDs that are not in the table.
        """
        classes = np.searchsorted(self.ids, ids)
        known = (classes < len(self.ids)) & (self._ids_and_none[classes] == ids)
        return np.where(known, classes, -1)

    def ids_of(self, classes: NDArray | Sequence[int] | int) -> NDArray[np.int64]:
        """Return the object ID of each class.

        Args:
            classes: integers of any shape; -1 for "no class".

        Returns:
            int64 of the same shape; 0 for -1.
        """
        return self._ids_and_none[classes]

    def classes_among(self, ids: ArrayLike) -> NDArray[np.int64]:
        """Return the classes whose object IDs are in `ids`, ascending."""
        return np.flatnonzero(np.isin(self.ids, ids))
