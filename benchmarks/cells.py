# SPDX-License-Identifier: GPL-3.0-or-later
"""Training in cells against one training with as many steps: quality, memory, and the differences where cells meet.

    python benchmarks/cells.py [--photos 576] [--cells 4] [--steps 6000] [--seeds 0 1] [--json] [--write]

The capture is one of benchmarks/aerial.py. One training has as many anchors as it grows. The coarse model has at most
that number divided by the number of cells, and each cell a little more, since cells overlap. Of the steps of the
training in cells, some are those of the coarse model and of the seams. Differences to the held-out photos are compared
in the pixels whose surface is near a cut between cells and in all others, for both models. Memory is measured on larger
captures, too, in trainings of a few steps. --write saves the figures to docs/figures/cells.json, the text to
docs/cells.md and pictures of the differences to docs/cells.png.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
if str(ROOT) not in sys.path:
    sys.path.insert(0, str(ROOT))

from benchmarks import aerial, documents, shared

WORK = ROOT / "build" / "cells"
COARSE, SEAMS = 0.2, 0.05
"""Fractions of the steps for the coarse model and for the seams; the cells share the others."""

NEAR = 1.0
"""Distance in meters up to which a surface is near a cut."""

_LEFT_OUT = ("--leave-out", "dense-points")
_UNLIMITED = ("--max-anchors", 10**8)

_OF_CELL = 4 / 3
"""Most anchors of a cell, relative to an equal part of those of one training."""

_FEW = 100
"""Steps of trainings whose memory is measured."""

_MEMORY_MB = 100
"""Memory for photos in these trainings, so that the models take most of it."""

_COMMANDS = {"coarse": "coarse `train`", "split": "`split`", "cell": "`train-cell`", "merge": "`merge`"}

_QUALITY = {"psnr": ("PSNR, dB", "{:.2f}"), "ssim": ("SSIM", "{:.3f}"), "miou_all": ("mIoU", "{:.3f}")}


def main() -> None:
    """Measure, and print the document or the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--photos", type=int, default=576)
    parser.add_argument("--points-per-photo", type=int, default=100)
    parser.add_argument("--cells", type=int, default=4)
    parser.add_argument("--steps", type=int, default=6000)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--large-photos", type=int, default=2000, help="photos of the captures for the memory")
    parser.add_argument(
        "--large-points", type=int, nargs="+", default=[260, 1150], help="points for each photo of these captures"
    )
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    # First, since the peak memory of a child includes what this process has had at most.
    found: dict[str, Any] = {"idle": shared.in_child("benchmarks.cells:idle")["memory_gb"]}
    shared.compile_everything()
    large = []
    for points_per_photo in options.large_points:
        large.append(measure_memory(_town(options.large_photos, points_per_photo), options.cells))
        print(large[-1], file=sys.stderr, flush=True)
    town, runs = _town(options.photos, options.points_per_photo), []
    for seed in options.seeds:
        runs.append(measure(town, options.photos, options.cells, options.steps, seed))
        print(runs[-1], file=sys.stderr, flush=True)
    found |= {
        "photos": options.photos, "cells": options.cells, "steps": options.steps, "runs": runs,
        "large_photos": options.large_photos, "large": large,
    }  # fmt: skip
    if options.write:
        shared.save_figure(picture(town, options.photos, *folders(options.seeds[0])), documents.DOCS / "cells.png")
        documents.save("cells", found)
    print(json.dumps(found) if options.json else document(found))


def _town(photos: int, points_per_photo: int) -> Path:
    """Return the folder of a capture, which is made if it is missing."""
    town = WORK / f"town-{photos}-{points_per_photo}"
    if not (town / "labels.json").exists():
        # In a child, for the same reason.
        shared.in_child("benchmarks.cells:make_town", folder=str(town), photos=photos, points=points_per_photo)
    return town


def make_town(folder: str, photos: int, points: int) -> None:
    """Make a capture with so many points for each photo."""
    aerial.make(Path(folder), photos, points_per_photo=points)


