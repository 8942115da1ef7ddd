"""Quality of trainings of different lengths: a row for each length and preset, and the curve of error against run time.

    python benchmarks/length.py [--json] [--capture build/demo/capture] [--write]
    python benchmarks/length.py --expect CAPTURE ...

Each length is a separate training from the beginning, through the user's commands. --write saves the figures to
docs/figures/length.json, the table to docs/length.md and the plot to docs/error-over-time.png. --expect measures the
values in backend/shared/expectation.py: the loss of PSNR after each number of steps, compared with a training until it
converges, on each of these captures.
"""

from __future__ import annotations

import argparse
import functools
import json
import statistics
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks import documents, shared

SECONDS = (15, 30, 60, 144, 300)
PRESETS = ("preview", "standard", "final")
STEPS = (150, 300, 600, 1000, 1500)
CONVERGED = "final"
"""The preset that trains until it stops improving, and the only preset whose meshes are measured."""
DEMO_SECONDS = 144
"""The length of `make demo`."""
DEMO = f"{DEMO_SECONDS} s"
QUOTED = (30, 60, 300)
"""Lengths that docs/results.md quotes."""
SEEDS = {DEMO: 3}
"""Number of seeds, if not 1; trainings that differ only in the seed are 0.1 dB and more apart."""

_COLUMNS = (
    ("train_seconds", "seconds", "{:.0f}"), ("steps", "steps", "{:,.0f}"), ("psnr", "PSNR, dB", "{:.2f}"),
    ("miou", "mIoU", "{:.4f}"), ("mbiou", "mBIoU", "{:.4f}"), ("f1_005", "F1 at 5 mm", "{:.3f}"),
    ("f1", "F1 at 2 cm", "{:.3f}"), ("texture_psnr", "texture, dB", "{:.1f}"),
)  # fmt: skip


