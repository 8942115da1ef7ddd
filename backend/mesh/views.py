"""Renders of the whole scene, and of single objects without occluders, in each view."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from ..model.generate import Generated
from ..model.object_model import ObjectModel
from ..raster import Camera, Rendered, devices, object_map, rasterize
from ..training.scene import Scene

ALPHA_SEEN = 0.5
"""Smallest alpha of a pixel that has a depth."""

_REACH = 3.4
"""Radius of a splat in standard deviations: sqrt(2 ln 255) and a margin."""
_BORDER = 1.9
"""Number of pixels by which the renderer's low-pass filter enlarges the radius of a splat."""


@dataclass(frozen=True)
class SceneMap:
    """A render of the whole scene in one view.

    Attributes:
        depth: (H, W) float32, along z in scene units, 0 where alpha is too small.
        depth_uncertainty: (H, W) float32, expected error of the depth in scene units.
        ids: (H, W) int32, class index of the most probable object, -1 where nothing is drawn.
        probability: (H, W) float32, probability of that object.
    """

    camera: Camera
    depth: np.ndarray
    depth_uncertainty: np.ndarray
    ids: np.ndarray
    probability: np.ndarray


@dataclass(frozen=True)
class ObjectView:
    """A render of an object's splats in one view, without the rest of the scene, in a rectangle around them.

    Attributes:
        camera: The view's camera, cropped to the rectangle.
        x, y: Upper left pixel of the rectangle in the view.
        depth: (h, w) float32, along z in scene units, 0 where alpha < 0.5.
        depth_uncertainty: (h, w) float32, expected error of the depth in scene units.
        alpha: (h, w) float32.
        color: (h, w, 3) float32, not premultiplied by alpha, at the capture's common exposure.
        visible: (h, w) float32, 0 .. 1, the fraction of the object's light that is not occluded in the whole scene.
    """

    camera: Camera
    x: int
    y: int
    depth: np.ndarray
    depth_uncertainty: np.ndarray
    alpha: np.ndarray
    color: np.ndarray
    visible: np.ndarray


