"""Speed of the rasterizer, in ns per (pixel, splat) pair.

A pair is a pixel inside a splat's bounding box, clipped to the image: the work of a renderer without exact spans or
early termination. Forward is projection, binning and blending of color, alpha and label probability; backward is all
gradients. Scenes are random: splats of a few pixels, 40 to 50 splats per pixel, opacities 0.05 to 0.95.
The reference is the float64 torch renderer of the tests, which blends every splat into every pixel. It is compared with
the kernels on a small image; for larger scenes, the factor is larger.

    python -m benchmarks.raster [--json] [--repeats 15]
"""

from __future__ import annotations

import argparse
import contextlib
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
if str(ROOT) not in sys.path:
    sys.path.insert(0, str(ROOT))

import backend  # noqa: F401, I001 - sets the thread wait policy, before torch is loaded

import numba
import numpy as np
import psutil
import torch

from backend.raster import Camera, compile_kernels
from backend.raster.cpu import renderer as cpu
from backend.raster.reference import rasterize_reference
from backend.raster.splats import HALF_H, HALF_W, U, V

SIZES = ((40_000, 320, 240, 1.2), (50_000, 640, 480, 2.0), (200_000, 1280, 960, 2.0))
MIDDLE = SIZES[1]
SMALL = (500, 160, 120, 5.0)
OBJECTS = (1, 10, 100, 1_000, 10_000)


class Scene:
    """Random splats, `size` pixels across, spread evenly over the image and over depths 1 to 4."""

    def __init__(
        self, count: int, width: int, height: int, size: float, objects: int = 8, scattered: bool = False
    ) -> None:
        rng = np.random.default_rng(0)
        z = rng.uniform(1, 4, count)
        u, v = rng.uniform(0, width, count), rng.uniform(0, height, count)
        means = np.stack([(u - width / 2) / width * z, (v - height / 2) / width * z, z], 1)
        scales = np.exp(rng.normal(0, 0.5, (count, 3))) * size / width * z[:, None]
        quats, opacities = rng.normal(size=(count, 4)), rng.uniform(0.05, 0.95, count)
        sh = rng.normal(0, 0.3, (count, 4, 3))
        x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        # Objects form a regular grid over the image; with `scattered`, each splat has a random object.
        across = int(np.ceil(np.sqrt(objects)))

        def field(x: np.ndarray, y: np.ndarray) -> np.ndarray:
            row, column = (y * across / height).astype(np.int32), (x * across / width).astype(np.int32)
            return np.minimum(row * across + column, objects - 1)

        ids = rng.integers(0, objects, count).astype(np.int32) if scattered else field(u, v)
        self.gaussians = cpu.Gaussians(*(a.astype(np.float32) for a in (means, quats, scales, opacities, sh)), ids=ids)
        self.camera = Camera(
            np.eye(4), np.array([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1.0]]), width, height
        )
        self.labels = rng.integers(0, objects, (height, width)).astype(np.int32) if scattered else field(x, y)
        shape = (height, width)
        self.g_color = rng.normal(size=(3, *shape)).astype(np.float32)
        self.g_alpha, self.g_label_probability = (rng.normal(size=shape).astype(np.float32) for _ in range(2))
        self.frame = self.forward()

    def forward(self) -> cpu.Frame:
        return cpu.forward(self.gaussians, self.camera, self.labels)

    def backward(self) -> None:
        cpu.backward(self.frame, self.g_color, self.g_alpha, self.g_label_probability)

    def step(self) -> None:
        """Run the rasterizer's part of a training step."""
        cpu.backward(self.forward(), self.g_color, self.g_alpha, self.g_label_probability)

    def step_discs(self, surface: bool = False) -> None:
        """Run the same step with the splats as discs; surface: with depth, normals, distortion and their gradients."""
        frame = cpu.forward(
            self.gaussians, self.camera, self.labels, surface, False, surface, surface, flat=True
        )  # fmt: skip
        three = (self.g_alpha, self.g_color, self.g_color[:2].copy()) if surface else ()
        cpu.backward(frame, self.g_color, self.g_alpha, self.g_label_probability, *three)

    def id_render(self) -> None:
        """Render color, and find the most probable object of every pixel."""
        cpu.object_ranks(cpu.forward(self.gaussians, self.camera), 1)

    @property
    def pairs(self) -> float:
        s = self.frame.splats[self.frame.seen].astype(np.float64)
        across = np.minimum(s[:, U] + s[:, HALF_W], self.camera.width) - np.maximum(s[:, U] - s[:, HALF_W], 0)
        down = np.minimum(s[:, V] + s[:, HALF_H], self.camera.height) - np.maximum(s[:, V] - s[:, HALF_H], 0)
        return float((across * down).sum())


