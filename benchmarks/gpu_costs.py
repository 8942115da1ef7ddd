"""What a training step costs on a GPU, as far as that can be known without one.

    python benchmarks/gpu_costs.py [--nvrtc LIBRARY] [--nvdisasm PROGRAM] [--write]

The step runs with an emulated GPU, which counts what is launched, the bytes of all arguments, and how often the inner
loops run. NVRTC compiles the kernels for three generations of GPUs, and nvdisasm shows the instructions of their loops;
both come with packages (nvidia-cuda-nvrtc, triton) or NVIDIA's toolkit. A prediction follows from these and the cards'
data sheets: each kernel takes the longer of the time to move its bytes once, and to issue its loops' instructions. It
leaves out caches, latency and occupancy, so it is a lower bound.

The host's time is that of a step whose kernels do nothing, on tensors so small that torch's operations take the time of
their calls; they run on the CPU, so the driver's part of a launch is missing.
"""

from __future__ import annotations

import argparse
import collections
import ctypes
import os
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

ROOT = Path(__file__).resolve().parents[1]
if str(ROOT) not in sys.path:
    sys.path.insert(0, str(ROOT))

import numpy as np
import torch
from PIL import Image
from torch.utils._python_dispatch import TorchDispatchMode

import backend  # noqa: F401 - sets the thread wait policy
from backend.capture import load_capture
from backend.commands.setup.small_scene import SmallScene
from backend.gpu import driver
from backend.gpu import kernel as kernels
from backend.labels import vote
from backend.model.object_model import first_anchors_in_view
from backend.raster.discs import SPOT
from backend.raster.gpu import binning, renderer
from backend.raster.gpu.kernels import TILE, raster_kernel
from backend.raster.settings import ALPHA_MIN
from backend.shared.events import Reporter
from backend.training import step
from backend.training.settings import Settings
from backend.training.step import frustum
from backend.training.trainer import Trainer
from benchmarks import documents

EMULATE = "OBJECTGS_EMULATE_GPU"
POINTS, WIDTH, HEIGHT = 100_000, 1920, 1080
SCALE = 1 / 16
"""The emulated step has this fraction of the pixels and the anchors, whose sizes in pixels are the same."""
CARDS = {
    "RTX 2060": ("sm_75", 30, 1.68, 336, 2),
    "RTX 4070": ("sm_89", 46, 2.475, 504, 2),
    "H100 SXM": ("sm_90", 132, 1.83, 3350, 64),
}
"""Architecture, multiprocessors, boost clock in GHz, memory bandwidth in GB/s, and operations in double that a
multiprocessor does a clock, by NVIDIA's data sheets. A multiprocessor of each issues four warp instructions a clock."""
BLENDING, PROJECTION = ("blend", "blend_backward"), ("project", "project_backward")
PARTS = (*BLENDING, "projection", "other kernels", "torch", "step")
LOOPS = ("tested", "missed", "hit", "summed")
OFFSETS = 10
NAMES = {"3d": "Gaussians", "2d": "discs"}
STEPS, SAMPLED_TILES = 40, 150
WARP = kernels.WARP
_EMPTY = "KERNEL(32, 1) empty({}) {{"
_NO_LAUNCH = {
    "view", "_unsafe_view", "reshape", "expand", "slice", "select", "split", "unbind", "t", "transpose", "permute",
    "unsqueeze", "squeeze", "detach", "alias", "as_strided", "empty", "empty_like", "new_empty", "empty_strided",
    "new_empty_strided", "is_pinned", "split_with_sizes", "lift_fresh", "_reshape_alias", "set_", "resize_",
}  # fmt: skip
"""torch operations that launch nothing on a GPU."""


class Recorder(TorchDispatchMode):
    """Counts the torch operations that launch something on a GPU, and the bytes of their tensors."""

    def __init__(self) -> None:
        super().__init__()
        self.bytes: collections.Counter[str] = collections.Counter()
        self.launched: collections.Counter[str] = collections.Counter()

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        found = function(*args, **(kwargs or {}))
        name = function.__name__.split(".")[0]
        if name not in _NO_LAUNCH:
            self.launched[name] += 1
            self.bytes[name] += sum(tensor.nbytes for tensor in _tensors((args, found)))
        return found