class Views:
    """Renders of a model through the cameras of a scene.

    Args:
        model: The trained model.
        scene: The scene with the cameras and photos.
        indices: The views to use.
        memory_mb: Memory limit of the cache of renders. Object views, and the scene maps used beside them, are cached
            until other objects are requested; then the maps that were not used for longest make way for others.
    """

    def __init__(self, model: ObjectModel, scene: Scene, indices: Sequence[int], memory_mb: float = 600) -> None:
        self.model = model
        self.scene = scene
        self.indices = tuple(indices)
        self._room = memory_mb * 1e6
        self._maps: OrderedDict[int, SceneMap] = OrderedDict()
        self._used: set[int] = set()
        self._views: dict[int, ObjectView | None] = {}
        self._classes: tuple[int, ...] = ()
        self._all: Generated | None = None
        self._own: Generated | None = None

    def camera(self, index: int) -> Camera:
        """Return the camera of view `index` in scene units."""
        return self.scene.camera(index)

    def scene_map(self, index: int) -> SceneMap:
        """Render the whole scene in view `index`."""
        self._used.add(index)
        if index in self._maps:
            self._maps.move_to_end(index)
            return self._maps[index]
        camera = self.camera(index)
        drawn = self._draw(self._scene_splats(camera), camera)
        ids, probability = (devices.host(plane) for plane in object_map(drawn))
        # What lies just behind the surface does not count as hidden by it.
        found = SceneMap(camera, *self._depth(drawn, up_to_median=False), ids, probability)
        if self._take(_bytes(found)):
            self._maps[index] = found
        return found

    def object_view(self, index: int, classes: Sequence[int]) -> ObjectView | None:
        """Render the objects `classes` (class indices) alone in view `index`; None if they are out of view."""
        self._turn_to(classes)
        if index not in self._views:
            view = self._object_view(index)
            if view is not None and not self._take(_bytes(view)):
                return view
            self._views[index] = view
        return self._views[index]

    def _object_view(self, index: int) -> ObjectView | None:
        camera = self.camera(index)
        splats = self._own_splats(camera)
        rectangle = _rectangle(splats, camera)
        if rectangle is None:
            return None
        x, y, width, height = rectangle
        camera = camera.crop(x, y, width, height)
        drawn = self._draw(splats, camera)
        alpha = devices.host(drawn.alpha)
        if not (alpha >= ALPHA_SEEN).any():
            return None
        shown = self._shown(index)[y : y + height, x : x + width] * self._claimed(index)[y : y + height, x : x + width]
        visible = np.clip(shown / np.maximum(alpha, 1e-3), 0, 1).astype(np.float32)
        color = np.moveaxis(devices.host(drawn.color), 0, 2) / np.maximum(alpha, 1e-3)[..., None]
        return ObjectView(
            camera, x, y, *self._depth(drawn, up_to_median=True), alpha, np.ascontiguousarray(color), visible
        )

    def _claimed(self, index: int) -> np.ndarray:
        """Return the pixels (H, W) bool that may show the current objects, according to the photo's mask.

        Pixels with the ID 0, or whose ID is ignored, are not supervised in training, so splats of any object may show
        the background there. If the mask contains the objects, these pixels are not part of them.
        """
        camera = self.camera(index)
        mask = self.scene.capture.mask(index)
        known = self.model.classes.ids_of([c for c in self._classes if c])
        if mask is None or len(known) < len(self._classes) or not np.isin(mask, known).any():
            return np.ones((camera.height, camera.width), bool)
        return mask > 0

    def _shown(self, index: int) -> np.ndarray:
        """Return the fraction (H, W) of each pixel's light in view `index` that comes from the current objects."""
        if len(self._classes) == 1:
            # For a single object, the scene map suffices: in other pixels, another object is more probable.
            whole = self.scene_map(index)
            return np.where(whole.ids == self._classes[0], whole.probability, np.float32(0))
        camera = self.camera(index)
        splats = self._scene_splats(camera)
        ours = self._are_ours(splats.ids).int()
        labels = torch.ones((camera.height, camera.width), dtype=torch.int32, device=ours.device)
        with torch.no_grad():
            drawn = rasterize(*splats[:5], ours, camera, labels, primitive=self.model.primitive)
        assert drawn.label_probability is not None
        return devices.host(drawn.label_probability)

    def _draw(self, splats: Generated, camera: Camera) -> Rendered:
        with torch.no_grad():
            return rasterize(
                *splats[:6], camera, want_depth=True, want_median=True, want_surface=True,
                primitive=self.model.primitive,
            )  # fmt: skip

    def _depth(self, drawn: Rendered, up_to_median: bool) -> tuple[np.ndarray, np.ndarray]:
        """Return the depth (h, w), 0 where alpha is too small, and its uncertainty (h, w), both along z.

        The uncertainty is the difference between the median and the mean depth, which agree if a pixel shows a single
        surface. 3D Gaussians extend through the surface, and their mean depth lies behind it, so the median is used.
        For 2D Gaussians, which are intersected with the pixel's ray, a mean approximates their common surface, whereas
        the median jumps between Gaussians. That of all lies a little behind the surface, since what is behind shines
        through; that of those up to the median does not.
        """
        assert drawn.median is not None and drawn.depth is not None and drawn.surface is not None
        alpha, median = devices.host(drawn.alpha), devices.host(drawn.median)
        mean = devices.host(drawn.depth) / np.maximum(alpha, 1e-3)
        seen = (alpha >= ALPHA_SEEN) & (median > 0)
        depth = median
        if self.model.primitive == "2d":
            depth = devices.host(drawn.surface) if up_to_median else mean
        return np.where(seen, depth, np.float32(0)), np.where(seen, np.abs(mean - median), np.float32(0))

    def _scene_splats(self, camera: Camera) -> Generated:
        if not self.model.explicit:
            return self.model.generate(camera_center=camera.center)
        if self._all is None:
            self._all = self.model.generate()
        return self._all

    def _own_splats(self, camera: Camera) -> Generated:
        if self._own is not None:
            return self._own
        if self.model.explicit:
            splats = self._scene_splats(camera)
            self._own = splats.select(self._are_ours(splats.ids) & self.scene.before_surroundings(splats.means))
            return self._own
        ours = self._are_ours(self.model.anchors.ids) & self.scene.before_surroundings(self.model.anchors.positions)
        anchors = ours.nonzero()[:, 0]
        return self.model.generate(anchors, camera.center)

    def _are_ours(self, ids: torch.Tensor) -> torch.Tensor:
        """Return which of the class indices `ids` belong to the current objects, bool."""
        return torch.isin(ids, torch.tensor(self._classes, dtype=ids.dtype, device=ids.device))

    def _turn_to(self, classes: Sequence[int]) -> None:
        classes = tuple(sorted({int(c) for c in classes}))
        if classes != self._classes:
            self._room += sum(_bytes(view) for view in self._views.values() if view is not None)
            self._classes, self._views, self._own = classes, {}, None
            self._used.clear()

    def _take(self, size: float) -> bool:
        """Return whether a render of this size may be cached; unused scene maps make way for it."""
        while size > self._room and self._maps and (oldest := next(iter(self._maps))) not in self._used:
            self._room += _bytes(self._maps.pop(oldest))
        fits = size <= self._room
        if fits:
            self._room -= size
        return fits


def _bytes(render: SceneMap | ObjectView) -> int:
    return sum(plane.nbytes for plane in vars(render).values() if isinstance(plane, np.ndarray))


def _rectangle(splats: Generated, camera: Camera) -> tuple[int, int, int, int] | None:
    """Return the rectangle of the image that the splats may cover: x, y, width, height; None if out of view."""
    points = devices.host(splats.means.double()) @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    before = points[:, 2] > camera.near
    points, scales = points[before], devices.host(splats.scales)[before]
    if not len(points):
        return None
    focal = np.array([camera.K[0, 0], camera.K[1, 1]])
    centers = points[:, :2] / points[:, 2:] * focal + camera.K[:2, 2]
    # Away from the optical axis, footprints are stretched radially.
    slant = 1 + (points[:, :2] / points[:, 2:]) ** 2
    reach = _REACH * scales.max(1)[:, None] * focal * np.sqrt(slant) / points[:, 2:] + _BORDER
    size = np.array([camera.width, camera.height])
    low, high = centers - reach, centers + reach
    inside = ((high > 0) & (low < size)).all(1)
    if not inside.any():
        return None
    first = np.clip(np.floor(low[inside].min(0)), 0, size - 1).astype(int)
    last = np.clip(np.ceil(high[inside].max(0)), first + 1, size).astype(int)
    return int(first[0]), int(first[1]), int(last[0] - first[0]), int(last[1] - first[1])
