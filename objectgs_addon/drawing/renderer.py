# SPDX-License-Identifier: GPL-3.0-or-later
"""GPU rendering of splats with the same blending as the backend's rasterizers."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import bpy
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader
from mathutils import Matrix

from ...backend.shared.splats.picking import View
from . import shaders
from .order import back_to_front
from .splat_arrays import Labels, SplatArrays

LABEL_AMOUNT = 0.75
"""Opacity of the color of a label over a splat's own."""


@dataclass(frozen=True)
class DrawnObject:
    """An object to draw.

    Attributes:
        splats: splats in local coordinates.
        matrix: (4, 4) local to world.
        recolor: (3, 4) affine map of colors.
        color: sRGB-encoded RGB that replaces the splats' colors but keeps their brightness, and its opacity.
        is_selected: outline it in the color of the selection.
        is_pointed_at: outline it in white.
        selected: (N,) bool, the splats that are drawn as selected; None if there are none.
        labels: colors of single splats; None if there are none.
    """

    splats: SplatArrays
    matrix: np.ndarray
    recolor: np.ndarray
    color: tuple[float, float, float, float]
    is_selected: bool = False
    is_pointed_at: bool = False
    selected: np.ndarray | None = None
    labels: Labels | None = None

    @property
    def slots(self) -> int:
        """Number of rows in the shader's table of objects: one for the object, and one for each color of labels."""
        return 1 if self.labels is None else 1 + len(self.labels.colors)


