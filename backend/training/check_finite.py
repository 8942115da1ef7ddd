"""Diagnosis of non-finite losses and gradients: finds the values that cause them, after a cheap check has failed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch

from ..model.anchors import Layout
from ..model.generate import Generated
from ..model.object_model import ObjectModel
from ..raster import devices
from ..shared.reconstruction.objects import default_name
from .optimizer.adam import LARGEST_GRADIENT

BRIGHTEST = 1e9
"""Larger colors are reported as faults, since their squares overflow in SSIM."""

_COLUMNS = {
    "offsets": ("offset_columns", 3),
    "extents": ("extent_columns", 0),
    "features": ("feature_columns", 0),
    "opacities": ("opacity_columns", 1),
    "scales and rotations": ("shape_columns", 7),
    "colors": ("color_columns", 3),
}
"""The parts of an anchor's row: their columns, and the number of columns per splat (0: shared by all splats)."""


class Fault(NamedTuple):
    """Values that are not finite.

    Attributes:
        what: "the label loss", "the gradient of the offsets", ...
        anchors: (n,) int64, the affected anchors, if known.
        splat: index of the affected splat of the first anchor, if known.
        unrecoverable: (m,) int64, the anchors with non-finite parameters, not only gradients.
    """

    what: str
    anchors: torch.Tensor
    splat: int | None
    unrecoverable: torch.Tensor

    def owner(self, model: ObjectModel, names: Mapping[int, str]) -> str | None:
        """Return the name of the first anchor's object, of those in `names` by ID; None if no anchor is known."""
        if not len(self.anchors):
            return None
        object_id = int(model.classes.ids_of(int(model.anchors.ids[self.anchors[0]])))
        return names.get(object_id, default_name(object_id) if object_id else "no object")

    def sentence(self, step: int, view: str, owner: str | None) -> str:
        """Return a warning for the user; owner: the name of the first anchor's object."""
        first = f"Step {step}, {view}: {self.what} is not finite"
        if not len(self.anchors):
            return f"{first}; the update was skipped."
        who = "anchor" if self.splat is None else f"splat {self.splat} of anchor"
        others = len(self.anchors) - 1
        more = f" and {others} more" if others else ""
        fate = "the update was skipped"
        if len(self.unrecoverable):
            fate = (
                f"{len(self.unrecoverable)} of them were removed from the model"
                if others
                else "it was removed from the model"
            )
        return f"{first}, because of {who} {int(self.anchors[0])} ({owner}){more}; {fate}."


def find_fault_of_loss(terms: Mapping[str, torch.Tensor], g: Generated, seen: torch.Tensor, offsets: int) -> Fault:
    """Find the cause of a non-finite loss.

    Args:
        terms: the terms () of the loss by name.
        g: the rendered splats.
        seen: (n,) int64, their anchors.
        offsets: number of splats per anchor.
    """
    named = [name for name, value in terms.items() if not value.isfinite()]
    numbers = torch.cat([g.means, g.quats, g.scales, g.opacities[:, None]], 1).detach()
    broken = ~(numbers.isfinite().all(1) & (g.sh.detach().flatten(1).abs().amax(1) <= BRIGHTEST))
    if g.valid is not None:
        broken &= g.valid
    sources = g.source[broken]
    anchors = seen[sources // offsets].unique()
    splat = None
    if len(sources):
        splat = int(sources[seen[sources // offsets] == anchors[0]][0] % offsets)
    return Fault(" and ".join(named) or "the sum of the losses", anchors, splat, anchors)


def find_fault_of_rows(
    gradients: torch.Tensor, values: torch.Tensor, seen: torch.Tensor, layout: Layout
) -> Fault | None:
    """Find unusable gradients (n, columns) of the anchors `seen` (n,), whose rows are `values` (n, columns)."""
    bad = ~(gradients.abs() < LARGEST_GRADIENT)
    anchors = seen[bad.any(1)]
    if not len(anchors):
        return None
    columns = bad[bad.any(1)]
    named, splat = [], None
    for name, (part, of_splat) in _COLUMNS.items():
        places = columns[:, getattr(layout, part)]
        if places.any():
            named.append(name)
            if of_splat and splat is None and places[0].any():
                splat = int(places[0].nonzero()[0, 0]) // of_splat
    unrecoverable = seen[bad.any(1) & ~values.isfinite().all(1)]
    return Fault(f"the gradient of the {', '.join(named)}", anchors, splat, unrecoverable)


def find_fault_of_heads(gradients: Mapping[str, list[torch.Tensor]]) -> Fault | None:
    """Find a head with non-finite gradients; `gradients` are by the heads' names."""
    for name, parts in gradients.items():
        if not all(part.isfinite().all() for part in parts):
            none = torch.empty(0, dtype=torch.int64)
            of = "the background" if name == "background" else f"the {name} head"
            return Fault(f"the gradient of {of}", none, None, none)
    return None


class FiniteCheck:
    """Counter of updates that were skipped because a loss or gradient was not finite, with the latest fault.

    On the CPU, each step is checked immediately. On a GPU this would require synchronization, so it is done only while
    updates are being skipped, as detected by occasional calls of `watch`.
    """

    def __init__(self, device: torch.device) -> None:
        self.skipped = torch.zeros((), dtype=torch.int64, device=device)
        self.fault: Fault | None = None
        self._on_gpu = devices.on_gpu(self.skipped)
        self._closely = False
        self._noticed = 0

    @property
    def at_once(self) -> bool:
        """Whether each step is checked before the next step."""
        return self._closely or not self._on_gpu

    @at_once.setter
    def at_once(self, closely: bool) -> None:
        self._closely = closely

    def watch(self) -> None:
        """Enable immediate checks if updates were skipped since the last call, otherwise disable them on a GPU.

        Synchronizes with the GPU.
        """
        skipped = int(self.skipped)
        self._closely, self._noticed = skipped > self._noticed, skipped

    def take_fault(self) -> Fault | None:
        """Return the latest fault and clear it."""
        fault, self.fault = self.fault, None
        return fault

    def take_skipped(self) -> int:
        """Return the number of skipped updates since the last call; synchronizes with the GPU."""
        skipped = int(self.skipped)
        self.skipped.zero_()
        self._noticed = 0
        return skipped
