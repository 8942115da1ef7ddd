# SPDX-License-Identifier: GPL-3.0-or-later
"""GPU rendering of splats with the same blending as the backend's rasterizers."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import bpy
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader
from mathutils import Matrix

from ...backend.shared.splats.levels import Merged
from ...backend.shared.splats.picking import View
from . import shaders
from .entries import DrawnObject, Entries, entries_of
from .splat_arrays import SplatArrays

LABEL_AMOUNT = 0.75
"""Opacity of the color of a label over a splat's own."""


class TooManySplats(Exception):
    """The textures cannot hold the splats."""


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
        self._entries: Entries | None = None
        self._order: gpu.types.GPUTexture | None = None
        self._count = 0

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

        Raises:
            TooManySplats: the message says how many are too many.
        """
        objs = [obj for obj in objs if len(obj.splats.means)]
        if not objs:
            return False
        if _count(objs) > _room():
            objs = [replace(obj, levels=None) for obj in objs]
        if self._pool is None or not self._pool.holds(objs):
            self._pool = self._entries = None
            self._pool = _Pool(objs)
        if self._entries is None or not self._entries.holds(objs):
            self._entries = entries_of(objs, self._pool.starts)
        entries = self._entries.update(objs, view)
        if entries is not None:
            self._count = len(entries)
            self._order = _texture(entries, "RG32F") if self._count else None
        if self._count == 0:
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

    @property
    def has_splats(self) -> bool:
        """Whether splats are in GPU memory."""
        return self._pool is not None

    def free(self) -> None:
        """Free GPU memory."""
        self._target = self._pool = self._entries = self._order = None

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
        objects_table = _texture(_objects(objs, view), "RGBA32F")
        shader.uniform_sampler("order", self._order)
        shader.uniform_sampler("splats", self._pool.splats)
        shader.uniform_sampler("harmonics", self._pool.harmonics)
        shader.uniform_sampler("objects", objects_table)
        shader.uniform_sampler("depth", hiding)
        self._quads[shader].draw_instanced(shader, instance_count=self._count)


class _Target:
    """The textures that the splat shader writes to, and their framebuffer."""

    def __init__(self, width: int, height: int) -> None:
        self.picture, self.marks = (gpu.types.GPUTexture((width, height), format="RGBA16F") for _ in range(2))
        self.buffer = gpu.types.GPUFrameBuffer(color_slots=(self.picture, self.marks))


class _Pool:
    """Splats of several meshes and of their levels of detail, concatenated in textures."""

    def __init__(self, objs: Sequence[DrawnObject]) -> None:
        self._arrays = _arrays_of(objs)
        starts = np.cumsum([0, *(len(arrays.means) for arrays in self._arrays.values())])
        self.starts = {key: int(start) for key, start in zip(self._arrays, starts)}
        count = int(starts[-1])
        if count > _room():
            raise TooManySplats(
                f"The graphics driver can draw {_room():,} splats at once, not {count:,}; hide some objects"
            )
        texels = shaders.TABLE_WIDTH * gpu.capabilities.max_texture_size_get()
        most = max(arrays.harmonics.shape[1] for arrays in self._arrays.values())
        self.bands = max(bands for bands in (1, 4, 9, 16) if bands == 1 or bands <= min(most, texels // max(count, 1)))
        table = _table(count * shaders.SPLAT_TEXELS, 4)
        splats = table[: count * shaders.SPLAT_TEXELS].reshape(count, shaders.SPLAT_TEXELS, 4)
        for arrays, start in zip(self._arrays.values(), starts):
            own = slice(start, start + len(arrays.means))
            splats[own, 0, :3], splats[own, 0, 3] = arrays.means, arrays.opacities
            splats[own, 1] = arrays.quats
            splats[own, 2, :3] = arrays.scales
        self.splats = _upload(table, "RGBA32F")
        del table, splats  # Large scenes need the memory.
        table = _table(count * self.bands, 4)
        harmonics = table[: count * self.bands].reshape(count, self.bands, 4)
        for arrays, start in zip(self._arrays.values(), starts):
            bands = min(arrays.harmonics.shape[1], self.bands)
            harmonics[start : start + len(arrays.means), :bands, :3] = arrays.harmonics[:, :bands]
        self.harmonics = _upload(table, "RGBA16F")

    def holds(self, objs: Sequence[DrawnObject]) -> bool:
        """Return whether the textures contain the splats of all these objects and not many others."""
        wanted = _arrays_of(objs)
        if not all(key in self.starts for key in wanted):
            return False
        used = sum(len(arrays.means) for arrays in wanted.values())
        return sum(len(arrays.means) for arrays in self._arrays.values()) <= 2 * used + 100_000


def _room() -> int:
    """Return how many splats the textures can hold."""
    texels = shaders.TABLE_WIDTH * gpu.capabilities.max_texture_size_get()
    return min(texels // shaders.SPLAT_TEXELS, shaders.MOST_SPLATS)


def _count(objs: Iterable[DrawnObject]) -> int:
    """Return how many splats the textures hold for objects, with those of their levels of detail."""
    return sum(len(arrays.means) for arrays in _arrays_of(objs).values())


def _arrays_of(objs: Iterable[DrawnObject]) -> dict[int, SplatArrays | Merged]:
    """Return the splats of objects and of their levels of detail by their identity."""
    found: dict[int, SplatArrays | Merged] = {}
    for obj in objs:
        found[id(obj.splats)] = obj.splats
        if obj.levels is not None:
            found[id(obj.levels.merged)] = obj.levels.merged
    return found


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
    table[:, 10, :3] = [(obj.is_selected, obj.is_pointed_at, obj.splats.blur) for obj in objs]
    slots = [obj.slots for obj in objs]
    table = np.repeat(table, slots, axis=0)
    for first, obj in zip(np.cumsum([0, *slots]), objs):
        if obj.labels is not None:
            own = slice(first + 1, first + obj.slots)
            table[own, 9, :3], table[own, 9, 3] = obj.labels.colors, LABEL_AMOUNT
    return table


def _texture(values: np.ndarray, kind: str) -> gpu.types.GPUTexture:
    """Store texels (..., channels) in a texture with rows of TABLE_WIDTH."""
    texels = values.reshape(-1, values.shape[-1])
    table = _table(*texels.shape)
    table[: len(texels)] = texels
    return _upload(table, kind)


def _table(texels: int, channels: int) -> np.ndarray:
    """Return zeros (rows * TABLE_WIDTH, channels) for at least one texel."""
    rows = max(1, -(-texels // shaders.TABLE_WIDTH))
    return np.zeros((rows * shaders.TABLE_WIDTH, channels), np.float32)


def _upload(table: np.ndarray, kind: str) -> gpu.types.GPUTexture:
    rows = len(table) // shaders.TABLE_WIDTH
    return gpu.types.GPUTexture((shaders.TABLE_WIDTH, rows), format=kind, data=_buffer(table))


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