def main() -> None:
    """Print the table, or one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--capture", type=Path, default=ROOT / "build/demo/capture")
    parser.add_argument("--write", action="store_true")
    parser.add_argument("--expect", type=Path, nargs="+", metavar="CAPTURE")
    options = parser.parse_args()
    if options.expect:
        found = shortfalls(options.expect)
        print(json.dumps(found))
        for steps in map(str, STEPS):
            of_each = [row[steps] for row in found.values()]
            print(f"{steps}: ({min(of_each):.2f}, {max(of_each):.2f})", file=sys.stderr)
        return
    capture = options.capture.resolve()
    made_from = shared.digest(shared.sources(), str(capture))
    names = [*PRESETS, *(f"{seconds} s" for seconds in SECONDS)]
    results = shared.Results(ROOT / "build" / "length", made_from, sum(SEEDS.get(name, 1) for name in names))

    def get(name: str, seed: int, *words: object) -> dict[str, Any]:
        return results.get(
            f"{name}, seed {seed}",
            lambda: shared.from_photos_to_report(
                capture, *words, "--seed", seed, meshes=name not in PRESETS or name == CONVERGED
            ),
            lambda found: f"{found['steps']} steps, {found['psnr']:.2f} dB, {found['train_seconds']:.0f} s",
        )  # fmt: skip

    # The longest training directly follows CONVERGED, since they are compared and a machine's speed varies over hours.
    words = {preset: ("--preset", preset) for preset in PRESETS}
    words |= {f"{seconds} s": ("--minutes", seconds / 60) for seconds in SECONDS[::-1]}
    rows = {name: [get(name, seed, *own) for seed in range(SEEDS.get(name, 1))] for name, own in words.items()}
    if results.failures:
        sys.exit("\n".join(f"{name}: {why}" for name, why in results.failures.items()))
    found = {name: rows[name] for name in (*(f"{seconds} s" for seconds in SECONDS), *PRESETS)}
    if options.write:
        shared.save_figure(plot(found), documents.DOCS / "error-over-time.png")
        documents.save("length", {name: [_without_curve(row) for row in own] for name, own in found.items()})
    print(json.dumps(found) if options.json else document(found))


def shortfalls(captures: list[Path]) -> dict[str, dict[str, float]]:
    """Return capture -> steps -> dB below a training that stops when it no longer improves."""
    total = len(captures) * (len(STEPS) + 1)
    found = {}
    for capture in captures:
        results = shared.Results(
            ROOT / "build" / "length", shared.digest(shared.sources(), str(capture.resolve())), total
        )

        def psnr(name: str, *words: object, capture: Path = capture, results: shared.Results = results) -> float:
            make = functools.partial(shared.from_photos_to_report, capture.resolve(), *words, meshes=False)
            return results.get(f"{capture} {name}", make, lambda row: f"{row['steps']} steps, {row['psnr']:.2f} dB")[
                "psnr"
            ]

        best = psnr(CONVERGED, "--preset", CONVERGED)
        found[capture.name] = {str(steps): best - psnr(f"{steps}", "--steps", steps) for steps in STEPS}
    return found


def document(found: Mapping[str, Sequence[Mapping[str, Any]]]) -> str:
    """Return the text of docs/length.md; `found` has the figures of each seed by training."""

    def cells(rows: Sequence[Mapping[str, Any]]) -> list[str]:
        return [shared.spread([row[key] for row in rows], form) for key, _, form in _COLUMNS]

    head = ("training", *(title for _, title, _ in _COLUMNS))
    seeds = ", ".join(f"{name} {count}" for name, count in SEEDS.items())
    lines = [
        "# Length of training",
        "",
        "Made by `python benchmarks/length.py --write`: trainings of the demo on the processor, measured on held-out "
        f"views. Number of seeds: {seeds}, others 1; ± is the standard deviation over the seeds. F1 is the median over "
        "the objects, where training views see the true surface.",
        "",
        *shared.table(head, ((name, *cells(rows)) for name, rows in found.items())),
        "",
        comparison(found[f"{SECONDS[-1]} s"], found[CONVERGED]),
    ]
    return "\n".join(lines) + "\n"


def comparison(longest: Sequence[Mapping[str, Any]], ends: Sequence[Mapping[str, Any]]) -> str:
    """Compare converged trainings with the longest ones, by their means over seeds; returns text."""

    def mean(rows: Sequence[Mapping[str, Any]], key: str) -> float:
        return statistics.fmean(row[key] for row in rows)

    times, steps = (mean(ends, key) / mean(longest, key) for key in ("train_seconds", "steps"))
    return (
        f"Until it stops improving: {times:.2f} times as long as the {SECONDS[-1]} s, {steps:.2f} times as many steps, "
        f"{mean(ends, 'psnr') - mean(longest, 'psnr'):+.2f} dB."
    )


def mean_psnr(rows: Sequence[Mapping[str, Any]]) -> float:
    """Return the mean PSNR over seeds, in dB."""
    return statistics.fmean(row["psnr"] for row in rows)


def mean_steps(rows: Sequence[Mapping[str, Any]]) -> float:
    """Return the mean number of steps over seeds."""
    return statistics.fmean(row["steps"] for row in rows)


def _without_curve(row: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in row.items() if key != "curve"}


def plot(found: Mapping[str, Sequence[Mapping[str, Any]]]) -> Any:
    """Plot PSNR, mIoU and F1 of the first seed over the seconds of training."""
    from matplotlib.figure import Figure

    with shared.plot_style():
        figure = Figure(figsize=(10, 3.2), layout="constrained")
        panels = (("psnr", "PSNR, dB"), ("miou", "mIoU"), ("f1_005", "F1 of the meshes at 5 mm"))
        for axes, (key, title), color in zip(figure.subplots(1, len(panels)), panels, shared.COLORS, strict=False):
            rows = [found[f"{seconds} s"][0] for seconds in SECONDS]
            clocked = [(row["train_seconds"], row[key]) for row in rows]
            axes.plot(*zip(*clocked, strict=True), color=color, marker="o", markersize=4, linewidth=2)
            for name in PRESETS:
                row = found[name][0]
                if row[key] is not None:
                    axes.plot(row["train_seconds"], row[key], "D", color=shared.MARKED, markersize=5)
                    below = -11 if name != CONVERGED else 5  # its point is near the previous one
                    axes.annotate(
                        name,
                        (row["train_seconds"], row[key]),
                        xytext=(4, below),
                        textcoords="offset points",
                        fontsize=8,
                    )
            axes.set_title(title)
            axes.set_xlabel("seconds of training")
            axes.set_xlim(left=0)
    return figure


if __name__ == "__main__":
    main()