def _tensors(values: Any) -> Iterator[torch.Tensor]:
    if isinstance(values, torch.Tensor):
        yield values
    elif isinstance(values, (tuple, list)):
        for value in values:
            yield from _tensors(value)


@contextmanager
def recorded_kernels() -> Iterator[tuple[dict[str, collections.Counter[str]], dict[str, kernels.Kernel]]]:
    """Record the launches of kernels, the bytes of their arguments, and the seconds that their emulation takes; and the
    kernels themselves."""
    found: dict[str, collections.Counter[str]] = {
        what: collections.Counter() for what in ("launched", "bytes", "seconds")
    }
    seen: dict[str, kernels.Kernel] = {}
    launch = kernels.Kernel.__call__

    def recorded(self: kernels.Kernel, blocks: int, threads: int, *arguments: Any) -> None:
        if not blocks:
            return
        run = self._launch

        def timed(*words: Any) -> None:
            started = time.perf_counter()
            run(*words)
            found["seconds"][self.name] += time.perf_counter() - started

        seen[self.name] = self
        found["launched"][self.name] += 1
        found["bytes"][self.name] += sum(a.nbytes for a in arguments if isinstance(a, torch.Tensor))
        self.__dict__["_launch"] = timed
        launch(self, blocks, threads, *arguments)
        self.__dict__["_launch"] = run

    kernels.Kernel.__call__ = recorded  # type: ignore[method-assign]
    try:
        yield found, seen
    finally:
        kernels.Kernel.__call__ = launch  # type: ignore[method-assign]


def host_costs(primitive: str, scratch: Path) -> dict[str, Any]:
    """Measure the launches of a step with few splats, and the host's milliseconds if no kernel computes anything.

    Only the anchors in view are found in earnest, outside the time, as the rest of the step depends on them.
    """
    trainer = SmallScene(scratch, torch.device("cpu")).start(primitive)
    for _ in range(5):
        trainer.step(0.6)
    with recorded_kernels() as (of_kernels, _), Recorder() as of_torch:
        trainer.step(0.6)
    index, present, count = first_anchors_in_view(
        trainer.model.anchors, *frustum(trainer.scene.camera(0)), len(trainer.model.anchors)
    )
    threads, seconds = torch.get_num_threads(), []
    with ExitStack() as held:
        for owner, name, stand_in in (
            (kernels.Kernel, "_launch", lambda *_: None),
            (step, "first_anchors_in_view", lambda *_: (index, present, count)),
            (binning.IntersectionCount, "expected_capacity", lambda _: 2000),
            (binning.IntersectionCount, "wait", lambda _: 2000),
        ):
            held.enter_context(mock.patch.object(owner, name, stand_in))
        # Kernels that were launched before have their launch already.
        for cached in (kernels.kernel, raster_kernel):
            cached.cache_clear()
            held.callback(cached.cache_clear)
        torch.set_num_threads(1)
        for number in range(STEPS + 10):
            started = time.perf_counter()
            trainer.step(0.6)
            if number >= 10:
                seconds.append(time.perf_counter() - started)
    torch.set_num_threads(threads)
    return {
        "kernels": of_kernels["launched"].total(),
        "torch": of_torch.launched.total(),
        "host_ms": 1e3 * statistics.median(seconds),
        "host_ms_least": 1e3 * min(seconds),
    }


def launch_microseconds() -> dict[str, float]:
    """Return the host's microseconds for a launch with few and with many arguments, without a driver behind it."""
    found = {}
    for count in (3, 24):
        with mock.patch.object(kernels, "source_of", lambda *_, n=count: _EMPTY.format(", ".join(["float *x"] * n))):
            kernel = kernels.Kernel("empty", {})
        kernel.__dict__["_launch"] = lambda *_: None
        tensors = [torch.zeros(8) for _ in range(count)]
        times = []
        for _ in range(2000):
            started = time.perf_counter()
            kernel(1, 32, *tensors)
            times.append(time.perf_counter() - started)
        found[str(count)] = 1e6 * statistics.median(times)
    return found