class Renderer:
    """Splat renderer with shaders and the textures of the objects drawn last; requires an active GPU context."""

    def __init__(self) -> None:
        self._splat = shaders.splat_shader()
        self._over = shaders.over_shader()
        self._mark = shaders.mark_shader()
        square = {"corner": [(-1, -1), (1, -1), (-1, 1), (1, 1)]}
        self._quads = {shader: batch_for_shader(shader, "TRI_STRIP", square) for shader in (self._splat, self._over)}
        self._nothing = gpu.types.GPUTexture((1, 1), format="R32F", data=_buffer(np.ones(1)))
        self._target: _Target | None = None
        self._pool: _Pool | None = None
        self._sorted: _Sorted | None = None

    def draw(self, objs: Sequence[DrawnObject], view: View, projection: np.ndarray, depth: np.ndarray | None) -> bool:
        """Draw into the renderer's offscreen image.

        Args:
            objs: the objects to draw.
            view: camera and image size.
            projection: (4, 4) OpenGL projection matrix of the view.
            depth: (height, width) depth buffer for this projection, 0 at the near plane and 1 at the far plane, that
                occludes splats; or None.

        Returns:
            False if there is nothing to draw.
        """
        objs = [obj for obj in objs if len(obj.splats.means)]
        if not objs:
            return False
        if self._pool is None or not self._pool.holds(objs):
            self._pool, self._sorted = _Pool(objs), None
        if self._sorted is None or not self._sorted.holds(objs):
            self._sorted = _Sorted(self._pool, objs)
        self._sorted.sort(objs, view)
        if self._sorted.count == 0:
            return False
        with _KeptState(), self._target_of(view.width, view.height).buffer.bind():
            gpu.state.active_framebuffer_get().clear(color=(0.0, 0.0, 0.0, 0.0))
            self._write(objs, view, projection, depth)
        return True

    def mark(self, meshes: Iterable[bpy.types.Object], view: View, to_clip: np.ndarray, clear: bool) -> None:
        """Mark evaluated mesh objects as pointed at, whether or not something hides them.

        Args:
            meshes: the mesh objects.
            view: camera and image size.
            to_clip: (4, 4) world to clip space.
            clear: empty the image first, since no splats were drawn.
        """
        with _KeptState(), self._target_of(view.width, view.height).buffer.bind():
            if clear:
                gpu.state.active_framebuffer_get().clear(color=(0.0, 0.0, 0.0, 0.0))
            gpu.state.blend_set("ALPHA_PREMULT")
            gpu.state.depth_test_set("NONE")
            self._mark.bind()
            for obj in meshes:
                corners = np.empty((len(obj.data.vertices), 3), np.float32)
                obj.data.vertices.foreach_get("co", corners.reshape(-1))
                triangles = np.empty((len(obj.data.loop_triangles), 3), np.int32)
                obj.data.loop_triangles.foreach_get("vertices", triangles.reshape(-1))
                if len(triangles):
                    batch = batch_for_shader(self._mark, "TRIS", {"pos": corners}, indices=triangles)
                    self._mark.uniform_float("to_clip", Matrix((to_clip @ np.array(obj.matrix_world)).tolist()))
                    batch.draw(self._mark)

    def composite(self, selected: tuple[float, float, float], width: float) -> None:
        """Blend the image over the active framebuffer, with outlines of marked objects.

        Args:
            selected: linear color of the selection's outlines.
            width: width of the outlines in pixels.
        """
        target = self._target
        with _KeptState():
            gpu.state.depth_test_set("NONE")
            gpu.state.blend_set("ALPHA_PREMULT")
            self._over.bind()
            self._over.uniform_float("width", (width / target.picture.width, width / target.picture.height))
            self._over.uniform_float("selected", selected)
            self._over.uniform_sampler("picture", target.picture)
            self._over.uniform_sampler("marks", target.marks)
            self._quads[self._over].draw(self._over)

    def pixels(self) -> np.ndarray:
        """Return the image as (height, width, 4) float32, premultiplied, top row first."""
        width, height = self._target.picture.width, self._target.picture.height
        with self._target.buffer.bind():
            read = gpu.state.active_framebuffer_get().read_color(0, 0, width, height, 4, 0, "FLOAT")
        read.dimensions = width * height * 4
        return np.array(read, np.float32).reshape(height, width, 4)[::-1]

    def free(self) -> None:
        """Free GPU memory."""
        self._target = self._pool = self._sorted = None

    def _target_of(self, width: int, height: int) -> _Target:
        if self._target is None or (self._target.picture.width, self._target.picture.height) != (width, height):
            self._target = _Target(width, height)
        return self._target

    def _write(
        self, objs: Iterable[bpy.types.Object], view: View, projection: np.ndarray, depth: np.ndarray | None
    ) -> None:
        hiding = self._nothing
        if depth is not None:
            hiding = gpu.types.GPUTexture(depth.shape[::-1], format="R32F", data=_buffer(depth))
        gpu.state.blend_set("ALPHA_PREMULT")
        gpu.state.depth_test_set("NONE")
        gpu.state.depth_mask_set(False)
        shader = self._splat
        shader.bind()
        shader.uniform_float("lens", (view.fx, view.fy, view.cx, view.cy))
        shader.uniform_float("size", (view.width, view.height, view.near, float(view.orthographic)))
        shader.uniform_float("limits", view.slope_limits().reshape(-1).tolist())
        shader.uniform_float("depths", (float(projection[2, 2]), float(projection[2, 3])))
        shader.uniform_int("bands", self._pool.bands)
        shader.uniform_int("hides", int(depth is not None))
        objects_table = _table(_objects(objs, view), "RGBA32F")
        shader.uniform_sampler("order", self._sorted.texture)
        shader.uniform_sampler("splats", self._pool.splats)
        shader.uniform_sampler("harmonics", self._pool.harmonics)
        shader.uniform_sampler("objects", objects_table)
        shader.uniform_sampler("depth", hiding)
        self._quads[shader].draw_instanced(shader, instance_count=self._sorted.count)


class _Target:
    """The textures that the splat shader writes to, and their framebuffer."""

    def __init__(self, width: int, height: int) -> None:
        self.picture, self.marks = (gpu.types.GPUTexture((width, height), format="RGBA16F") for _ in range(2))
        self.buffer = gpu.types.GPUFrameBuffer(color_slots=(self.picture, self.marks))


