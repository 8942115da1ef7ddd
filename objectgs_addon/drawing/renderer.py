# SPDX-License-Identifier: GPL-3.0-or-later
"""Draws splats into a picture on the GPU, as the backend's renderers blend them."""

from collections.abc import Sequence
from dataclasses import dataclass

import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader

from ...backend.picking import View
from ..splat_arrays import SplatArrays
from . import shaders
from .order import back_to_front


@dataclass(frozen=True)
class Drawn:
    """An object to draw: its splats, their map to the world (4, 4), the affine map of its colours (3, 4), and what
    covers them: `colour` and `highlight`, encoded RGB with the share (4,)."""

    splats: SplatArrays
    matrix: np.ndarray
    recolour: np.ndarray
    colour: tuple[float, float, float, float]
    highlight: tuple[float, float, float, float]


class Renderer:
    """GPU programs and the tables of what was drawn last. Only to be used where a GPU context is active."""

    def __init__(self) -> None:
        self._splat = shaders.splat_shader()
        self._over = shaders.over_shader()
        square = {"corner": [(-1, -1), (1, -1), (-1, 1), (1, 1)]}
        self._quads = {shader: batch_for_shader(shader, "TRI_STRIP", square)
                       for shader in (self._splat, self._over)}
        self._nothing = gpu.types.GPUTexture((1, 1), format="R32F", data=_buffer(np.ones(1)))
        self._target: gpu.types.GPUOffScreen | None = None
        self._pool: _Pool | None = None
        self._sorted: _Sorted | None = None

    def draw(self, things: Sequence[Drawn], view: View, projection: np.ndarray, depth: np.ndarray | None) -> bool:
        """Draw into the renderer's own picture; False where there is nothing to draw.

        projection (4, 4): OpenGL's, which `depth` (height, width), if any, was drawn with: 0 at the near plane, 1 at
        the far one; splats behind it are hidden.
        """
        things = [thing for thing in things if len(thing.splats.means)]
        if not things:
            return False
        if self._pool is None or not self._pool.holds(things):
            self._pool, self._sorted = _Pool(things), None
        if self._sorted is None or not self._sorted.holds(things):
            self._sorted = _Sorted(self._pool, things)
        self._sorted.sort(things, view)
        if self._sorted.count == 0:
            return False
        with _state(), self._target_of(view.width, view.height).bind():
            target = gpu.state.active_framebuffer_get()
            target.clear(color=(0.0, 0.0, 0.0, 0.0))
            self._write(things, view, projection, depth)
        return True

    def over(self) -> None:
        """Lay the picture over the active framebuffer."""
        with _state():
            gpu.state.depth_test_set("NONE")
            gpu.state.blend_set("ALPHA_PREMULT")
            self._over.bind()
            self._over.uniform_sampler("picture", self._target.texture_color)
            self._quads[self._over].draw(self._over)

    def pixels(self) -> np.ndarray:
        """(height, width, 4) float32 of the picture, premultiplied, the top row first."""
        width, height = self._target.width, self._target.height
        with self._target.bind():
            read = gpu.state.active_framebuffer_get().read_color(0, 0, width, height, 4, 0, "FLOAT")
        read.dimensions = width * height * 4
        return np.array(read, np.float32).reshape(height, width, 4)[::-1]

    def free(self) -> None:
        """Give the GPU's memory back."""
        if self._target is not None:
            self._target.free()
        self._target = self._pool = self._sorted = None

    def _target_of(self, width: int, height: int) -> gpu.types.GPUOffScreen:
        if self._target is None or (self._target.width, self._target.height) != (width, height):
            if self._target is not None:
                self._target.free()
            self._target = gpu.types.GPUOffScreen(width, height, format="RGBA16F")
        return self._target

    def _write(self, things, view: View, projection: np.ndarray, depth: np.ndarray | None) -> None:
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
        things_table = _table(_objects(things, view), "RGBA32F")
        shader.uniform_sampler("order", self._sorted.texture)
        shader.uniform_sampler("splats", self._pool.splats)
        shader.uniform_sampler("harmonics", self._pool.harmonics)
        shader.uniform_sampler("things", things_table)
        shader.uniform_sampler("depth", hiding)
        self._quads[shader].draw_instanced(shader, instance_count=self._sorted.count)


