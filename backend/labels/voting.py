"""Assigns each point an object ID by votes of the views' masks, as in ObjectGS, with three strategies.

As in the paper's algorithm 1, an unlabeled pixel is a vote for ID 0. Unlike there, 0 needs more than half of all votes
to win, since masks that give an object several IDs split its votes, but not those for 0; where masks have gaps, 0 needs
more votes than these explain (`needed_to_be_unlabeled`). Unlike in the published code, views in which a point is behind
the camera or outside the image do not vote on it. Held-out views do not vote, so that their masks are used only to
measure quality. Neither do masks without any label, since they are more often missing than complete.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from scipy.ndimage import minimum_filter

from ..capture import Capture
from ..shared.class_table import ClassTable
from ..shared.events import Reporter

Strategy = Literal["majority", "probability", "correspondence"]

FEW_POINTS = 20
"""An object with fewer points causes a warning."""

MOSTLY_UNLABELED = 0.8
"""Fraction of unlabeled votes from which on a point says nothing about the gaps in the masks of objects."""

_GAP_QUANTILE, _BELOW_RATE, _ABOVE_RATE = 0.1, 1.28, 3.0
"""The rate of gaps is estimated by a quantile, of points that are on objects even where many masks show objects on the
background, and by its standard deviations below the mean. Unlabeled votes have to exceed the rate by more of them."""

_ENOUGH_POINTS = 20
"""Points from which on the rate of gaps is estimated; with fewer, masks are taken to have none."""

_ENOUGH_VOTES, _CONSISTENT = 3, 0.4
"""Votes from which on a point tells whether IDs are consistent, and mean margin below which they are not: where half of
the objects in each photo have a wrong ID it is 0.25, and where each photo has numbers of its own it is below 0.2."""

_SLOTS = 6
_MERGE_AT = 1 << 23


@dataclass(frozen=True)
class Votes:
    """The result of a vote on M points.

    ids: (M,) int64, object of each point; 0 if no view voted on it, or more than half of them for 0.
    margins: (M,) float32 in [0, 1], the chosen ID's fraction of all votes, 0 included, minus the next best ID's.
    counts: number of points of each object.
    visible: (M,) int32, number of views that voted on the point, for 0 or an object.
    """

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
    positions: np.ndarray | None = None,
) -> Votes:
    """Label points by votes of a capture's masks.

    The occlusion test raises the fraction of correctly labeled points of the demo capture from 97.4% to 99.3%
    (majority) and from 75% to 98% (probability).

    Args:
        capture: The capture; must be prepared.
        strategy: majority: each view that contains the point votes for the ID at its pixel; the most frequent ID wins,
            the smallest of equals. probability: the ID is drawn in proportion to these votes. correspondence: only
            views in which COLMAP observed the point vote, at the observed pixel.
        seed: For probability.
        occlusion: Whether to ignore views in which nearer points hide the point, unless COLMAP observed it there; has
            no effect on correspondence.
        reporter: Receives status, progress and warnings.
        positions: (M, 3) positions in the capture's coordinates to label instead of its points, such as splats.

    Returns:
        The labels.
    """
    if strategy not in ("majority", "probability", "correspondence"):
        raise ValueError(f"unknown strategy {strategy!r}")
    if positions is not None and strategy == "correspondence":
        raise ValueError("correspondence applies to COLMAP's own points only")
    reporter = reporter or Reporter()
    classes = ClassTable(capture.object_ids)
    voters = capture.points.xyz if positions is None else positions
    ballots = _Ballots(len(voters), len(classes))
    indices = [i for i in capture.train_indices if set(capture.ids_in(i)) - {0}]

    def cast(index: int, points: np.ndarray, x: np.ndarray, y: np.ndarray) -> None:
        mask = capture.mask(index)
        assert mask is not None
        ids = mask[y, x]
        # Ignored pixels of corrected masks show no known object, but not none either.
        known = ids >= 0
        ballots.add(points[known], classes.classes_of(ids[known]))

    xyz = np.ascontiguousarray(voters.T, np.float64)
    nothing = np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.int64)
    for done, index in enumerate(indices, 1):
        observed = None
        if strategy == "correspondence" or occlusion:
            observed = find_observed_points(capture, index) if positions is None else nothing
        if strategy == "correspondence":
            assert observed is not None
            cast(index, *observed)
        else:
            cast(index, *find_visible_points(capture, xyz, index, observed[0] if observed else None))
        reporter.progress(done, len(indices), what="views")
    if occlusion and strategy != "correspondence" and not ballots.visible.all():
        # Points that the occlusion test hides from every view are voted on without it.
        silent = np.flatnonzero(ballots.visible == 0)
        hidden = np.ascontiguousarray(xyz[:, silent])
        for index in indices:
            reporter.check()
            points, x, y = find_visible_points(capture, hidden, index, None)
            cast(index, silent[points], x, y)
    chosen, margins = ballots.count(np.random.default_rng(seed) if strategy == "probability" else None)
    ids = classes.ids_of(chosen)
    won = np.bincount(chosen[chosen >= 0], minlength=len(classes))
    counts = {int(i): int(n) for i, n in zip(classes.ids, won)}
    warnings = _describe_problems(capture, counts, int((ids == 0).sum()) if len(classes) else 0, len(ids))
    judged = (ids != 0) & (ballots.visible >= _ENOUGH_VOTES)
    if judged.sum() >= _ENOUGH_POINTS and margins[judged].mean() < _CONSISTENT:
        warnings.append(
            "The masks give most points another ID in each photo; if the segments of each photo are numbered on their "
            "own, read them with Import Masks (`masks`), which finds the objects."
        )
    for sentence in warnings:
        reporter.warning(sentence)
    return Votes(ids, margins, counts, ballots.visible, warnings)


def needed_to_be_unlabeled(unlabeled: np.ndarray, votes: np.ndarray) -> np.ndarray:
    """Compute the fraction of votes for 0 above which a point belongs to no object.

    Masks with gaps leave a point of an object unlabeled in some views, at random, at a rate g. The fraction among n
    votes then has the standard deviation sqrt(g (1 - g) / n), which puts its 10 % quantile 1.28 deviations below g.

    Args:
        unlabeled, votes: (M,) int, the votes for 0 and all votes of each point.

    Returns:
        (M,) float64: g + 3 sqrt(g (1 - g) / n), at least one half and less than 1.
    """
    fractions = unlabeled / np.maximum(votes, 1)
    on_objects = (votes > 0) & (fractions < MOSTLY_UNLABELED)
    gaps = 0.0
    if on_objects.sum() >= _ENOUGH_POINTS:
        low = float(np.quantile(fractions[on_objects], _GAP_QUANTILE))
        gaps = min(low + _BELOW_RATE * float(np.sqrt(low * (1 - low) / np.median(votes[on_objects]))), 1.0)
    needed = gaps + _ABOVE_RATE * np.sqrt(gaps * (1 - gaps) / np.maximum(votes, 1))
    # A point that all masks leave unlabeled belongs to no object in any case.
    return np.clip(needed, 0.5, 1 - 1 / np.maximum(2 * votes, 2))


def _describe_problems(capture: Capture, counts: dict[int, int], unlabeled: int, points: int) -> list[str]:
    def listed(ids: list[int]) -> str:
        named = [f"{i} ({capture.names[i]})" if i in capture.names else str(i) for i in ids[:10]]
        return ", ".join(named) + (f" and {len(ids) - 10} more" if len(ids) > 10 else "")

    none = [i for i, count in counts.items() if count == 0]
    few = [i for i, count in counts.items() if 0 < count < FEW_POINTS]
    warnings = []
    if none:
        warnings.append(
            f"No point was labeled as object {listed(none)}; training places points where the masks of two views agree."
        )
    if few:
        warnings.append(f"Fewer than {FEW_POINTS} points were labeled as object {listed(few)}.")
    if 2 * unlabeled > points:
        warnings.append(f"{unlabeled} of {points} points were labeled as no object.")
    return warnings


def find_visible_points(
    capture: Capture, xyz: np.ndarray, index: int, observed: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Project points xyz (3, M): indices of those inside the view, their pixels' columns and rows, all (n,).

    If the indices of observed points are given, hidden points are omitted, except for observed ones.
    """
    view = capture.views[index]
    # Not a matrix product: for one this narrow, BLAS spends 50 times as long on its threads.
    x, y, z = (r[0] * xyz[0] + r[1] * xyz[1] + r[2] * xyz[2] + r[3] for r in view.viewmat[:3])
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        x = x / z * view.K[0, 0] + view.K[0, 2]
        y = y / z * view.K[1, 1] + view.K[1, 2]
        points = np.flatnonzero((z > 0) & (x >= 0) & (x < view.width) & (y >= 0) & (y < view.height))
    x, y, z = x[points], y[points], z[points]
    if observed is not None and len(points):
        shown = _find_unhidden(x, y, z, view.width, view.height, view.K[0, 0]) | np.isin(points, observed)
        points, x, y = points[shown], x[shown], y[shown]
    return points, x.astype(np.int64), y.astype(np.int64)


