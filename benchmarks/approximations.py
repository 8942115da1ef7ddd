"""Error against run time of all approximations, and whether the defaults lie on the Pareto front.

    python benchmarks/approximations.py [--demo build/demo] [--steps 750] [--restart] [--json]

--demo is a reconstruction of the demo capture from `make demo`; it is not modified. The rasterizer's choices are
compared on its splats in one held-out view, against the exact image (see raster_variants.py). Those of the training
are compared by trainings of --steps beside the default, with the default's quality in the same time (see
training_variants.py). Those of meshes and textures are compared on three objects of the reconstruction, against their
true surfaces. Writes docs/error-against-time.md and its plots. Results are kept in build/approximations, so a stopped
run continues where it ended.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import json
import multiprocessing
import os
import shutil
import statistics
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
if str(ROOT) not in sys.path:
    sys.path.insert(0, str(ROOT))

from benchmarks import documents, raster_variants, shared, training_variants

WORK = ROOT / "build" / "approximations"
TURNS, SETS = 40, 5
"""Number of timings of each variant of the rasterizer, and number of sets of processes among which they are divided.
The memory layout of a process can change its speed by as much as variants differ."""
MORE_SETS = 10
"""Number of additional sets for a choice in which a variant seems better than the default; all sets count. Among about
thirty variants, one or two seem better by chance."""
SEEDS = 3
"""Number of trainings, of which the means count, for a variant that seems better by at least half of the noise."""
MESHED = 3
"""Number of times that the meshes of each variant are made; all variants take turns, and the median time counts."""
CURVE = (0.5, 0.7, 1.0, 1.4)
"""Lengths at which the default is trained, relative to --steps; its quality in a variant's time is interpolated."""
OBJECTS = ("mug", "teapot", "vase")
AGAIN = "the default again"
"""Name of a second process with the default, which measures the noise of the rasterizer's times."""

TIME_NOISE, ERROR_NOISE = 0.03, 0.02
"""Relative differences up to which the rasterizer's times and errors count as equal. The noise of the times is at least
the difference of the default's times in two processes."""
MESH_TIME_NOISE, PSNR_NOISE, SHARE_NOISE = 0.05, 0.1, 0.002
"""Minimum noise of a mesh's time (relative), of PSNR (dB), and of mIoU and F1."""
_LEAST_NOISE = (PSNR_NOISE, SHARE_NOISE)


@dataclass(frozen=True)
class Choice:
    """One approximation.

    title: its name. default: name of the default variant. variants: changes by name, in the form that the processes
    take. why: reason to keep the default even if another variant is better.
    """

    title: str
    default: str
    variants: Mapping[str, Mapping[str, Any]]
    note: str = ""
    why: str = ""


@dataclass
class Verdict:
    """Variants that are better than a choice's default in some figure and worse in none; if there are none, the default
    lies on the front."""

    choice: Choice
    better: list[str] = field(default_factory=list)


# --- what is compared ------------------------------------------------------------------------------------------------


def raster_choices() -> list[Choice]:
    """Return the choices of the CPU rasterizer; the variant {} changes nothing."""
    from backend.raster import simd
    from backend.raster.cpu import binning as cpu_bin
    from backend.shared.splats.blending import ALPHA_MIN, TRANSMITTANCE_THRESHOLD

    def among(values: Sequence[Any], default: Any, name: str, text: Callable[[Any], str]) -> tuple[str, dict[str, Any]]:
        names = {value: text(value) for value in sorted({*values, default})}
        return names[default], {names[v]: {} if v == default else {name: v} for v in names}

    one_in = round(1 / ALPHA_MIN)
    cuts = among((64, 128, 512, 2048, 10**6), one_in, "one_in", lambda n: f"1/{n:,}")
    cut_variants = {text: {"alpha_min": 1 / v["one_in"]} if v else {} for text, v in cuts[1].items()}
    stops = among((0.0, 1e-5, 1e-3, 1e-2), TRANSMITTANCE_THRESHOLD, "stop", lambda t: f"{t:.2g}" if t else "never")
    degrees = among((1, 2, 3, 4, 7), len(simd._EXP2) - 1, "exp_degree", str)
    tiles = among(
        ((16, 16), (32, 32), (64, 16), (64, 64), (128, 32)),
        (cpu_bin.TILE_W, cpu_bin.TILE_H), "tile", lambda s: f"{s[0]}x{s[1]}",
    )  # fmt: skip
    return [
        Choice(
            "alpha cut-off", cuts[0], cut_variants, "a splat is skipped in pixels where its alpha is less",
            why="other viewers skip splats there, and should show them as they were trained",
        ),
        Choice("transmittance stop", *stops, "blending stops below this transmittance"),
        Choice("degree of the exponential", *degrees, "of the polynomial for 2^x between -1/2 and 1/2"),
        Choice(
            "bounds",
            "rows of the ellipse",
            {
                "rows of the ellipse": {},
                "box": {"bounds": "box"},
                "tiles of the ellipse": {"bounds": "tiles"},
                "tiles of the box": {"bounds": "box tiles"},
                "tiles of 3 sigma": {"bounds": "square"},
            },
            "the pixels in which a splat is evaluated; tiles have 16x16 pixels, as on GPUs; 3 sigma: the square around"
            " the longer axis, as in the published rasterizers",
        ),
        Choice("tile size", *tiles, "pixels that one thread processes at a time"),
        Choice(
            "float precision",
            "float32",
            {
                "float32": {},
                "float64": {"float64": True, "sort": "argsort"},
                "float64, exponential of degree 11": {"float64": True, "sort": "argsort", "exp_degree": 11},
            },
            "of screen splats, planes and gradient rows; splats are projected in float64 in all of them",
        ),
        Choice(
            "sort",
            "once, all bits",
            {
                "once, all bits": {},
                "once, NumPy": {"sort": "argsort"},
                "once, 16 bits": {"sort": "16 bits"},
                "once, 8 bits": {"sort": "8 bits"},
                "per tile": {"sort": "tiles"},
                "tile and depth": {"sort": "keys"},
                "none": {"sort": "none"},
            },
            "once: one radix sort of all splats by depth, kept within the tiles; tile and depth: one sort"
            " of all (tile, splat) intersections, as in the published rasterizers, here by NumPy",
        ),
    ]  # fmt: skip


