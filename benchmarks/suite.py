"""Quality of default trainings on many captures, each of them difficult in its own way.

    python benchmarks/suite.py [--part develop|check|all] [--minutes 1 2 5] [--capture NAME ...] [--seed 0]
    python benchmarks/suite.py --compare OTHER        a checkout of another version, measured in the same run
    python benchmarks/suite.py --write [--minutes 1 2 5]

The synthetic captures are made by `suite_scenes.py` in build/suite, with exact truth; the others are those of
../shared/data that are there. Changes are developed on the captures `DEVELOP`; the others are looked at only when a
change is done. Each length is a training of its own through the user's commands. --write saves the figures of all
captures to docs/figures/suite.json, the tables to docs/suite.md and the plots beside it, and prints the values of
`PSNR_FIT` in backend/shared/expectation.py.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from backend.shared.expectation import PsnrFit, shortfall
from backend.shared.reconstruction.cameras import read_cameras
from backend.shared.reconstruction.folder import Reconstruction
from backend.shared.reconstruction.record import read_record
from benchmarks import documents, shared

SYNTHETIC = {
    "room": "a room from inside, objects against its walls",
    "yard": "objects before an open sky",
    "few": "12 views only",
    "plain": "walls, floor and table without texture",
    "thin": "a chair, a plant and a fence",
    "gloss": "polish, metal and glass",
    "many": "60 small objects",
    "exposure": "exposure and white balance at random, photos unordered",
    "blur": "shaken and noisy photos",
    "sparse": "23 unordered photos from all sides with few points",
    "ample": "the same scene in 60 photos with many points",
}
"""Scenes of `suite_scenes.py`, and what is difficult about them."""

REAL = {
    "tabletop": "a real table with objects, 640 x 480",
    "banana": "14 real photos of one object",
    "mouse": "56 real photos of a small glossy object, few points",
}
"""Captures of ../shared/data."""

DEVELOP = ("room", "yard", "few", "exposure", "tabletop")
"""Captures that changes are developed on."""

MINUTES = (1.0, 2.0, 5.0)

OVER_TIME, EXPECTED = "suite-over-time.png", "suite-expected.png"
"""The plots in docs/."""

_FEWEST_TO_FIT = 8
"""Smallest number of captures from which the quality of others is expected."""

_COLUMNS = (
    ("psnr", "PSNR, dB", "{:.2f}"),
    ("psnr_worst", "worst view", "{:.2f}"),
    ("psnr_corrected", "colors corrected", "{:.2f}"),
    ("ssim", "SSIM", "{:.4f}"),
    ("miou", "mIoU", "{:.4f}"),
    ("miou_all", "with unlabeled", "{:.4f}"),
    ("f1", "F1 at 2 cm", "{:.3f}"),
    ("f1_005", "at 5 mm", "{:.3f}"),
    ("f1_005_all", "whole objects", "{:.3f}"),
    ("texture_psnr", "texture, dB", "{:.1f}"),
    ("splats", "splats", "{:,.0f}"),
)
_TITLES = {"psnr": "PSNR, median view, dB", "miou_all": "mIoU with unlabeled", "f1_005": "F1 of meshes at 5 mm"}


def captures(names: Sequence[str]) -> dict[str, Path]:
    """Return the folders of the named captures; synthetic ones are made if needed, and real ones may be absent."""
    made = [name for name in names if name in SYNTHETIC]
    if made:
        python = next(
            path
            for path in (ROOT / ".venv-bpy" / part for part in ("bin/python", "Scripts/python.exe"))
            if path.exists()
        )
        subprocess.run([python, "benchmarks/suite_scenes.py", "build/suite", *made], cwd=ROOT, check=True)
    found = {}
    for name in names:
        folder = ROOT / "build" / "suite" / name if name in SYNTHETIC else ROOT.parent / "shared" / "data" / name
        if folder.is_dir():
            found[name] = folder
        else:
            print(f"{name} is left out: {folder} does not exist")
    return found


def measured(code: Path, capture: Path, minutes: float, seed: int) -> dict[str, Any]:
    """Train, mesh and evaluate with the commands of the checkout `code`, and return the figures of a row.

    PSNR values are medians over the held-out views except `psnr_worst`; those of meshes are medians over the objects.
    """
    has_masks = (capture / "masks").is_dir()
    with tempfile.TemporaryDirectory(prefix="objectgs-benchmark-") as scratch:
        out = Path(scratch) / "out"
        for words in (
            ("train", capture, "--out", out, "--minutes", minutes, "--seed", seed),
            *([("mesh", out)] if has_masks else []),
            ("evaluate", out),
            ("report", out),
        ):
            done = subprocess.run(
                [sys.executable, "-m", "backend", *map(str, words)],
                cwd=code, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
            )  # fmt: skip
            if done.returncode:
                raise RuntimeError(f"{words[0]}: {done.stderr.strip().splitlines()[-1:]}")
        report = json.loads((out / "report.json").read_text())
        agreement = read_record(Reconstruction(out)).capture.agreement
        sizes = [view.width * view.height for view in read_cameras(out).views]
    views, quality = report["views"], report["quality"]

    def over(key: str) -> float | None:
        known = [view[key] for view in views if view.get(key) is not None]
        return statistics.median(known) if known else None

    return {
        "steps": report["model"]["trained_steps"],
        "splats": report["model"]["gaussians"],
        "psnr": over("psnr"),
        "psnr_worst": min(view["psnr"] for view in views),
        "psnr_corrected": over("psnr_corrected"),
        "psnr_corrected_mean": quality["psnr_corrected"],
        "agreement": agreement,
        "pixels": statistics.mean(sizes),
        "ssim": quality["ssim"],
        "miou": quality["miou"],
        "miou_all": quality["miou_all"],
        **{key: shared.over_objects(report, key) for key in ("f1", "f1_005", "f1_005_all", "texture_psnr")},
    }


def document(found: Mapping[str, Any]) -> str:
    """Return the text of docs/suite.md."""
    described = {**SYNTHETIC, **REAL}
    lines = [
        "# Many captures",
        "",
        "Made by `python benchmarks/suite.py --write`: default trainings on two cores of a server CPU, measured on "
        "held-out views. *PSNR* is of the median view; *colors corrected* after the colors of each render are fitted "
        "to its photo. F1 of the meshes is the median over the objects, where training views see the true surface, and "
        "at 5 mm also over whole objects. Changes are developed on "
        + ", ".join(f"*{name}*" for name in DEVELOP)
        + " and the demo alone.",
        "",
        *shared.table(
            ("capture", "what is difficult"), ((name, text) for name, text in described.items() if name in found)
        ),
        "",
    ]
    for minutes in sorted({float(length) for of in found.values() for length in of}):
        lines += [f"## {minutes:g} min", ""]
        rows = [
            (name, *(_cell(of[str(minutes)].get(key), form) for key, _, form in _COLUMNS))
            for name, of in found.items()
            if str(minutes) in of
        ]
        median = [
            _cell(_median([of[str(minutes)].get(key) for of in found.values() if str(minutes) in of]), form)
            for key, _, form in _COLUMNS
        ]
        lines += [
            *shared.table(("capture", *(title for _, title, _ in _COLUMNS)), [*rows, ("**median**", *median)]),
            "",
        ]
    if len({length for of in found.values() for length in of}) > 1:
        lines += [f"![PSNR, mIoU and F1 over the minutes of training]({OVER_TIME})", ""]
    if len(found) >= _FEWEST_TO_FIT:
        lines += _expected_and_found(found)
    return "\n".join(lines).rstrip() + "\n"


def _expected_and_found(found: Mapping[str, Any]) -> list[str]:
    """Return the lines of docs/suite.md about the expectation of each capture from the others."""
    fit, errors = fit_of_psnr(found)
    described = {name: of[max(of, key=float)] for name, of in found.items()}
    inside = sum(abs(error) <= fit.margin for error in errors.values())
    rows = [
        (
            name,
            f"{row['agreement']:.1f}",
            f"{row['pixels'] / 1e6:.2f}",
            f"{row['psnr_corrected_mean'] - errors[name] - fit.margin:.1f} to "
            f"{row['psnr_corrected_mean'] - errors[name] + fit.margin:.1f}",
            f"{row['psnr_corrected_mean']:.1f}",
            f"{errors[name]:+.1f}",
        )
        for name, row in described.items()
    ]
    return [
        "## Expected and found",
        "",
        "What a training reaches is expected from how well photos agree with what their neighbors show at the depths "
        "of the points, and from the photos' size. Here, each capture's longest training is predicted by the fit to "
        "the other captures. PSNR in dB, colors corrected, mean over the held-out views; "
        f"{inside} of {len(rows)} are within {fit.margin:.1f} dB.",
        "",
        f"![Found over expected PSNR of each capture]({EXPECTED})",
        "",
        *shared.table(("capture", "agreement, dB", "megapixels", "expected", "found", "difference"), rows),
        "",
    ]


def fit_of_psnr(found: Mapping[str, Any]) -> tuple[PsnrFit, dict[str, float]]:
    """Fit the PSNR of trainings to the agreement and the size of the photos.

    Args:
        found: The figures by capture and minutes.

    Returns:
        The fit to all captures, with the margin within which 80% of captures, each predicted by the fit to the others,
        would be; and the difference of each capture's longest training to that prediction, in dB.
    """
    names = list(found)
    rows = [of[max(of, key=float)] for of in found.values()]
    terms = np.array([[1.0, row["agreement"], math.log2(row["pixels"] / 1e6)] for row in rows])
    final = np.array([row["psnr_corrected_mean"] + statistics.mean(shortfall(row["steps"])) for row in rows])

    def solve(kept: np.ndarray) -> np.ndarray:
        return np.linalg.lstsq(terms[kept], final[kept], rcond=None)[0]

    errors = {name: float(final[i] - terms[i] @ solve(np.arange(len(names)) != i)) for i, name in enumerate(names)}
    # The smallest margin that holds for a new capture with a probability of at least 80% (Barber et al. 2021).
    rank = min(math.ceil(0.8 * (len(names) + 1)), len(names))
    margin = sorted(map(abs, errors.values()))[rank - 1]
    return PsnrFit(*(float(value) for value in solve(np.ones(len(names), np.bool_))), margin), errors


def comparison(before: Mapping[str, Any], after: Mapping[str, Any]) -> str:
    """Return a table of the differences between two versions, `after` less `before`."""
    lines = []
    for minutes in sorted({float(length) for of in after.values() for length in of}):
        rows = []
        for name, of in after.items():
            new, old = of.get(str(minutes)), before.get(name, {}).get(str(minutes))
            if new and old:
                rows.append(
                    (
                        name,
                        *(_cell(_difference(new.get(key), old.get(key)), _signed(form)) for key, _, form in _COLUMNS),
                    )
                )
        lines += [f"{minutes:g} min, difference to the other version:", ""]
        lines += [*shared.table(("capture", *(title for _, title, _ in _COLUMNS)), rows), ""]
    return "\n".join(lines)


def _difference(new: float | None, old: float | None) -> float | None:
    return None if new is None or old is None else new - old


def _signed(form: str) -> str:
    return form.replace("{:", "{:+")


def _median(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return statistics.median(known) if known else None


def _cell(value: float | None, form: str) -> str:
    return "" if value is None else form.format(value)


def plot(found: Mapping[str, Any]) -> Any:
    """Plot PSNR, mIoU and F1 of each capture over the minutes of training."""
    from matplotlib.figure import Figure

    with shared.plot_style():
        figure = Figure(figsize=(10, 3.6), layout="constrained")
        axes_of = figure.subplots(1, len(_TITLES))
        for axes, (key, title) in zip(axes_of, _TITLES.items(), strict=True):
            for number, (name, of) in enumerate(found.items()):
                points = sorted((float(m), row[key]) for m, row in of.items() if row.get(key) is not None)
                if points:
                    style = "-" if name in DEVELOP else "--"
                    color = shared.COLORS[number % len(shared.COLORS)]
                    axes.plot(*zip(*points, strict=True), style, color=color, marker="o", markersize=3, label=name)
            axes.set_title(title)
            axes.set_xlabel("minutes of training")
        axes_of[0].legend(fontsize=7, ncols=2)
    return figure


def plot_expected(found: Mapping[str, Any]) -> Any:
    """Plot the found PSNR of each capture over the one expected from the others, and the interval."""
    from matplotlib.figure import Figure

    fit, errors = fit_of_psnr(found)
    values = {name: of[max(of, key=float)]["psnr_corrected_mean"] for name, of in found.items()}
    expected = {name: value - errors[name] for name, value in values.items()}
    with shared.plot_style():
        figure = Figure(figsize=(5.6, 4.6), layout="constrained")
        axes = figure.subplots()
        ends = np.array([min(expected.values()) - 2, max(expected.values()) + 2])
        axes.fill_between(ends, ends - fit.margin, ends + fit.margin, color=shared.COLORS[0], alpha=0.12, linewidth=0)
        axes.plot(ends, ends, color=shared.GRAY, linewidth=1)
        for name, value in values.items():
            color = shared.COLORS[1] if name in REAL else shared.COLORS[0]
            axes.plot(expected[name], value, "o", color=color, markersize=5)
            axes.annotate(name, (expected[name], value), xytext=(5, 3), textcoords="offset points", fontsize=8)
        axes.set_title("PSNR on held-out views, colors corrected, dB")
        axes.set_xlabel("expected from the other captures")
        axes.set_ylabel("found")
    return figure


def main() -> None:
    """Measure, and print or write the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--part", choices=("develop", "check", "all"), default="develop")
    parser.add_argument("--capture", nargs="+", choices=(*SYNTHETIC, *REAL), help="these captures instead of a part")
    parser.add_argument("--minutes", type=float, nargs="+", default=MINUTES)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--compare", type=Path, metavar="OTHER")
    parser.add_argument("--write", action="store_true", help="all captures, for the document")
    options = parser.parse_args()
    everything = (*SYNTHETIC, *REAL)
    parts = {"develop": DEVELOP, "check": [name for name in everything if name not in DEVELOP], "all": everything}
    names = everything if options.write else options.capture or parts[options.part]
    lengths = options.minutes
    folders = captures(names)
    shared.compile_everything()
    versions = {"this": ROOT, **({"other": options.compare.resolve()} if options.compare else {})}
    found: dict[str, dict[str, dict[str, Any]]] = {version: {} for version in versions}
    results = {
        version: shared.Results(
            ROOT / "build" / "suite-results" / version,
            shared.digest(shared.sources(code), version), len(folders) * len(lengths),
        )
        for version, code in versions.items()
    }  # fmt: skip
    # The versions take turns, since a machine's speed varies over hours.
    for minutes in lengths:
        for name, folder in folders.items():
            for version, code in versions.items():
                row = results[version].get(
                    f"{name} {minutes} min seed {options.seed}",
                    lambda code=code, folder=folder, minutes=minutes: measured(code, folder, minutes, options.seed),
                    lambda row: f"{row['psnr']:.2f} dB, worst {row['psnr_worst']:.2f}, mIoU {row['miou_all']}",
                )
                if row:
                    found[version].setdefault(name, {})[str(float(minutes))] = row
    failed = {name: why for each in results.values() for name, why in each.failures.items()}
    if failed:
        sys.exit("\n".join(f"{name}: {why}" for name, why in failed.items()))
    if options.write:
        if len(lengths) > 1:
            shared.save_figure(plot(found["this"]), documents.DOCS / OVER_TIME)
        if len(found["this"]) >= _FEWEST_TO_FIT:
            shared.save_figure(plot_expected(found["this"]), documents.DOCS / EXPECTED)
            print(fit_of_psnr(found["this"])[0])
        documents.save("suite", found["this"])
    print(document(found["this"]))
    if options.compare:
        print(comparison(found["other"], found["this"]))


if __name__ == "__main__":
    main()
