"""The edits of objects.json on plain splats: what is exported and filmed. Splats that nothing is done to stay as they
are, bit for bit and in their order, so that pixels without an edited object stay the same."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from .. import spherical_harmonics
from ..model.splats import Splats, concatenate
from ..objects import SceneObject, merged
from ..recolour import Recolour
from .fill import closing
from .floaters import inside_hull

UNIFORM_WITHIN = 1e-6
"""Stretches that differ less than this, relative to the largest, are one scale: a matrix may come from float32."""

_DROPPED = -1
_SMALLEST_SCALE = float(np.finfo(np.float32).tiny)


def apply_edits(splats: Splats, objects: Sequence[SceneObject]) -> Splats:
    """The splats as the user wants them: without what is removed or left out, recoloured, moved, with copies, and with
    what is invented in place of the removed.

    Splats of a merged object get the ID of the one it is shown as, whose edits count for both; copies keep the ID of
    what they are copies of and come last. IDs that `objects` does not list stay as they are.
    """
    edited = _closed(splats, objects)[0]
    copies = []
    for entry in objects:
        mine = np.flatnonzero(edited.object_ids == entry.id)
        if len(mine) == 0 or not (entry.recolour or entry.transform or entry.copies):
            continue
        own = edited.select(mine)
        if entry.recolour:
            own = recoloured(own, entry.recolour)
        copies += [transformed(own, place) for place in entry.copies]
        if entry.transform:
            own = transformed(own, entry.transform)
        for name in ("means", "quats", "scales", "sh"):
            getattr(edited, name)[mine] = getattr(own, name)
    return concatenate([edited, *copies]) if copies else edited


@dataclass(frozen=True)
class Fill:
    """What closes the places of removed objects, where it was captured and in its own colours.

    splats: n, of which put (n,) bool come and the others, captured ones, give way; closes (n,): for whose place.
    """

    splats: Splats
    put: NDArray[np.bool_]
    closes: NDArray[np.int64]


def fill_of(splats: Splats, objects: Sequence[SceneObject]) -> Fill:
    """What `apply_edits` closes the places of removed objects with."""
    return _closed(splats, objects)[1]


def transformed(splats: Splats, matrix: ArrayLike) -> Splats:
    """The splats moved by an affine map (4, 4). Where it stretches, shapes follow exactly, and colours turn with the
    rotation that is nearest to it."""
    matrix = np.asarray(matrix, np.float64)
    linear = matrix[:3, :3]
    left, stretches, right = np.linalg.svd(linear)
    turn = left @ right
    if len(splats) == 0:
        return splats
    if np.ptp(stretches) <= UNIFORM_WITHIN * stretches.max():
        # A Gaussian is its own reflection through its centre, which makes of a reflection a rotation.
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
        sh=spherical_harmonics.rotated(splats.sh, turn),
    )


def recoloured(splats: Splats, recolour: Recolour) -> Splats:
    """The splats with other colours, from every direction."""
    matrix, offset = recolour.affine()
    sh = splats.sh @ matrix.T
    sh[:, 0] += (0.5 * matrix.sum(1) + offset - 0.5) / spherical_harmonics.C0
    return replace(splats, sh=sh.astype(splats.sh.dtype))


def _closed(splats: Splats, objects: Sequence[SceneObject]) -> tuple[Splats, Fill]:
    """The splats that are to be seen, under the IDs that they are shown as, with what closes the places of the removed;
    and that alone."""
    known, slots = np.unique(splats.object_ids, return_inverse=True)
    shown = _shown_as(known, objects)[slots]
    keep = shown != _DROPPED
    for entry in objects:
        if entry.removed and entry.floaters:
            keep &= ~_floaters(splats, _with_id(splats, entry.id, objects))
    edited = replace(splats.select(keep), object_ids=shown[keep])
    closes = np.zeros(len(edited), np.int64)
    taken: list[tuple[Splats, int]] = []
    for entry in objects:
        if not (entry.removed and entry.fill):
            continue
        gone, put = closing(edited, splats.select(_with_id(splats, entry.id, objects)))
        if len(put) == 0:
            continue
        taken.append((edited.select(gone & (closes == 0)), entry.id))
        edited = concatenate([edited.select(~gone), put])
        closes = np.append(closes[~gone], np.full(len(put), entry.id))
    parts = [edited.select(closes != 0), *(part for part, _ in taken)]
    counts = [len(part) for part in parts]
    whose = np.concatenate([closes[closes != 0], np.repeat([i for _, i in taken], counts[1:]).astype(np.int64)])
    return edited, Fill(concatenate(parts), np.arange(sum(counts)) < counts[0], whose)


def _shown_as(ids: NDArray[np.int64], objects: Sequence[SceneObject]) -> NDArray[np.int64]:
    """For each ID the one it is shown as, `_DROPPED` where it is not to be seen."""
    entries = {entry.id: entry for entry in objects}
    into = merged(objects)
    found = []
    for object_id in ids.tolist():
        target = into.get(object_id, object_id)
        unseen = any(at in entries and entries[at].left_out for at in (object_id, target))
        unseen = unseen or (target in entries and entries[target].removed)
        found.append(_DROPPED if unseen else target)
    return np.array(found, np.int64)


def _with_id(splats: Splats, object_id: int, objects: Sequence[SceneObject]) -> NDArray[np.bool_]:
    """Which splats are shown as an object, those merged into it among them: (N,)."""
    return np.isin(splats.object_ids, [i for i, target in merged(objects).items() if target == object_id])


def _floaters(splats: Splats, mine: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which splats belong to no object and lie inside the hull of those that `mine` picks: (N,)."""
    unlabelled = np.flatnonzero(splats.object_ids == 0)
    found = np.zeros(len(splats), bool)
    found[unlabelled] = inside_hull(splats.means[unlabelled], splats.means[mine], splats.opacities[mine])
    return found


def _rotations(quats: NDArray) -> Rotation:
    return Rotation.from_quat(quats.astype(np.float64), scalar_first=True)


def _stretched(splats: Splats, linear: NDArray) -> tuple[NDArray, NDArray]:
    """Unit quaternions (N, 4) and scales (N, 3), largest first, of Gaussians under a linear map (3, 3)."""
    axes, scales, _ = np.linalg.svd((linear @ _rotations(splats.quats).as_matrix()) * splats.scales[:, None, :])
    axes[:, :, 2] *= np.sign(np.linalg.det(axes))[:, None]
    return Rotation.from_matrix(axes).as_quat(scalar_first=True), scales
