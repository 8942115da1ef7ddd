"""Detection of redundant views, of points outside all views, and of the area of views that has no points."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.spatial import cKDTree

from ..capture import BLURRED, Capture, View, measure_contrasts
from ..shared.stopping import Check, proceed

SAME_PIXELS = 0.5
"""Two views have the same position if the points of one move by at most this many pixels in the other."""

SAME_COLOR = 1.5
"""Their images are the same if they differ by at most this on average, of 255, as after another JPEG compression."""

_BLOCKS = 8
"""Number of blocks along each side of an image whose means are compared first."""

MARGIN = 0.1
"""Fraction of its size that a view is enlarged by on each side, since splats extend beyond their points."""

VACANT = 0.35
"""Fraction of the training views' area without points from which on points are looked for there."""

_SHOWN_ELSEWHERE = 0.8
"""Fraction of a blurred view's points that two other views must show."""

_MOST_VIEWS = 150
"""Number of views, spread evenly, in which points are counted."""

_MOST_EXAMINED = 60
"""Number of views in which surfaces, or what is around them, are looked for."""

_FEW_POINTS = 2000
"""Number of points, spread evenly, that are looked for first."""

_TOGETHER = 8192
"""Largest number of points near each other whose views are found together."""

CELLS = 40
"""Number of cells along the longer side of a view in which points are counted."""


def duplicate_views(capture: Capture, check: Check = proceed) -> list[int]:
    """Find training views that duplicate an earlier one: same position, same image, same objects in the masks.

    Images are read only for views at the same position.

    Args:
        capture: The capture; must be prepared.
        check: Called at intervals; ends the work by an exception once the user wants to stop.

    Returns:
        Indices of the duplicates, ascending.
    """
    train = list(capture.train_indices)
    if len(train) < 2:
        return []
    poses = _compute_pose_vectors(capture, train)
    tree, images = cKDTree(poses), _Images(capture)
    found: set[int] = set()
    # In the order of the earlier view, so that the first of several equal views is kept. The views near each one are
    # looked up one by one, since all pairs of a fixed camera's thousands of views would not fit into memory.
    for first, a in enumerate(train):
        check()
        if a not in found:
            near = (second for second in tree.query_ball_point(poses[first], SAME_PIXELS, p=np.inf) if second > first)
            for b in sorted(train[second] for second in near):
                if b in found or not _same_camera(capture, a, b) or capture.ids_in(a) != capture.ids_in(b):
                    continue
                if images.are_same(a, b):
                    found.add(b)
    return sorted(found)


def views_like_held_out(capture: Capture, check: Check = proceed) -> list[int]:
    """Find training views that show what a held-out view shows: same position, same camera, same image.

    A training on them has seen the held-out image, whatever the masks.

    Args:
        capture: The capture; must be prepared.
        check: Called at intervals; ends the work by an exception once the user wants to stop.

    Returns:
        Indices of the training views, ascending.
    """
    train, held_out = list(capture.train_indices), list(capture.test_indices)
    if not train or not held_out:
        return []
    poses = _compute_pose_vectors(capture, [*train, *held_out])
    near = cKDTree(poses[: len(train)]).query_ball_point(poses[len(train) :], SAME_PIXELS, p=np.inf)
    found: set[int] = set()
    images = _Images(capture)
    for index, candidates in zip(held_out, near, strict=True):
        check()
        for i in {train[candidate] for candidate in candidates} - found:
            if _same_camera(capture, i, index) and images.are_same(i, index):
                found.add(i)
    return sorted(found)


def _compute_pose_vectors(capture: Capture, views: list[int]) -> np.ndarray:
    """Return positions and rotations of views as vectors (n, 12), scaled to pixels: a distance of 1 moves a view's
    points by at most one pixel, and by about one pixel in the view with the nearest points."""
    rotations = np.array([capture.views[i].viewmat[:3, :3] for i in views])
    shifts = np.array([capture.views[i].viewmat[:3, 3] for i in views])
    focals = np.array([capture.views[i].K[0, 0] for i in views])
    pixels_per_length = 0.0
    for index, rotation, shift, focal in zip(views, rotations, shifts, focals, strict=True):
        depths = capture.points.xyz[capture.observed(index)] @ rotation[2] + shift[2]
        depth = float(np.median(depths)) if len(depths) else 0.0
        if depth > 0:
            pixels_per_length = max(pixels_per_length, focal / depth)
    centers = -np.einsum("nji,nj->ni", rotations, shifts)
    return np.concatenate(
        [(centers - centers.mean(0)) * pixels_per_length, rotations.reshape(-1, 9) * focals.max()], axis=1
    )


