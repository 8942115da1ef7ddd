"""Objects of splats from strokes, which may be added one by one."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch

from ..evaluation.images import as_bytes
from ..labels.regions import MergeTree
from ..model.generate import Generated
from ..raster import Camera, devices, object_ranks, rasterize
from ..shared.errors import InputError
from ..shared.reconstruction.objects import default_name
from .mask_edges import follow_edges
from .proposals import find_objects, try_regions
from .splat_graph import Solution, SplatGraph, Weights, build_graph, contributions, reduced
from .stroke_masks import Segment, stroke_pixels
from .strokes import PARTS, Stroke, Strokes, stroke_through
from .views import Views

LONGEST = 640
"""Longer side in pixels of the images from viewpoints that are not those of photos."""

_PHOTOS, _STROKES, _FEWEST_PIXELS = 16, 3, 30
"""Number of photos in which proposed objects are looked for, of strokes on each, and of pixels that they must show."""

_EVERYTHING = 0.9
"""Everything belongs to a proposed object if they cover more than this fraction of the photos' pixels."""

_RANKS = 4
"""Number of objects of a pixel that its mask is decided between."""


class StrokeOnNothing(InputError):
    """A stroke shows no splats; number: its number, from 1."""

    def __init__(self, number: int, where: str) -> None:
        super().__init__(
            f"Stroke {number} shows no splats, since nothing was reconstructed there in {where}; draw it elsewhere on "
            "the object."
        )
        self.number = number


class _Drawn(NamedTuple):
    """A stroke, and those on other objects from the same viewpoint, on which the pixels depend that it stands for."""

    stroke: Stroke
    others: tuple[Stroke, ...]


class _Shown(NamedTuple):
    """The (N,) contributions of the splats to a stroke, and the part of the picture of a mask in its place, or None."""

    splats: np.ndarray
    area: float | None