class _Pool:
    """Splats of several meshes, concatenated in textures."""

    def __init__(self, objs: Sequence[DrawnObject]) -> None:
        self._arrays = list({id(obj.splats): obj.splats for obj in objs}.values())
        starts = np.cumsum([0, *(len(arrays.means) for arrays in self._arrays)])
        self.starts = {id(arrays): int(start) for arrays, start in zip(self._arrays, starts)}
        count = int(starts[-1])
        room = shaders.TABLE_WIDTH * gpu.capabilities.max_texture_size_get() // max(count, 1)
        most = max(arrays.harmonics.shape[1] for arrays in self._arrays)
        self.bands = max(bands for bands in (1, 4, 9, 16) if bands == 1 or bands <= min(most, room))
        splats = np.zeros((count, shaders.SPLAT_TEXELS, 4), np.float32)
        harmonics = np.zeros((count, self.bands, 4), np.float32)
        for arrays, start in zip(self._arrays, starts):
            own = slice(start, start + len(arrays.means))
            splats[own, 0, :3], splats[own, 0, 3] = arrays.means, arrays.opacities
            splats[own, 1] = arrays.quats
            splats[own, 2, :3] = arrays.scales
            bands = min(arrays.harmonics.shape[1], self.bands)
            harmonics[own, :bands, :3] = arrays.harmonics[:, :bands]
        self.splats = _table(splats, "RGBA32F")
        self.harmonics = _table(harmonics, "RGBA16F")

    def holds(self, objs: Sequence[DrawnObject]) -> bool:
        """Return whether the textures contain the splats of all these objects and not many others."""
        wanted = {id(obj.splats): obj.splats for obj in objs}
        if not all(key in self.starts for key in wanted):
            return False
        used = sum(len(arrays.means) for arrays in wanted.values())
        return sum(len(arrays.means) for arrays in self._arrays) <= 2 * used + 100_000


class _Sorted:
    """Drawing order of splats for one view and one set of object transforms."""

    def __init__(self, pool: _Pool, objs: Sequence[DrawnObject]) -> None:
        self._splats, self._slots = [obj.splats for obj in objs], [obj.slots for obj in objs]
        counts = [len(splats.means) for splats in self._splats]
        self._entries = np.empty((sum(counts), 2), np.float32)
        self._depths = np.empty(len(self._entries), np.float32)
        self._parts = []
        first = slot = 0
        for splats, count, slots in zip(self._splats, counts, self._slots):
            start, own = pool.starts[id(splats)], slice(first, first + count)
            self._entries[own, 0] = np.arange(start, start + count)
            self._entries[own, 1] = slot
            self._parts.append((own, slot))
            first += count
            slot += slots
        self._rows: np.ndarray | None = None
        self._marked: list[tuple[np.ndarray | None, Labels | None]] = [(None, None)] * len(self._splats)
        self._order = np.zeros(0, np.int64)
        self.count = 0
        self.texture: gpu.types.GPUTexture | None = None

    def holds(self, objs: Sequence[DrawnObject]) -> bool:
        """Return whether this order is for these objects."""
        return self._slots == [obj.slots for obj in objs] and all(
            obj.splats is splats for obj, splats in zip(objs, self._splats)
        )

    def sort(self, objs: Sequence[DrawnObject], view: View) -> None:
        """Update the order if the view or an object has moved, and mark selected and labeled splats."""
        rows = view.viewmat[2] @ np.array([obj.matrix for obj in objs])
        moved = self._rows is None or not np.array_equal(rows, self._rows)
        if not self._mark([(obj.selected, obj.labels) for obj in objs]) and not moved:
            return
        if moved:
            self._rows = rows
            self._sort(rows, view)
        self.texture = _table(self._entries.take(self._order, axis=0), "RG32F") if self.count else None

    def _mark(self, marked: list[tuple[np.ndarray | None, Labels | None]]) -> bool:
        """Write which splats are selected, and their labels, into the entries; return False if nothing has changed."""
        if all(now is before for pair in zip(marked, self._marked) for now, before in zip(*pair)):
            return False
        for (own, slot), (selected, labels) in zip(self._parts, marked):
            self._entries[own, 1] = slot if labels is None else slot + labels.of_splats
            if selected is not None:
                self._entries[own, 1] += shaders.SELECTED * selected
        self._marked = marked
        return True

    def _sort(self, rows: np.ndarray, view: View) -> None:
        """Sort the splats by depth; rows (n, 4): the maps from each object's coordinates to the depth."""
        for splats, row, (own, _) in zip(self._splats, rows.astype(np.float32), self._parts):
            np.matmul(splats.means, row[:3], out=self._depths[own])
            self._depths[own] += row[3]
        self._order = back_to_front(self._depths, view.near, view.orthographic)
        self.count = len(self._order)


