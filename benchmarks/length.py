"""Quality of trainings of different lengths: a row for each length and preset, and the curve of error against run time.

    python benchmarks/length.py [--json] [--capture build/demo/capture] [--write]
    python benchmarks/length.py --expect CAPTURE ...

Each length is a separate training from the beginning, through the user's commands. --write saves the table to
docs/length.md and the plot to docs/error-over-time.png. --expect measures the values in backend/shared/expectation.py:
the loss of PSNR after each number of steps, compared with a training until it converges, on each of these captures.
"""

from __future__ import annotations

import argparse
import functools
import json
import statistics
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks import shared

SECONDS = (15, 30, 60, 120, 300)
PRESETS = ("preview", "standard", "final")
STEPS = (150, 300, 600, 1000, 1500)
CONVERGED = "final"
"""The preset that trains until it stops improving, and the only preset whose meshes are measured."""
SEEDS = 2
"""Number of seeds over which CONVERGED and the longest training are averaged for their comparison, since trainings that
differ only in the seed are 0.1 dB and more apart."""

_COLUMNS = (
    ("train_seconds", "seconds", "{:.0f}"), ("steps", "steps", "{:,}"), ("psnr", "PSNR", "{:.2f} dB"),
    ("miou", "mIoU", "{:.4f}"), ("f1", "F1 at 2 cm", "{:.3f}"), ("f1_005", "F1 at 5 mm", "{:.3f}"),
    ("texture_psnr", "texture", "{:.1f} dB"),
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
    results = shared.Results(ROOT / "build" / "length", made_from, len(SECONDS) + len(PRESETS) + 2 * (SEEDS - 1))

    def get(name: str, *words: object, meshes: bool) -> dict[str, Any]:
        return results.get(
            name, lambda: shared.from_photos_to_report(capture, *words, meshes=meshes),
            lambda found: f"{found['steps']} steps, {found['psnr']:.2f} dB, {found['train_seconds']:.0f} s",
        )  # fmt: skip

    presets = {preset: get(preset, "--preset", preset, meshes=preset == CONVERGED) for preset in PRESETS}
    # The longest training directly follows CONVERGED, since they are compared and a machine's speed varies over hours.
    lengths = {f"{seconds} s": get(f"{seconds} s", "--minutes", seconds / 60, meshes=True) for seconds in SECONDS[::-1]}
    found = dict(reversed(lengths.items())) | presets
    longest = f"{SECONDS[-1]} s", "--minutes", SECONDS[-1] / 60
    compared = [
        [found[name], *(get(f"{name}, seed {seed}", *words, "--seed", seed, meshes=False) for seed in range(1, SEEDS))]
        for name, *words in (longest, (CONVERGED, "--preset", CONVERGED))
    ]
    if results.failures:
        sys.exit("\n".join(f"{name}: {why}" for name, why in results.failures.items()))
    lines = [*table(found), "", comparison(*compared)]
    if options.write:
        (ROOT / "docs" / "length.md").write_text("\n".join(lines) + "\n")
        shared.save_figure(plot(found), ROOT / "docs" / "error-over-time.png")
    print(json.dumps(found) if options.json else "\n".join(lines))


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


def table(found: dict[str, dict[str, Any]]) -> list[str]:
    """Return the lines of the Markdown table."""

    def cells(row: dict[str, Any]) -> list[str]:
        return ["" if row[key] is None else form.format(row[key]) for key, _, form in _COLUMNS]

    head = ("training", *(title for _, title, _ in _COLUMNS))
    return shared.table(head, ((name, *cells(row)) for name, row in found.items()))


def comparison(longest: list[dict[str, Any]], ends: list[dict[str, Any]]) -> str:
    """Compare converged trainings with the longest ones, each over several seeds; returns text."""

    def mean(rows: list[dict[str, Any]], key: str) -> float:
        return statistics.fmean(row[key] for row in rows)

    of_each = (f"{end['psnr']:.2f} against {other['psnr']:.2f}" for end, other in zip(ends, longest, strict=True))
    times, steps = (mean(ends, key) / mean(longest, key) for key in ("train_seconds", "steps"))
    return (
        f"Until it stops improving: {times:.2f} times as long as the {SECONDS[-1]} s, {steps:.2f} times as many steps, "
        f"{mean(ends, 'psnr') - mean(longest, 'psnr'):+.2f} dB (means over {len(ends)} seeds: {', '.join(of_each)})."
    )


def plot(found: dict[str, dict[str, Any]]) -> Any:
    """Plot PSNR, mIoU and F1 over the seconds of training."""
    from matplotlib.figure import Figure

    with shared.plot_style():
        figure = Figure(figsize=(10, 3.2), layout="constrained")
        panels = (("psnr", "PSNR, dB"), ("miou", "mIoU"), ("f1_005", "F1 of the meshes at 5 mm"))
        for axes, (key, title), color in zip(figure.subplots(1, len(panels)), panels, shared.COLORS, strict=False):
            clocked = [(found[f"{seconds} s"]["train_seconds"], found[f"{seconds} s"][key]) for seconds in SECONDS]
            axes.plot(*zip(*clocked, strict=True), color=color, marker="o", markersize=4, linewidth=2)
            for name in PRESETS:
                row = found[name]
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
