"""Which numbers are at fault where a loss or a gradient is not finite; asked only once a cheap check has failed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch

from ..model.anchors import Layout
from ..model.generate import Generated
from .adam import LARGEST_GRADIENT

BRIGHTEST = 1e9
"""A colour beyond this is no colour: squares of such numbers overflow in SSIM."""

_COLUMNS = {
    "offsets": ("offset_columns", 3),
    "extents": ("extent_columns", 0),
    "features": ("feature_columns", 0),
    "opacities": ("opacity_columns", 1),
    "scales and rotations": ("shape_columns", 7),
    "colours": ("color_columns", 3),
}
"""The parts of an anchor's row: their columns, and how many of them each of its splats has (0: shared by all)."""


class Fault(NamedTuple):
    """what: "the label loss", "the gradient of the offsets", ...; anchors (n,) int64: those that it comes from, where
    that is known; splat: which of the first one's, where that is known; hopeless: which of the anchors (m,) int64 hold
    numbers that no training leads back from."""

    what: str
    anchors: torch.Tensor
    splat: int | None
    hopeless: torch.Tensor

    def sentence(self, step: int, view: str, owner: str | None) -> str:
        """What to tell the user; owner: the name of the first anchor's object."""
        first = f"Step {step}, {view}: {self.what} is not finite"
        if not len(self.anchors):
            return f"{first}; the update was skipped."
        who = "anchor" if self.splat is None else f"splat {self.splat} of anchor"
        others = len(self.anchors) - 1
        more = f" and {others} more" if others else ""
        fate = "the update was skipped"
        if len(self.hopeless):
            fate = f"{len(self.hopeless)} of them were taken out" if others else "it was taken out of the model"
        return f"{first}, because of {who} {int(self.anchors[0])} ({owner}){more}; {fate}."


def of_loss(terms: Mapping[str, torch.Tensor], g: Generated, seen: torch.Tensor, offsets: int) -> Fault:
    """Why the sum of the terms, each () and by its name, is not finite. g: what was drawn, of the anchors `seen` (n,)
    with so many offsets."""
    named = [name for name, value in terms.items() if not value.isfinite()]
    numbers = torch.cat([g.means, g.quats, g.scales, g.opacities[:, None]], 1).detach()
    broken = ~(numbers.isfinite().all(1) & (g.sh.detach().flatten(1).abs().amax(1) <= BRIGHTEST))
    if g.made is not None:
        broken &= g.made
    sources = g.source[broken]
    anchors = seen[sources // offsets].unique()
    splat = None
    if len(sources):
        splat = int(sources[seen[sources // offsets] == anchors[0]][0] % offsets)
    return Fault(" and ".join(named) or "the sum of the losses", anchors, splat, anchors)


def of_rows(gradients: torch.Tensor, values: torch.Tensor, seen: torch.Tensor, layout: Layout) -> Fault | None:
    """Which gradients (n, columns) of the anchors `seen` (n,), whose rows are `values` (n, columns), cannot be used."""
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
    hopeless = seen[bad.any(1) & ~values.isfinite().all(1)]
    return Fault(f"the gradient of the {', '.join(named)}", anchors, splat, hopeless)


def of_heads(gradients: Mapping[str, list[torch.Tensor]]) -> Fault | None:
    """Which head's gradients are not finite, by the heads' names."""
    for name, parts in gradients.items():
        if not all(part.isfinite().all() for part in parts):
            nowhere = torch.empty(0, dtype=torch.int64)
            of = "the background" if name == "background" else f"the {name} head"
            return Fault(f"the gradient of {of}", nowhere, None, nowhere)
    return None