def folders(seed: int) -> tuple[Path, Path]:
    """Return the folders of one training and of that in cells."""
    return WORK / f"one-{seed}", WORK / f"cells-{seed}"


def measure(town: Path, photos: int, cells: int, steps: int, seed: int) -> dict[str, Any]:
    """Train both ways, and return the quality and the peak memory of each, and the differences near cuts."""
    one, parts = folders(seed)
    shared.forget(one)
    shared.forget(parts)
    coarse, seams = round(COARSE * steps), round(SEAMS * steps)
    of_cell = (steps - coarse - seams) // cells
    words = ("train", town, "--seed", seed, *_LEFT_OUT)
    of_one = _run(*words, "--out", one, "--steps", steps, *_UNLIMITED)
    share = _export(one)["anchors"] / cells
    of_coarse = _run(*words, "--out", parts, "--steps", coarse, "--max-anchors", round(share))
    of_split = _run("split", parts, "--cells", cells)
    limited = ("--steps", of_cell, "--max-anchors", round(_OF_CELL * share))
    of_cells = [_run("train-cell", parts, "--cell", number, *limited) for number in range(cells)]
    of_merge = _run("merge", parts, "--steps", steps - coarse - cells * of_cell)
    return {
        "one": {**of_one, **_quality(one)},
        "merged": _quality(parts),
        "coarse": of_coarse,
        "split": of_split,
        "cells": of_cells,
        "merge": of_merge,
        "differences": shared.in_child(
            "benchmarks.cells:differences", town=str(town), photos=photos, one=str(one), merged=str(parts)
        ),
    }