class Pointer:
    """Finds the objects of splats.

    Args:
        splats: the splats, in scene units.
        primitive: "3d" or "2d".
        views: views of them.
        weights: what edges between splats are weighed by.
        progress: receives the number of prepared views, and of all.
        segment: the segmentation model by which a stroke stands for more than it covers, if there is one.
    """

    def __init__(
        self,
        splats: Generated,
        primitive: str,
        views: Views,
        weights: Weights,
        progress: Callable[[int, int], object],
        segment: Segment | None = None,
    ) -> None:
        self.splats = splats
        self._primitive, self._views, self._segment = primitive, views, segment
        self._index_of = {name: index for index, name in enumerate(views.names)}
        used = views.used
        self._graph: SplatGraph = build_graph(
            splats, primitive, [views.camera(index) for index in used],
            lambda number: self.picture(used[number]), weights, progress,
        )  # fmt: skip
        self._shown: dict[_Drawn, _Shown] = {}
        self._latest: Solution | None = None
        self._regions: MergeTree | None = None

    def solve(self, strokes: Strokes, left_out: Callable[[StrokeOnNothing], object] | None = None) -> np.ndarray:
        """Find the object of each splat.

        Args:
            strokes: the strokes.
            left_out: receives the error of a stroke that shows no splats and does without if others mark its object.

        Returns:
            (N,) int64 object IDs, 0 for none.

        Raises:
            StrokeOnNothing: a stroke shows no splats.
        """
        drawn = [_Drawn(stroke, self._others(stroke, strokes.strokes)) for stroke in strokes.strokes]
        found: dict[_Drawn, _Shown] = {}
        errors: dict[_Drawn, StrokeOnNothing] = {}
        for number, each in enumerate(drawn, 1):
            try:
                found[each] = self._contributions(number, each)
            except StrokeOnNothing as error:
                errors[each] = error
        self._shown = found
        marked = {0, *(stroke.object for stroke, _ in found)}
        for (stroke, _), shows_nothing in errors.items():
            if left_out is None or stroke.object not in marked:
                raise shows_nothing
            left_out(shows_nothing)
        areas = [shown.area for shown in self._shown.values() if shown.area]
        seeds: dict[int, np.ndarray] = {}
        for (stroke, _), shown in self._shown.items():
            # So that each stroke counts as much, however long it is; and each mask as much as it covers, since a splat
            # across the border of two masks belongs to the one that shows more of it.
            weight = shown.area / np.mean(areas) if shown.area else 1.0
            label = _label(stroke)
            seeds[label] = seeds.get(label, 0.0) + weight * shown.splats / shown.splats.sum()
        self._latest = self._graph.solve(seeds, strokes.everything, self._latest)
        return self._latest.ids // PARTS

    def propose(
        self,
        detail: float,
        progress: Callable[[int, int], object],
        found_in: Callable[[int, np.ndarray], object] | None = None,
    ) -> Strokes:
        """Find the objects without strokes, and return strokes that mark them, in up to three photos each.

        Args:
            detail: as for `find_objects`. After the first call, others are answered sooner.
            progress: receives the number of finished trials, and of all.
            found_in: receives the index of each view that objects are looked for in, and their IDs (h, w) in it, in the
                size of `voting_mask`; those without a stroke have none.
        """
        if self._regions is None:
            self._regions = try_regions(self._graph, progress)
        found = find_objects(self._graph, self._regions, detail)[self._graph.nearest]
        found[self._graph.is_alone] = 0
        used = self._views.used
        places = np.unique(np.linspace(0, len(used) - 1, min(len(used), _PHOTOS)).round().astype(int))
        best: dict[int, list[tuple[int, Stroke]]] = {}
        masks: list[tuple[int, np.ndarray]] = []
        for index, shown in self.shown_ids(found, [used[place] for place in places.tolist()]):
            masks.append((index, shown))
            view = self._views.reference(index)
            for object_id, pixels in zip(*np.unique(shown[shown > 0], return_counts=True), strict=True):
                if pixels >= _FEWEST_PIXELS:
                    stroke = Stroke(int(object_id), view, stroke_through(shown == object_id), exact=True)
                    best.setdefault(int(object_id), []).append((int(pixels), stroke))
        strokes = tuple(
            stroke
            for object_id in sorted(best)
            for _, stroke in sorted(best[object_id], key=lambda each: -each[0])[:_STROKES]
        )
        if found_in is not None:
            for index, shown in masks:
                found_in(index, np.where(np.isin(shown, list(best)), shown, 0))
        seen, known = self._graph.seen, np.isin(found[self._graph.nodes], list(best))
        everything = bool(seen[known].sum() >= _EVERYTHING * seen.sum())
        return Strokes(strokes, {object_id: default_name(object_id) for object_id in best}, everything)

    def votes(
        self, masks: Mapping[int, np.ndarray], objects: np.ndarray, progress: Callable[[int], object]
    ) -> np.ndarray:
        """Sum how much each splat contributes to the pixels of each object in masks.

        Args:
            masks: masks (h, w) by the index of the view, as from `voting_mask`; pixels of other IDs than those of the
                objects do not count.
            objects: (C,) object IDs.
            progress: receives the number of finished masks.

        Returns:
            (N, C) float64, in pixels.
        """
        found = np.zeros((len(self.splats.means), len(objects)))
        for done, (index, mask) in enumerate(masks.items(), 1):
            camera, downscale = reduced(self._views.camera(index))
            columns = np.flatnonzero(np.isin(objects, mask))
            if len(columns):
                planes = mask == objects[columns, None, None]
                found[:, columns] += downscale**2 * contributions(self.splats, camera, planes, self._primitive)
            progress(done)
        return found

    def voting_mask(self, index: int, mask: np.ndarray) -> np.ndarray:
        """Return the mask (h, w) of a view in the size in which masks vote, from (H, W)."""
        camera, downscale = reduced(self._views.camera(index))
        first = downscale // 2
        return np.ascontiguousarray(mask[first::downscale, first::downscale][: camera.height, : camera.width])

    def settle(self, objects: np.ndarray, votes: np.ndarray) -> np.ndarray:
        """Return the object ID (N,) of each splat by votes (N, C) on the objects (C,), as from `votes`."""
        return self._graph.settle(objects, votes)

    def shown_ids(self, ids: np.ndarray, views: Sequence[int]) -> Iterator[tuple[int, np.ndarray]]:
        """Yield each of the views and the object (h, w) that most of a pixel shows, for the splats' objects (N,).

        The size is that of `voting_mask`.
        """
        objects, classes = np.unique(ids, return_inverse=True)
        labeled = self.splats._replace(ids=torch.from_numpy(classes.astype(np.int32)).to(self.splats.means.device))
        for index in views:
            with torch.no_grad():
                drawn = rasterize(*labeled[:6], reduced(self._views.camera(index))[0], primitive=self._primitive)
            ranks, parts = (devices.host(plane) for plane in object_ranks(drawn, 1))
            yield index, np.where((ranks[0] >= 0) & (parts[0] > 0.5), objects[np.maximum(ranks[0], 0)], 0)

    def masks(self, ids: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
        """Yield each used view and its mask (H, W) int64, 0 where no splats are, for the objects (N,) of the splats."""
        objects, classes = np.unique(np.append(ids, 0), return_inverse=True)
        of_splats = torch.from_numpy(classes[:-1].astype(np.int32)).to(self.splats.means.device)
        labeled = self.splats._replace(ids=of_splats)
        for index in self._views.used:
            camera = self._views.camera(index)
            with torch.no_grad():
                drawn = rasterize(*labeled[:6], camera, primitive=self._primitive)
            ranks, parts = (devices.host(plane) for plane in object_ranks(drawn, _RANKS))
            # Of all objects, a photo shows few.
            present = np.union1d(ranks[ranks >= 0], 0)
            shown = np.zeros((camera.height, camera.width, len(present)), np.float32)
            for found, part in zip(ranks, parts, strict=True):
                row, column = np.nonzero(found >= 0)
                shown[row, column, np.searchsorted(present, found[row, column])] += part[row, column]
            shown[..., 0] += 1.0 - shown.sum(2)
            yield index, objects[present[follow_edges(self.picture(index), shown)]]

    def _others(self, stroke: Stroke, strokes: Sequence[Stroke]) -> tuple[Stroke, ...]:
        """Return the strokes on other objects from the same viewpoint, if they matter for what a stroke stands for."""
        if self._segment is None or stroke.exact:
            return ()
        return tuple(other for other in strokes if other.view == stroke.view and other.object != stroke.object)

    def _contributions(self, number: int, drawn: _Drawn) -> _Shown:
        """Return the splats that a stroke shows; number: its number, for errors."""
        if drawn in self._shown:
            return self._shown[drawn]
        stroke, camera = drawn.stroke, self._camera(drawn.stroke)
        pixels, is_mask = stroke_pixels(
            stroke, drawn.others, (camera.width, camera.height), self._segment, lambda: self._seen(stroke, camera)
        )
        found = contributions(self.splats, camera, pixels[None], self._primitive)[:, 0]
        if not found.sum() > 0.5:
            raise StrokeOnNothing(number, stroke.view if isinstance(stroke.view, str) else "the viewport")
        return _Shown(found, float(pixels.mean()) if is_mask else None)

    def _seen(self, stroke: Stroke, camera: Camera) -> np.ndarray:
        """Return what the user saw while drawing a stroke, (H, W, 3) uint8: the photo, or the splats."""
        return self.picture(self._index_of[stroke.view]) if isinstance(stroke.view, str) else self._drawn(camera)

    def picture(self, index: int) -> np.ndarray:
        """Return the picture (H, W, 3) uint8 of a view: its photo, or else the splats."""
        return self._drawn(self._views.camera(index)) if self._views.photo is None else self._views.photo(index)

    def _drawn(self, camera: Camera) -> np.ndarray:
        """Draw the splats over black, (H, W, 3) uint8."""
        with torch.no_grad():
            drawn = rasterize(*self.splats[:6], camera, primitive=self._primitive)
        return as_bytes(devices.host(drawn.color.clamp(0, 1).permute(1, 2, 0).contiguous()))

    def _camera(self, stroke: Stroke) -> Camera:
        """Return the camera that a stroke was drawn through, in scene units."""
        if isinstance(stroke.view, str):
            return self._views.camera(self._index_of[stroke.view])
        view = stroke.view
        factor = min(1.0, LONGEST / max(view.width, view.height))
        fx, fy, cx, cy = (factor * value for value in view.intrinsics)
        return Camera(
            self._views.normalization.viewmat(np.array(view.viewmat)),
            np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]),
            max(round(factor * view.width), 1), max(round(factor * view.height), 1), blur=self._views.blur,
        )  # fmt: skip


def _label(stroke: Stroke) -> int:
    """Return the label of the part of an object that a stroke is on; 0 for what belongs to none."""
    return PARTS * stroke.object + (stroke.part if stroke.object else 0)
