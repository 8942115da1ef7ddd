"""Splats as a graph: neighbors, and how likely two of them belong to one object.

Two neighbors rather belong to different objects if their colors differ, if their surfaces meet in a concave edge as
where an object stands on a table, if they are far apart for where they are, if a photo has an edge between them, or if
one of them is on a large plane and the other in front of it.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from scipy import sparse
from scipy.spatial import cKDTree
from skimage.color import rgb2lab

from ..raster import Camera, devices, rasterize
from ..shared.splats.spherical_harmonics import C0
from ..stereo.scene_planes import sides_of_planes
from ..stereo.surface_normals import bending, concavity, measure_normals, normals_of_depth
from .clusters import Clusters, Coarse, between_clusters, nested_clusters
from .color_model import ColorModel
from .random_walker import best_borders, connected_with, random_walker, rough_walker

if TYPE_CHECKING:
    from ..model.generate import Generated

NEIGHBORS = 10
"""Number of neighbors of a splat in the graph."""

SEEN, ALONE = 1.0, 4.0
"""Splats that cover less than the first number of pixels in all photos together get the object of the nearest other, or
none, if that is farther away than the second number times the local spacing."""

LEAST = 1e-4
"""Least weight of an edge, before the factors of planes."""

ON_PLANE, IN_FRONT = 3.0, 0.1
"""Factors of the weights of edges within a large plane, and between it and what is in front of it."""

STROKES, FOUND, CERTAIN = 1e-4, 2e-3, 0.5
"""Weights of the colors of the strokes for each marked object, and of what was found with these, relative to the square
root of their number: the more objects are marked, the more their colors tell. The last number is the probability from
which on a node counts as found."""

NOTHING = 1e-4
"""Weight of belonging to no object, relative to all edges of a node and to the fourth root of the number of marked
objects, unless everything belongs to one."""

VOTES = 0.3
"""Weight of the votes of masks where these agree, relative to all edges of a node."""

SEEDED = 0.8
"""The splats that make up this part of what a stroke shows are its seeds; the rest shines through from behind."""

LONGEST = 1000
"""Longer side in pixels of the images in which contributions to whole photos are summed."""

_MOST_PHOTOS = 150
"""Largest number of photos in which splats are counted; of more, some at equal distances are used."""

_PHOTOS, _SAMPLES, _VISIBLE = 16, 5, 0.3

_CONVEX, _SHOWN = 0.5, 0.1
"""Change of the rendered surface's normals along an edge from which on it is convex; and least part of what a splat
covers whose normals are known and do not cancel each other."""


class Weights(NamedTuple):
    """What the edges between splats are weighed by: exp(-sum of the squares), before the factors of planes.

    Attributes:
        color: weight of a tenth of the CIELAB distance of two splats.
        concave: weight of the concavity (the change of the normals along the edge).
        turned: weight of 1 - the cosine of the angle between the normals of the rendered surface, unless it is convex
            there. Of this and the concavity, the larger one counts. 0: no surface is rendered.
        gap: weight of the distance in units of the local spacing.
        steps: weight of a tenth of the largest CIELAB step in the photos.
        neighbors: number of splats that a normal is measured on, itself included.
    """

    color: float
    concave: float
    turned: float
    gap: float
    steps: float
    neighbors: int


OF_SPLATS = Weights(color=0.5, concave=12.0, turned=3.6, gap=0.5, steps=0.4, neighbors=33)
"""Weights for trained splats."""

OF_POINTS = Weights(color=0.7, concave=8.0, turned=0.0, gap=1 / 3, steps=0.25, neighbors=17)
"""Weights for the points of a capture, which are fewer and farther apart."""


def contributions(splats: Generated, camera: Camera, planes: np.ndarray, primitive: str) -> np.ndarray:
    """Sum the blending weights of each splat over pixels.

    Args:
        splats: N splats of the model.
        camera: the view.
        planes: (C, H, W), weights of the pixels.
        primitive: "3d" or "2d".

    Returns:
        (N, C) float64: for each plane, the sum of weight times blending weight over the pixels.
    """
    # The gradient of a pixel's color with respect to that of a splat is the splat's blending weight there.
    sh = torch.zeros((len(splats.means), 1, 3), device=splats.means.device, requires_grad=True)
    drawn = rasterize(*splats[:4], sh, splats.ids, replace(camera, gain=(1.0, 1.0, 1.0)), primitive=primitive)
    found = np.empty((len(splats.means), len(planes)))
    for first in range(0, len(planes), 3):
        some = planes[first : first + 3]
        channels = np.zeros((3, camera.height, camera.width), np.float32)
        channels[: len(some)] = some
        (gradient,) = torch.autograd.grad(drawn.color, sh, devices.upload(channels, sh), retain_graph=True)
        found[:, first : first + 3] = devices.host(gradient[:, 0, : len(some)]) / C0
    return found


def reduced(camera: Camera) -> tuple[Camera, int]:
    """Return the camera of an image in which contributions to all of it are summed, and by what it is reduced."""
    downscale = -(-max(camera.width, camera.height) // LONGEST)
    return camera.reduced(downscale), downscale


@dataclass(frozen=True)
class Solution:
    """The objects of N splats.

    Attributes:
        objects: (C,) int64, ascending: the object IDs that were to be found, and 0.
        probabilities: (n, C) float32, probabilities of the nodes of the graph.
        ids: (N,) int64, the object ID of each splat.
    """

    objects: np.ndarray
    probabilities: np.ndarray
    ids: np.ndarray

    def among(self, objects: np.ndarray) -> np.ndarray:
        """Return the probabilities (n, C) of other objects (C,); those of objects that it lacks are 0."""
        _, now, then = np.intersect1d(objects, self.objects, return_indices=True)
        columns = np.zeros((len(self.probabilities), len(objects)), np.float32)
        columns[:, now] = self.probabilities[:, then]
        return columns


@dataclass(frozen=True)
class Edges:
    """The m edges of a graph between nodes, each in both directions or in one.

    Attributes:
        first, second: (m,) nodes.
        gap: (m,) distance in units of the local spacing.
        color: (m,) a tenth of the CIELAB distance.
        steps: (m,) a tenth of the largest CIELAB step in the photos.
    """

    first: np.ndarray
    second: np.ndarray
    gap: np.ndarray
    color: np.ndarray
    steps: np.ndarray


@dataclass(frozen=True)
class SplatGraph:
    """The graph of N splats.

    Attributes:
        nodes: (n,) int64, the splats that are seen.
        nearest: (N,) int64, the node of each splat, or the nearest one.
        is_alone: (N,) bool, splats that are no nodes and far from all of them.
        lab: (n, 3) CIELAB color of each node, the mean over its neighborhood.
        weights: (n, n) weights of the edges.
        clusters: clusters of the nodes by these weights, in whose order the nodes are.
        edges: what the weights are made of, but for planes.
        xyz: (n, 3) positions of the nodes.
        seen: (n,) pixels that each node covers in all photos together.
        facing: (n, 3) sum of the directions to the cameras, each as long as the pixels that the node covers there.
        distances: (n,) mean distance to the cameras, by these pixels.
    """

    nodes: np.ndarray
    nearest: np.ndarray
    is_alone: np.ndarray
    lab: np.ndarray
    weights: sparse.csr_array
    clusters: Clusters
    edges: Edges
    xyz: np.ndarray
    seen: np.ndarray
    facing: np.ndarray
    distances: np.ndarray

    @functools.cached_property
    def colors(self) -> ColorModel:
        """The colors of the nodes, to be counted."""
        return ColorModel(self.lab)

    @functools.cached_property
    def coarse(self) -> Coarse | None:
        """The graph of the clusters, if there are many."""
        return between_clusters(self.weights, self.clusters)

    def solve(self, seeds: dict[int, np.ndarray], everything: bool = False, before: Solution | None = None) -> Solution:
        """Find the object of each splat.

        Args:
            seeds: for each object or part of one, by ID, the (N,) contributions of the splats to its strokes, as from
                `contributions`; those of 0 belong to no object.
            everything: whether every splat belongs to an object; otherwise, splats far from the strokes have none.
            before: an earlier solution for similar strokes, from which this one begins.
        """
        objects = np.array(sorted({0, *seeds}))
        nothing = np.zeros(len(self.nearest))
        labels = _seed_labels(np.stack([seeds.get(object_id, nothing)[self.nodes] for object_id in objects.tolist()]))
        marked, outside = len(seeds), np.zeros((len(self.nodes), len(objects)))
        if not everything:
            outside[:, 0] = NOTHING * marked**0.25 * np.asarray(self.weights.sum(axis=1)).ravel()
        prior = STROKES * marked * self.colors.likeness(labels, len(objects)) + outside
        if self.coarse is None:
            rough = self._walk(labels, prior, 1.0)
        else:
            rough = rough_walker(self.weights, labels, prior, self.clusters, self.coarse)
        found = rough.argmax(1)
        # As in GrabCut, what was found tells more about an object's colors than strokes do. What rather belongs to none
        # counts even if that is uncertain: its colors would else be taken for those of the objects.
        is_known = rough.max(1) > CERTAIN
        if not everything:
            is_known |= found == 0
        known = np.where(is_known & ~self._loose(found, labels, everything), found, -1)
        prior = FOUND * marked**0.5 * self.colors.likeness(known, len(objects)) + outside
        probabilities = self._walk(labels, prior, 1.0, rough if before is None else before.among(objects))
        found = probabilities.argmax(1) if everything else best_borders(self.weights, probabilities)
        found = self._joined(found, labels, everything)
        ids = objects[found][self.nearest]
        return Solution(objects, probabilities, ids if everything else np.where(self.is_alone, 0, ids))

    def settle(self, objects: np.ndarray, votes: np.ndarray) -> np.ndarray:
        """Find the object of each splat by votes that may be wrong.

        Where votes contradict each other, they count less than what the neighbors are.

        Args:
            objects: (C,) object IDs.
            votes: (N, C), not negative.

        Returns:
            (N,) int64, an object ID for each splat.
        """
        parts = votes[self.nodes] / np.maximum(votes[self.nodes].sum(1, keepdims=True), 1.0)
        ordered = np.sort(np.column_stack([np.zeros(len(parts)), parts]), axis=1)
        certain = (ordered[:, -1] - ordered[:, -2]) ** 2
        weight = VOTES * certain * np.asarray(self.weights.sum(axis=1)).ravel()
        probabilities = self._walk(np.full(len(parts), -1), weight[:, None] * parts, 1.0)
        return objects[probabilities.argmax(1)][self.nearest]

    def _walk(
        self, seeds: np.ndarray, prior: np.ndarray, strength: float, start: np.ndarray | None = None
    ) -> np.ndarray:
        return random_walker(self.weights, seeds, prior, strength, start, self.clusters)

    def _joined(self, found: np.ndarray, seeds: np.ndarray, everything: bool) -> np.ndarray:
        """Give the loose parts of objects to the objects around them; found, seeds: (n,) labels."""
        loose = self._loose(found, seeds, everything)
        if not loose.any() or loose.all():
            return found
        known = np.where(loose, -1, found)
        around = self._walk(known, np.zeros((len(found), found.max() + 1)), 0.0)
        # Parts that are connected to nothing keep their labels.
        return np.where(loose & (around.max(1) > 0), around.argmax(1), found)

    def _loose(self, found: np.ndarray, seeds: np.ndarray, everything: bool) -> np.ndarray:
        """Return which nodes (n,) belong to parts of an object that are not connected to any of its seeds.

        Such a part only has a similar color. found, seeds: (n,) labels; seeds are -1 where there is none.
        """
        loose = ~connected_with(self.weights, found, (seeds >= 0) & (seeds == found))
        return loose if everything else loose & (found > 0)


def _seed_labels(shown: np.ndarray) -> np.ndarray:
    """Return the label of each node (n,), -1 for those that are no seeds, from the contributions (labels, n)."""
    most, labels = shown.argmax(0), np.full(shown.shape[1], -1)
    for label, part in enumerate(shown):
        order = np.argsort(-part, kind="stable")
        enough = np.searchsorted(np.cumsum(part[order]), SEEDED * part.sum()) + 1
        seeds = order[:enough]
        labels[seeds[(most[seeds] == label) & (part[seeds] > 0)]] = label
    return labels


def build_graph(
    splats: Generated,
    primitive: str,
    cameras: Sequence[Camera],
    photo: Callable[[int], np.ndarray],
    weights: Weights,
    progress: Callable[[int, int], object],
) -> SplatGraph:
    """Build the graph of a model's splats.

    Args:
        splats: the splats, in scene units.
        primitive: "3d" or "2d".
        cameras: the cameras of the training views, in scene units.
        photo: returns the photo (H, W, 3) uint8 of the camera with an index.
        weights: what the edges are weighed by.
        progress: receives the number of finished cameras, and of all.

    Returns:
        The graph.
    """
    means = devices.host(splats.means).astype(np.float64)
    seen, to_cameras = np.zeros(len(means)), np.zeros(len(means))
    facing, rendered = np.zeros((len(means), 3)), np.zeros((len(means), 3))
    in_photos = {}
    counted = np.unique(np.linspace(0, len(cameras) - 1, min(len(cameras), _MOST_PHOTOS)).round().astype(int))
    chosen = set(counted[np.unique(np.linspace(0, len(counted) - 1, _PHOTOS).round().astype(int))].tolist())
    for done, number in enumerate(counted.tolist(), 1):
        camera = cameras[number]
        small, downscale = reduced(camera)
        planes = np.ones((1, small.height, small.width), np.float32)
        if weights.turned:
            planes = np.concatenate([planes, _rendered_normals(splats, small, primitive)])
        shown = downscale**2 * contributions(splats, small, planes, primitive)
        weight = shown[:, 0]
        if weights.turned:
            rendered += shown[:, 1:]
        to_camera = camera.center - means
        distance = np.maximum(np.linalg.norm(to_camera, axis=1), 1e-12)
        facing += (weight / distance)[:, None] * to_camera
        to_cameras += weight * distance
        seen += weight
        if number in chosen:
            in_photos[number] = weight.astype(np.float32)
        progress(done, len(counted))
    nodes = np.flatnonzero(seen > SEEN)
    if len(nodes) <= weights.neighbors:
        nodes = np.arange(len(means))
    # Neighbors in space should be close in memory, too, where a solution reads them again and again.
    nodes = nodes[cKDTree(means[nodes]).indices]
    xyz = means[nodes]
    tree = cKDTree(xyz)
    nearest = np.empty(len(means), np.int64)
    nearest[nodes] = np.arange(len(nodes))
    hidden = np.setdiff1d(np.arange(len(means)), nodes)
    away, nearest[hidden] = tree.query(means[hidden], workers=-1)

    distance, neighbor = tree.query(xyz, k=min(weights.neighbors, len(nodes)), workers=-1)
    normal = measure_normals(xyz[neighbor], facing[nodes])
    rgb = np.clip(0.5 + C0 * devices.host(splats.sh[:, 0])[nodes].astype(np.float64), 0, 1)
    lab = rgb2lab(rgb[None])[0][neighbor[:, :6]].mean(1)
    second, length = neighbor[:, 1 : NEIGHBORS + 1].ravel(), distance[:, 1 : NEIGHBORS + 1].ravel()
    first = np.repeat(np.arange(len(nodes)), len(second) // len(nodes))
    other = first != second
    first, second, length = first[other], second[other], length[other]
    spacing = distance[:, 1:6].mean(1)
    is_alone = np.zeros(len(means), bool)
    is_alone[hidden] = away > ALONE * spacing[nearest[hidden]]
    gap = length / np.maximum(np.minimum(spacing[first], spacing[second]), 1e-12)
    color = np.linalg.norm(lab[first] - lab[second], axis=1) / 10
    steps = _steps_in_photos(xyz, (first, second), {n: w[nodes] for n, w in in_photos.items()}, cameras, photo) / 10
    bent = weights.concave * concavity(xyz, normal, first, second)
    if weights.turned:
        size = np.linalg.norm(rendered[nodes], axis=1, keepdims=True)
        is_known = size > _SHOWN * seen[nodes, None]
        surface = np.where(is_known, rendered[nodes] / np.maximum(size, 1e-12), normal)
        turned = 1 - (surface[first] * surface[second]).sum(1)
        turned[bending(xyz, surface, first, second) > _CONVEX] = 0.0
        bent = np.maximum(bent, weights.turned * turned)
    unlike = (weights.color * color) ** 2 + bent**2
    unlike += (weights.gap * gap) ** 2 + (weights.steps * steps) ** 2
    distances = to_cameras[nodes] / np.maximum(seen[nodes], 1e-12)
    sides = sides_of_planes(xyz, normal, distances, seen[nodes], (first, second))
    alike = (LEAST + np.exp(-unlike)) * np.choose(sides + 1, (IN_FRONT, 1.0, ON_PLANE))
    between = sparse.coo_array((alike, (first, second)), shape=(len(nodes), len(nodes))).tocsr()
    between = between.maximum(between.T).tocsr()
    order, clusters = nested_clusters(between)
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    nodes, nearest, lab, xyz, distances = nodes[order], place[nearest], lab[order], xyz[order], distances[order]
    between, edges = between[order][:, order], Edges(place[first], place[second], gap, color, steps)
    return SplatGraph(
        nodes, nearest, is_alone, lab, between, clusters, edges, xyz, seen[nodes], facing[nodes], distances
    )


def _rendered_normals(splats: Generated, camera: Camera, primitive: str) -> np.ndarray:
    """Return the normals (3, H, W) of the surface that splats show."""
    with torch.no_grad():
        drawn = rasterize(*splats[:6], camera, want_depth=True, primitive=primitive)
    assert drawn.depth is not None
    return normals_of_depth(devices.host(drawn.depth), devices.host(drawn.alpha), camera)


def _steps_in_photos(
    xyz: np.ndarray,
    edges: tuple[np.ndarray, np.ndarray],
    visible: dict[int, np.ndarray],
    cameras: Sequence[Camera],
    photo: Callable[[int], np.ndarray],
) -> np.ndarray:
    """Return the largest CIELAB step between the ends of each edge, the mean over the photos that show both."""
    first, second = edges
    total, count = np.zeros(len(first)), np.zeros(len(first))
    for number, weight in visible.items():
        camera = cameras[number]
        viewmat, (fx, fy, cx, cy) = camera.arrays()
        in_camera = xyz @ np.asarray(viewmat[:3, :3], np.float64).T + viewmat[:3, 3]
        depth = np.maximum(in_camera[:, 2], 1e-9)
        pixels = np.stack([fx * in_camera[:, 0] / depth + cx, fy * in_camera[:, 1] / depth + cy], 1)
        size = np.array([camera.width, camera.height])
        shown = (weight > _VISIBLE) & (in_camera[:, 2] > 0) & (pixels >= 0).all(1) & (pixels < size).all(1)
        both = np.flatnonzero(shown[first] & shown[second])
        lab = rgb2lab(photo(number))
        before, step = None, np.zeros(len(both))
        for t in np.linspace(0, 1, _SAMPLES):
            at = ((1 - t) * pixels[first[both]] + t * pixels[second[both]]).astype(np.int64)
            here = lab[at[:, 1], at[:, 0]]
            if before is not None:
                step = np.maximum(step, np.linalg.norm(here - before, axis=1))
            before = here
        total[both] += step
        count[both] += 1
    known = count > 0
    usual = float(np.median(total[known] / count[known])) if known.any() else 0.0
    return np.where(known, total / np.maximum(count, 1), usual)