def large_step(primitive: str, scratch: Path) -> tuple[dict[str, Any], dict[str, kernels.Kernel]]:
    """Run a step with many splats; returns the bytes of each kernel and the numbers of iterations, and the kernels."""
    capture = load_capture(scratch / "capture", scratch / "cache", reporter=Reporter())
    settings = Settings(primitive=primitive, offsets=OFFSETS, voxel=1e-3, pyramid=(1,), max_anchors=10 * POINTS)
    trainer = Trainer.start(capture, vote(capture, reporter=Reporter()).ids, settings)
    frames = []
    forward = renderer.forward

    def kept(*arguments: Any, **options: Any) -> Any:
        frames.append(forward(*arguments, **options))
        return frames[-1]

    renderer.forward = kept
    try:
        with recorded_kernels() as (of_kernels, launched), Recorder() as of_torch:
            trainer.step(0.9)
    finally:
        renderer.forward = forward
    frame = frames[0]
    figures = {
        "anchors": len(trainer.model.anchors) / SCALE,
        "splats": int((frame.gaussians.opacities > ALPHA_MIN).sum()) / SCALE,
        "drawn": int(frame.seen.sum()) / SCALE,
        "bytes": {name: moved / SCALE for name, moved in of_kernels["bytes"].items()},
        "torch_bytes": of_torch.bytes.total() / SCALE,
        **{name: value / SCALE for name, value in iterations(frame).items()},
    }
    return figures, launched