def measure_memory(town: Path, cells: int) -> dict[str, float]:
    """Train a few steps both ways; returns the number of anchors and splats, and the peak memory of each process."""
    folder, coarse = WORK / "large", WORK / "large-coarse"
    shared.forget(folder)
    shared.forget(coarse)
    memory = ("--memory-mb", _MEMORY_MB)
    words = ("train", town, "--steps", _FEW, *memory, *_LEFT_OUT)
    one = _run(*words, "--out", folder, *_UNLIMITED)
    export = _export(folder)
    parts = {"coarse": _run(*words, "--out", coarse, "--max-anchors", export["anchors"] // cells)}
    # So few steps add no anchors, so the cells are those of the whole model instead of the coarse one.
    parts["split"] = _run("split", folder, "--cells", cells, *memory)
    of_cells = [_run("train-cell", folder, "--cell", number, "--steps", _FEW, *memory) for number in range(cells)]
    parts["cell"] = max(of_cells, key=lambda cell: cell["memory_gb"])
    parts["merge"] = _run("merge", folder, "--steps", _FEW, *memory)
    return {
        "anchors": export["anchors"],
        "splats": export["splats"],
        "one": one["memory_gb"],
        **{name: part["memory_gb"] for name, part in parts.items()},
    }


def _export(folder: Path) -> dict[str, Any]:
    """Return the record of the export of a reconstruction."""
    return json.loads((folder / "objectgs.json").read_text())["export"]


def _run(*words: object) -> dict[str, float]:
    return shared.in_child("benchmarks.cells:run", words=[*map(str, words)])


def run(words: Sequence[str]) -> dict[str, float]:
    """Run a command of the backend in this process; returns its seconds and its peak memory in GB."""
    from backend.cli.main import main as command
    from backend.commands.setup.machine import peak_mb

    started = time.monotonic()
    if command([*words, "--json"]):
        raise RuntimeError(f"{words[0]} has failed")
    return {"seconds": time.monotonic() - started, "memory_gb": peak_mb() / 1e3}


def idle() -> dict[str, float]:
    """Return the peak memory in GB of a process that has imported what training needs."""
    from backend.commands.cells import train_cell  # noqa: F401
    from backend.commands.setup.machine import peak_mb

    return {"memory_gb": peak_mb() / 1e3}


def _quality(folder: Path) -> dict[str, float]:
    """Return the quality on the held-out views, and the number of anchors."""
    shared.run_backend("evaluate", folder)
    quality = json.loads((folder / "evaluation.json").read_text())["quality"]
    return {**{name: quality[name] for name in _QUALITY}, "anchors": _export(folder)["anchors"]}


def _opened(folder: Path) -> tuple[Any, Any]:
    """Return the scene and the model of a reconstruction."""
    from backend.capture import load_capture
    from backend.shared.formats.json_file import read_json
    from backend.training.trainer import Trainer

    capture = load_capture(Path(read_json(folder / "objectgs.json")["capture"]["folder"]), folder / "cache")
    resumed = Trainer.resume(capture, folder / "checkpoint")
    assert resumed is not None
    return resumed[0].scene, resumed[0].shown


def differences(town: str, photos: int, one: str, merged: str) -> dict[str, float]:
    """Return the mean squared differences of both models to the held-out photos, near cuts and elsewhere."""
    sums = {f"{model}_{place}": 0.0 for model in ("one", "merged") for place in ("near", "far")}
    counts = {"near": 0, "far": 0}
    for of_one, of_merged, distance, _ in _compared(Path(town), photos, Path(one), Path(merged)):
        for place, there in (("near", distance < NEAR), ("far", distance >= NEAR)):
            counts[place] += int(there.sum())
            sums[f"one_{place}"] += float(of_one[there].sum())
            sums[f"merged_{place}"] += float(of_merged[there].sum())
    return {name: value / counts[name.split("_")[1]] for name, value in sums.items()} | {
        "pixels_near": counts["near"] / sum(counts.values())
    }


def _compared(town: Path, photos: int, one: Path, merged: Path) -> Any:
    """Yield the squared differences of both models to each held-out photo, (h, w), the distance of the pixels' surfaces
    to the nearest cut in meters, (h, w), and the photo, (h, w, 3)."""
    from backend.model.draw import draw
    from backend.training.cells.division import read_division

    scene, of_one = _opened(one)
    merged_scene, of_merged = _opened(merged)
    division = read_division(merged / "cells" / "cells.json")
    viewmats, count = aerial.flight(photos)
    truth = aerial.Town(count, 0)
    for index in scene.capture.test_indices:
        view = scene.capture.views[index]
        viewmat, photo = viewmats[int(Path(view.name).stem)], scene.capture.image(index) / 255
        _, _, depth = truth.render(viewmat, view.K[0, 0], view.width, view.height)
        rows, columns = np.indices(depth.shape)
        local = np.stack([(columns - view.K[0, 2]) / view.K[0, 0], (rows - view.K[1, 2]) / view.K[1, 1]], -1)
        world = (np.concatenate([local, np.ones_like(local[..., :1])], -1) * depth[..., None] - viewmat[:3, 3]) @ (
            viewmat[:3, :3]
        )
        at = merged_scene.normalization.to_scene(world.reshape(-1, 3))
        distance = np.full(len(at), np.inf)
        for number, core in enumerate(cell.core for cell in division.cells):
            inside = division.cells_of(at) == number
            walls = np.abs(at[inside, :, None] - np.array(core).T)
            distance[inside] = walls.reshape(-1, 6).min(1)
        squared = [
            np.square(draw(model, scene.camera(index), want_ids=False).image - photo).mean(-1)
            for model, scene in ((of_one, scene), (of_merged, merged_scene))
        ]
        yield *squared, distance.reshape(depth.shape) / merged_scene.normalization.scale, photo


def document(found: Mapping[str, Any]) -> str:
    """Return the text of docs/cells.md."""
    runs = found["runs"]

    def row(title: str, steps: int, memory: Sequence[float], values: Sequence[Mapping[str, float]]) -> list[str]:
        return [
            title, f"{steps:,}", shared.spread([value["anchors"] for value in values], "{:,.0f}"),
            *(shared.spread([value[name] for value in values], form) for name, (_, form) in _QUALITY.items()),
            shared.spread(memory, "{:.2f}"),
        ]  # fmt: skip

    ones = [run["one"] for run in runs]
    of_parts = [
        max(part["memory_gb"] for part in (run["coarse"], run["split"], *run["cells"], run["merge"])) for run in runs
    ]
    change = [run["merged"]["psnr"] - run["one"]["psnr"] for run in runs]
    near = [run["differences"] for run in runs]
    lines = [
        "# Training in cells",
        "",
        f"Made by `python benchmarks/cells.py --write`: {found['photos']} aerial photos of 320 x 240 pixels, trained "
        f"with {found['steps']:,} steps, and as {found['cells']} cells with as many steps together, those of the "
        f"coarse model ({COARSE:.0%}) and of the seams ({SEAMS:.0%}) included. The one training has no limit of "
        f"anchors; the coarse model has at most 1/{found['cells']} of its anchors, and a cell at most "
        f"{_OF_CELL / found['cells']:.0%}"
        + (f"; mean and standard deviation over {len(runs)} seeds." if len(runs) > 1 else ", one seed."),
        "",
        *shared.table(
            ["", "steps", "anchors", *(title for title, _ in _QUALITY.values()), "peak memory, GB"],
            [
                row("one training", found["steps"], [one["memory_gb"] for one in ones], ones),
                row("cells", found["steps"], of_parts, [run["merged"] for run in runs]),
            ],
        ),
        "",
        f"The cells' PSNR is {shared.spread(change, '{:+.2f}')} dB relative to that of one training. Here, most of the "
        "memory is that for photos (`--memory-mb`), which is the same in each process.",
        "",
        f"Mean squared differences to the held-out photos, for surfaces within {NEAR:g} m of a cut between cells "
        f"({statistics.fmean(d['pixels_near'] for d in near):.0%} of the pixels) and elsewhere:",
        "",
        *shared.table(
            ["", "near cuts", "elsewhere", "ratio"],
            [
                [
                    title,
                    *(f"{statistics.fmean(d[f'{model}_{place}'] for d in near):.5f}" for place in ("near", "far")),
                    shared.spread([d[f"{model}_near"] / d[f"{model}_far"] for d in near], "{:.2f}"),
                ]
                for model, title in (("one", "one training"), ("merged", "cells"))
            ],
        ),
        "",
        "![A held-out photo, and the differences of both models to it, with the cuts between cells](cells.png)",
        "",
        f"The most memory that processes took in {_FEW} steps on {found['large_photos']:,} such photos, in GB and "
        f"relative to one training, with `--memory-mb {_MEMORY_MB}` for the photos. Of it, {found['idle']:.2f} GB are "
        "taken by Python and its packages before anything is read. The coarse model has "
        f"1/{found['cells']} of the anchors:",
        "",
        *shared.table(
            ["anchors", "splats", "one training", *_COMMANDS.values()],
            [
                [
                    f"{large['anchors']:,}", f"{large['splats']:,}", f"{large['one']:.2f}",
                    *(f"{large[name]:.2f} ({large[name] / large['one']:.0%})" for name in _COMMANDS),
                ]
                for large in found["large"]
            ],
        ),
    ]  # fmt: skip
    return "\n".join(lines) + "\n"


def picture(town: Path, photos: int, one: Path, merged: Path) -> Any:
    """Return a figure with the held-out photo that shows most of the cuts, and the differences of both models to it."""
    of_one, of_merged, distance, photo = max(
        _compared(town, photos, one, merged), key=lambda found: int((found[2] < NEAR).sum())
    )
    with shared.plot_style():
        from matplotlib.figure import Figure

        figure = Figure(figsize=(9, 2.7), layout="constrained")
        shown = (("photo", photo), ("one training", np.sqrt(of_one)), ("cells", np.sqrt(of_merged)))
        for axis, (title, image) in zip(figure.subplots(1, 3), shown, strict=True):
            axis.imshow(image, cmap="magma", vmin=0, vmax=0.3)
            axis.contour(distance, [NEAR], colors="white", linewidths=0.6)
            axis.set(title=title, xticks=[], yticks=[])
            axis.grid(visible=False)
    return figure


if __name__ == "__main__":
    main()
