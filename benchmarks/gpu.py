"""Speed of the CUDA renderer, in ms and in ns per (pixel, splat) pair, and its utilization of the GPU.

Pairs are counted as in benchmarks/raster.py: pixels inside a splat's bounding box, clipped to the image. Forward is
projection, binning and blending of color, alpha and label probability; backward is all gradients. Scenes are random,
with about 45 splats per pixel for any number of splats and pixels.

The GPU's limits are measured in the same run: a copy within GPU memory, and a float32 matrix product without tensor
cores. A blending kernel's share of arithmetic counts the operations for every pixel of a tile and every splat that the
tile processes (FORWARD_FLOPS, BACKWARD_FLOPS); its share of memory counts the data that must be read and written once.

    python benchmarks/gpu.py [--json] [--repeats 10] [--demo build/demo/capture] [--out FILE]

--demo names a capture to train on; the default is the demo capture, if `make demo` has created it. A step of its
training is profiled, too. If gsplat is installed, it renders the same splats in the same run. If there is no GPU, or
packages for training are missing, the benchmark reports this and exits normally.
"""

from __future__ import annotations

import argparse
import functools
import importlib.util
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

ROOT = Path(__file__).resolve().parents[1]
if str(ROOT) not in sys.path:
    sys.path.insert(0, str(ROOT))

from backend.raster import Camera
from backend.raster.devices import why_not_cuda
from backend.raster.settings import EPS_2D
from backend.raster.splats import HALF_H, HALF_W, SPLAT_COLUMNS, U, V

SIZES = (
    (100_000, 640, 480), (300_000, 640, 480), (1_000_000, 640, 480), (100_000, 1280, 720), (1_000_000, 1280, 720),
    (100_000, 1920, 1080), (1_000_000, 1920, 1080), (3_000_000, 1920, 1080),
)  # fmt: skip
MIDDLE = (300_000, 640, 480)
OBJECTS = (1, 7, 24, 63, 90, 1_000, 10_000)
DEMO = ROOT / "build" / "demo" / "capture"
DEMO_SECONDS = (15, 30, 60)
FORWARD_FLOPS, BACKWARD_FLOPS = 14, 40
"""Operations per (tile pixel, splat) pair; a fused multiply-add counts as two. Includes the operations on every pair
and, for about a third of the pairs, those of blending."""


