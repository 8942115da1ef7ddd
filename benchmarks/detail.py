# SPDX-License-Identifier: GPL-3.0-or-later
"""Levels of detail in the viewport: the time of a frame on the CPU against the error of the image.

The scene is a town of flat splats: streets and houses, with walls of several colors. The views are from afar, from a
street, and close to a wall. Measured in Blender's Python are the time and memory that building the levels takes, and
the time to choose and sort the splats of a frame of 1920 x 1080 pixels, which is repeated whenever the view moves,
against that of sorting all splats in the same run; the upload and the drawing by the graphics card are not included.
The error is that of images of 640 x 480 pixels by the backend's renderer: the PSNR to the image of all splats, and to
one of all splats at four times the size, averaged, which has less aliasing. "limited" is with the viewport's limit.

    python benchmarks/detail.py [--millions 1 3 10] [--blender .venv-bpy/bin/python] [--json]
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import time
import tracemalloc
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
if str(ROOT) not in sys.path:
    sys.path.insert(0, str(ROOT))

PIXELS = (0.5, 1.0, 2.0)
BUDGET = 750_000
"""`MOST` of objectgs_addon/drawing/entries.py."""

REPEATS = 7
HOUSES = 24
"""Along each side of the town, whose side is 2 units a house."""

VIEWS = {
    "afar": ((0.0, -60.0, 30.0), (0.0, 0.0, 0.0)),
    "street": ((0.0, -16.0, 0.6), (0.2, 20.0, 0.8)),
    "close": ((0.0, 0.7, 0.4), (0.5, 1.0, 0.4)),
}


def town(count: int) -> tuple[np.ndarray, ...]:
    """Return means, quats, scales, opacities and harmonics of a town of `count` splats, float32."""
    rng = np.random.default_rng(0)
    corners = 2.0 * np.stack(np.meshgrid(*2 * [np.arange(HOUSES) - HOUSES / 2], indexing="ij"), -1).reshape(-1, 2)
    heights = rng.uniform(0.5, 2.5, len(corners))
    side = 2.0 * HOUSES
    # Rectangles: a corner and two edges. The ground, and five sides of each house of 1 x 1.
    x, y, z = np.eye(3)
    rectangles = [((-side / 2, -side / 2, 0.0), side * x, side * y)]
    for (left, front), height in zip(corners, heights):
        corner = np.array([left + 0.5, front + 0.5, 0.0])
        rectangles += [(corner + height * z, x, y), (corner, x, height * z), (corner, y, height * z)]
        rectangles += [(corner + y, x, height * z), (corner + x, y, height * z)]
    first, edge_x, edge_y = (np.array([rectangle[k] for rectangle in rectangles]) for k in range(3))
    areas = np.linalg.norm(edge_x, axis=1) * np.linalg.norm(edge_y, axis=1)
    face = rng.choice(len(areas), count, p=areas / areas.sum())
    u, v = rng.uniform(size=(2, count, 1))
    means = first[face] + u * edge_x[face] + v * edge_y[face]
    spacing = math.sqrt(areas.sum() / count)
    scales = spacing * np.exp(rng.normal(-0.3, 0.4, (count, 3)))
    # The thin axis, 0, 1 or 2, is that of the normal.
    scales[np.arange(count), np.argmax(np.abs(np.cross(edge_x, edge_y)), axis=1)[face]] *= 0.05
    quats = np.hstack([np.ones((count, 1)), rng.normal(0, 0.03, (count, 3))])
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    bricks = np.sin(40.0 * means).prod(1) > 0.0
    shade = rng.uniform(0.2, 0.9, (len(areas), 3))[face] * np.where(bricks, 1.0, 0.6)[:, None]
    harmonics = rng.normal(0, 0.03, (count, 4, 3))
    harmonics[:, 0] = (shade + rng.normal(0, 0.05, (count, 3)) - 0.5) / 0.2820948
    opacities = rng.uniform(0.3, 0.99, count)
    return tuple(values.astype(np.float32) for values in (means, quats, scales, opacities, harmonics))


def viewmat(eye: tuple[float, ...], target: tuple[float, ...]) -> np.ndarray:
    """Return the viewmat (4, 4) of a camera that looks from one point to another."""
    forward = np.subtract(target, eye)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3, :3] = right, np.cross(forward, right), forward
    matrix[:3, 3] = -matrix[:3, :3] @ eye
    return matrix


def frames(count: int) -> dict[str, Any]:
    """Measure building and frames in Blender's Python."""
    import headless

    headless.extension()
    from objectgs.backend.shared.splats.levels import build_levels
    from objectgs.backend.shared.splats.picking import View
    from objectgs.objectgs_addon.drawing.entries import DrawnObject, entries_of
    from objectgs.objectgs_addon.drawing.splat_arrays import SplatArrays

    splats = SplatArrays(*town(count))
    tracemalloc.start()
    began = time.perf_counter()
    levels = build_levels(splats.means, splats.quats, splats.scales, splats.opacities, splats.harmonics)
    seconds = time.perf_counter() - began
    kept, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    starts = {id(splats): 0, id(levels.merged): count}
    found: dict[str, Any] = {"seconds": seconds, "kept_gb": kept / 1e9, "peak_gb": peak / 1e9, "views": {}}
    for name, (eye, target) in VIEWS.items():
        milliseconds: dict[str, list[float]] = {"all": [], "chosen": []}
        for kind, own in (("all", None), ("chosen", levels)):
            obj = DrawnObject(splats, np.eye(4), np.eye(3, 4), (0.0, 0.0, 0.0, 0.0), levels=own)
            entries = entries_of([obj], starts)
            for step in range(REPEATS):
                moved = viewmat(tuple(np.add(eye, 1e-4 * step)), target)
                view = View(moved, 1600.0, 1600.0, 960.0, 540.0, 1920, 1080)
                began = time.perf_counter()
                table = entries.update([obj], view)
                milliseconds[kind].append(1e3 * (time.perf_counter() - began))
        found["views"][name] = {
            "splats": len(table),
            **{f"{kind}_ms": float(np.median(times[1:])) for kind, times in milliseconds.items()},
        }
    return found


