"""Variants of the CPU rasterizer, each in a separate process, and the exact image to compare them with.

A kernel's constants are frozen when it is compiled, so a variant is a process that changes constants or functions of
the modules first, and that has its own folder for compiled kernels. `benchmarks/approximations.py` starts these
processes and lets them take turns:

    python -m benchmarks.raster_variants '{"alpha_min": 0.01}' SCENE.npz EXACT.npz

The exact image is that of the float64 reference, which draws every splat in exact order, without the cut-off at
ALPHA_MIN (only splats that add less than 1e-12 to each pixel are omitted) and without TRANSMITTANCE_THRESHOLD. The
constants that define the image, ALPHA_MAX and the low-pass filter, are the same in all variants.
"""

from __future__ import annotations

import importlib.abc
import importlib.machinery
import json
import math
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import shared

PARAMETERS = ("means", "quats", "scales", "opacities", "sh")
NOTHING = 1e-12
"""Splats that add less than this to every pixel of a part are omitted from the exact image."""
_PART = 48
"""Maximum side, in pixels, of the parts in which the exact image is drawn."""


# --- the exact image -------------------------------------------------------------------------------------------------


def parts_of(width: int, height: int) -> list[tuple[int, int, int, int]]:
    """Return (x, y, width, height) of each part of an image."""
    return [
        (x, y, min(_PART, width - x), min(_PART, height - y))
        for y in range(0, height, _PART)
        for x in range(0, width, _PART)
    ]


def exact_part(scene_file: str, part: tuple[int, int, int, int]) -> dict[str, np.ndarray]:
    """Render a part of the exact image.

    Returns:
        `color` (3, h, w) and `label_probability` (h, w); `drawn`, the indices of the splats drawn there; and
        `g_` + name, their gradients for each of PARAMETERS.
    """
    import torch

    from backend.raster import reference

    torch.set_num_threads(1)
    shared.replace(reference, "ALPHA_MIN", NOTHING)
    shared.replace(reference, "TRANSMITTANCE_THRESHOLD", 0.0)
    scene = np.load(scene_file)
    camera = camera_of(scene)
    x, y, width, height = part
    here = np.s_[y : y + height, x : x + width]
    camera = camera.crop(x, y, width, height)
    drawn = np.flatnonzero(_reaches(scene, camera))
    leaves = {name: torch.from_numpy(scene[name][drawn]).double().requires_grad_() for name in PARAMETERS}
    exact = reference.rasterize_reference(
        **leaves, ids=torch.from_numpy(scene["ids"][drawn]), camera=camera, objects=int(scene["objects"])
    )
    labels = torch.from_numpy(scene["labels"][here]).long()[..., None]
    weight = exact.probabilities.gather(-1, labels.clamp(min=0))[..., 0] * (labels[..., 0] >= 0)
    towards = (
        torch.from_numpy(scene["g_color"][:, *here]).double(),
        torch.from_numpy(scene["g_label_probability"][here]).double(),
    )
    ((exact.color * towards[0]).sum() + (weight * towards[1]).sum()).backward()
    gradients = [leaf.grad if leaf.grad is not None else torch.zeros_like(leaf) for leaf in leaves.values()]
    return {
        "color": exact.color.detach().numpy(),
        "label_probability": weight.detach().numpy(),
        "drawn": drawn,
        **{f"g_{name}": gradient.numpy() for name, gradient in zip(PARAMETERS, gradients, strict=True)},
    }


def _reaches(scene: Any, camera: Any) -> np.ndarray:
    """Return (N,) bool: whether a splat adds NOTHING or more to some pixel of the camera's image."""
    import torch

    from backend.raster.reference import _footprints, rotation_matrices
    from backend.raster.settings import TAN_MARGIN

    means, quats, scales, opacities = (torch.from_numpy(scene[name]).double() for name in PARAMETERS[:4])
    W, t = (torch.from_numpy(camera.viewmat[:3, columns]) for columns in (slice(3), 3))
    p = means @ W.T + t
    ahead = p[:, 2] > camera.near
    p = torch.where(ahead[:, None], p, 1.0)
    axes = W @ rotation_matrices(quats / torch.linalg.vector_norm(quats, dim=-1, keepdim=True)) * scales[:, None, :]
    a, _, c, _ = _footprints(p, axes, camera, camera.blur, TAN_MARGIN)
    reach = torch.sqrt(2 * torch.log(opacities.clamp(min=2 * NOTHING) / NOTHING))
    fx, fy, cx, cy = (float(v) for v in camera.arrays()[1])
    u, v = fx * p[:, 0] / p[:, 2] + cx, fy * p[:, 1] / p[:, 2] + cy
    across = (u + reach * a.sqrt() > 0) & (u - reach * a.sqrt() < camera.width)
    down = (v + reach * c.sqrt() > 0) & (v - reach * c.sqrt() < camera.height)
    return (ahead & across & down).numpy()