def training_choices() -> list[Choice]:
    """Return the choices of the training; each variant is compared with the default in the same time."""
    from backend.training.settings import GROW_FROM, GROW_UNTIL, Settings, growth_interval

    settings = Settings()
    often = growth_interval(0)
    cadences = {f"every {n}": {} if n == often else {"grow_every": n} for n in (often // 2, often, 50, 100, 200)}

    def of_setting(name: str, values: Sequence[int], text: str = "{}") -> tuple[str, dict[str, Any]]:
        default = getattr(settings, name)
        found = {text.format(v): {} if v == default else {"settings": {name: v}} for v in sorted({*values, default})}
        return text.format(default), found

    return [
        Choice("SH degree", *of_setting("sh_degree", (0, 1, 2, 3)), "of the colors"),
        Choice(
            "resolution pyramid",
            "by size",
            {
                "by size": {},
                "half at first": {"pyramid": [[0.25, 2]]},
                "quarter, then half": {"pyramid": [[0.08, 4], [0.25, 2]]},
            },
            "images are reduced until 8 % and 25 % of the training; by size: unless they would have less than 300"
            " pixels, so never for this capture",
        ),
        Choice(
            "Adam",
            "rows in view",
            {"rows in view": {}, "all rows": {"dense_adam": True}},
            "which anchors a step updates",
        ),
        Choice(
            "densification cadence",
            f"every {often}",
            {**cadences, "never": {"grow_every": 10**9}},
            "steps between two rounds of growth and pruning, "
            f"between {GROW_FROM:.0%} and {GROW_UNTIL:.0%} of the training",
        ),
        Choice(
            "offsets per anchor",
            *of_setting("offsets", (5, 10, 20), "k = {}"),
            "splats per anchor",
            why="more splats increase file size, memory use and drawing time, and the paper uses as many",
        ),
    ]


def mesh_choices() -> list[Choice]:
    """Return the choices of meshes and textures."""
    from backend.mesh.field.extract import FACES
    from backend.mesh.field.fusion import _VOXEL_PER_PIXEL

    def among(values: Sequence[Any], default: Any, name: str, text: str) -> tuple[str, dict[str, Any]]:
        return text.format(default), {
            text.format(v): {} if v == default else {name: v} for v in sorted({*values, default})
        }

    return [
        Choice(
            "TSDF voxel", *among((0.5, 1.0, 1.4), _VOXEL_PER_PIXEL, "voxel_per_pixel", "{} px"),
            "edge of a voxel in footprints of a pixel on the object",
        ),
        Choice("faces", *among((2_000, 5_000, 50_000), FACES, "faces", "{:,}"), "at most, for each object"),
        Choice(
            "texture size",
            "by photos",
            {"by photos": {}, **{f"{size}": {"texture_size": size} for size in (256, 512, 2048, 4096)}},
            "pixels along the side; by photos: the smallest from 512 on that can hold the detail of the photos",
        ),
    ]  # fmt: skip


# --- the rasterizer --------------------------------------------------------------------------------------------------


def write_scene(folder: Path, path: Path) -> None:
    """Save the splats of a reconstruction in a held-out view, the view's labels, and gradients for the backward pass.

    The gradients are those of half the mean squared error of the image and of a weighted mean -log of the label's
    probability.
    """
    import numpy as np
    import torch

    from backend.model.object_model import anchors_in_view
    from backend.raster import rasterize

    trained = opened(folder)
    index = trained.capture.test_indices[len(trained.capture.test_indices) // 2]
    camera, model = trained.scene.camera(index), trained.model
    viewmat, intrinsics = camera.arrays()
    seen = anchors_in_view(model.anchors, viewmat, intrinsics, camera.width, camera.height, camera.near)
    photo, labels = trained.scene.target(index)
    with torch.no_grad():
        g = model.generate(seen, camera.center)
        drawn = rasterize(*g[:6], camera, labels=labels)
        image = drawn.color + (1 - drawn.alpha) * model.background[:, None, None]
        known = labels >= 0
        g_color = (image - photo) / photo.numel()
        g_label_probability = torch.where(known, -0.1 / (drawn.label_probability + 0.01), 0.0) / known.sum()
    means = g.means.double() - torch.from_numpy(camera.center)
    names = dict(zip(raster_variants.PARAMETERS, (means, *g[1:5]), strict=True))
    np.savez(
        path,
        **{name: np.ascontiguousarray(value.detach().numpy(), np.float32) for name, value in names.items()},
        ids=g.ids.numpy(), objects=len(model.classes), viewmat=camera.at_origin().viewmat, K=camera.K,
        labels=labels.numpy(), g_color=g_color.numpy(), g_label_probability=g_label_probability.numpy(),
        g_alpha=np.zeros_like(g_label_probability),
    )  # fmt: skip


def opened(folder: Path) -> Any:
    """Open a reconstruction as the user's commands do."""
    from backend.cli.parser import build_parser
    from backend.commands.folder import open_trained
    from backend.shared.events import Reporter
    from backend.shared.stopping import StoppingReporter, StopRequest

    options = build_parser().parse_args(["evaluate", str(folder)])
    return open_trained(options, StoppingReporter(Reporter(), StopRequest()))


def write_exact(scene_file: Path, path: Path) -> None:
    """Render and save the exact image of a scene, in as many processes as there are cores."""
    import numpy as np

    scene = np.load(scene_file)
    height, width = scene["labels"].shape
    parts = raster_variants.parts_of(width, height)
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(os.cpu_count(), mp_context=context) as pool:
        waiting = {pool.submit(raster_variants.exact_part, str(scene_file), part): part for part in parts}

        def found() -> Any:
            for done, future in enumerate(concurrent.futures.as_completed(waiting), 1):
                print(f"exact image: part {done} of {len(parts)}", flush=True)
                yield waiting[future], future.result()

        np.savez(path, **raster_variants.join(scene, found()))


class Worker:
    """A variant of the rasterizer in a separate process."""

    def __init__(self, changes: Mapping[str, Any], kernels: Path, scene: Path, exact: Path) -> None:
        words = [sys.executable, "-m", "benchmarks.raster_variants", json.dumps(changes), str(scene), str(exact)]
        self._errors = (kernels.parent / f"{kernels.name}.log").open("w+")
        self._process = subprocess.Popen(
            words, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._errors, text=True,
            env={**os.environ, "NUMBA_CACHE_DIR": str(kernels)},
        )  # fmt: skip

    def answer(self) -> dict[str, Any]:
        """Read the next line of the process; raise RuntimeError if the process has ended."""
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            self._errors.seek(0)
            raise RuntimeError(" | ".join(self._errors.read().strip().splitlines()[-3:]) or "exited without output")
        return json.loads(line)

    def turn(self) -> dict[str, Any]:
        """Run one forward and backward pass and return the times."""
        assert self._process.stdin is not None
        self._process.stdin.write("\n")
        self._process.stdin.flush()
        return self.answer()

    def close(self) -> None:
        """End the process."""
        self._process.communicate()
        self._errors.close()


def measure_choice(choice: Choice, scene: Path, exact: Path, kernels: Path, sets: int) -> dict[str, Any]:
    """Measure errors and times of all variants of a choice, and of AGAIN, in `sets` sets of processes."""
    return joined([measure_set(choice, scene, exact, kernels) for _ in range(sets)])


def joined(parts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Merge results of a choice, from single sets or merged before.

    The ratios to the default are medians over all sets, the milliseconds medians over `parts`.
    """

    def of_sets(row: Mapping[str, Any]) -> list[float]:
        return row.get("times_default_of_sets", [row["times_default"]])

    found = {}
    for name, row in parts[0].items():
        ratios = [ratio for part in parts for ratio in of_sets(part[name])]
        found[name] = {
            **row,
            "step_ms": statistics.median(part[name]["step_ms"] for part in parts),
            "times_default": statistics.median(ratios),
            "times_default_of_sets": ratios,
        }
    return found


def measure_set(choice: Choice, scene: Path, exact: Path, kernels: Path) -> dict[str, Any]:
    """Measure errors and times of all variants of a choice, and of AGAIN, in one process each.

    They take turns, so that other load on the machine affects them equally.
    """
    workers: dict[str, Worker] = {}
    found: dict[str, Any] = {}
    try:
        for name, changes in {**choice.variants, AGAIN: choice.variants[choice.default]}.items():
            place = kernels / shared.digest([], sorted(changes.items()))
            place.mkdir(parents=True, exist_ok=True)
            workers[name] = Worker(changes, place, scene, exact)
            # Each process compiles on one core, so at most one per core starts at a time.
            waiting = [other for other in workers if other not in found]
            if len(waiting) == os.cpu_count():
                found[waiting[0]] = workers[waiting[0]].answer()
        found |= {name: worker.answer() for name, worker in workers.items() if name not in found}
        times: dict[str, list[dict[str, float]]] = {name: [] for name in workers}
        for turn in range(TURNS // SETS + 2):
            for name, worker in workers.items():
                taken = worker.turn()
                if turn >= 2:
                    times[name].append(taken)
    finally:
        for worker in workers.values():
            worker.close()
    for name, rows in times.items():
        sums = [row["forward_ms"] + row["backward_ms"] for row in rows]
        # Relative to the default in the same turn, since turns differ more than variants.
        ratios = [a / b for a, b in zip(sums, [r["forward_ms"] + r["backward_ms"] for r in times[choice.default]])]
        found[name] |= {
            "forward_ms": statistics.median(row["forward_ms"] for row in rows),
            "backward_ms": statistics.median(row["backward_ms"] for row in rows),
            "step_ms": statistics.median(sums),
            "times_default": statistics.median(ratios),
        }
    return found


# --- meshes ----------------------------------------------------------------------------------------------------------


def meshed(spec: dict[str, Any], folder: str) -> dict[str, Any]:
    """Make meshes of OBJECTS in a copy of a reconstruction, and measure them; must run in a separate process."""
    from backend.cli import main as arguments
    from backend.evaluation.meshes import evaluate_mesh, mesh_entries
    from backend.evaluation.truth import load_truth
    from backend.mesh.field import fusion
    from backend.shared.events import Reporter

    if "voxel_per_pixel" in spec:
        shared.replace(fusion, "_VOXEL_PER_PIXEL", spec["voxel_per_pixel"])
    words = ["mesh", folder, "--objects", *OBJECTS, "--restart"]
    for name in ("faces", "texture_size"):
        if name in spec:
            words += [f"--{name.replace('_', '-')}", str(spec[name])]
    if arguments.main(words):
        raise RuntimeError(f"python -m backend {' '.join(words)} failed")
    reconstruction = opened(Path(folder))
    capture = reconstruction.capture
    truth = load_truth(capture, capture.train_indices)
    meshes = reconstruction.folder.meshes
    rows = []
    for entry in mesh_entries(meshes, reconstruction.progress.step, Reporter()).values():
        figures = evaluate_mesh(meshes, entry, reconstruction.scene, truth, capture.test_indices, Reporter())
        rows.append({**figures, **entry})
    return {
        "seconds": sum(row["seconds"] for row in rows),
        **{
            name: statistics.fmean(row[name] for row in rows)
            for name in ("f1", "f1_005", "chamfer", "texture_psnr", "faces", "texture_size")
        },
    }


# --- the front -------------------------------------------------------------------------------------------------------


def better_than(default: Sequence[float], others: Mapping[str, Sequence[float]], noise: Sequence[float]) -> list[str]:
    """Return the variants that are better than the default in some figure and worse in none.

    All figures are costs; differences up to `noise` count as equal.
    """

    def beats(costs: Sequence[float]) -> bool:
        gains = [(mine - cost, n) for mine, cost, n in zip(default, costs, noise, strict=True)]
        return all(gain >= -n for gain, n in gains) and any(gain > n for gain, n in gains)

    return [name for name, costs in others.items() if beats(costs)]


def raster_verdict(choice: Choice, found: Mapping[str, Any], time_noise: float) -> Verdict:
    """Compare the variants of a rasterizer choice; the costs are time and the errors of image and gradient."""
    costs = {n: (row["times_default"], row["picture"], row["gradient"]) for n, row in found.items()}
    mine = costs.pop(choice.default)
    return Verdict(choice, better_than(mine, costs, [time_noise, *(ERROR_NOISE * cost for cost in mine[1:])]))


def training_row(pairs: Sequence[Mapping[str, Any]], curve: Mapping[int, Any], steps: int) -> dict[str, float]:
    """Return a variant's figures as means over its seeds, and the default's figures in the same time."""
    time = statistics.fmean(pair["times_default"] for pair in pairs)
    return {
        "time": time,
        "seeds": len(pairs),
        **_in_default_time(curve, time * steps),
        **_mean_figures([pair["variant"] for pair in pairs]),
    }


def _mean_figures(rows: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    return {name: statistics.fmean(row[name] for row in rows) for name in (*training_variants.FIGURES, "splats")}


def _in_default_time(curve: Mapping[int, Any], steps: float) -> dict[str, float]:
    return {f"{name}_default": value for name, value in training_variants.in_time(curve, steps).items()}


def training_gains(row: Mapping[str, float]) -> list[float]:
    """Return the gains of a variant's figures over the default's in the same time."""
    return [row[name] - row[f"{name}_default"] for name in training_variants.FIGURES]


def training_noise(rows: Sequence[Mapping[str, float]]) -> list[float]:
    """Return twice the standard deviation of the default's figures over seeds."""
    return [2 * statistics.stdev(row[name] for row in rows) for name in training_variants.FIGURES]


def training_verdict(choice: Choice, found: Mapping[str, Any], noise: Sequence[float]) -> Verdict:
    """Compare the variants of a training choice; the costs are the losses of PSNR and mIoU against the default.

    `noise` is that of a single training; for means over n seeds it is divided by the square root of n, but it is at
    least _LEAST_NOISE.
    """
    verdict = Verdict(choice)
    for name, row in found.items():
        if name != choice.default:
            costs = [-gain for gain in training_gains(row)]
            own = [max(n / row["seeds"] ** 0.5, least) for n, least in zip(noise, _LEAST_NOISE, strict=True)]
            verdict.better += better_than([0.0] * len(own), {name: costs}, own)
    return verdict


def mesh_verdict(choice: Choice, found: Mapping[str, Any]) -> Verdict:
    """Compare the variants of a mesh choice; the costs are time, negative F1 at 5 mm and negative texture PSNR."""
    costs = {name: (row["seconds"], -row["f1_005"], -row["texture_psnr"]) for name, row in found.items()}
    mine = costs.pop(choice.default)
    return Verdict(choice, better_than(mine, costs, (MESH_TIME_NOISE * mine[0], SHARE_NOISE, PSNR_NOISE)))


# --- what comes of it ------------------------------------------------------------------------------------------------


@dataclass
class Found:
    """Results by choice and variant.

    time_noise: relative noise of the rasterizer's times. noise: that of the trainings' PSNR and mIoU. curve: the
    default's figures by number of steps. seeds: number of trainings of the default with `steps` steps.
    """

    raster: dict[str, dict[str, Any]]
    training: dict[str, dict[str, Any]]
    meshes: dict[str, dict[str, Any]]
    time_noise: float
    noise: list[float]
    curve: dict[int, dict[str, float]]
    steps: int
    seeds: int
    verdicts: list[Verdict] = field(default_factory=list)


def raster_plot(choices: Sequence[Choice], found: Mapping[str, Any]) -> Any:
    """Plot time against the error of the image, one panel per choice."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import NullFormatter

    panels = [choice for choice in choices if found.get(choice.title)]
    columns = 2
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(10.4, 2.4 * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for ax, choice in zip(axes, panels):
        points = {n: (row["times_default"], max(row["picture"], 1e-6)) for n, row in found[choice.title].items()}
        _front_panel(ax, points, choice.default)
        ax.legend(fontsize=7.5, loc="upper left", bbox_to_anchor=(1.0, 1.03), borderaxespad=0.2)
        ax.set_title(choice.title)
        ax.set_yscale("log")
        low, high = (f(y for _, y in points.values()) for f in (min, max))
        ax.set_ylim(min(low / 2, 0.05), max(high * 2, 2))
        if max(x for x, _ in points.values()) > 2.5:
            ax.set_xscale("log", base=2)
        else:
            ax.set_xlim(min(0.8, *(x - 0.05 for x, _ in points.values())), None)
        for axis in (ax.xaxis, ax.yaxis):
            axis.set_major_formatter("{x:g}")
            axis.set_minor_formatter(NullFormatter())
    for ax in axes[len(panels) :]:
        ax.set_axis_off()
    figure.supxlabel("time of forward and backward, default = 1", fontsize=9)
    figure.supylabel("image error (RMSE, steps of 8 bits)", fontsize=9)
    return figure


def _front_panel(ax: Any, points: Mapping[str, tuple[float, float]], default: str) -> None:
    """Plot points (time, cost) with distinct markers, the default highlighted, and the Pareto front."""
    best, steps = float("inf"), []
    for x, y in sorted(points.values()):
        if y < best:
            best = y
            steps.append((x, y))
    if len(steps) > 1:
        ax.plot(*zip(*steps), color="#c9c9d0", linewidth=1.2, drawstyle="steps-post", zorder=1)
    looks = iter(zip(shared.COLORS * 2, "os^vDP" + "Xs^vDP"))
    for name, (x, y) in points.items():
        marked = name == default
        color, marker = (shared.MARKED, "*") if marked else next(looks)
        size = 12 if marked else 6
        ax.plot(x, y, marker, color=color, markersize=size, label=name, zorder=4 if marked else 3, alpha=0.9)
    ax.margins(0.15)


def training_plot(choices: Sequence[Choice], found: Found) -> Any:
    """Plot time against PSNR and mIoU, one column per choice: the variants, and the default's curve with its noise."""
    from matplotlib.figure import Figure

    panels = [choice for choice in choices if found.training.get(choice.title)]
    figure = Figure(figsize=(2.5 * len(panels), 6.0), layout="constrained")
    axes = figure.subplots(2, len(panels), squeeze=False, sharey="row")
    times = [steps / found.steps for steps in found.curve]
    for column, choice in enumerate(panels):
        for row, (name, text) in enumerate(zip(training_variants.FIGURES, ("PSNR (dB)", "mIoU"), strict=True)):
            ax = axes[row, column]
            line = [figures[name] for figures in found.curve.values()]
            ax.plot(times, line, color=shared.MARKED, linewidth=1.6, zorder=2)
            low, high = ([value + sign * found.noise[row] for value in line] for sign in (-1, 1))
            ax.fill_between(times, low, high, color=shared.MARKED, alpha=0.13, linewidth=0)
            looks = iter(zip(shared.COLORS * 2, "os^vDP" + "Xs^vDP"))
            for variant, figures in found.training[choice.title].items():
                marked = variant == choice.default
                color, marker = (shared.MARKED, "*") if marked else next(looks)
                ax.plot(figures["time"], figures[name], marker, color=color, label=variant, zorder=4 if marked else 3,
                        markersize=12 if marked else 6)  # fmt: skip
            ax.set_xscale("log")
            ax.set_xticks([0.7, 1.0, 1.4], ["0.7", "1", "1.4"])
            ax.minorticks_off()
            if not row:
                ax.set_title(choice.title)
            else:
                ax.set_xlabel("time, default = 1")
                ax.legend(fontsize=7.5, loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=2, handlelength=1.4)
            if not column:
                ax.set_ylabel(text)
    return figure


def mesh_plot(choices: Sequence[Choice], found: Mapping[str, Any]) -> Any:
    """Plot time against 1 - F1 at 5 mm and against the texture's RMSE, one column per choice."""
    from matplotlib.figure import Figure

    panels = [choice for choice in choices if found.get(choice.title)]
    figure = Figure(figsize=(3.3 * len(panels), 5.8), layout="constrained")
    axes = figure.subplots(2, len(panels), squeeze=False)
    for column, choice in enumerate(panels):
        for row, (name, text) in enumerate((("f1_005", "1 - F1 at 5 mm"), ("texture_psnr", "texture, RMSE (8 bits)"))):
            ax = axes[row, column]
            cost = (lambda v: 1 - v) if row == 0 else (lambda v: 255 * 10 ** (-v / 20))
            points = {n: (entry["seconds"], cost(entry[name])) for n, entry in found[choice.title].items()}
            _front_panel(ax, points, choice.default)
            if not row:
                ax.set_title(choice.title)
            else:
                ax.set_xlabel("seconds for three meshes")
                ax.legend(fontsize=7.5, loc="upper center", bbox_to_anchor=(0.5, -0.22), ncols=3)
            if not column:
                ax.set_ylabel(text)
    return figure


def document(found: Found, choices: Mapping[str, Sequence[Choice]], scene: Mapping[str, Any]) -> str:
    """Return the text of docs/error-against-time.md."""
    off = [verdict for verdict in found.verdicts if verdict.better]
    on = len(found.verdicts) - len(off)
    lines = [
        "# Error against run time",
        "",
        "Made by `python benchmarks/approximations.py`; every figure here was measured by it. Defaults are in bold.",
        "A default lies on the Pareto front if no variant is better in time or an error and worse in none of them,"
        " beyond",
        "the stated noise.",
        "",
        f"**{on} of {len(found.verdicts)} defaults lie on the front**"
        + (f"; the exception{'s' if len(off) > 1 else ''}:" if off else "."),
        "",
        *(f"- {verdict.choice.title}: {_exception(verdict, found)}" for verdict in off),
        *([""] if off else []),
        "## The rasterizer",
        "",
        f"Forward and backward passes of {scene['splats']:,} trained splats in one held-out view of the demo,"
        f" {scene['width']}x{scene['height']}, on {os.cpu_count()} cores. Errors are relative to a float64",
        "reference in exact order and without cut-offs: for the image, the RMSE and the largest error in steps of 8"
        " bits;",
        "for the gradients, a fraction of their norm, as the root mean square over means, rotations, scales, opacities"
        " and",
        f"colors. The variants of a choice are timed in turn, {TURNS // SETS} times in each of {SETS} sets of"
        " processes. The time is the",
        "median over the sets of the median ratio to the default's time; the minimum and maximum of the sets are in",
        f"brackets. If a variant seemed better, {MORE_SETS} more sets were timed and included."
        f" Noise: {found.time_noise:.0%} of the time, the",
        "difference of the default's own times in two processes but at least"
        f" {TIME_NOISE:.0%}, and {ERROR_NOISE:.0%} of an error.",
        "",
        "![Time against image error for each choice of the rasterizer](error-against-time-raster.png)",
        "",
    ]  # fmt: skip
    for choice in choices["raster"]:
        lines += _section(choice, found, found.raster, ("ms", "time", "RMSE", "largest", "gradient"), _raster_row)
    lines += [
        "## Training",
        "",
        f"The demo, trained from its points for {found.steps:,} steps; quality on held-out views. Each variant was",
        "trained at the same time as the default, each on its own core, so that the ratio of their times does not"
        " depend",
        f"on other load. The default was trained for {_listed(list(found.curve))} steps (the line in the plot,",
        "interpolated over the logarithm of the steps). Its quality is interpolated at the variant's time; a variant"
        " is",
        "better if its quality is higher. Noise of one training, twice the standard deviation of the default over",
        f"{found.seeds} seeds: {found.noise[0]:.2f} dB and {found.noise[1]:.4f}. A variant that seemed better by half"
        " of that was",
        f"trained with {SEEDS} seeds; means over seeds have accordingly less noise, but at least {PSNR_NOISE} dB and"
        f" {SHARE_NOISE}.",
        "",
        "![Time against PSNR and mIoU for each choice](error-against-time-training.png)",
        "",
    ]
    head = ("time", "PSNR", "default in that time", "mIoU", "default in that time", "splats", "seeds")
    for choice in choices["training"]:
        lines += _section(choice, found, found.training, head, _training_row)
    lines += [
        "## Meshes and textures",
        "",
        f"Meshes of {', '.join(OBJECTS[:-1])} and {OBJECTS[-1]} of the trained demo, made by `mesh` with all other"
        " settings unchanged; F1 against the true surface visible in training views, PSNR of the",
        f"textured meshes against held-out photos, means over the three. The variants are timed in turn, {MESHED}"
        " times; the time is the median."
        f" Noise: {MESH_TIME_NOISE:.0%} of the time, {SHARE_NOISE} of F1, {PSNR_NOISE} dB.",
        "",
        "![Time against errors of surfaces and textures](error-against-time-meshes.png)",
        "",
    ]
    for choice in choices["meshes"]:
        lines += _section(choice, found, found.meshes, ("seconds", "F1 at 5 mm", "F1 at 2 cm", "texture"), _mesh_row)
    return "\n".join(lines).rstrip() + "\n"


def _exception(verdict: Verdict, found: Found) -> str:
    names = " and ".join(f"`{name}`" for name in verdict.better)
    text = f"{names} {'is' if len(verdict.better) == 1 else 'are'} better than `{verdict.choice.default}`"
    return f"{text}; {verdict.choice.why}" if verdict.choice.why else text


def _section(
    choice: Choice, found: Found, results: Mapping[str, Any], head: Sequence[str], row: Callable[[Any], list[str]]
) -> list[str]:
    rows = results.get(choice.title)
    lines = [f"### {choice.title[0].upper()}{choice.title[1:]}", "", f"{choice.note[0].upper()}{choice.note[1:]}.", ""]
    if choice.why:
        lines += [f"It stays at {choice.default} even if another is slightly better: {choice.why}.", ""]
    if not rows:
        return [*lines, "Not measured: it failed.", ""]
    verdict = next(verdict for verdict in found.verdicts if verdict.choice == choice)
    better = verdict.better
    body = []
    for name in choice.variants:
        if name not in rows:
            continue
        place = "default" + ("" if better else ", on the front") if name == choice.default else ""
        marked = f"**{name}**" if name == choice.default else name
        body.append([marked, *row(rows[name]), "better" if name in better else place])
    return [*lines, *shared.table([choice.title, *head, ""], body), ""]


def _raster_row(row: Mapping[str, Any]) -> list[str]:
    of_sets = row["times_default_of_sets"]
    spread = f" ({min(of_sets):.2f}-{max(of_sets):.2f})" if min(of_sets) < max(of_sets) else ""
    return [
        f"{row['step_ms']:.1f}", f"{row['times_default']:.2f}{spread}", f"{row['picture']:.3g}",
        f"{row['largest']:.3g}", f"{row['gradient']:.3g}",
    ]  # fmt: skip


def _training_row(row: Mapping[str, Any]) -> list[str]:
    return [
        f"{row['time']:.2f}", f"{row['psnr']:.2f} dB", f"{row['psnr_default']:.2f} dB", f"{row['miou']:.4f}",
        f"{row['miou_default']:.4f}", f"{row['splats']:,.0f}", f"{row['seeds']}",
    ]  # fmt: skip


def _listed(numbers: Sequence[int]) -> str:
    words = [f"{number:,}" for number in numbers]
    return f"{', '.join(words[:-1])} and {words[-1]}"


def _mesh_row(row: Mapping[str, Any]) -> list[str]:
    return [f"{row['seconds']:.1f}", f"{row['f1_005']:.4f}", f"{row['f1']:.4f}", f"{row['texture_psnr']:.2f} dB"]


# --- all of it -------------------------------------------------------------------------------------------------------


def run(demo: Path, steps: int) -> tuple[Found, dict[str, Sequence[Choice]], dict[str, Any], dict[str, str]]:
    """Measure everything that has no stored result.

    Returns:
        The results; the choices by kind; the number of splats and the image size of the scene; the failures by name.
    """
    import numpy as np

    shared.compile_everything()
    choices = {"raster": raster_choices(), "training": training_choices(), "meshes": mesh_choices()}
    copy = WORK / "reconstruction"
    if not (demo / "checkpoint").is_dir():
        raise SystemExit(f"{demo} is not a trained reconstruction; make one by `make demo`, or name one by --demo.")
    code = [*shared.sources(), *(ROOT / "benchmarks" / name for name in ("raster_variants.py", "shared.py"))]
    made_from = shared.digest(code, (demo / "objectgs.json").read_text(), (demo / "splats.ply").stat().st_size, TURNS)
    marker = WORK / "made-from.txt"
    if not marker.exists() or marker.read_text() != made_from:
        shared.forget(WORK)
        ignored = shutil.ignore_patterns("meshes", "pictures", "previews", "capture", "*.blend*", "*.png")
        shutil.copytree(demo, copy, ignore=ignored)
        write_scene(copy, WORK / "scene.npz")
        marker.write_text(made_from)
    scene_file, exact_file = WORK / "scene.npz", WORK / "exact.npz"
    if not exact_file.exists():
        write_exact(scene_file, exact_file)
    capture = json.loads((copy / "objectgs.json").read_text())["capture"]["folder"]

    trainings = {shared.digest([], v): v for c in choices["training"] for v in c.variants.values()}
    meshes = {shared.digest([], v): v for c in choices["meshes"] for v in c.variants.values()}
    total = len(choices["raster"]) + len(CURVE) + len(trainings) - 1 + MESHED * len(meshes)
    results = shared.Results(WORK / "results", made_from, total)

    def timed(choice: Choice, sets: int, which: str) -> dict[str, Any]:
        return results.get(
            f"{choice.title}, {sets} {which}",
            partial(measure_choice, choice, scene_file, exact_file, WORK / "kernels", sets),
            lambda found: ", ".join(f"{name} {row['times_default']:.2f}" for name, row in found.items()),
        )

    raster = {choice.title: timed(choice, SETS, "sets of processes") for choice in choices["raster"]}
    for choice in choices["raster"]:
        rows = {name: row for name, row in raster[choice.title].items() if name != AGAIN}
        if rows and raster_verdict(choice, rows, TIME_NOISE).better:
            results.total += 1
            if again := timed(choice, MORE_SETS, "more"):
                raster[choice.title] = joined([raster[choice.title], again])
    default_again = [found.pop(AGAIN)["times_default"] for found in raster.values() if found]
    time_noise = max([TIME_NOISE, *(abs(ratio - 1) for ratio in default_again)])

    def beside(spec: Mapping[str, Any], seeds: Sequence[int], at: int = steps) -> dict[str, Any]:
        return results.get(
            f"training {json.dumps(spec)}, seeds {seeds[0]} and {seeds[1]}, {at} steps",
            partial(training_variants.side_by_side, spec, capture, str(WORK / "cache"), at, seeds),
            lambda found: f"{found['variant']['psnr']:.2f} dB in {found['times_default']:.2f} times the default's time,"
            f" which came to {found['default']['psnr']:.2f} dB",
        )  # fmt: skip

    pairs = [pair for part in CURVE if (pair := beside({}, (0, 1), round(part * steps)))]
    defaults = [row for pair in pairs for row in (pair["variant"], pair["default"])]
    by_spec = {key: beside(spec, (0, 2 + i)) for i, (key, spec) in enumerate(trainings.items()) if spec}
    defaults += [pair["default"] for pair in by_spec.values() if pair]
    alike = [row for row in defaults if row["steps"] == steps]
    noise = training_noise(alike) if len(alike) > 1 else list(_LEAST_NOISE)
    curve = training_variants.curve_of(defaults)
    training: dict[str, dict[str, Any]] = {}
    for choice in choices["training"]:
        rows: dict[str, Any] = {}
        for name, spec in choice.variants.items():
            if not spec:
                rows[name] = {
                    "time": 1.0,
                    "seeds": len(alike),
                    **_in_default_time(curve, steps),
                    **_mean_figures(alike),
                }
            elif pair := by_spec[shared.digest([], spec)]:
                rows[name] = training_row([pair], curve, steps)
        training[choice.title] = rows
        for name in training_verdict(choice, rows, [n / 2 for n in noise]).better:
            spec = choice.variants[name]
            results.total += SEEDS - 1
            more = [pair for seed in range(1, SEEDS) if (pair := beside(spec, (seed, len(trainings) + seed)))]
            rows[name] = training_row([by_spec[shared.digest([], spec)], *more], curve, steps)

    turns: dict[str, list[dict[str, Any]]] = {key: [] for key in meshes}
    for turn in range(1, MESHED + 1):
        for key, spec in meshes.items():
            row = results.get(
                f"meshes {json.dumps(spec)}, turn {turn}",
                partial(shared.in_child, "benchmarks.approximations:meshed", spec=spec, folder=str(copy)),
                lambda row: f"{row['seconds']:.1f} s, F1 {row['f1_005']:.4f}, {row['texture_psnr']:.2f} dB",
            )
            turns[key] += [row] if row else []
    by_mesh = {
        key: {**rows[0], "seconds": statistics.median(row["seconds"] for row in rows)}
        for key, rows in turns.items()
        if rows
    }
    textured: dict[str, dict[str, Any]] = {}
    for choice in choices["meshes"]:
        keys = {name: shared.digest([], spec) for name, spec in choice.variants.items()}
        textured[choice.title] = {name: by_mesh[key] for name, key in keys.items() if key in by_mesh}

    found = Found(raster, training, textured, time_noise, noise, curve, steps, len(alike))
    for kind, of, judge in (
        ("raster", raster, lambda choice, rows: raster_verdict(choice, rows, time_noise)),
        ("training", training, lambda choice, rows: training_verdict(choice, rows, noise)),
        ("meshes", textured, mesh_verdict),
    ):
        for choice in choices[kind]:
            if choice.default in of[choice.title]:
                found.verdicts.append(judge(choice, of[choice.title]))
            else:
                of[choice.title] = {}
    scene = np.load(scene_file)
    height, width = scene["labels"].shape
    about = {"splats": len(scene["ids"]), "width": width, "height": height}
    return found, choices, about, results.failures


def main() -> None:
    """Measure, write the document and the plots, and print which defaults lie off the front."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--demo", type=Path, default=ROOT / "build/demo", help="a reconstruction of the demo capture")
    parser.add_argument("--steps", type=int, default=750, help="steps of the training of a variant")
    parser.add_argument("--restart", action="store_true", help="discard earlier results")
    parser.add_argument("--json", action="store_true", help="print one JSON object as the last line")
    options = parser.parse_args()
    if options.restart:
        shared.forget(WORK)
    found, choices, scene, failures = run(options.demo.resolve(), options.steps)
    with shared.plot_style():
        for name, figure in (
            ("raster", raster_plot(choices["raster"], found.raster)),
            ("training", training_plot(choices["training"], found)),
            ("meshes", mesh_plot(choices["meshes"], found.meshes)),
        ):
            shared.save_figure(figure, documents.DOCS / f"error-against-time-{name}.png")
    documents.save_text("error-against-time", document(found, choices, scene))
    for verdict in found.verdicts:
        what = f"off the front: {_exception(verdict, found)}" if verdict.better else "on the front"
        print(f"{verdict.choice.title:26s} {verdict.choice.default:22s} {what}")
    if options.json:
        print(
            json.dumps(
                {
                    "raster": found.raster, "training": found.training, "meshes": found.meshes, "noise": found.noise,
                    "better_than_default": {v.choice.title: v.better for v in found.verdicts}, "failures": failures,
                }
            )
        )  # fmt: skip
    if failures:
        raise SystemExit("Not measured: " + "; ".join(failures))


if __name__ == "__main__":
    main()
