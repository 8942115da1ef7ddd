"""Gives each point of the cloud an object ID by letting the views' masks vote (ObjectGS, three strategies).

Two differences from the published code: a point behind the camera or outside the image does not vote there, and label
0 (unlabelled) counts only where nothing else voted. Held-out views do not vote, so that quality stays measured on
views whose masks nothing has seen.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from scipy.ndimage import minimum_filter

from ..capture import Capture
from ..protocol import Reporter

Strategy = Literal["majority", "probability", "correspondence"]

FEW_POINTS = 20
"""Fewer points than this make an object worth a warning."""

_SLOTS = 6
_MERGE_AT = 1 << 23


@dataclass(frozen=True)
class Votes:
    """ids (M,) int64 object of each point, 0 where nobody voted for one; margins (M,) float32 in [0, 1]: the chosen
    ID's share of the votes other than 0, less the share of the best other ID; counts: points of each object; visible
    (M,) int32: how many views voted on the point, with 0 or another ID."""

    ids: np.ndarray
    margins: np.ndarray
    counts: dict[int, int]
    visible: np.ndarray
    warnings: list[str] = field(default_factory=list)


def vote(
    capture: Capture,
    strategy: Strategy = "majority",
    seed: int = 0,
    occlusion: bool = True,
    reporter: Reporter | None = None,
    places: np.ndarray | None = None,
) -> Votes:
    """Label the capture's points from its masks, or other `places` (M,3) in its coordinates, which COLMAP knows nothing
    about (splats, say).

    majority: each view in which the point lies votes with the ID at its pixel, the most frequent wins, ties go to the
    smallest. probability: the ID is drawn in proportion to those votes, from `seed`. correspondence: only views in
    which COLMAP observed the point vote, at the observed pixel. `occlusion` drops views in which nearer points hide
    the point, unless COLMAP observed it there (no effect on correspondence). On the demo capture it raises the share
    of points labelled right from 97.4% to 99.3% (majority) and from 75% to 98% (probability).
    """
    if strategy not in ("majority", "probability", "correspondence"):
        raise ValueError(f"unknown strategy {strategy!r}")
    if places is not None and strategy == "correspondence":
        raise ValueError("COLMAP observed no places but its own points, so none correspond to others")
    reporter = reporter or Reporter()
    object_ids = capture.object_ids
    voters = capture.points.xyz if places is None else places
    ballots = _Ballots(len(voters), len(object_ids))
    indices = [i for i in capture.train_indices if capture.views[i].mask_file is not None]

    def cast(index: int, points: np.ndarray, x: np.ndarray, y: np.ndarray) -> None:
        mask = capture.mask(index)
        assert mask is not None
        seen = mask[y, x]
        ballots.add(points, np.where(seen == 0, -1, np.searchsorted(object_ids, seen)))

    xyz = np.ascontiguousarray(voters.T, np.float64)
    nothing = np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.int64)
    reporter.status("Voting")
    for done, index in enumerate(indices, 1):
        observed = None
        if strategy == "correspondence" or occlusion:
            observed = _observed(capture, index) if places is None else nothing
        if strategy == "correspondence":
            assert observed is not None
            cast(index, *observed)
        else:
            cast(index, *_projected(capture, xyz, index, observed[0] if observed else None))
        reporter.progress(done, len(indices), what="views")
    if occlusion and strategy != "correspondence" and not ballots.visible.all():
        # Hidden from every view by what the z-buffer can tell: then what projects there is better than nothing.
        silent = ballots.visible == 0
        for index in indices:
            points, x, y = _projected(capture, xyz, index, None)
            keep = silent[points]
            cast(index, points[keep], x[keep], y[keep])
    chosen, margins = ballots.count(np.random.default_rng(seed) if strategy == "probability" else None)
    ids = np.where(chosen < 0, 0, object_ids[chosen] if len(object_ids) else 0).astype(np.int64)
    won = np.bincount(chosen[chosen >= 0], minlength=len(object_ids))
    counts = {int(i): int(n) for i, n in zip(object_ids, won)}
    warnings = _warnings(capture, counts, int((ids == 0).sum()) if len(object_ids) else 0, len(ids))
    for sentence in warnings:
        reporter.warning(sentence)
    return Votes(ids, margins, counts, ballots.visible, warnings)


def _warnings(capture: Capture, counts: dict[int, int], unlabelled: int, points: int) -> list[str]:
    def listed(ids: list[int]) -> str:
        named = [f"{i} ({capture.names[i]})" if i in capture.names else str(i) for i in ids[:10]]
        return ", ".join(named) + (f" and {len(ids) - 10} more" if len(ids) > 10 else "")

    none = [i for i, count in counts.items() if count == 0]
    few = [i for i, count in counts.items() if 0 < count < FEW_POINTS]
    warnings = []
    if none:
        warnings.append(f"No point was labelled as object {listed(none)}, so training starts without it.")
    if few:
        warnings.append(f"Fewer than {FEW_POINTS} points were labelled as object {listed(few)}.")
    if 2 * unlabelled > points:
        warnings.append(f"{unlabelled} of {points} points were labelled as no object.")
    return warnings


def _projected(
    capture: Capture, xyz: np.ndarray, index: int, observed: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Those of the points xyz (3,M) in front of a view and inside it: indices, pixels' columns and rows, all (n,).

    Given the points that COLMAP observed there, those that others hide are left out, but never an observed one.
    """
    view = capture.views[index]
    # Not as a matrix product: BLAS spends 50 times as long on its threads as on a product this narrow.
    x, y, z = (r[0] * xyz[0] + r[1] * xyz[1] + r[2] * xyz[2] + r[3] for r in view.viewmat[:3])
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        x = x / z * view.K[0, 0] + view.K[0, 2]
        y = y / z * view.K[1, 1] + view.K[1, 2]
        points = np.flatnonzero((z > 0) & (x >= 0) & (x < view.width) & (y >= 0) & (y < view.height))
    x, y, z = x[points], y[points], z[points]
    if observed is not None and len(points):
        shown = _unhidden(x, y, z, view.width, view.height, view.K[0, 0]) | np.isin(points, observed)
        points, x, y = points[shown], x[shown], y[shown]
    return points, x.astype(np.int64), y.astype(np.int64)