def join(scene: Any, parts: Iterator[tuple[tuple[int, int, int, int], dict[str, np.ndarray]]]) -> dict[str, np.ndarray]:
    """Assemble the exact image and its gradients from its parts."""
    height, width = scene["labels"].shape
    whole = {"color": np.zeros((3, height, width)), "label_probability": np.zeros((height, width))}
    whole |= {f"g_{name}": np.zeros(scene[name].shape) for name in PARAMETERS}
    for (x, y, w, h), found in parts:
        whole["color"][:, y : y + h, x : x + w] = found["color"]
        whole["label_probability"][y : y + h, x : x + w] = found["label_probability"]
        for name in PARAMETERS:
            whole[f"g_{name}"][found["drawn"]] += found[f"g_{name}"]
    return whole


def camera_of(scene: Any) -> Any:
    """Return the camera of a scene file."""
    from backend.raster import Camera

    height, width = scene["labels"].shape
    return Camera(scene["viewmat"], scene["K"], width, height)


# --- variants --------------------------------------------------------------------------------------------------------


def exp2_coefficients(degree: int) -> tuple[float, ...]:
    """Return the coefficients, highest degree first, of a polynomial of `degree` for 2^f on [-1/2, 1/2].

    For the kernels' own degree, these are the kernels' coefficients; otherwise, a least-squares fit of the relative
    error at Chebyshev nodes, which is nearly optimal.
    """
    from backend.raster import simd

    if degree == len(simd._EXP2) - 1:
        return simd._EXP2
    f = 0.5 * np.cos(np.pi * (np.arange(200) + 0.5) / 200)
    powers = f[:, None] ** np.arange(degree, -1, -1)
    return tuple(np.linalg.lstsq(powers / np.exp2(f)[:, None], np.ones(len(f)), rcond=None)[0].tolist())


def _set_everywhere(**values: float) -> None:
    """Change a constant, keeping its type, in every module of the rasterizer that has it."""
    for name, value in values.items():
        owners = [m for key, m in list(sys.modules.items()) if key.startswith("backend.raster") and hasattr(m, name)]
        if not owners:
            raise RuntimeError(f"no module of the rasterizer has the constant {name} any more")
        for owner in owners:
            setattr(owner, name, type(getattr(owner, name))(value))


def _alpha_min(value: float) -> None:
    _set_everywhere(ALPHA_MIN=value, _LOG2_CUT=math.log2(value))


def _stop(value: float) -> None:
    _set_everywhere(TRANSMITTANCE_THRESHOLD=value, _TRANSMITTANCE_THRESHOLD=value)


def _exp_degree(degree: int) -> None:
    from backend.raster import simd

    shared.replace(simd, "_EXP2", exp2_coefficients(degree))


def _tile(size: tuple[int, int]) -> None:
    from backend.raster import simd

    width, height = size
    _set_everywhere(TILE_W=width, TILE_H=height, STRIDE=width + simd.LANES, ROW_SLOTS=height + simd.LANES)