def _objects(objs: Sequence[DrawnObject], view: View) -> np.ndarray:
    """Return the shader's data for each object and label in this view, (n, OBJECT_TEXELS, 4) float32."""
    table = np.zeros((len(objs), shaders.OBJECT_TEXELS, 4), np.float32)
    matrices = np.array([obj.matrix for obj in objs])
    camera_to_world = np.linalg.inv(view.viewmat)[:3]
    table[:, 0:3] = (view.viewmat @ matrices)[:, :3]
    # Harmonics rotate with the object but ignore its scale.
    left, _, right = np.linalg.svd(matrices[:, :3, :3])
    back = np.swapaxes(left @ right, 1, 2)
    if view.orthographic:
        table[:, 3:6, 3] = back @ camera_to_world[:, 2]
    else:
        table[:, 3:6, :3] = back @ matrices[:, :3, :3]
        table[:, 3:6, 3] = np.einsum("nij,nj->ni", back, matrices[:, :3, 3] - camera_to_world[:, 3])
    table[:, 6:9] = [obj.recolor for obj in objs]
    table[:, 9] = [obj.color for obj in objs]
    table[:, 10, :2] = [(obj.is_selected, obj.is_pointed_at) for obj in objs]
    slots = [obj.slots for obj in objs]
    table = np.repeat(table, slots, axis=0)
    for first, obj in zip(np.cumsum([0, *slots]), objs):
        if obj.labels is not None:
            own = slice(first + 1, first + obj.slots)
            table[own, 9, :3], table[own, 9, 3] = obj.labels.colors, LABEL_AMOUNT
    return table


def _table(values: np.ndarray, kind: str) -> gpu.types.GPUTexture:
    """Store texels (..., channels) in a texture with rows of TABLE_WIDTH."""
    channels = values.shape[-1]
    texels = values.size // channels
    rows = max(1, -(-texels // shaders.TABLE_WIDTH))
    filled = np.empty((rows * shaders.TABLE_WIDTH, channels), np.float32)
    filled[:texels] = values.reshape(-1, channels)
    filled[texels:] = 0.0
    return gpu.types.GPUTexture((shaders.TABLE_WIDTH, rows), format=kind, data=_buffer(filled))


def _buffer(values: np.ndarray) -> gpu.types.Buffer:
    flat = np.ascontiguousarray(values, np.float32).reshape(-1)
    return gpu.types.Buffer("FLOAT", flat.size, flat)


class _KeptState:
    """Context manager that restores the GPU state of blending and depth tests."""

    def __enter__(self) -> None:
        self._before = gpu.state.blend_get(), gpu.state.depth_test_get(), gpu.state.depth_mask_get()

    def __exit__(self, *_: Any) -> None:
        blend, test, mask = self._before
        gpu.state.blend_set(blend)
        gpu.state.depth_test_set(test)
        gpu.state.depth_mask_set(mask)