def _unhidden(x: np.ndarray, y: np.ndarray, z: np.ndarray, width: int, height: int, focal: float) -> np.ndarray:
    """Which points no nearer point hides: (n,) bool.

    The points are too sparse to make a surface, so each stands for the 3 x 3 cells around it, a cell being as wide as
    points lie apart; a point is hidden when it lies behind the nearest of these by more than a surface at 45 degrees
    would recede over two cells. Relative to the cells, so that neither the scene's size nor the zoom matters.
    """
    cell = max(2.0, float(np.sqrt(width * height / len(z))))
    columns, rows = int(np.ceil(width / cell)), int(np.ceil(height / cell))
    at = (y / cell).astype(np.int64) * columns + (x / cell).astype(np.int64)
    nearest = np.full(rows * columns, np.inf)
    np.minimum.at(nearest, at, z)
    nearest = minimum_filter(nearest.reshape(rows, columns), 3, mode="nearest").ravel()
    return z <= nearest[at] * (1 + 2 * cell / focal)


def _observed(capture: Capture, index: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The points that COLMAP observed inside a view, as `_projected` gives them."""
    view, keypoints = capture.views[index], capture.keypoints(index)
    x, y = keypoints.xy[:, 0], keypoints.xy[:, 1]
    inside = (x >= 0) & (x < view.width) & (y >= 0) & (y < view.height)
    # A point observed twice in one image is a wrong match; one of its observations votes.
    points, first = np.unique(keypoints.point_index[inside], return_index=True)
    return points, x[inside][first].astype(np.int64), y[inside][first].astype(np.int64)


class _Ballots:
    """How often each ID was voted for at each point, sparsely.

    Few IDs meet at a point, so each point has a few slots of (ID, count); what finds no slot goes to a list of
    (point, ID) keys that is merged now and then. Memory grows with the points, not with views or IDs.
    """

    def __init__(self, points: int, objects: int) -> None:
        self.points, self.objects = points, max(objects, 1)
        self.visible = np.zeros(points, np.int32)
        self._ids = np.full((_SLOTS, points), -1, np.int32)
        self._counts = np.zeros((_SLOTS, points), np.int32)
        self._overflow: list[np.ndarray] = []
        self._waiting = 0
        self._merged = (np.zeros(0, np.int64), np.zeros(0, np.int64))

    def add(self, points: np.ndarray, ids: np.ndarray) -> None:
        """One view's votes: distinct point indices (n,), IDs (n,) from 0, -1 for unlabelled."""
        self.visible[points] += 1
        labelled = ids >= 0
        points, ids = points[labelled], ids[labelled]
        for slot in range(_SLOTS):
            if len(points) == 0:
                return
            held = self._ids[slot, points]
            mine = (held == ids) | (held < 0)
            self._ids[slot, points[mine]] = ids[mine]
            self._counts[slot, points[mine]] += 1
            points, ids = points[~mine], ids[~mine]
        self._overflow.append(points * self.objects + ids)
        self._waiting += len(points)
        if self._waiting > _MERGE_AT:
            self._merge()

    def _merge(self) -> None:
        new, times = np.unique(np.concatenate([*self._overflow, np.zeros(0, np.int64)]), return_counts=True)
        keys, counts = np.concatenate([self._merged[0], new]), np.concatenate([self._merged[1], times])
        # Two sorted runs: a stable sort merges them in one pass.
        order = np.argsort(keys, kind="stable")
        keys, counts = keys[order], counts[order]
        first = np.flatnonzero(np.diff(keys, prepend=-1))
        self._merged = (keys[first], np.add.reduceat(counts, first) if len(first) else counts)
        self._overflow, self._waiting = [], 0

    def count(self, rng: np.random.Generator | None) -> tuple[np.ndarray, np.ndarray]:
        """The chosen ID (M,) from 0, -1 where none was voted for, and its margin (M,); drawn when `rng` is given."""
        self._merge()
        slot, point = np.nonzero(self._ids >= 0)
        points = np.concatenate([point, self._merged[0] // self.objects])
        ids = np.concatenate([self._ids[slot, point].astype(np.int64), self._merged[0] % self.objects])
        counts = np.concatenate([self._counts[slot, point].astype(np.int64), self._merged[1]])
        chosen, margins = np.full(self.points, -1, np.int64), np.zeros(self.points, np.float32)
        if len(points) == 0:
            return chosen, margins
        # The votes of a point stand together, the most frequent first, among equals the smallest ID.
        order = np.lexsort((ids, -counts, points))
        points, ids, counts = points[order], ids[order], counts[order]
        voted, first, length = np.unique(points, return_index=True, return_counts=True)
        below = np.concatenate([[0], np.cumsum(counts)])
        total = below[first + length] - below[first]
        most = counts[first]
        second = np.where(length > 1, counts[np.minimum(first + 1, len(counts) - 1)], 0)
        if rng is None:
            pick, others = first, second
        else:
            drawn = below[first] + np.floor(rng.random(len(voted)) * total).astype(np.int64)
            pick = np.searchsorted(below, drawn, side="right") - 1
            others = np.where(pick == first, second, most)
        chosen[voted] = ids[pick]
        margins[voted] = np.maximum(counts[pick] - others, 0) / total
        return chosen, margins