class _Pool:
    """The splats of several meshes in textures, one behind the other."""

    def __init__(self, things: Sequence[Drawn]) -> None:
        self._arrays = list({id(thing.splats): thing.splats for thing in things}.values())
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

    def holds(self, things: Sequence[Drawn]) -> bool:
        """Whether all of these are here, and not many others."""
        wanted = {id(thing.splats): thing.splats for thing in things}
        if not all(key in self.starts for key in wanted):
            return False
        used = sum(len(arrays.means) for arrays in wanted.values())
        return sum(len(arrays.means) for arrays in self._arrays) <= 2 * used + 100_000


class _Sorted:
    """The order in which splats are drawn, for one view of objects in their places."""

    def __init__(self, pool: _Pool, things: Sequence[Drawn]) -> None:
        self._splats = [thing.splats for thing in things]
        counts = [len(splats.means) for splats in self._splats]
        self._entries = np.empty((sum(counts), 2), np.float32)
        self._depths = np.empty(len(self._entries), np.float32)
        self._parts = []
        first = 0
        for slot, (splats, count) in enumerate(zip(self._splats, counts)):
            start, own = pool.starts[id(splats)], slice(first, first + count)
            self._entries[own, 0] = np.arange(start, start + count)
            self._entries[own, 1] = slot
            self._parts.append(own)
            first += count
        self._rows: np.ndarray | None = None
        self.count = 0
        self.texture: gpu.types.GPUTexture | None = None

    def holds(self, things: Sequence[Drawn]) -> bool:
        """Whether these are the objects that it sorts."""
        return len(things) == len(self._splats) and all(
            thing.splats is splats for thing, splats in zip(things, self._splats))

    def sort(self, things: Sequence[Drawn], view: View) -> None:
        """Bring the order up to date, if the view or an object has moved."""
        rows = view.viewmat[2] @ np.array([thing.matrix for thing in things])
        if self._rows is not None and np.array_equal(rows, self._rows):
            return
        self._rows = rows
        for splats, row, own in zip(self._splats, rows.astype(np.float32), self._parts):
            np.matmul(splats.means, row[:3], out=self._depths[own])
            self._depths[own] += row[3]
        order = back_to_front(self._depths, view.near, view.orthographic)
        self.count = len(order)
        self.texture = _table(self._entries.take(order, axis=0), "RG32F") if self.count else None


def _objects(things: Sequence[Drawn], view: View) -> np.ndarray:
    """(n, OBJECT_TEXELS, 4) float32: what the shader needs of each object in this view."""
    table = np.zeros((len(things), shaders.OBJECT_TEXELS, 4), np.float32)
    matrices = np.array([thing.matrix for thing in things])
    eye = np.linalg.inv(view.viewmat)[:3]
    table[:, 0:3] = (view.viewmat @ matrices)[:, :3]
    # Harmonics turn with the object but are not stretched with it.
    left, _, right = np.linalg.svd(matrices[:, :3, :3])
    back = np.swapaxes(left @ right, 1, 2)
    if view.orthographic:
        table[:, 3:6, 3] = back @ eye[:, 2]
    else:
        table[:, 3:6, :3] = back @ matrices[:, :3, :3]
        table[:, 3:6, 3] = np.einsum("nij,nj->ni", back, matrices[:, :3, 3] - eye[:, 3])
    table[:, 6:9] = [thing.recolour for thing in things]
    table[:, 9], table[:, 10] = [thing.colour for thing in things], [thing.highlight for thing in things]
    return table


def _table(values: np.ndarray, kind: str) -> gpu.types.GPUTexture:
    """Texels (..., channels) as a texture of rows of TABLE_WIDTH."""
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


class _state:
    """Leaves blending and depth tests as they were."""

    def __enter__(self):
        self._before = gpu.state.blend_get(), gpu.state.depth_test_get(), gpu.state.depth_mask_get()

    def __exit__(self, *_):
        blend, test, mask = self._before
        gpu.state.blend_set(blend)
        gpu.state.depth_test_set(test)
        gpu.state.depth_mask_set(mask)