def _bounds(kind: str) -> None:
    """Change the pixels in which a splat is evaluated.

    `box`: tiles and pixels of the ellipse's bounding box. `tiles`, `box tiles` and `square`: every pixel of the 16 x 16
    tiles that intersect the ellipse, its bounding box or a square of 3 sigma (of the longer axis).
    """
    from numba import njit, prange

    from backend.raster import simd
    from backend.raster.cpu import binning as cpu_bin
    from backend.raster.cpu import blending, blending_backward
    from backend.raster.cpu import renderer as cpu
    from backend.raster.splats import HALF_H, HALF_W, LOP, SLOPE, A, C, U, V

    if kind != "box":
        _tile((16, 16))
    tile_w, half_log2e = cpu_bin.TILE_W, 0.5 / math.log(2.0)
    whole = kind != "box"
    half = np.float32(0.5)

    @njit(inline="always", error_model="numpy")
    def rows(splats, n, tile_x, tile_y, rows, height, starts, stops, tops, centers):
        v = splats[n, V]
        anchor = min(max(v, np.float32(0.0)), np.float32(height))
        u = splats[n, U] - half - np.float32(tile_x)
        y0, y1, start, stop = 0, rows, 0, tile_w
        if not whole:
            y0 = max(int(math.floor(v - splats[n, HALF_H])) - tile_y, 0)
            y1 = min(int(math.floor(v + splats[n, HALF_H])) + 1 - tile_y, rows)
            middle = u + splats[n, SLOPE] * (v - anchor)
            start = max(int(math.floor(middle - splats[n, HALF_W])), 0)
            stop = min(int(math.floor(middle + splats[n, HALF_W])) + 2, tile_w)
        for row in range(y0, y1, simd.LANES):
            y = simd.ramp(np.float32(tile_y + row) + half)
            dy = y - simd.splat(v)
            simd.store(tops, row, simd.splat(splats[n, LOP]) - simd.splat(splats[n, C]) * dy * dy)
            simd.store(centers, row, simd.splat(u) + simd.splat(splats[n, SLOPE]) * (y - simd.splat(anchor)))
            simd.store(starts, row, simd.splat_i(np.int32(start)))
            simd.store(stops, row, simd.splat_i(np.int32(stop)))
        return y0, y1

    @njit(error_model="numpy")
    def ends(splats, n, row, columns, height, tile_w, tile_h):
        anchor = min(max(splats[n, V], np.float32(0.0)), np.float32(height))
        u = splats[n, U] + splats[n, SLOPE] * (splats[n, V] - anchor)
        first = max(int(math.floor((u - splats[n, HALF_W] - half) / np.float32(tile_w))), 0)
        last = min(int(math.floor((u + splats[n, HALF_W] + half) / np.float32(tile_w))) + 1, columns)
        return first, last

    @njit(parallel=True, error_model="numpy")
    def square(splats):
        for n in prange(splats.shape[0]):
            if splats[n, HALF_H] > 0:
                c = half_log2e / splats[n, C]
                b = splats[n, SLOPE] * c
                a = half_log2e / splats[n, A] + b * b / c
                longest = 0.5 * (a + c) + math.sqrt(0.25 * (a - c) * (a - c) + b * b)
                splats[n, HALF_W] = splats[n, HALF_H] = 3.0 * math.sqrt(longest)

    for module in (blending, blending_backward):
        shared.replace(module, "splat_rows", rows)
    if kind != "tiles":
        shared.replace(cpu_bin, "row_ends", ends)
    if kind == "square":

        def project_squares(*arguments: Any) -> None:
            project(*arguments)
            square(arguments[8])

        project = shared.replace(cpu, "project", project_squares)


def _sort(kind: str) -> None:
    """Change the sort of the splats by depth.

    `argsort`: NumPy's sort. `16 bits` and `8 bits`: quantized depths, with ties in model order. `none`: in model order.
    `tiles`: each tile's intersections separately. `keys`: one sort of all intersections by tile and depth.
    """
    from numba import njit, prange

    from backend.raster.cpu import renderer as cpu
    from backend.raster.splats import DEPTH, HALF_H

    def visible(splats: np.ndarray) -> np.ndarray:
        return np.flatnonzero(splats[:, HALF_H] > 0).astype(np.int32)

    def order(splats: np.ndarray, ids: np.ndarray) -> np.ndarray:
        found = visible(splats)
        depths = splats[found, DEPTH]
        if kind == "argsort":
            return found[np.argsort(depths, kind="stable")]
        if kind.endswith("bits") and len(found):
            steps = 2 ** int(kind.split()[0]) - 1
            low, high = depths.min(), depths.max()
            keys = ((depths - low) * (steps / max(high - low, 1e-30))).astype(np.uint16)
            return found[np.argsort(keys, kind="stable")]
        return found

    @njit(parallel=True)
    def by_tile(splats, isect_offsets, isect_ids, isect_rows):
        for tile in prange(isect_offsets.size - 1):
            first, last = isect_offsets[tile], isect_offsets[tile + 1]
            here, there = isect_ids[first:last].copy(), isect_rows[first:last].copy()
            depths = np.empty(last - first, np.float32)
            for i in range(last - first):
                depths[i] = splats[here[i], DEPTH]
            sequence = np.argsort(depths, kind="mergesort")
            for i in range(last - first):
                isect_ids[first + i] = here[sequence[i]]
                isect_rows[first + i] = there[sequence[i]]

    def by_key(splats: np.ndarray, isect_offsets: np.ndarray, isect_ids: np.ndarray, isect_rows: np.ndarray) -> None:
        tile = np.repeat(np.arange(isect_offsets.size - 1, dtype=np.uint64), np.diff(isect_offsets))
        bits = np.ascontiguousarray(splats[isect_ids, DEPTH]).view(np.uint32)
        sequence = np.argsort(tile << np.uint64(32) | bits, kind="stable")
        isect_ids[:], isect_rows[:] = isect_ids[sequence], isect_rows[sequence]

    shared.replace(cpu, "depth_order", order)
    if kind in ("tiles", "keys"):
        sort = by_tile if kind == "tiles" else by_key

        def bin_and_sort(splats: np.ndarray, order: np.ndarray, width: int, height: int) -> Any:
            isect_offsets, isect_ids, isect_rows, row_offsets = bin_splats(splats, order, width, height)
            sort(splats, isect_offsets, isect_ids, isect_rows)
            return isect_offsets, isect_ids, isect_rows, row_offsets

        bin_splats = shared.replace(cpu, "bin_splats", bin_and_sort)


