"""Application of the edits in objects.json to splats, for export and film.

Splats without edits stay bitwise identical and in order, so that pixels without an edited object do not change.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from ..model.splats import Splats, concatenate
from ..shared.color.recolor import Recolor
from ..shared.events import Reporter
from ..shared.reconstruction.objects import SceneObject, members_of, shown_as
from ..shared.splats import spherical_harmonics
from ..shared.splats.floaters import floating
from .fill import fill_hole
from .floaters import inside_hull

UNIFORM_WITHIN = 1e-6
"""Scales along the axes that differ less than this, relative to the largest, are uniform: matrices may be float32."""

_DROPPED = -1
_SMALLEST_SCALE = float(np.finfo(np.float32).tiny)


def apply_edits(splats: Splats, objects: Sequence[SceneObject], reporter: Reporter | None = None) -> Splats:
    """Apply the user's edits: remove, fill holes, clean floaters, recolor, transform and duplicate.

    Args:
        splats: The captured splats.
        objects: The objects with their edits; splats with other IDs do not change.
        reporter: Receives the progress of filling holes; its check ends the work once the user wants to stop.

    Returns:
        The edited splats. Splats of a merged object have the ID of the object that it is merged into, whose edits count
        for both. Duplicates have the ID of the original and come last.
    """
    reporter = reporter or Reporter()
    edited = _remove_and_fill(splats, objects, reporter)[0]
    copies = []
    for entry in objects:
        mine = np.flatnonzero(edited.object_ids == entry.id)
        if len(mine) == 0 or not (entry.recolor or entry.transform or entry.copies):
            continue
        reporter.check()
        own = edited.select(mine)
        if entry.recolor:
            own = recolored(own, entry.recolor)
        copies += [transformed(own, place) for place in entry.copies]
        if entry.transform:
            own = transformed(own, entry.transform)
        for name in ("means", "quats", "scales", "sh"):
            getattr(edited, name)[mine] = getattr(own, name)
    return concatenate([edited, *copies]) if copies else edited


@dataclass(frozen=True)
class Fill:
    """The filling of the holes of removed and moved objects, untransformed and in the captured colors.

    Attributes:
        splats: n splats.
        put: (n,) bool; true for new splats, false for captured splats that they replace.
        fills: (n,) IDs of the objects whose holes are filled.
    """

    splats: Splats
    put: NDArray[np.bool_]
    fills: NDArray[np.int64]


def compute_fill(splats: Splats, objects: Sequence[SceneObject], reporter: Reporter | None = None) -> Fill:
    """Return the filling of the holes of removed and moved objects, as `apply_edits` uses it.

    reporter: receives the progress.
    """
    return _remove_and_fill(splats, objects, reporter or Reporter())[1]


def transformed(splats: Splats, matrix: ArrayLike) -> Splats:
    """Transform splats by an affine map.

    Args:
        splats: The splats.
        matrix: (4, 4). If it scales the axes differently, the shapes follow exactly, and the spherical harmonics rotate
            by the nearest rotation.

    Returns:
        The transformed splats.
    """
    matrix = np.asarray(matrix, np.float64)
    linear = matrix[:3, :3]
    left, stretches, right = np.linalg.svd(linear)
    turn = left @ right
    if len(splats) == 0:
        return splats
    if np.ptp(stretches) <= UNIFORM_WITHIN * stretches.max():
        # A Gaussian is symmetric about its center, so that a reflection acts as a rotation.
        proper = Rotation.from_matrix(turn * np.sign(np.linalg.det(turn)))
        quats = (proper * _rotations(splats.quats)).as_quat(scalar_first=True)
        scales = splats.scales * stretches.mean()
    else:
        quats, scales = _stretched(splats, linear)
    return replace(
        splats,
        means=(splats.means @ linear.T + matrix[:3, 3]).astype(splats.means.dtype),
        quats=quats.astype(splats.quats.dtype),
        scales=np.maximum(scales, _SMALLEST_SCALE).astype(splats.scales.dtype),
        sh=spherical_harmonics.rotate(splats.sh, turn),
    )


def recolored(splats: Splats, recolor: Recolor) -> Splats:
    """Return the splats recolored, in all view directions."""
    matrix, offset = recolor.affine()
    sh = splats.sh @ matrix.T
    sh[:, 0] += (0.5 * matrix.sum(1) + offset - 0.5) / spherical_harmonics.C0
    return replace(splats, sh=sh.astype(splats.sh.dtype))


def _remove_and_fill(splats: Splats, objects: Sequence[SceneObject], reporter: Reporter) -> tuple[Splats, Fill]:
    """Return the visible splats, with the IDs that they are shown as and with filled holes, and the filling itself."""
    known, slots = np.unique(splats.object_ids, return_inverse=True)
    shown = _visible_as(known, objects)[slots]
    keep = shown != _DROPPED
    for entry in objects:
        if entry.removed and entry.floaters:
            reporter.check()
            keep &= ~_floaters(splats, _with_id(splats, entry.id, objects))
        if entry.cleaned:
            reporter.check()
            mine = np.flatnonzero(shown == entry.id)
            keep[mine[floating(splats.means[mine])]] = False
    edited = replace(splats.select(keep), object_ids=shown[keep])
    fills = np.zeros(len(edited), np.int64)
    taken: list[tuple[Splats, int]] = []
    filled = [entry for entry in objects if entry.fill]
    for done, entry in enumerate(filled):

        def report(fraction: float, done: int = done) -> None:
            reporter.progress(done + fraction, len(filled), what="holes")

        # A moved object is still where it was captured here.
        others = edited.object_ids != entry.id
        replaced, put = fill_hole(edited.select(others), splats.select(_with_id(splats, entry.id, objects)), report)
        report(1.0)
        if len(put) == 0:
            continue
        gone = others.copy()
        gone[others] = replaced
        taken.append((edited.select(gone & (fills == 0)), entry.id))
        edited = concatenate([edited.select(~gone), put])
        fills = np.append(fills[~gone], np.full(len(put), entry.id))
    parts = [edited.select(fills != 0), *(part for part, _ in taken)]
    counts = [len(part) for part in parts]
    whose = np.concatenate([fills[fills != 0], np.repeat([i for _, i in taken], counts[1:]).astype(np.int64)])
    return edited, Fill(concatenate(parts), np.arange(sum(counts)) < counts[0], whose)


def _visible_as(ids: NDArray[np.int64], objects: Sequence[SceneObject]) -> NDArray[np.int64]:
    """Return for each ID the one that it is shown as, `_DROPPED` if it is not visible."""
    shown, removed = shown_as(objects), {entry.id for entry in objects if entry.removed}
    targets = [shown.get(object_id, object_id) for object_id in ids.tolist()]
    return np.array([_DROPPED if target is None or target in removed else target for target in targets], np.int64)


def _with_id(splats: Splats, object_id: int, objects: Sequence[SceneObject]) -> NDArray[np.bool_]:
    """Find the splats of an object, including those merged into it: (N,)."""
    return np.isin(splats.object_ids, members_of(objects, object_id))


def _floaters(splats: Splats, mine: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Find the splats of no object inside the convex hull of those that `mine` selects: (N,)."""
    unlabeled = np.flatnonzero(splats.object_ids == 0)
    found = np.zeros(len(splats), bool)
    found[unlabeled] = inside_hull(splats.means[unlabeled], splats.means[mine], splats.opacities[mine])
    return found


def _rotations(quats: NDArray) -> Rotation:
    return Rotation.from_quat(quats.astype(np.float64), scalar_first=True)


def _stretched(splats: Splats, linear: NDArray) -> tuple[NDArray, NDArray]:
    """Return unit quats (N, 4) and scales (N, 3), largest first, of Gaussians under a linear map (3, 3)."""
    axes, scales, _ = np.linalg.svd((linear @ _rotations(splats.quats).as_matrix()) * splats.scales[:, None, :])
    axes[:, :, 2] *= np.sign(np.linalg.det(axes))[:, None]
    return Rotation.from_matrix(axes).as_quat(scalar_first=True), scales