class Scene:
    """Random splats on the GPU, spread evenly over the image and over depths 1 to 4."""

    def __init__(self, count: int, width: int, height: int, objects: int = 8) -> None:
        from backend.raster.gpu import renderer

        self.renderer = renderer
        rng = np.random.default_rng(0)
        size = 2.0 * (50_000 / count * width * height / (640 * 480)) ** 0.5
        z = rng.uniform(1, 4, count)
        u, v = rng.uniform(0, width, count), rng.uniform(0, height, count)
        means = np.stack([(u - width / 2) / width * z, (v - height / 2) / width * z, z], 1)
        scales = np.exp(rng.normal(0, 0.5, (count, 3))) * size / width * z[:, None]
        arrays = (means, rng.normal(size=(count, 4)), scales, rng.uniform(0.05, 0.95, count))
        arrays = (*arrays, rng.normal(0, 0.3, (count, 4, 3)))
        across = int(np.ceil(np.sqrt(objects)))

        def field(x: np.ndarray, y: np.ndarray) -> torch.Tensor:
            """Return object IDs on a regular grid over the image."""
            row, column = (y * across / height).astype(np.int32), (x * across / width).astype(np.int32)
            return torch.from_numpy(np.minimum(row * across + column, objects - 1)).cuda()

        self.gaussians = renderer.Gaussians(
            *(torch.from_numpy(a.astype(np.float32)).cuda() for a in arrays), ids=field(u, v)
        )
        self.camera = Camera(
            np.eye(4), np.array([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1.0]]), width, height
        )
        self.labels = field(*np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5))
        self.g_color = torch.randn(3, height, width, device="cuda")
        self.g_alpha, self.g_label_probability = torch.randn(2, height, width, device="cuda").unbind()
        self.frame = self.forward()

    def forward(self, **wanted: bool) -> Any:
        return self.renderer.forward(self.gaussians, self.camera, self.labels, **wanted)

    def backward(self) -> None:
        self.renderer.backward(self.frame, self.g_color, self.g_alpha, self.g_label_probability)

    def step(self) -> None:
        """Run the rasterizer's part of a training step."""
        self.renderer.backward(self.forward(), self.g_color, self.g_alpha, self.g_label_probability)

    def step_discs(self, surface: bool = False) -> None:
        """Run the same step with the splats as discs; surface: with depth, normals and distortion."""
        frame = self.forward(flat=True, want_depth=surface, want_normals=surface, want_moments=surface)
        more = (self.g_alpha, self.g_color, self.g_color[:2].contiguous()) if surface else ()
        self.renderer.backward(frame, self.g_color, self.g_alpha, self.g_label_probability, *more)

    def id_render(self) -> None:
        """Render color, and find the most probable object of every pixel."""
        self.renderer.object_ranks(self.renderer.forward(self.gaussians, self.camera), 1)

    @property
    def pairs(self) -> float:
        s = self.frame.splats[self.frame.seen].double()
        across = (s[:, U] + s[:, HALF_W]).clamp(max=self.camera.width) - (s[:, U] - s[:, HALF_W]).clamp(min=0)
        down = (s[:, V] + s[:, HALF_H]).clamp(max=self.camera.height) - (s[:, V] - s[:, HALF_H]).clamp(min=0)
        return float((across * down).sum())

    def work(self) -> dict[str, float]:
        """Return the minimum work of a step: (tile, splat) intersections, those that are blended, and the operations
        and bytes of the two blending kernels."""
        intersections, blended = float(self.frame.intersections.isect_offsets[-1]), float(self.frame.isect_counts.sum())
        pixels = self.frame.transmittance.numel()
        staged = blended * (4 * SPLAT_COLUMNS + 8)
        return {
            "intersections": intersections,
            "blended": blended,
            "forward_flops": blended * 256 * FORWARD_FLOPS,
            "backward_flops": blended * 256 * BACKWARD_FLOPS,
            "forward_bytes": staged + pixels * 4 * 7,
            "backward_bytes": staged + intersections * (64 + 8) + pixels * 4 * 12,
        }


