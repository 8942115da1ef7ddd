# SPDX-License-Identifier: GPL-3.0-or-later
"""Time, memory and disk space of a training over photos, points and splats, with what larger captures will take.

    python benchmarks/scale.py [--photos 50 200 800] [--densities 100 400] [--json] [--write]

Each row is a `train` of a few steps on a capture of benchmarks/aerial.py, whose photos all show a part of the town of
the same size. A model with a few terms is fitted to the rows. It is tested on the largest captures, with a fit to the
others, and predicts what captures of 10 and 100 times as many photos take. --write saves the figures to
docs/figures/scale.json, the text to docs/scale.md and the plot to docs/scale.png.
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

WORK = ROOT / "build" / "scale"
STEPS = 40
TIMED_VIEWS, REPEATS = 9, 3
VISITS = 30
"""Steps a photo that a training takes, for the hours in the predictions."""

LIMITS = {"16 GB of memory": ("memory_gb", 16.0), "1 TB of disk space": ("disk_gb", 1000.0)}

MODELS = {
    "prepare_seconds": ("reading and planning, s", ("photos", "points")),
    "step_ms": ("step, ms", ("visible",)),
    "save_seconds": ("export, s", ("anchors",)),
    "memory_gb": ("memory, GB", ("anchors",)),
    "disk_gb": ("disk space, GB", ("photos", "anchors")),
}
"""What is predicted: its title, and the quantities that it is linear in, besides a constant."""


def main() -> None:
    """Measure, and print the document or the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--photos", type=int, nargs="+", default=[50, 200, 800])
    parser.add_argument("--densities", type=int, nargs="+", default=[100, 400], help="points for each photo")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    shared.compile_everything()
    rows = []
    for photos in options.photos:
        for density in options.densities:
            if not (_town(photos, density) / "labels.json").exists():
                aerial.make(_town(photos, density), photos, points_per_photo=density)
            rows.append(shared.in_child("benchmarks.scale:measure", photos=photos, density=density))
            print(rows[-1], file=sys.stderr, flush=True)
    found = {"rows": rows}
    if options.write:
        shared.save_figure(plot(found), documents.DOCS / "scale.png")
        documents.save("scale", found)
    print(json.dumps(found) if options.json else document(found))


