"""Accuracy and speed of `backend.shared.splats.picking`, compared with the exact IDs and the renderer.

The splats are those of a reconstruction whose capture has exact masks (`make demo`). `agrees_with_truth` is the
fraction of random pixels whose picked ID is the true one, excluding pixels whose neighbors have another ID;
`agrees_with_renderer` is the fraction of all random pixels whose picked ID equals that of `raster.object_map`. Held-out
views are used first. Times are of single picks among about `splats` splats: randomly moved copies of the
reconstruction.

    python benchmarks/pick.py [RECONSTRUCTION] [--json]
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np
import torch
from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from backend.export import read_splats
from backend.raster import Camera, object_map, rasterize
from backend.shared.formats.json_file import read_json
from backend.shared.reconstruction.folder import Reconstruction
from backend.shared.splats.picking import Cloud, PickObject, View, ids_in, pick

PIXELS = 100
VIEWS = 10


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("reconstruction", nargs="?", type=Path, default=Path("build/demo"))
    parser.add_argument("--splats", type=int, default=500_000)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    torch.set_num_threads(1)
    result = measure(options.reconstruction, options.splats)
    if options.json:
        print(json.dumps(result))
    else:
        for key, value in result.items():
            print(f"{key:>22}  {value:.4g}" if isinstance(value, float) else f"{key:>22}  {value}")


def measure(folder: Path, wanted: int) -> dict:
    """Return the figures that `main` prints."""
    splats, _warnings = read_splats(Reconstruction(folder).splats)
    cameras = read_json(Reconstruction(folder).cameras)
    truth = Path(cameras["capture"]) / "truth" / "masks"
    if not truth.is_absolute():
        truth = folder / truth
    objects = placed(splats)
    chosen = [camera for camera in cameras["cameras"] if camera["held_out"]]
    chosen += [camera for camera in cameras["cameras"] if not camera["held_out"]]
    rng = np.random.default_rng(0)
    right = inside = agreed = compared = 0
    for camera in chosen[:VIEWS]:
        view = view_of(camera)
        ids = np.array(Image.open(truth / camera["name"]).convert("I"))
        uniform = windows_agree(ids)
        drawn = rendered_ids(splats, view)
        for x, y in zip(rng.integers(0, view.width, PIXELS), rng.integers(0, view.height, PIXELS), strict=True):
            seen = pick(objects, view, x + 0.5, y + 0.5)
            found = -1 if seen is None else seen.object_id
            compared += 1
            agreed += found == drawn[y, x]
            if uniform[y, x]:
                inside += 1
                right += found == ids[y, x]
    times, first, box = clock(splats, view_of(chosen[0]), wanted)
    return {
        "pixels": inside,
        "agrees_with_truth": right / inside,
        "agrees_with_renderer": agreed / compared,
        "splats": wanted,
        "first_ms": first,
        "median_ms": float(np.median(times)),
        "slowest_ms": float(np.max(times)),
        "rectangle_ms": box,
    }


def placed(splats, matrix: np.ndarray | None = None) -> list[PickObject]:
    """Return each object's splats with the object-to-world matrix."""
    matrix = np.eye(4) if matrix is None else matrix
    found = []
    for object_id in np.unique(splats.object_ids):
        own = splats.object_ids == object_id
        cloud = Cloud(splats.means[own], splats.quats[own], splats.scales[own], splats.opacities[own], splats.blur)
        found.append(PickObject(int(object_id), cloud, matrix))
    return found


def view_of(camera: dict) -> View:
    """Convert a camera of cameras.json."""
    K = np.array(camera["K"])
    return View(
        np.array(camera["viewmat"]), K[0, 0], K[1, 1], K[0, 2], K[1, 2], camera["width"], camera["height"], near=1e-3
    )


def rendered_ids(splats, view: View) -> np.ndarray:
    """Return the renderer's object IDs (H, W); -1 where nothing is drawn."""
    known, index = np.unique(splats.object_ids, return_inverse=True)
    K = np.array([[view.fx, 0, view.cx], [0, view.fy, view.cy], [0, 0, 1]])
    camera = Camera(view.viewmat, K, view.width, view.height, view.near, splats.blur)
    arrays = (splats.means, splats.quats, splats.scales, splats.opacities, splats.sh)
    tensors = [torch.from_numpy(np.ascontiguousarray(array, np.float32)) for array in arrays]
    drawn = rasterize(*tensors, torch.from_numpy(index.astype(np.int32)), camera)
    classes, _ = object_map(drawn)
    return np.where(classes >= 0, known[np.maximum(classes, 0)], -1)


def windows_agree(ids: np.ndarray) -> np.ndarray:
    """Return (H, W) bool: whether all neighbors of a pixel have its ID; False at the border."""
    windows = np.lib.stride_tricks.sliding_window_view(ids, (3, 3))
    agree = np.zeros(ids.shape, bool)
    agree[1:-1, 1:-1] = (windows == ids[1:-1, 1:-1, None, None]).all((2, 3))
    return agree


def clock(splats, view: View, wanted: int) -> tuple[list[float], float, float]:
    """Measure picks among at least `wanted` splats, the first pick with its setup, and a box select of the view; ms."""
    copies = -(-wanted // len(splats.means))
    side = 1.2 * np.linalg.norm(np.percentile(splats.means, 95, 0) - np.percentile(splats.means, 5, 0))
    rng = np.random.default_rng(1)
    started = time.perf_counter()
    objects: list[PickObject] = []
    for copy in range(copies):
        matrix = np.eye(4)
        if copy:
            matrix[:3, 3] = rng.uniform(-0.5, 0.5, 3) * side
        objects += placed(splats, matrix)
    pick(objects, view, 0.5 * view.width, 0.5 * view.height)
    first = 1e3 * (time.perf_counter() - started)
    times = []
    for x, y in zip(rng.uniform(0, view.width, 200), rng.uniform(0, view.height, 200), strict=True):
        started = time.perf_counter()
        pick(objects, view, x, y)
        times.append(1e3 * (time.perf_counter() - started))
    started = time.perf_counter()
    ids_in(objects, view, (0.0, 0.0, view.width, view.height))
    return times, first, 1e3 * (time.perf_counter() - started)


if __name__ == "__main__":
    main()