def timed(jobs: dict[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """Return the median GPU time of each job in ms; jobs take turns, and the first two turns are not counted."""
    times: dict[str, list[float]] = {name: [] for name in jobs}
    for turn in range(repeats + 2):
        for name, job in jobs.items():
            begin, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
            begin.record()
            job()
            end.record()
            end.synchronize()
            if turn > 1:
                times[name].append(begin.elapsed_time(end))
    return {name: statistics.median(values) for name, values in times.items()}


def peak_mb(job: Callable[[], object]) -> float:
    """Return the peak GPU memory that a job adds, in MB."""
    torch.cuda.synchronize()
    torch.cuda.empty_cache()
    torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_allocated()
    job()
    torch.cuda.synchronize()
    return (torch.cuda.max_memory_allocated() - before) / 1e6


def limits(repeats: int) -> dict[str, float]:
    """Measure the GPU's limits: GB/s of a copy (reads plus writes), and float32 TFLOP/s of a matrix product."""
    numbers = torch.empty(2**28, device="cuda")
    copy = torch.empty_like(numbers)
    a, b = torch.randn(2, 8192, 8192, device="cuda").unbind()
    allowed = torch.backends.cuda.matmul.allow_tf32
    torch.backends.cuda.matmul.allow_tf32 = False
    try:
        times = timed({"copy": lambda: copy.copy_(numbers), "product": lambda: a @ b}, repeats)
    finally:
        torch.backends.cuda.matmul.allow_tf32 = allowed
    return {"gb_per_s": 2 * 4 * 2**28 / times["copy"] / 1e6, "tflops": 2 * 8192**3 / times["product"] / 1e9}


def kernels_alone(scene: Scene, repeats: int) -> dict[str, float]:
    """Measure the two blending kernels with torch's profiler, in ms."""
    from torch.profiler import ProfilerActivity, profile

    scene.step()
    with profile(activities=[ProfilerActivity.CUDA]) as profiler:
        for _ in range(repeats):
            scene.step()
        torch.cuda.synchronize()
    found: dict[str, float] = {}
    for event in profiler.key_averages():
        for name in ("blend_backward", "blend"):
            if name in event.key:
                found[name] = found.get(name, 0.0) + event.device_time_total / 1e3 / repeats
                break
    return found


def gsplat_step(scene: Scene) -> tuple[Callable[[], object], Callable[[], object]] | None:
    """Return gsplat's forward pass, and its forward and backward pass, on the scene's splats (color and alpha only).

    None if gsplat is not installed, or if its wheel has no kernels for this GPU and they cannot be compiled here.
    """
    try:
        from gsplat import rasterization
    except ImportError:
        return None
    g = scene.gaussians
    leaves = [t.clone().requires_grad_() for t in (g.means, g.quats, g.scales, g.opacities, g.sh)]
    viewmats = torch.from_numpy(scene.camera.viewmat).float().cuda()[None]
    Ks = torch.from_numpy(scene.camera.K).float().cuda()[None]
    target = scene.g_color.permute(1, 2, 0)[None].contiguous()

    def forward() -> Any:
        return rasterization(
            *leaves, viewmats, Ks, scene.camera.width, scene.camera.height, sh_degree=1, packed=False, eps2d=EPS_2D,
        )  # fmt: skip

    def step() -> None:
        colors, alphas, _ = forward()
        ((colors * target).sum() + (alphas[0, ..., 0] * scene.g_alpha).sum()).backward()
        for leaf in leaves:
            leaf.grad = None

    try:
        step()
    except Exception as error:  # Whatever fails in it must not end the other measurements.
        print(f"gsplat is left out, as it failed: {str(error).splitlines()[0]}", file=sys.stderr)
        return None
    return forward, step


def demo_quality(capture: Path) -> list[dict[str, float]]:
    """Train on the GPU with the command, from the beginning for each of DEMO_SECONDS, and return the quality on the
    held-out views."""
    curve = []
    with tempfile.TemporaryDirectory(prefix="objectgs-benchmark-") as place:
        for seconds in DEMO_SECONDS:
            command = [sys.executable, "-m", "backend"]
            minutes = str(seconds / 60)
            train = ["train", capture, "--out", place, "--minutes", minutes, "--device", "cuda", "--restart"]
            for words in (train, ["evaluate", place]):
                done = subprocess.run([*command, *words], cwd=ROOT, capture_output=True, text=True)
                if done.returncode:
                    raise SystemExit(f"{' '.join(map(str, words))}\n{done.stderr}")
            quality = json.loads((Path(place) / "evaluation.json").read_text())["quality"]
            curve.append({"seconds": seconds, "psnr": quality["psnr"], "miou": quality["miou"]})
    return curve


def lacking_for_training() -> list[str]:
    """Return the names of missing packages that the training command requires."""
    packages = ("pycolmap", "scipy", "PIL", "safetensors", "skimage", "xatlas", "manifold3d", "fast_simplification")
    return [name for name in packages if importlib.util.find_spec(name) is None]


def training_profile(folder: Path, device: torch.device, warm_up: int = 300, steps: int = 30) -> dict[str, float]:
    """Train on a capture and return, for one step: ms of the host, ms until the GPU is done, the part of the time in
    which the GPU computes, and the number of kernels and copies that it runs."""
    from torch.profiler import ProfilerActivity, profile

    from backend.capture import load_capture
    from backend.labels import vote
    from backend.shared.events import Reporter
    from backend.training.budget import Budget
    from backend.training.settings import Settings
    from backend.training.trainer import Trainer

    on_gpu = device.type == "cuda"
    wait = torch.cuda.synchronize if on_gpu else lambda: None
    with tempfile.TemporaryDirectory(prefix="objectgs-benchmark-") as place:
        quiet = Reporter()
        capture = load_capture(folder, Path(place) / "cache", reporter=quiet)
        trainer = Trainer.start(capture, vote(capture, reporter=quiet).ids, Settings(), device=device)
        trainer.run(Budget(steps=warm_up), Path(place) / "checkpoint", quiet)
        wait()
        begin = time.perf_counter()
        for _ in range(steps):
            trainer.step(0.6)
        queued = time.perf_counter()
        wait()
        end = time.perf_counter()
        with profile(activities=[ProfilerActivity.CUDA if on_gpu else ProfilerActivity.CPU]) as profiler:
            for _ in range(steps):
                trainer.step(0.6)
            wait()
    events = profiler.key_averages()
    busy = sum(event.self_device_time_total for event in events) / 1e3 / steps
    step_ms = 1e3 * (end - begin) / steps
    return {
        "host_ms": 1e3 * (queued - begin) / steps,
        "step_ms": step_ms,
        "gpu_busy": busy / step_ms,
        "launches": sum(event.count for event in events if event.self_device_time_total > 0) / steps,
        "anchors": len(trainer.model.anchors),
    }


def measure_sizes(repeats: int, can: Mapping[str, float], say: Callable[..., None]) -> Iterator[dict[str, Any]]:
    """Yield the times of forward and backward passes for each of SIZES; can: see `limits`."""
    say(f"\n{'splats':>9} {'image':>10} {'splats per pixel':>16} {'forward ms':>10} {'backward':>9}"
        f" {'ns per pair':>11} {'MB':>7} {'as discs':>9} {'gsplat ms':>10} {'step over gsplat':>17}")  # fmt: skip
    for size in SIZES:
        scene = Scene(*size)
        jobs: dict[str, Callable[[], object]] = {
            "forward": scene.forward, "backward": scene.backward, "step": scene.step, "discs": scene.step_discs,
            "surface": lambda scene=scene: scene.step_discs(surface=True),
        }  # fmt: skip
        other = gsplat_step(scene)
        if other:
            jobs |= {"gsplat_forward": other[0], "gsplat_step": other[1]}
        times = timed(jobs, repeats)
        pairs = scene.pairs
        alone, work = kernels_alone(scene, repeats), scene.work()
        shares = {
            name: {
                "ms": ms,
                "of_arithmetic": work[f"{kind}_flops"] / ms / 1e9 / can["tflops"],
                "of_memory": work[f"{kind}_bytes"] / ms / 1e6 / can["gb_per_s"],
            }
            for name, kind in (("blend", "forward"), ("blend_backward", "backward"))
            if (ms := alone.get(name))
        }
        row = {
            "splats": size[0], "width": size[1], "height": size[2], "pairs": pairs, "kernels": shares, **work,
            **{f"{name}_ms": ms for name, ms in times.items()},
            "forward_ns_per_pair": 1e6 * times["forward"] / pairs,
            "backward_ns_per_pair": 1e6 * times["backward"] / pairs, "mb": peak_mb(scene.step),
        }  # fmt: skip
        both = row["forward_ns_per_pair"] + row["backward_ns_per_pair"]
        beside = f"{times['gsplat_step']:10.2f} {times['step'] / times['gsplat_step']:17.2f}" if other else f"{'-':>10}"
        say(
            f"{size[0]:9d} {f'{size[1]}x{size[2]}':>10} {pairs / size[1] / size[2]:16.0f} {times['forward']:10.2f}"
            f" {times['backward']:9.2f} {both:11.4f} {row['mb']:7.0f} {times['discs']:9.2f} {beside}"
        )
        for name, share in shares.items():
            say(f"{name:>30}: {share['ms']:.2f} ms, {share['of_arithmetic']:.0%} of arithmetic,"
                f" {share['of_memory']:.0%} of memory")  # fmt: skip
        yield row
        del scene, jobs, other


def measure_objects(repeats: int, say: Callable[..., None]) -> dict[str, dict[str, float]]:
    """Return the time of a step and of a render of IDs for each of OBJECTS."""
    say(f"\n{'objects':>9} {'step ms':>9} {'ID render ms':>13} {'MB':>7}")
    scenes = {n: Scene(*MIDDLE, objects=n) for n in OBJECTS}
    jobs = {f"step {n}": s.step for n, s in scenes.items()} | {f"ids {n}": s.id_render for n, s in scenes.items()}
    times = timed(jobs, repeats)
    objects = {}
    for n, scene in scenes.items():
        objects[str(n)] = {"step_ms": times[f"step {n}"], "id_render_ms": times[f"ids {n}"], "mb": peak_mb(scene.step)}
        say(f"{n:9d} {times[f'step {n}']:9.2f} {times[f'ids {n}']:13.2f} {objects[str(n)]['mb']:7.0f}")
    return objects


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print one JSON object as the last line, and no table")
    parser.add_argument("--repeats", type=int, default=10, help="how often each measurement is repeated")
    parser.add_argument("--demo", type=Path, help="capture to train on")
    parser.add_argument("--out", type=Path, help="JSON file for the figures, written again after each measurement")
    options = parser.parse_args()
    say = (lambda *_: None) if options.json else functools.partial(print, flush=True)
    found: dict[str, Any] = {"gpu": None}

    def keep(**figures: Any) -> None:
        found.update(figures)
        if options.out:
            options.out.parent.mkdir(parents=True, exist_ok=True)
            options.out.write_text(json.dumps(found, indent=1) + "\n")

    why_not = why_not_cuda()
    if why_not:
        print(json.dumps({"gpu": None, "why": why_not}) if options.json else f"Nothing was measured. {why_not}")
        return
    can = limits(options.repeats)
    keep(gpu=torch.cuda.get_device_name(), limits=can, sizes=[])
    say(f"{found['gpu']}: {can['gb_per_s']:.0f} GB/s, {can['tflops']:.1f} TFLOP/s in float32.")
    capture = options.demo or (DEMO if DEMO.exists() else None)
    lacking = lacking_for_training()
    if capture and not lacking:
        step = training_profile(capture, torch.device("cuda"))
        keep(training_step=step)
        say(
            f"A step of training on {step['anchors']} anchors takes {step['step_ms']:.2f} ms, {step['host_ms']:.2f} ms "
            f"of them on the host; the GPU computes for {step['gpu_busy']:.0%}, in {step['launches']:.0f} launches."
        )
    for row in measure_sizes(options.repeats, can, say):
        keep(sizes=[*found["sizes"], row])
    objects = measure_objects(options.repeats, say)
    keep(objects=objects, thousand_objects_over_one=objects["1000"]["step_ms"] / objects["1"]["step_ms"])
    say(f"A step at 1,000 objects takes {found['thousand_objects_over_one']:.2f} times what it takes at one.")
    keep(demo=None)
    if capture and lacking:
        say(f"\nNothing was trained: this Python lacks {', '.join(lacking)}.")
    elif capture:
        keep(demo=demo_quality(capture))
        say("\n" + "\n".join(f"{c['seconds']:4.0f} s: {c['psnr']:.1f} dB, mIoU {c['miou']:.3f}" for c in found["demo"]))
    else:
        say("\nThere is no capture to train on: `make demo` makes one, --demo names another.")
    if options.json:
        print(json.dumps(found))


if __name__ == "__main__":
    main()