def _find_unhidden(x: np.ndarray, y: np.ndarray, z: np.ndarray, width: int, height: int, focal: float) -> np.ndarray:
    """Find the points that are not hidden by nearer points: (n,) bool.

    The points are too sparse for a surface, so each covers the 3 x 3 cells around it; a cell is as wide as the mean
    distance between points. A point is hidden if it is farther than the nearest point of its cell by more than a
    surface at 45 degrees recedes over two cells. The test is independent of the scene's size and the focal length.
    """
    cell = max(2.0, float(np.sqrt(width * height / len(z))))
    columns, rows = int(np.ceil(width / cell)), int(np.ceil(height / cell))
    at = (y / cell).astype(np.int64) * columns + (x / cell).astype(np.int64)
    nearest = np.full(rows * columns, np.inf)
    np.minimum.at(nearest, at, z)
    nearest = minimum_filter(nearest.reshape(rows, columns), 3, mode="nearest").ravel()
    return z <= nearest[at] * (1 + 2 * cell / focal)


def find_observed_points(capture: Capture, index: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the points that COLMAP observed inside a view: their indices and pixels' columns and rows, all (n,)."""
    view, keypoints = capture.views[index], capture.keypoints(index)
    x, y = keypoints.xy[:, 0], keypoints.xy[:, 1]
    inside = (x >= 0) & (x < view.width) & (y >= 0) & (y < view.height)
    # Two observations of a point in one image are a wrong match; one of them votes.
    points, first = np.unique(keypoints.point_index[inside], return_index=True)
    return points, x[inside][first].astype(np.int64), y[inside][first].astype(np.int64)


class _Ballots:
    """Sparse counts of the votes for each ID at each point.

    Points have votes for few IDs, so each point has a few slots of (ID, count); further votes go to a list of
    (point, ID) keys, which is merged repeatedly. Memory grows with the points, not with views or IDs.
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
        """Add the votes of one view: distinct point indices (n,) and class indices (n,), -1 for unlabeled."""
        self.visible[points] += 1
        labeled = ids >= 0
        points, ids = points[labeled], ids[labeled]
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
        # A stable sort merges two sorted runs in one pass.
        order = np.argsort(keys, kind="stable")
        keys, counts = keys[order], counts[order]
        first = np.flatnonzero(np.diff(keys, prepend=-1))
        self._merged = (keys[first], np.add.reduceat(counts, first) if len(first) else counts)
        self._overflow, self._waiting = [], 0

    def count(self, rng: np.random.Generator | None) -> tuple[np.ndarray, np.ndarray]:
        """Return the chosen class index (M,), -1 for 0 or without votes, and its margin (M,); drawn if `rng` is given.

        If not drawn, 0 wins by more than `needed_to_be_unlabeled`; otherwise the objects are compared with each other.
        """
        self._merge()
        slot, point = np.nonzero(self._ids >= 0)
        points = np.concatenate([point, self._merged[0] // self.objects])
        ids = np.concatenate([self._ids[slot, point].astype(np.int64), self._merged[0] % self.objects])
        counts = np.concatenate([self._counts[slot, point].astype(np.int64), self._merged[1]])
        unlabeled = self.visible - np.bincount(points, counts, self.points).astype(np.int64)
        some = np.flatnonzero(unlabeled)
        points, ids = np.concatenate([points, some]), np.concatenate([ids, np.full(len(some), -1)])
        counts = np.concatenate([counts, unlabeled[some]])
        chosen, margins = np.full(self.points, -1, np.int64), np.zeros(self.points, np.float32)
        if len(points) == 0:
            return chosen, margins
        # Sorted by point, then by descending frequency, then by ID; 0 is last where it has too few votes to win.
        needed = needed_to_be_unlabeled(unlabeled, self.visible)
        is_minority = (ids < 0) & (counts <= needed[points] * self.visible[points])
        order = np.lexsort((ids, ids < 0, -counts, points) if rng is not None else (ids, -counts, is_minority, points))
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