def errors(count: int) -> dict[str, dict[str, Any]]:
    """Return the number of splats and the PSNRs for each view and error in pixels, and for the viewport's limit."""
    import torch

    from backend.raster import Camera, rasterize
    from backend.shared.splats.level_selection import PlacedLevels, select
    from backend.shared.splats.levels import build_levels
    from backend.shared.splats.picking import View

    splats = town(count)
    levels = build_levels(*splats)
    drawn = len(levels.order)

    def image(arrays: Sequence[np.ndarray], matrix: np.ndarray, finer: int = 1) -> np.ndarray:
        K = np.array([[533.0, 0, 320], [0, 533.0, 240], [0, 0, 1 / finer]]) * finer
        tensors = [torch.from_numpy(np.ascontiguousarray(values)) for values in arrays]
        ids = torch.zeros(len(arrays[0]), dtype=torch.int32)
        color = rasterize(*tensors, ids, Camera(matrix, K, 640 * finer, 480 * finer)).color.numpy().clip(0.0, 1.0)
        return color.reshape(3, 480, finer, 640, finer).mean((2, 4))

    def psnr(one: np.ndarray, other: np.ndarray) -> float:
        return -10 * math.log10(max(float(((one - other) ** 2).mean()), 1e-12))

    found: dict[str, dict[str, Any]] = {}
    for name, (eye, target) in VIEWS.items():
        matrix = viewmat(eye, target)
        view = View(matrix, 533.0, 533.0, 320.0, 240.0, 640, 480)
        whole, smooth = image(splats, matrix), image(splats, matrix, 4)
        found[name] = {"all": {"splats": count, "psnr": math.inf, "smooth": psnr(whole, smooth)}}
        for pixels, budget in (*((pixels, 1 << 40) for pixels in PIXELS), (1.0, BUDGET)):
            (places,) = select([PlacedLevels(levels, np.eye(4))], view, pixels, budget)
            own, merged = levels.order[places[places < drawn]], places[places >= drawn] - drawn
            chosen = [
                np.concatenate([values[own], coarse[merged].astype(np.float32)])
                for values, coarse in zip(splats, levels.merged)
            ]
            drawn_now = image(chosen, matrix)
            found[name][f"{pixels} px" + ", limited" * (budget == BUDGET)] = {
                "splats": len(places),
                "psnr": psnr(drawn_now, whole),
                "smooth": psnr(drawn_now, smooth),
            }
    return found


def tables(results: dict[str, dict[str, Any]]) -> str:
    """Return the results as Markdown."""
    lines = ["| millions | levels, s | kept, GB | while building, GB |", "|---|---:|---:|---:|"]
    for millions, found in results.items():
        own = found["frames"]
        lines.append(f"| {millions} | {own['seconds']:.1f} | {own['kept_gb']:.2f} | {own['peak_gb']:.2f} |")
    lines += ["", "| millions | view | all, ms | chosen, ms | ratio | splats |", "|---|---|---:|---:|---:|---:|"]
    for millions, found in results.items():
        for name, own in found["frames"]["views"].items():
            ratio = own["all_ms"] / own["chosen_ms"]
            times = f"{own['all_ms']:.0f} | {own['chosen_ms']:.0f} | {ratio:.1f} | {own['splats']:,}"
            lines.append(f"| {millions} | {name} | {times} |")
    lines += ["", "| millions | view | error | splats | PSNR to all, dB | to four times the size, dB |"]
    lines += ["|---|---|---|---:|---:|---:|"]
    for millions, found in results.items():
        for name, rows in found["errors"].items():
            for label, own in rows.items():
                figures = f"{own['splats']:,} | {own['psnr']:.1f} | {own['smooth']:.1f}"
                lines.append(f"| {millions} | {name} | {label} | {figures} |")
    return "\n".join(lines)


def main() -> None:
    """Measure, and print tables or JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--millions", type=float, nargs="+", default=[1, 3, 10])
    parser.add_argument("--blender", type=Path, default=ROOT / ".venv-bpy" / "bin" / "python")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--frames", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.frames:
        print(json.dumps(frames(options.frames)))
        return
    results = {}
    for millions in options.millions:
        count = round(1e6 * millions)
        command = [options.blender, __file__, "--frames", str(count)]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        results[f"{millions:g}"] = {"frames": json.loads(done.stdout.splitlines()[-1]), "errors": errors(count)}
    print(json.dumps(results) if options.json else tables(results))


if __name__ == "__main__":
    main()