def _same_camera(capture: Capture, a: int, b: int) -> bool:
    first, second = capture.views[a], capture.views[b]
    same_size = (first.width, first.height) == (second.width, second.height)
    return same_size and np.allclose(first.K, second.K, rtol=0, atol=SAME_PIXELS)


class _Images:
    """Comparison of a capture's images, which are read only if the means of their blocks are alike."""

    def __init__(self, capture: Capture) -> None:
        self._capture = capture
        self._means: dict[int, np.ndarray] = {}

    def are_same(self, a: int, b: int) -> bool:
        """Return whether two views of the same size have the same image."""
        # The difference of two means is at most the mean of the differences, so this rejects no equal images.
        if float(np.abs(self._block_means(a) - self._block_means(b)).sum(axis=(0, 1)).mean()) > SAME_COLOR:
            return False
        difference = self._capture.image(a).astype(np.int16) - self._capture.image(b)
        return float(np.abs(difference).mean()) <= SAME_COLOR

    def _block_means(self, index: int) -> np.ndarray:
        """Return the sums of an image's blocks over its number of pixels, (up to _BLOCKS, up to _BLOCKS, 3)."""
        if index not in self._means:
            image = self._capture.image(index)
            rows, columns = (np.unique(np.linspace(0, n, _BLOCKS, endpoint=False).astype(int)) for n in image.shape[:2])
            sums = np.add.reduceat(np.add.reduceat(image.astype(np.float64), rows, axis=0), columns, axis=1)
            self._means[index] = sums / (image.shape[0] * image.shape[1])
        return self._means[index]


