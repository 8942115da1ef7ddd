"""Cost of a training over the number of objects: time, frames a second and memory, as in the paper's table.

    python benchmarks/objects.py [--capture build/demo/capture] [--steps 300] [--write]

The photos are those of the demo, whose exact depth splits its surfaces into any number of objects of equal size: the
cells of a grid in space. All trainings have the same number of steps. --write writes docs/figures/objects.json and
docs/objects.md. Results are kept in build/objects.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
import time
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
if str(ROOT) not in sys.path:
    sys.path.insert(0, str(ROOT))

from benchmarks import documents, shared

COUNTS = (7, 24, 63, 80, 90, 1000)
"""Numbers of objects: those of the paper's table, and many more."""

REPEATS = 5
"""How often each held-out view is rendered."""

PAPER = {7: (72, 80, 10), 24: (31, 90, 12), 63: (69, 50, 35), 80: (113, 40, 45), 90: (112, 40, 45)}
"""Number of objects -> minutes, frames a second and GB of GPU memory in the paper, each of another scene."""


def split_capture(source: Path, count: int, folder: Path) -> int:
    """Copy the demo capture with its surfaces split into about `count` objects; returns their number.

    The cells' edge is found by bisection, so that the depth of all views falls into about `count` of them.
    """
    from backend.capture import load_capture

    with tempfile.TemporaryDirectory(prefix="objectgs-benchmark-") as cache:
        capture = load_capture(source, Path(cache))
        positions = {view.name: _positions(source, view) for view in capture.views}
    everything = np.concatenate([xyz[::7, ::7].reshape(-1, 3) for xyz in positions.values()])
    low, high = 1e-3 * np.ptp(everything, axis=0).max(), 2 * np.ptp(everything, axis=0).max()
    for _ in range(40):
        edge = np.sqrt(low * high)
        found = len(np.unique(np.floor(everything / edge).astype(np.int64), axis=0))
        low, high = (edge, high) if found > count else (low, edge)
    cells = np.unique(np.floor(everything / high).astype(np.int64), axis=0)
    number = {tuple(cell): i for i, cell in enumerate(cells.tolist(), 1)}
    shutil.copytree(source / "images", folder / "images")
    shutil.copytree(source / "sparse", folder / "sparse")
    for name, xyz in positions.items():
        keys, of_pixels = np.unique(np.floor(xyz / high).astype(np.int64).reshape(-1, 3), axis=0, return_inverse=True)
        ids = np.array([number.get(tuple(key), 0) for key in keys.tolist()], np.uint16)[of_pixels.reshape(-1)]
        path = (folder / "masks" / name).with_suffix(".png")
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(ids.reshape(xyz.shape[:2])).save(path)
    return len(cells)


def _positions(source: Path, view: Any) -> np.ndarray:
    """Return the world position (h, w, 3) of each pixel of a view, from its exact depth."""
    depth = np.load((source / "truth" / "depth" / view.name).with_suffix(".npy")).astype(np.float64)
    rows, columns = np.mgrid[: view.height, : view.width] + 0.5
    directions = np.stack([columns, rows, np.ones_like(rows)], -1) @ np.linalg.inv(view.K).T
    in_camera = directions * np.where(np.isfinite(depth), depth, 0)[..., None]
    return (in_camera - view.viewmat[:3, 3]) @ view.viewmat[:3, :3]


def measured(capture: str, count: int, steps: int) -> dict[str, Any]:
    """Train and measure; must run in a separate process, whose peak memory is a result.

    fps: views a second, rendered with IDs at the size of the photos.
    """
    import resource

    from backend.capture import load_capture
    from backend.evaluation import evaluate
    from backend.labels import vote
    from backend.model.draw import draw
    from backend.raster import compile_kernels
    from backend.shared.events import Reporter
    from backend.training.budget import Budget
    from backend.training.settings import Settings
    from backend.training.trainer import Trainer

    compile_kernels()
    with tempfile.TemporaryDirectory(prefix="objectgs-benchmark-") as scratch:
        folder = Path(scratch) / "capture"
        objects = split_capture(Path(capture), count, folder)
        loaded = load_capture(folder, Path(scratch) / "cache")
        trainer = Trainer.start(loaded, vote(loaded).ids, Settings())
        trainer.run(Budget(steps=steps), Path(scratch) / "checkpoint", Reporter())

        def render(index: int) -> tuple[Any, Any]:
            rendered = draw(trainer.shown, trainer.scene.camera(index))
            return rendered.image, rendered.ids

        started = time.perf_counter()
        views = [render(index) for index in loaded.test_indices for _ in range(REPEATS)]
        fps = len(views) / (time.perf_counter() - started)
        quality = evaluate(loaded, render, loaded.test_indices)["quality"]
    return {
        "objects": objects,
        "seconds": trainer.progress.seconds,
        "fps": fps,
        "memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1000,
        "splats": len(trainer.shown.generate().source),
        "psnr": quality["psnr"],
        "miou": quality["miou"],
    }


def document(found: Mapping[str, Any]) -> str:
    """Return the text of docs/objects.md."""
    least = found["rows"][0]
    rows = [
        [
            f"{row['objects']:,}", f"{row['seconds']:.0f}", f"{row['seconds'] / least['seconds']:.2f}",
            f"{row['fps']:.1f}", f"{row['memory_mb']:,.0f} MB", f"{row['splats']:,}", f"{row['psnr']:.2f}",
            f"{row['miou']:.3f}",
        ]
        for row in found["rows"]
    ]  # fmt: skip
    paper = [[str(count), f"{m} min", str(fps), f"{gb} GB"] for count, (m, fps, gb) in PAPER.items()]
    lines = [
        "# Cost of objects",
        "",
        f"Made by `python benchmarks/objects.py --write`: trainings of {found['steps']} steps on the demo's photos, "
        "whose surfaces are split into more and more objects, on two cores of a server CPU. These objects are the "
        "cells of a grid in space, whose borders no photo shows, so their mIoU says little about real objects. Frames "
        "a second are those of 320x240 pixels with object IDs. The rasterizer blends one "
        "probability, that of a pixel's label, whatever the number of objects; only the map of the most probable "
        "objects looks at several.",
        "",
        *shared.table(
            ("objects", "seconds", "times the least", "frames a second", "memory", "splats", "PSNR", "mIoU"), rows
        ),
        "",
        "In the paper, whose rasterizer blends a channel for each object, on a GPU, 30,000 steps, and scenes that "
        "differ in more than their objects:",
        "",
        *shared.table(("objects", "training", "frames a second", "GPU memory"), paper),
    ]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Measure, and print or write the document."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--capture", type=Path, default=ROOT / "build/demo/capture")
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    shared.compile_everything()
    code = [*shared.sources(), Path(__file__)]
    results = shared.Results(ROOT / "build" / "objects", shared.digest(code, options.steps), len(COUNTS))
    rows = [
        results.get(
            f"{count} objects",
            partial(
                shared.in_child, "benchmarks.objects:measured", capture=str(options.capture.resolve()), count=count,
                steps=options.steps,
            ),
            lambda row: f"{row['objects']} objects, {row['seconds']:.0f} s, {row['memory_mb']:.0f} MB",
        )
        for count in COUNTS
    ]  # fmt: skip
    if results.failures:
        raise SystemExit("Not measured: " + "; ".join(f"{name}: {why}" for name, why in results.failures.items()))
    found = {"steps": options.steps, "rows": rows}
    if options.write:
        documents.save("objects", found)
    print(document(found))


if __name__ == "__main__":
    main()