def timed(jobs: dict[str, Callable[[], object]], repeats: int) -> dict[str, tuple[float, float]]:
    """Return median and spread (half the interquartile range) in ms; jobs take turns, the first turn is not counted."""
    times: dict[str, list[float]] = {name: [] for name in jobs}
    for turn in range(repeats + 1):
        for name, job in jobs.items():
            started = time.perf_counter()
            job()
            if turn:
                times[name].append(1e3 * (time.perf_counter() - started))
    result = {}
    for name, values in times.items():
        quarters = statistics.quantiles(values, n=4) if len(values) > 1 else [values[0]] * 3
        result[name] = (statistics.median(values), (quarters[2] - quarters[0]) / 2)
    return result


def against_reference(repeats: int) -> dict[str, float]:
    """Time forward + backward of a small scene with the reference and the kernels."""
    scene = Scene(*SMALL)
    g = scene.gaussians
    names = ("means", "quats", "scales", "opacities", "sh")
    target = [torch.from_numpy(a).double() for a in (scene.g_color, scene.g_alpha, scene.g_label_probability)]
    labels = torch.from_numpy(scene.labels).long()[..., None]

    def reference() -> None:
        leaves = {name: torch.from_numpy(getattr(g, name)).double().requires_grad_() for name in names}
        expected = rasterize_reference(**leaves, ids=torch.from_numpy(g.ids), camera=scene.camera, objects=8)
        weight = expected.probabilities.gather(-1, labels)[..., 0]
        planes = (expected.color, expected.alpha, weight)
        sum((a * b).sum() for a, b in zip(planes, target, strict=True)).backward()

    slow = timed({"reference": reference}, 3)["reference"][0]
    fast = timed({"kernels": scene.step}, 4 * repeats)["kernels"][0]
    return {
        "reference_ms": slow,
        "kernels_ms": fast,
        "times": slow / fast,
        "reference_ns_per_pair": 1e6 * slow / scene.pairs,
    }


def peak_mb(objects: int) -> float:
    """Return the peak memory that a step and an ID render add to the scene's, in MB; measured in a separate process."""
    script = f"from benchmarks.raster import memory; memory({objects})"
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True)
    return float(done.stdout.split()[-1])


def memory(objects: int) -> None:
    """Print the peak memory that a step and an ID render add to this process, in MB."""
    compile_kernels()
    scene = Scene(*MIDDLE, objects=objects)
    del scene.frame
    before = psutil.Process().memory_info().rss
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")  # Linux: the peak counts from here
    scene.step()
    scene.id_render()
    print((_peak_bytes() - before) / 1e6)