def iterations(frame: renderer.Frame) -> dict[str, float]:
    """Return how often the warps of the blending kernels look at a splat ("visits"), draw it because it may be drawn in
    their pixels ("candidates"), and find that it is drawn in one of them ("hits").

    The last two are found in a sample of tiles, and without the transmittance, so they are upper limits.
    """
    counts, offsets = frame.isect_counts.numpy(), frame.intersections.isect_offsets.numpy()
    across = -(-frame.camera.width // TILE)
    splats = frame.splats.double().numpy()
    tilts = None if frame.tilts is None else frame.tilts.double().numpy()
    found = np.zeros(3)
    for tile in np.random.default_rng(0).permutation(np.flatnonzero(counts))[:SAMPLED_TILES]:
        n = frame.intersections.isect_ids[offsets[tile] : offsets[tile] + counts[tile]].numpy()
        y, x = np.mgrid[:TILE, :TILE] + 0.5
        x, y = x + tile % across * TILE, y + tile // across * TILE
        u, v, slope, a, c, lop = (splats[n, i, None, None] for i in range(6))
        reach, dy = lop - np.log2(ALPHA_MIN), y - v
        along = y - np.clip(v, 0, frame.camera.height)
        d = x - (u + slope * along)
        fall, spot, q = a * d * d + c * dy * dy, np.inf, np.ones_like(d)
        if tilts is not None:
            q0, qx, qy, nearest, spot_u = (tilts[n, i, None, None] for i in range(5))
            q = q0 + qy * along + qx * d
            spot = SPOT * ((x - spot_u) ** 2 + dy * dy)
            fall = np.where((q > 0) & (nearest * q <= 1), fall / np.where(q == 0, 1, q * q), np.inf)
        drawn = np.minimum(fall, spot) <= reach
        # Of a warp's 8x4 pixels: the bound of each row is that of its pixel nearest to the ridge.
        rows = (len(n), 4, 4, 2, 8)
        d, q = d.reshape(rows), np.abs(q.reshape(rows))
        nearest_d = np.where((d[..., 0] <= 0) & (d[..., -1] >= 0), 0, np.minimum(abs(d[..., 0]), abs(d[..., -1])))
        dy = np.broadcast_to(dy, (len(n), TILE, TILE)).reshape(rows)[..., 0]
        bound = a[..., None] * nearest_d**2 + c[..., None] * dy**2
        may = bound <= reach[..., None] * q.max(-1) ** 2
        may |= np.broadcast_to(spot <= reach, drawn.shape).reshape(rows).any(-1)
        found += 8 * len(n), may.any(2).sum(), drawn.reshape(rows).any((2, 4)).sum()
    visits = 8 * int(counts.sum())
    return {"visits": visits, "candidates": visits * found[1] / found[0], "hits": visits * found[2] / found[0]}


def loops_of(text: str) -> tuple[list[str], list[tuple[int, int]]]:
    """Return the instructions in a kernel's listing, with "-> n" after a jump forward over the next n of them, and the
    first and last + 1 instruction of each loop."""
    lines: list[str] = []
    labels: dict[str, int] = {}
    for line in text.splitlines():
        if label := re.match(r"(\.L_x_\d+):", line):
            labels[label[1]] = len(lines)
        elif found := re.search(r"/\*[0-9a-f]{4,}\*/\s+(.*?);", line):
            lines.append(found[1])
    spans = []
    for at, words in enumerate(lines):
        target = re.search(r"BRA.*`\((\.L_x_\d+)\)", words)
        to = labels.get(target[1], at) if target else at
        if to > at:
            lines[at] += f" -> {to - at - 1}"
        elif to < at:
            spans.append((to, at + 1))
    return lines, spans


def instructions_of_loops(text: str) -> dict[str, int]:
    """Return the instructions of a blending kernel's iterations.

    "tested": of the loop in which a warp tests 32 splats; "missed" and "hit": of that over candidates, where no pixel
    of the warp is drawn and where one is; "summed": of the loop over warps that sums up gradients.
    """
    lines, spans = loops_of(text)

    def smallest(holds: Callable[[list[str]], bool]) -> tuple[int, int]:
        return min((span for span in spans if holds(lines[slice(*span)])), key=lambda span: span[1] - span[0])

    over_splats = smallest(lambda loop: any("MUFU.EX2" in words for words in loop))
    tests = smallest(
        lambda loop: (
            any(re.search(r"VOTE.ANY R\d+, PT", words) for words in loop) and sum("FFMA" in words for words in loop) > 4
        )
    )
    nested = [over_splats] if tests[0] <= over_splats[0] and over_splats[1] <= tests[1] else []
    body = lines[slice(*over_splats)]
    # The compiler may have unrolled the loop.
    unrolled = sum("MUFU.EX2" in words for words in body)
    jumps = sorted((int(words.rpartition("-> ")[2]) for words in body if "-> " in words), reverse=True)
    inner = [s for s in spans if not any(o != s and s[0] <= o[0] and o[1] <= s[1] for o in spans)]
    others = [
        end - begin
        for begin, end in inner
        if (begin, end) not in (over_splats, tests) and sum("FFMA" in words for words in lines[begin:end]) > 4
    ]
    return {
        "tested": tests[1] - tests[0] - sum(end - begin for begin, end in nested),
        "missed": round((len(body) - sum(jumps[:unrolled])) / unrolled),
        "hit": round(len(body) / unrolled),
        "summed": max(others, default=0),
    }


def compiled(
    nvrtc: ctypes.CDLL, nvdisasm: str, step: dict[str, kernels.Kernel]
) -> dict[str, dict[str, dict[str, int]]]:
    """Compile the kernels of a step for the architecture of each card; returns their sizes and loops."""
    os.environ[EMULATE] = "0"
    found: dict[str, dict[str, dict[str, int]]] = {}
    for architecture in dict.fromkeys(card[0] for card in CARDS.values()):
        for name, kernel in step.items():
            source = kernels.source_of(name, kernel.variant)
            binary = driver.compile_source(nvrtc, name, source, [f"--gpu-architecture={architecture}"])
            with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
                file.write(binary)
                file.flush()
                text = subprocess.run([nvdisasm, "-c", file.name], capture_output=True, text=True, check=True).stdout
            loops = instructions_of_loops(text) if name in BLENDING else {}
            found.setdefault(name, {})[architecture] = {
                "instructions": len(re.findall(r"/\*[0-9a-f]{4,}\*/", text)),
                "double": len(re.findall(r"\s(D(FMA|MUL|ADD|SETP|MNMX)|MUFU\.\w*64\w*)", text)), **loops,
            }  # fmt: skip
    os.environ[EMULATE] = "1"
    return found


def predicted(step: Mapping[str, Any], code: Mapping[str, Any]) -> dict[str, dict[str, float]]:
    """Return a lower bound of the milliseconds of a step's parts on each card."""
    found = {}
    for card, (architecture, processors, gigahertz, bandwidth, doubles) in CARDS.items():
        parts: dict[str, float] = collections.Counter({"torch": 1e-6 * step["torch_bytes"] / bandwidth})
        for name, moved in step["bytes"].items():
            issued = 0.0
            if name in BLENDING:
                loop = code[name][architecture]
                issued = step["visits"] * loop["tested"] / WARP + step["candidates"] * loop["missed"]
                issued += step["hits"] * (loop["hit"] - loop["missed"] + loop["summed"])
            in_double = step["anchors"] * OFFSETS * code[name][architecture]["double"] if name in PROJECTION else 0
            part = name if name in BLENDING else "projection" if name in PROJECTION else "other kernels"
            parts[part] += max(
                1e-6 * moved / bandwidth,
                1e-6 * issued / (4 * processors * gigahertz),
                1e-6 * in_double / (doubles * processors * gigahertz),
            )
        found[card] = {**parts, "step": sum(parts.values())}
    return found


def write_capture(folder: Path) -> None:
    """Write a capture of points on a wall, and random pictures."""
    rng = np.random.default_rng(0)
    for name in ("images", "masks", "sparse/0"):
        (folder / name).mkdir(parents=True)
    width, height, count = (round(value * side) for value, side in ((WIDTH, 0.25), (HEIGHT, 0.25), (POINTS, SCALE)))
    assert width * height == SCALE * WIDTH * HEIGHT
    points = rng.uniform(-1, 1, (count, 3)) * [1.6, 0.9, 0.02]
    images = []
    for i in range(2):
        images += [f"{i + 1} 1 0 0 0 {0.2 * i} 0 3.2 1 {i}.png", ""]
        picture = rng.integers(0, 255, (height, width, 3), np.uint8)
        Image.fromarray(picture).save(folder / "images" / f"{i}.png", compress_level=0)
        mask = np.repeat([[1] * (width // 2) + [2] * (width // 2)], height, 0).astype(np.uint8)
        Image.fromarray(mask).save(folder / "masks" / f"{i}.png")
    model = {
        "cameras": [f"1 PINHOLE {width} {height} {width} {width} {width / 2} {height / 2}"],
        "images": images,
        "points3D": [f"{i} {x:.5f} {y:.5f} {z:.5f} 128 128 128 0" for i, (x, y, z) in enumerate(points.tolist())],
    }
    for name, lines in model.items():
        (folder / "sparse/0" / f"{name}.txt").write_text("\n".join(lines) + "\n")


def find(pattern: str) -> str | None:
    """Return a file of an installed package."""
    return next((str(path) for folder in sys.path for path in sorted(Path(folder or ".").glob(pattern))), None)


def document(figures: Mapping[str, Any]) -> str:
    """Return the text of docs/gpu.md."""
    step, code, lines = figures["step"], figures["code"], []
    for name, of in figures["host"].items():
        lines.append(f"| {name} | {of['kernels']} | {of['torch']} | {of['host_ms']:.2f} ({of['host_ms_least']:.2f}) |")
    launch = figures["launch_us"]
    architectures = list(next(iter(code["3d"].values())))
    loops, doubles = [], []
    for primitive, kernels_of in code.items():
        for name in BLENDING:
            counts = [[kernels_of[name][a][kind] for kind in LOOPS] for a in architectures]
            cells = [" / ".join(str(count or "-") for count in of) for of in counts]
            loops.append(f"| {name}, {NAMES[primitive]} | {' | '.join(cells)} |")
        for name in PROJECTION:
            cells = [str(kernels_of[name][a]["double"]) for a in architectures]
            doubles.append(f"| {name}, {NAMES[primitive]} | {' | '.join(cells)} |")
    sizes, times = [], []
    for primitive, of in step.items():
        sizes.append(
            f"| {NAMES[primitive]} | {of['anchors']:,.0f} | {of['splats']:,.0f} | {of['drawn']:,.0f} | "
            f"{of['visits'] / 1e6:.0f} | {of['candidates'] / of['visits']:.2f} | {of['hits'] / of['visits']:.2f} | "
            f"{(sum(of['bytes'].values()) + of['torch_bytes']) / 1e9:.2f} |"
        )
        for card, parts in figures["predicted"][primitive].items():
            cells = [f"{parts[part]:.2f}" for part in PARTS]
            times.append(f"| {NAMES[primitive]}, {card} | {' | '.join(cells)} |")
    return f"""# Cost of a training step on a GPU

No GPU has run this code yet. The figures follow from an emulated step, from the kernels as NVRTC compiles them, and
from the cards' data sheets; `python benchmarks/gpu_costs.py --write` makes them, and `make gpu` measures on a GPU.

A step's launches, and the milliseconds of the host without the work of a GPU (median, least). A sort of torch counts as
one, and launches several kernels.

| splats | kernels | torch operations | host ms |
|---|---|---|---|
{chr(10).join(lines)}

A launch takes the host {launch["3"]:.1f} microseconds with 3 arrays and {launch["24"]:.1f} with
24, without the driver's part.

Instructions of an iteration of the inner loops: a warp of 8x4 pixels tests which of 32 splats may be drawn in it /
visits a splat that then is not drawn / one that is / adds up the gradient of one.

| kernel | {" | ".join(architectures)} |
|---|{"---|" * len(architectures)}
{chr(10).join(loops)}

Instructions in double, of which most cards do few:

| kernel | {" | ".join(architectures)} |
|---|{"---|" * len(architectures)}
{chr(10).join(doubles)}

A step at {WIDTH}x{HEIGHT}, scaled up from {1 / SCALE:.0f} times fewer pixels and anchors: splats that are opaque
enough, splats in the image, splats tested by a warp in millions, the fractions of them that may be drawn and that are
drawn, and the gigabytes of all arguments.

| splats | anchors | splats | in the image | tested | may be drawn | drawn | GB |
|---|---|---|---|---|---|---|---|
{chr(10).join(sizes)}

The shortest time in which cards could move these bytes once and issue these instructions, in milliseconds. Latency,
caches and occupancy are left out, so a card will take longer.

| | {" | ".join(PARTS)} |
|---|{"---|" * len(PARTS)}
{chr(10).join(times)}
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--nvrtc", default=find("nvidia/*/lib/libnvrtc.so.*"), help="the library NVRTC")
    parser.add_argument("--nvdisasm", default=shutil.which("nvdisasm") or find("triton/backends/nvidia/bin/nvdisasm"))
    parser.add_argument("--write", action="store_true", help="write docs/figures/gpu.json and docs/gpu.md")
    options = parser.parse_args()
    if not options.nvrtc or not options.nvdisasm:
        parser.error("NVRTC or nvdisasm is missing; install nvidia-cuda-nvrtc and triton, or name them")
    os.environ[EMULATE] = "1"
    torch.manual_seed(0)
    figures: dict[str, Any] = {"host": {}, "launch_us": launch_microseconds(), "step": {}, "code": {}, "predicted": {}}
    with tempfile.TemporaryDirectory() as folder:
        write_capture(Path(folder) / "capture")
        for primitive, name in NAMES.items():
            figures["host"][name] = host_costs(primitive, Path(folder) / primitive)
            step, launched = large_step(primitive, Path(folder))
            figures["step"][primitive] = step
            figures["code"][primitive] = compiled(ctypes.CDLL(options.nvrtc), options.nvdisasm, launched)
            figures["predicted"][primitive] = predicted(step, figures["code"][primitive])
    print(document(figures))
    if options.write:
        documents.save("gpu", figures)


if __name__ == "__main__":
    main()