def blind_views(capture: Capture, check: Check = proceed) -> list[int]:
    """Find training views that contain no point, even with a margin around their border.

    Args:
        capture: The capture.
        check: Called at intervals; ends the work by an exception once the user wants to stop.

    Returns:
        Indices of the views, ascending; empty if this holds for all views.
    """
    views = capture.train_indices
    xyz = capture.points.xyz
    # A view with points nearly always contains one of a few.
    few = xyz[:: max(len(xyz) // _FEW_POINTS, 1)]
    blind = []
    for index in views:
        check()
        some = len(capture.observed(index)) or _inside(capture, index, few).any()
        if not some and not _inside(capture, index, xyz).any():
            blind.append(index)
    return blind if len(blind) < len(views) else []


def blurred_views(capture: Capture, check: Check = proceed) -> dict[int, float]:
    """Find training views that are blurred, if other views show almost all of what they show.

    Args:
        capture: The capture; must be prepared.
        check: Called at intervals; ends the work by an exception once the user wants to stop.

    Returns:
        Indices of the views, the most blurred first, with the contrast of their details relative to other views.
    """
    views = capture.train_indices
    contrasts = measure_contrasts(capture, views, check)
    seen_in = np.zeros(len(capture.points.xyz), np.int64)
    for index in views:
        seen_in[np.unique(capture.observed(index))] += 1
    found = {}
    for place in np.argsort(contrasts, kind="stable"):
        if contrasts[place] >= BLURRED:
            break
        observed = np.unique(capture.observed(views[place]))
        if float(np.mean(seen_in[observed] > 2)) >= _SHOWN_ELSEWHERE:
            found[views[place]] = float(contrasts[place])
            seen_in[observed] -= 1
    return found


def views_without_objects(capture: Capture) -> list[int]:
    """Find training views whose masks show no object, other than those left out.

    Args:
        capture: The capture.

    Returns:
        Indices of the views, ascending; empty if this holds for all views.
    """
    views = capture.train_indices
    without = [i for i in views if capture.views[i].mask_file is not None and not set(capture.ids_in(i)) - {0}]
    return without if len(without) < len(views) else []


def unseen_points(capture: Capture, check: Check = proceed) -> np.ndarray:
    """Find points outside every training view.

    Args:
        capture: The capture.
        check: Called at intervals; ends the work by an exception once the user wants to stop.

    Returns:
        (M,) bool; all False if this holds for all points.
    """
    unseen = np.ones(len(capture.points.xyz), np.bool_)
    # Points that COLMAP observed need no projection, which leaves few.
    for index in capture.train_indices:
        unseen[capture.observed(index)] = False
    for left, views in _with_views(capture, np.flatnonzero(unseen)):
        for index in views:
            check()
            if not len(left):
                break
            seen = _inside(capture, index, capture.points.xyz[left])
            unseen[left[seen]] = False
            left = left[~seen]
    return unseen if not unseen.all() else np.zeros_like(unseen)


def vacancy(capture: Capture, check: Check = proceed) -> float:
    """Return the mean fraction of the training views' area without points, of at most `_MOST_VIEWS` of them.

    Args:
        capture: The capture.
        check: Called at intervals; ends the work by an exception once the user wants to stop.
    """
    xyz, views = capture.points.xyz, capture.train_indices
    some = views[:: -(-len(views) // _MOST_VIEWS) or 1]
    fractions = []
    for index in some:
        check()
        fractions.append(1.0 - occupied_cells(capture.views[index], xyz).mean())
    return float(np.mean(fractions)) if fractions else 0.0


def examined_views(capture: Capture) -> list[int]:
    """Return the indices of at most `_MOST_EXAMINED` training views, spread evenly."""
    train = list(capture.train_indices)
    count = min(len(train), _MOST_EXAMINED)
    return [train[i] for i in np.unique(np.linspace(0, len(train) - 1, count).astype(int))]


def occupied_cells(view: View, xyz: np.ndarray) -> np.ndarray:
    """Return the cells of a view with any of the points (n, 3) in them: (rows, columns) bool."""
    cell = max(view.width, view.height) / CELLS
    rows, columns = max(round(view.height / cell), 1), max(round(view.width / cell), 1)
    occupied = np.zeros((rows, columns), np.bool_)
    _, y, x = cells_of(view, view.to_camera(xyz), occupied.shape)
    occupied[y, x] = True
    return occupied


def cells_of(view: View, local: np.ndarray, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return which of the positions (n, 3) in camera space are in a view, and the rows and columns of their cells."""
    inside, x, y = view.pixels_of(local)
    return inside, y * shape[0] // view.height, x * shape[1] // view.width


def _inside(capture: Capture, index: int, xyz: np.ndarray) -> np.ndarray:
    """Return which of the points xyz (n, 3) are inside a view or near its border: (n,) bool."""
    view = capture.views[index]
    x, y, z = view.to_camera(xyz).T
    across, down = MARGIN * view.width, MARGIN * view.height
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        u = x / z * view.K[0, 0] + view.K[0, 2]
        v = y / z * view.K[1, 1] + view.K[1, 2]
        inside = (u >= -across) & (u <= view.width + across) & (v >= -down) & (v <= view.height + down)
    return (z > 0) & inside


def _with_views(capture: Capture, points: np.ndarray) -> Iterator[tuple[np.ndarray, list[int]]]:
    """Yield the points, by their indices, in groups of neighbors, with the training views that may show any of them.

    Those are left out of which one border has the group's bounding box on its outer side.
    """
    views, xyz = capture.train_indices, capture.points.xyz[points]
    if not len(points) or not views:
        return
    borders = [_borders(capture.views[index]) for index in views]
    normals, offsets = np.array([each[0] for each in borders]), np.array([each[1] for each in borders])
    # More than rounding changes.
    slack = 1e-6 * (np.abs(offsets).max() + np.abs(xyz).max())
    order = cKDTree(xyz, _TOGETHER, compact_nodes=False, balanced_tree=False).indices
    for first in range(0, len(order), _TOGETHER):
        group = order[first : first + _TOGETHER]
        low, high = xyz[group].min(0), xyz[group].max(0)
        farthest = normals @ ((low + high) / 2) + offsets + np.abs(normals) @ ((high - low) / 2)
        yield points[group], [index for index, far in zip(views, farthest, strict=True) if (far > -slack).all()]


def _borders(view: View) -> tuple[np.ndarray, np.ndarray]:
    """Return the planes around what `_inside` finds inside a view: unit normals (5, 3), and offsets (5,).

    A point is on the inner side of a plane if normal . point + offset is positive.
    """
    (fx, _, cx), (_, fy, cy) = view.K[:2]
    across, down = MARGIN * view.width, MARGIN * view.height
    normals = np.array(
        [[fx, 0, cx + across], [-fx, 0, view.width + across - cx], [0, fy, cy + down],
         [0, -fy, view.height + down - cy], [0, 0, 1.0]]
    )  # fmt: skip
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return normals @ view.viewmat[:3, :3], normals @ view.viewmat[:3, 3]
