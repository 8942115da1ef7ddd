"""The splats of a model in parts, since all of those of a large model may not fit into memory beside it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from ..model.object_model import ObjectModel
from ..model.splats import Splats, some_blocks
from ..raster import devices


class Part(NamedTuple):
    """N splats in world units, and (N,) int64 the offset that each was generated from: anchor * offsets + offset."""

    splats: Splats
    source: NDArray[np.int64]


class ModelSplats(Protocol):
    """The splats of a model."""

    def parts(self) -> Iterator[Part]:
        """Yield all splats in the order of their anchors, the same each time; one part or more."""
        ...

    def of(self, anchors: torch.Tensor) -> Part:
        """Return the splats of anchors, given by their ascending indices, int64."""
        ...


class ExactSplats:
    """The splats of a view-independent model, which are made when they are asked for."""

    def __init__(self, model: ObjectModel) -> None:
        self._model = model

    def parts(self) -> Iterator[Part]:
        """As in `ModelSplats`."""
        anchors = self._model.anchors
        for rows in some_blocks(len(anchors), anchors.layout.offsets):
            yield self.of(torch.arange(rows.start, rows.stop, device=self._model.device))

    def of(self, anchors: torch.Tensor) -> Part:
        """As in `ModelSplats`."""
        return Part(*self._model.splats(anchors))


class FittedSplats:
    """The splats that were fitted to a view-dependent model, as from `fit_splats`."""

    def __init__(self, model: ObjectModel, splats: Splats, source: NDArray[np.int64]) -> None:
        self._model, self._all = model, Part(splats, source)

    def parts(self) -> Iterator[Part]:
        """As in `ModelSplats`."""
        splats, source = self._all
        for rows in some_blocks(len(splats)):
            yield Part(splats.select(rows), source[rows])

    def of(self, anchors: torch.Tensor) -> Part:
        """As in `ModelSplats`."""
        chosen = np.zeros(len(self._model.anchors), np.bool_)
        chosen[devices.host(anchors)] = True
        rows = np.flatnonzero(np.repeat(chosen, self._model.anchors.layout.offsets)[self._all.source])
        return Part(self._all.splats.select(rows), self._all.source[rows])