def _peak_bytes() -> int:
    """Return the peak resident memory of this process."""
    if Path("/proc/self/status").exists():
        lines = Path("/proc/self/status").read_text().splitlines()
        return next(1024 * int(line.split()[1]) for line in lines if line.startswith("VmHWM"))
    info = psutil.Process().memory_info()
    return getattr(info, "peak_wset", info.rss)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print one JSON object as the last line, and no table")
    parser.add_argument("--repeats", type=int, default=15, help="how often each measurement is repeated")
    options = parser.parse_args()
    say = (lambda *_: None) if options.json else print
    say(f"Kernels ready in {compile_kernels():.1f} s; {numba.get_num_threads()} threads.")

    say(
        f"\n{'splats':>8} {'image':>10} {'splats per pixel':>16} {'forward ms':>16} {'backward ms':>16}"
        f" {'ns per pair':>20}"
    )
    sizes = []
    for size in SIZES:
        scene = Scene(*size)
        times = timed({"forward": scene.forward, "backward": scene.backward}, options.repeats)
        pairs = scene.pairs
        (forward, f_spread), (backward, b_spread) = times["forward"], times["backward"]
        row = {
            "splats": size[0],
            "width": size[1],
            "height": size[2],
            "pairs": pairs,
            "forward_ms": forward,
            "backward_ms": backward,
            "forward_ns_per_pair": 1e6 * forward / pairs,
            "backward_ns_per_pair": 1e6 * backward / pairs,
        }
        sizes.append(row)
        say(
            f"{size[0]:8d} {f'{size[1]}x{size[2]}':>10} {pairs / size[1] / size[2]:16.0f}"
            f" {forward:9.2f} +-{f_spread:5.2f} {backward:9.2f} +-{b_spread:5.2f}"
            f" {row['forward_ns_per_pair']:6.2f} + {row['backward_ns_per_pair']:5.2f} ="
            f" {row['forward_ns_per_pair'] + row['backward_ns_per_pair']:5.2f}"
        )

    middle = Scene(*MIDDLE)
    threads = {}
    for count in (1, 2):
        numba.set_num_threads(min(count, numba.config.NUMBA_NUM_THREADS))
        threads[str(count)] = 1e6 * timed({"step": middle.step}, options.repeats)["step"][0] / middle.pairs
    numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)
    speed_up = threads["1"] / threads["2"]
    say(f"\nForward + backward, {MIDDLE[0]} splats at {MIDDLE[1]}x{MIDDLE[2]}, ns a pair:")
    say(f"{threads['1']:.2f} on 1 thread, {threads['2']:.2f} on 2: {speed_up:.2f} times faster")

    jobs: dict[str, Callable[[], object]] = {
        "3d": middle.step, "2d": middle.step_discs, "2d with normals": lambda: middle.step_discs(surface=True)
    }  # fmt: skip
    kinds = {name: time for name, (time, _) in timed(jobs, options.repeats).items()}
    say("\nForward + backward of the same splats as 3D Gaussians and as discs, ms:")
    say(
        f"{kinds['3d']:.1f} as 3D Gaussians, {kinds['2d']:.1f} as discs ({kinds['2d'] / kinds['3d']:.2f} times),"
        f" {kinds['2d with normals']:.1f} with depth, normals and distortion"
    )

    reference = against_reference(options.repeats)
    say(f"\nForward + backward of {SMALL[0]} splats at {SMALL[1]}x{SMALL[2]} by both: the torch reference takes")
    say(f"{reference['reference_ms']:.0f} ms ({reference['reference_ns_per_pair']:.0f} ns a pair), the kernels")
    say(f"{reference['kernels_ms']:.2f} ms: {reference['times']:.0f} times faster. Larger scenes differ more.")

    say(f"\n{'objects':>8} {'step ms':>16} {'ID render ms':>16} {'scattered ms':>12} {'MB':>6}")
    scenes = {n: Scene(*MIDDLE, objects=n) for n in OBJECTS}
    jobs = {f"step {n}": s.step for n, s in scenes.items()}
    jobs |= {f"ids {n}": s.id_render for n, s in scenes.items()}
    jobs |= {f"scattered {n}": Scene(*MIDDLE, objects=n, scattered=True).id_render for n in OBJECTS}
    times = timed(jobs, options.repeats)
    objects = {}
    for n in OBJECTS:
        (step, s_spread), (ids, i_spread) = times[f"step {n}"], times[f"ids {n}"]
        scattered = times[f"scattered {n}"][0]
        objects[str(n)] = {"step_ms": step, "id_render_ms": ids, "id_render_scattered_ms": scattered, "mb": peak_mb(n)}
        say(
            f"{n:8d} {step:9.2f} +-{s_spread:5.2f} {ids:9.2f} +-{i_spread:5.2f}"
            f" {scattered:12.2f} {objects[str(n)]['mb']:6.1f}"
        )

    if options.json:
        pair = ("forward_ns_per_pair", "backward_ns_per_pair")
        middle_of = {key: statistics.median(row[key] for row in sizes) for key in pair}
        print(json.dumps({**middle_of, "times_faster_than_reference": reference["times"], "threads": threads,
                          "objects": objects, "two_d_over_three_d": kinds["2d"] / kinds["3d"], "primitives_ms": kinds,
                          "sizes": sizes, "reference": reference}))  # fmt: skip


if __name__ == "__main__":
    main()