def measure(photos: int, density: int) -> dict[str, float]:
    """Train for a few steps on a capture in this process, and return the figures."""
    from backend.cli.main import main as command
    from backend.commands.setup.machine import peak_mb
    from backend.model.object_model import anchors_in_view
    from backend.shared.formats.json_file import read_json
    from backend.training.step import frustum

    capture, out = _town(photos, density), WORK / f"trained-{photos}-{density}"
    shared.forget(out)
    started = time.monotonic()
    words = ["train", str(capture), "--out", str(out), "--steps", str(STEPS), "--json"]
    if command([*words, "--max-anchors", "100000000", "--leave-out", "dense-points"]):
        raise RuntimeError("the training has failed")
    seconds, memory = time.monotonic() - started, peak_mb() / 1e3
    stages = {stage["name"]: stage["seconds"] for stage in read_json(out / "objectgs.json")["stages"]}
    trainer = _trainer(capture, out)
    anchors, views = trainer.model.anchors, trainer.scene.capture.train_indices
    chosen = views[:: max(len(views) // TIMED_VIEWS, 1)][:TIMED_VIEWS]
    visible = [len(anchors_in_view(anchors, *frustum(trainer.scene.camera(index)))) for index in chosen]
    return {
        "photos": photos,
        "points": photos * density,
        "anchors": len(anchors),
        "visible": statistics.fmean(visible),
        "prepare_seconds": seconds - stages["train"] - stages["export"],
        "step_ms": 1e3
        * statistics.median(min(trainer.view_step.measure_seconds(index) for _ in range(REPEATS)) for index in chosen),
        "save_seconds": stages["export"],
        "memory_gb": memory,
        "disk_gb": (_bytes(capture) + _bytes(out)) / 1e9,
    }


def _town(photos: int, density: int) -> Path:
    return WORK / f"town-{photos}-{density}"


def _trainer(capture: Path, out: Path) -> Any:
    from backend.capture import load_capture
    from backend.training.trainer import Trainer

    resumed = Trainer.resume(load_capture(capture, out / "cache"), out / "checkpoint")
    assert resumed is not None
    return resumed[0]


def _bytes(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def fit(rows: Sequence[Mapping[str, float]], name: str) -> dict[str, float]:
    """Return the terms of MODELS[name], of the smallest relative squared error and not negative, and the constant."""
    from scipy.optimize import nnls

    terms = ["", *MODELS[name][1]]
    values = np.array([[row[term] if term else 1.0 for term in terms] for row in rows])
    measured = np.array([row[name] for row in rows])
    # Columns of a like size, since the solver stops at absolute tolerances.
    sizes = np.abs(values).max(0)
    found, _ = nnls(values / sizes / measured[:, None], np.ones(len(rows)))
    return dict(zip(terms, (found / sizes).tolist(), strict=True))


def predict(model: Mapping[str, float], row: Mapping[str, float]) -> float:
    """Return the value of a fitted model for a row."""
    return sum(factor * (row[term] if term else 1.0) for term, factor in model.items())


def document(found: Mapping[str, Any]) -> str:
    """Return the text of docs/scale.md."""
    rows = found["rows"]
    models = {name: fit(rows, name) for name in MODELS}
    largest = max(row["photos"] for row in rows)
    densest = max((row for row in rows if row["photos"] == largest), key=lambda row: row["points"])
    titles = [title for title, _ in MODELS.values()]
    terms = {"": "constant", "photos": "photo", "points": "point", "anchors": "anchor", "visible": "anchor in view"}
    factors = (
        [MODELS[name][0], *(f"{model[term]:.3g}" if term in model else "" for term in terms)]
        for name, model in models.items()
    )
    lines = [
        "# Large captures",
        "",
        "Made by `python benchmarks/scale.py --write`: trainings on aerial captures of 320 x 240 pixels, of which each "
        "photo shows a part of the same size, on the processor, with the points of the capture alone. Memory is the "
        "most that the process took.",
        "",
        *shared.table(["photos", "points", "anchors", "anchors in view", *titles], map(_cells, rows)),
        "",
        "![Time of a step over all anchors, and over those in view](scale.png)",
        "",
        "A step takes as long as the anchors in view require, however many there are.",
        "",
        "## Cost model",
        "",
        *shared.table(["", *terms.values()], factors),
        "",
        *_tested(rows, largest),
        "",
        f"What it predicts for {densest['points'] // largest} points for each photo, with {VISITS} steps for each:",
        "",
        *_predicted(models, densest),
        "",
        "Where resources end:",
        "",
        *(f"- {limit}: {_end(models[name], densest, most)}" for limit, (name, most) in LIMITS.items()),
        "",
        "`split` divides a model into cells that each take a part of the memory.",
    ]
    return "\n".join(lines) + "\n"


def _cells(row: Mapping[str, float]) -> list[str]:
    return [
        f"{row['photos']:,}", f"{row['points']:,}", f"{row['anchors']:,}", f"{row['visible']:,.0f}",
        f"{row['prepare_seconds']:.0f}", f"{row['step_ms']:.0f}", f"{row['save_seconds']:.1f}",
        f"{row['memory_gb']:.2f}", f"{row['disk_gb']:.2f}",
    ]  # fmt: skip


def _tested(rows: Sequence[Mapping[str, float]], largest: int) -> list[str]:
    """Return lines with the errors of fits to the smaller captures for the largest ones."""
    smaller, last = [row for row in rows if row["photos"] < largest], [row for row in rows if row["photos"] == largest]
    errors = []
    for name, (title, _) in MODELS.items():
        of_smaller = fit(smaller, name)
        errors.append([title, *(f"{predict(of_smaller, row) / row[name] - 1:+.0%}" for row in last)])
    return [
        f"Its error for the captures of {largest:,} photos, if it is fitted to the smaller ones alone:",
        "",
        *shared.table(["", *(f"{row['points']:,} points" for row in last)], errors),
    ]


def _predicted(models: Mapping[str, Mapping[str, float]], measured: Mapping[str, float]) -> list[str]:
    """Return a table of what 1, 10 and 100 times as many photos take, of which each shows the same."""
    lines = []
    for times in (1, 10, 100):
        row = {**measured, **{key: times * measured[key] for key in ("photos", "points", "anchors")}}
        values = {name: predict(model, row) for name, model in models.items()}
        hours = VISITS * row["photos"] * values["step_ms"] / 3.6e6
        lines.append(
            [
                f"{row['photos']:,}", f"{row['anchors'] / 1e6:.1f}", f"{values['prepare_seconds'] / 60:,.0f}",
                f"{hours:,.1f}", f"{values['save_seconds'] / 60:,.1f}", f"{values['memory_gb']:,.0f}",
                f"{values['disk_gb']:,.0f}",
            ]
        )  # fmt: skip
    return shared.table(
        ["photos", "million anchors", "reading and planning, min", "steps, h", "export, min", "memory, GB", "disk, GB"],
        lines,
    )


def _end(model: Mapping[str, float], measured: Mapping[str, float], most: float) -> str:
    """Return how many photos and anchors a resource is enough for."""
    of_photo = sum(factor * measured[term] / measured["photos"] for term, factor in model.items() if term)
    photos = (most - model[""]) / of_photo
    anchors = photos * measured["anchors"] / measured["photos"]
    return f"{photos:,.0f} photos, {anchors / 1e6:.1f} million anchors"


def plot(found: Mapping[str, Any]) -> Any:
    """Return a figure with the time of a step over all anchors, and over those in view."""
    with shared.plot_style():
        from matplotlib.figure import Figure

        figure = Figure(figsize=(8, 3.2), layout="constrained")
        axes = figure.subplots(1, 2, sharey=True)
        for density in sorted({row["points"] // row["photos"] for row in found["rows"]}):
            rows = [row for row in found["rows"] if row["points"] // row["photos"] == density]
            for axis, term in zip(axes, ("anchors", "visible"), strict=True):
                values = [row[term] for row in rows]
                axis.plot(values, [row["step_ms"] for row in rows], "o-", label=f"{density} points for each photo")
        axes[0].set(xlabel="all anchors", ylabel="step, ms", xscale="log", ylim=(0, None))
        axes[1].set(xlabel="anchors in view", xlim=(0, None))
        axes[0].legend()
    return figure


if __name__ == "__main__":
    main()