class _Doubled(importlib.machinery.SourceFileLoader):
    """Loader for a module of the rasterizer that replaces float32 by float64."""

    _EXP2 = (
        ("_INTS", "ir.VectorType(ir.IntType(64), LANES)"),
        ("[23]", "[52]"),
        ("12582912.0", "6755399441055744.0"),
        ("-126.0", "-1022.0"),
    )
    _SIMD = (("ir.FloatType()", "ir.DoubleType()"), ("types.float32", "types.float64"), ("}f32", "}f64"))

    def get_code(self, fullname: str) -> Any:
        source = Path(self.path).read_text()
        if fullname.endswith(".simd"):
            head, exp2 = source.split("def exp2(")
            source = _replaced(head, self._SIMD) + "def exp2(" + _replaced(exp2, self._EXP2)
        return compile(source.replace("np.float32", "np.float64"), self.path, "exec", dont_inherit=True)


def _replaced(text: str, pairs: tuple[tuple[str, str], ...]) -> str:
    for old, new in pairs:
        if old not in text:
            raise RuntimeError(f"backend/raster/simd.py has no {old} to be replaced any more")
        text = text.replace(old, new)
    return text


class _DoubledFinder(importlib.abc.MetaPathFinder):
    _SHARED = ("simd", "splats", "spherical_harmonics", "discs", "tile_intersection")

    def find_spec(self, fullname: str, path: Any, target: Any = None) -> Any:
        package, _, name = fullname.rpartition(".")
        if package != "backend.raster.cpu" and (package != "backend.raster" or name not in self._SHARED):
            return None
        found = importlib.machinery.PathFinder.find_spec(fullname, path)
        assert found is not None and found.origin is not None
        found.loader = _Doubled(fullname, found.origin)
        return found


_CHANGES: dict[str, Callable[[Any], None]] = {
    "alpha_min": _alpha_min,
    "stop": _stop,
    "exp_degree": _exp_degree,
    "tile": _tile,
    "bounds": _bounds,
    "sort": _sort,
}


# --- the process -----------------------------------------------------------------------------------------------------


def main() -> None:
    """Print the variant's errors, then the times of one forward and backward pass per input line, as JSON objects."""
    changes, scene_file, exact_file = json.loads(sys.argv[1]), sys.argv[2], sys.argv[3]
    kind = np.float64 if changes.pop("float64", False) else np.float32
    if kind is np.float64:
        sys.meta_path.insert(0, _DoubledFinder())
    from backend.raster.cpu import renderer as cpu

    for name, value in changes.items():
        _CHANGES[name](value)
    scene, exact = np.load(scene_file), np.load(exact_file)
    gaussians = cpu.Gaussians(*(np.ascontiguousarray(scene[name], kind) for name in PARAMETERS), ids=scene["ids"])
    camera, labels = camera_of(scene), scene["labels"]
    towards = [np.ascontiguousarray(scene[name], kind) for name in ("g_color", "g_alpha", "g_label_probability")]

    started = time.perf_counter()
    frame = cpu.forward(gaussians, camera, labels)
    gradients = cpu.backward(frame, *towards)
    print(json.dumps({"compile_seconds": time.perf_counter() - started, **errors(frame, gradients, exact)}), flush=True)
    for _ in sys.stdin:
        times = [time.perf_counter()]
        frame = cpu.forward(gaussians, camera, labels)
        times.append(time.perf_counter())
        cpu.backward(frame, *towards)
        times.append(time.perf_counter())
        print(json.dumps({"forward_ms": 1e3 * (times[1] - times[0]), "backward_ms": 1e3 * (times[2] - times[1])}))
        sys.stdout.flush()


def errors(frame: Any, gradients: Any, exact: Any) -> dict[str, float]:
    """Compare a variant with the exact image and gradients.

    Returns:
        `picture`: RMSE of the colors in 8-bit steps. `largest`: the largest error. `gradient`: norm of the difference
        relative to the exact gradient's norm, as root mean square over PARAMETERS.
    """

    error = 255 * (frame.color - exact["color"])
    parts = []
    for name in PARAMETERS:
        true = exact[f"g_{name}"]
        parts.append(np.linalg.norm(getattr(gradients, name) - true) / max(np.linalg.norm(true), 1e-300))
    return {
        "picture": float(np.sqrt(np.mean(error**2))),
        "largest": float(np.abs(error).max()),
        "gradient": float(np.sqrt(np.mean(np.square(parts)))),
    }


if __name__ == "__main__":
    main()
