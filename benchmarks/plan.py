"""Savings of the plan: trainings with all of its omissions, with none, and with parts of the result only.

    python benchmarks/plan.py [CAPTURE ...] [--json] [--steps 800] [--needed] [--write] [-- TRAIN OPTIONS]

Each training is measured on the held-out views; if the plan omits something, the figures are means over three seeds.
Several omissions are also undone one at a time. If the omissions change the quality, the training as planned is
repeated with fewer or more steps until its quality is the same. A capture without masks is also trained with empty
masks, so that nothing is omitted, and with masks that show one object everywhere. `--needed` also omits, one at a time,
the operations that the plan includes. Further trainings extract meshes: of everything, of one object, in groups, and
none. Finally, redundant data is added to the captures that `--surplus` names, and pinhole images are undistorted.
`--write` writes the tables to docs/plan.md.
"""

from __future__ import annotations

import argparse
import functools
import json
import math
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks import documents, plan_captures, shared

DEMO = ROOT / "build/demo/capture"
SAME_PSNR = 0.1
"""Two trainings are equally good within this difference, in dB, or twice the standard error of the difference."""

SEEDS = 3

DB_AN_OCTAVE, TRIES, MOST_TIMES = 1.5, 4, 2
"""Assumed gain in dB of doubling the steps, until it is measured; maximum number of trainings with other steps; maximum
factor of the steps."""

FLAT = ("--primitive", "2d")
AS_GOOD, EVERYWHERE = "as planned, equal quality", "with an object everywhere"

SURPLUS = ("duplicate-views", "blind-views", "unseen-points")
"""Plan keys of the redundant data that `plan_captures.with_surplus` adds."""

GROUPS = 3
"""Number of groups, to which objects are assigned in turn."""

_COLUMNS = (
    ("steps", "steps", "{:,}"), ("seconds", "seconds", "{:.0f}"), ("cpu_seconds", "CPU seconds", "{:.0f}"),
    ("train", "training", "{:.0f}"), ("peak_mb", "memory", "{:,.0f} MB"), ("psnr", "PSNR", "{:.2f} dB"),
    ("miou", "mIoU", "{:.4f}"), ("splats", "splats", "{:,.0f}"),
)  # fmt: skip
_PARTS_COLUMNS = (
    ("total", "seconds in all", "{:.0f}"), ("train", "training", "{:.0f}"), ("mesh_seconds", "meshes", "{:.0f}"),
    ("mesh_mb", "memory", "{:,.0f} MB"), ("psnr", "PSNR", "{:.2f} dB"), ("iou", "IoU of the object", "{:.4f}"),
    ("splats", "splats", "{:,}"),
)  # fmt: skip


def backend(*words: object) -> tuple[list[dict[str, Any]], float, float]:
    """Run a command and return its events, its wall time and its processor time in seconds."""
    before, started = os.times(), time.monotonic()
    done = subprocess.run(
        [sys.executable, "-m", "backend", *map(str, words), "--json"], cwd=ROOT, capture_output=True, text=True
    )
    if done.returncode:
        raise RuntimeError(done.stdout.splitlines()[-1] if done.stdout else done.stderr)
    seconds, after = time.monotonic() - started, os.times()
    busy = sum(after[2:4]) - sum(before[2:4])
    return [json.loads(line) for line in done.stdout.splitlines()], seconds, busy


def measured(capture: Path, options: Sequence[str], meshes: bool = False) -> dict[str, Any]:
    """Train, optionally extract meshes, and return the figures.

    iou is by object ID, left_out the keys that the plan omits, objects the list in objects.json.
    """
    with tempfile.TemporaryDirectory(prefix="objectgs-benchmark-") as scratch:
        out = Path(scratch) / "out"
        events, seconds, busy = backend("train", capture, "--out", out, *options)
        dressing = backend("mesh", out)[1] if meshes else 0.0
        quality = backend("evaluate", out)[0][-1]
        memory = json.loads((out / "objectgs.json").read_text())
        stages = {stage["name"]: stage for stage in memory["stages"]}
        listed, plan = out / "objects.json", json.loads((out / "plan.json").read_text())["decisions"]
        scores = json.loads((out / "evaluation.json").read_text())["objects"]
        return {
            "cpu_seconds": busy,
            "seconds": seconds,
            "total": seconds + dressing,
            **{name: stages[name]["seconds"] for name in ("read", "vote", "train", "export") if name in stages},
            "mesh_seconds": dressing if meshes else None,
            "peak_mb": stages["train"]["peak_rss_mb"],
            "mesh_mb": max(stages[name]["peak_rss_mb"] for name in ("train", "mesh") if name in stages),
            "psnr": quality.get("psnr"),
            "miou": quality.get("miou"),
            "miou_all": quality.get("miou_all"),
            "steps": events[-1]["steps"],
            "splats": memory["export"]["splats"],
            "iou": {str(row["id"]): row["iou"] for row in scores},
            "left_out": [own["key"] for own in plan if own["done"] is False],
            "objects": json.loads(listed.read_text())["objects"] if listed.exists() else [],
        }


class Capture:
    """A capture and its results.

    folder: the capture's folder. options: options of every training. name: name of its results.
    """

    def __init__(self, folder: Path, options: Sequence[str], name: str = "") -> None:
        self.folder, self.options = folder, tuple(options)
        code = [*shared.sources(), *([Path(plan_captures.__file__)] if name else [])]
        self.results = shared.Results(ROOT / "build" / "plan", shared.digest(code, str(folder)), 0)
        self.name = name or ("demo" if folder == DEMO else folder.name)

    def made(self, what: str, make: Callable[..., Path], *arguments: object) -> Capture:
        """Make a capture from this one with a function of `plan_captures`."""
        name = f"{self.name} {what}"
        folder = ROOT / "build" / "plan" / "captures" / name.replace(" ", "-")
        shared.forget(folder)
        folder.mkdir(parents=True)
        return Capture(make(self.folder, folder, *arguments), self.options, name)

    def plan(self) -> list[dict[str, Any]]:
        """Return the decisions as in plan.json."""
        return backend("plan", self.folder, *self.options)[0][-1]["plan"]

    def train(self, steps: int, *more: str, meshes: bool = False) -> dict[str, Any]:
        """Return the figures of a training, measured once."""
        words = ["--steps", str(steps), *self.options, *more]
        name = f"{self.name} {' '.join(words)}" + (" and meshes" if meshes else "")
        return self._once(
            name,
            functools.partial(measured, self.folder, words, meshes),
            lambda row: f"{row['total']:.0f} s, {row['peak_mb']:.0f} MB, PSNR {row['psnr']}",
        )

    def prepare(self) -> dict[str, Any]:
        """Return the seconds, memory and disk space of an import, measured once."""
        return self._once(
            f"{self.name} imported", functools.partial(imported, self.folder), lambda row: f"{row['seconds']:.1f} s"
        )

    def _once(
        self, name: str, make: Callable[[], dict[str, Any]], line: Callable[[dict[str, Any]], str]
    ) -> dict[str, Any]:
        """Return a result; raise SystemExit if it fails."""
        self.results.total += 1
        found = self.results.get(name, make, line)
        if self.results.failures:
            sys.exit("\n".join(self.results.failures.values()))
        return found

    def train_often(self, seeds: int, steps: int, *more: str, **words: Any) -> dict[str, Any]:
        """Return means of the figures over seeds, and the standard error of the PSNR."""
        rows = [self.train(steps, *more, *(("--seed", str(seed)) if seed else ()), **words) for seed in range(seeds)]
        known = {key for key, _, _ in _COLUMNS if rows[0][key] is not None}
        spread = statistics.stdev(row["psnr"] for row in rows) if seeds > 1 else 0.0
        return {
            **{key: statistics.fmean(row[key] for row in rows) for key in known},
            "steps": rows[0]["steps"],
            "error": spread / seeds**0.5,
        }


def omissions(capture: Capture, steps: int, needed: bool) -> tuple[list[str], dict[str, dict[str, Any]]]:
    """Return the keys that the plan omits, and the trainings with and without these omissions."""
    plan = capture.plan()
    has_masks = next(own["done"] for own in plan if own["key"] == "votes")
    open_to_choice = [own for own in plan if own["can_override"]]
    left_out = [own["key"] for own in open_to_choice if own["done"] is False]
    train = functools.partial(capture.train_often, SEEDS if left_out or not has_masks else 1)
    planned = train(steps)
    found = {"as planned": planned}
    if has_masks:
        whole = train(steps, "--keep", "all")
    else:
        left_out = ["votes", "labels", *left_out]
        # Supervision of unlabeled pixels is disabled, as when masks are missing, since it acts as a label.
        empty = capture.made("with empty masks", plan_captures.with_masks, 0)
        whole = empty.train_often(SEEDS, steps, "--keep", "all", "--leave-out", "rest")
        labeled = capture.made("with an object everywhere", plan_captures.with_masks, 1)
        found[EVERYWHERE] = labeled.train_often(SEEDS, steps, "--keep", "all")
    found = {"as planned": planned, "nothing left out": whole, **found}
    if judged(planned, whole) != "equal":
        found[AS_GOOD] = as_good(train, planned, whole["psnr"])
    if has_masks and len(left_out) > 1:
        found |= {f"with {key}": train(steps, "--keep", key) for key in left_out}
    if needed:
        done = [own["key"] for own in open_to_choice if own["done"]]
        found |= {f"without {key}": train(steps, "--leave-out", key) for key in done}
    return left_out, found


def surplus_of(capture: Capture, steps: int) -> dict[str, dict[str, Any]]:
    """Train on a capture with redundant data: without all of it, with all of it, and with one kind at a time.

    Raises:
        RuntimeError: the plan does not omit the redundant data.
    """
    more = capture.made("with redundant data", plan_captures.with_surplus)
    if missing := set(SURPLUS) - set(more.train(steps)["left_out"]):
        raise RuntimeError(f"The plan does not leave {', '.join(sorted(missing))} out of {more.folder}.")
    train = functools.partial(more.train_often, SEEDS)
    keep = [word for key in SURPLUS for word in ("--keep", key)]
    planned, whole = train(steps), train(steps, *keep)
    found = {"the capture itself": capture.train_often(SEEDS, steps), "as planned": planned, "nothing left out": whole}
    if judged(planned, whole) != "equal":
        found[AS_GOOD] = as_good(train, planned, whole["psnr"])
    return found | {f"with {key}": train(steps, "--keep", key) for key in SURPLUS}


def as_good(train: Callable[[int], dict[str, Any]], planned: dict[str, Any], psnr: float) -> dict[str, Any]:
    """Repeat the training as planned with other steps until it reaches this PSNR; else return the nearest of TRIES."""
    tried = {planned["steps"]: planned}
    steps = min(2 ** ((psnr - planned["psnr"]) / DB_AN_OCTAVE), MOST_TIMES) * planned["steps"]
    for _ in range(TRIES):
        latest = train(round(steps))
        tried[latest["steps"]] = latest
        if abs(latest["psnr"] - psnr) <= SAME_PSNR:
            break
        (a, b), slope = sorted(tried, key=lambda n: abs(tried[n]["psnr"] - psnr))[:2], DB_AN_OCTAVE
        if (octaves := math.log2(a / b)) and (gain := tried[a]["psnr"] - tried[b]["psnr"]) * octaves > 0:
            slope = gain / octaves
        steps = min(a * 2 ** ((psnr - tried[a]["psnr"]) / slope), MOST_TIMES * planned["steps"])
        if round(steps) in tried:
            break
    return min(tried.values(), key=lambda row: abs(row["psnr"] - psnr))


def imported(folder: Path) -> dict[str, Any]:
    """Import a capture and return the seconds, and memory and disk space in MB."""
    with tempfile.TemporaryDirectory(prefix="objectgs-benchmark-") as scratch:
        out = Path(scratch) / "out"
        _, seconds, _ = backend("import", folder, "--out", out)
        stages = json.loads((out / "objectgs.json").read_text())["stages"]
        disk = sum(path.stat().st_size for path in out.rglob("*") if path.is_file())
    return {"seconds": seconds, "peak_mb": max(stage["peak_rss_mb"] for stage in stages), "disk_mb": disk / 1e6}


def train_parts(capture: Capture, steps: int) -> dict[str, dict[str, Any]]:
    """Train and extract meshes of everything and of parts.

    `iou` is that of the object which is also extracted alone: the one with the median number of points.
    """
    everything = capture.train(steps, meshes=True)
    found = {"everything": everything}
    chosen = None
    if objects := sorted(everything["objects"], key=lambda entry: entry["points"]):
        chosen = objects[len(objects) // 2]
        found[f"only {chosen['name']}"] = capture.train(steps, "--only", chosen["name"], meshes=True)
        file = ROOT / "build" / "plan" / f"groups-of-{capture.name}.json"
        file.write_text(json.dumps({str(own["id"]): f"group {i % GROUPS}" for i, own in enumerate(objects)}))
        found[f"in {GROUPS} groups"] = capture.train(steps, "--groups", str(file), meshes=True)
    found["no meshes"] = {**everything, "total": everything["seconds"], "mesh_seconds": None,
                          "mesh_mb": everything["peak_mb"]}  # fmt: skip
    found["flat splats, everything"] = capture.train(steps, *FLAT, meshes=True)
    found["flat splats, no meshes"] = capture.train(steps, *FLAT, "--no-meshes")
    for name, row in found.items():
        found[name] = {**row, "iou": row["iou"].get(str(chosen["id"])) if chosen else None}
    return found


def change(new: dict[str, Any], old: dict[str, Any], names: Mapping[str, str]) -> str:
    """Return the relative differences of figures as text."""
    return ", ".join(
        f"{abs(1 - new[key] / old[key]):.0%} {'less' if new[key] <= old[key] else 'more'} {name}"
        for key, name in names.items()
    )


_COSTS = {"seconds": "time", "cpu_seconds": "CPU time", "peak_mb": "memory"}


def verdict(found: dict[str, dict[str, Any]]) -> str:
    """Return the effect of the omissions on cost and quality as text."""
    planned, whole = found["as planned"], found["nothing left out"]
    text = f"As planned, the same number of steps takes {change(planned, whole, _COSTS)}; {gain_of(planned, whole)}, "
    text += f"{judged(planned, whole)}."
    if same := found.get(AS_GOOD):
        text += f" In {same['steps']:,} steps it takes {change(same, whole, _COSTS)}; {gain_of(same, whole)}."
    if labeled := found.get(EVERYWHERE):
        text += " Nothing left out: votes, the ID channel and the label loss with masks that are empty. Labels of one "
        text += "object that is everywhere are more than that, since their loss favors opaque pixels; compared with "
        text += "these: "
        text += f"{change(planned, labeled, _COSTS)}; {gain_of(planned, labeled)}, {judged(planned, labeled)}."
    return text


def error_of(new: dict[str, Any], old: dict[str, Any]) -> float:
    """Return the standard error of the difference of two PSNR values, in dB."""
    return math.hypot(new["error"], old["error"])


def gain_of(new: dict[str, Any], old: dict[str, Any]) -> str:
    """Return the difference of two PSNR values and its standard error as text."""
    error = error_of(new, old)
    return f"{new['psnr'] - old['psnr']:+.2f}{f' ± {error:.2f}' if error else ''} dB"


def judged(new: dict[str, Any], old: dict[str, Any]) -> str:
    """Return `better`, `equal` or `worse`, comparing the PSNR of two trainings."""
    gain = new["psnr"] - old["psnr"]
    if abs(gain) <= max(SAME_PSNR, 2 * error_of(new, old)):
        return "equal"
    return "better" if gain > 0 else "worse"


def parts_verdict(found: dict[str, dict[str, Any]]) -> str:
    """Return the savings of extracting less as text."""
    everything = found["everything"]
    lines = []
    for name, row in found.items():
        against = found["flat splats, everything"] if name.startswith("flat splats") else everything
        if row is not against and name != "everything":
            saved = change(row, against, {"total": "time", "mesh_mb": "memory"})
            lines.append(f"{name}: {saved}, {row['psnr'] - against['psnr']:+.2f} dB")
    return "; ".join(lines) + "."


def rows_of(columns: Sequence[tuple[str, str, str]], found: dict[str, dict[str, Any]]) -> list[str]:
    """Return a Markdown table."""

    def cells(row: dict[str, Any]) -> list[str]:
        return ["" if row.get(key) is None else form.format(row[key]) for key, _, form in columns]

    return shared.table(("", *(title for _, title, _ in columns)), ((name, *cells(row)) for name, row in found.items()))


def heading(level: int, text: str) -> str:
    """Return a Markdown heading."""
    return f"{'#' * level} {text[0].upper()}{text[1:]}"


def section_of_omissions(capture: Capture, steps: int, needed: bool) -> tuple[dict[str, Any], list[str]]:
    """Measure the plan's omissions; returns the figures and lines of Markdown."""
    left_out, trainings = omissions(capture, steps, needed)
    found = verdict(trainings) if left_out else f"{verdict(trainings)} Both did the same; the difference is noise."
    lines = [f"Left out: {', '.join(left_out) or 'nothing'}.", "", *rows_of(_COLUMNS, trainings), "",
             found, ""]  # fmt: skip
    return {"left_out": left_out, "trainings": trainings}, lines


def section_of_parts(capture: Capture, steps: int) -> tuple[dict[str, Any], list[str]]:
    """Measure the user's choices of results; returns the figures and lines of Markdown."""
    parts = train_parts(capture, steps)
    lines = ["With meshes, and with parts of the result only:", "", *rows_of(_PARTS_COLUMNS, parts), "",
             parts_verdict(parts), ""]  # fmt: skip
    return {"parts": parts}, lines


def section_of_pinholes(capture: Capture) -> tuple[dict[str, Any], list[str]]:
    """Measure the savings without undistortion; returns the figures and lines of Markdown, empty if images need it."""
    if any(own["key"] == "undistortion" and own["done"] for own in capture.plan()):
        return {}, []
    plain, bent = capture.prepare(), capture.made("through a lens", plan_captures.through_a_lens).prepare()
    text = (
        f"Pinhole images are not undistorted: import takes {plain['seconds']:.1f} instead of "
        f"{bent['seconds']:.1f} seconds, {plain['peak_mb']:,.0f} instead of {bent['peak_mb']:,.0f} MB of memory and "
        f"{plain['disk_mb']:.1f} instead of {bent['disk_mb']:.1f} MB on disk."
    )
    return {"undistortion": {"left out": plain, "done": bent}}, [text, ""]


def section_of_surplus(capture: Capture, steps: int) -> tuple[dict[str, Any], list[str]]:
    """Measure the savings for a capture with redundant data; returns the figures and lines of Markdown."""
    trainings = surplus_of(capture, steps)
    lines = [
        heading(3, f"{capture.name}, with redundant data"), "",
        "About twice as many photos: of those added, half are JPEG copies, and half show nothing reconstructed; "
        f"also {plan_captures.UNSEEN:.0%} more points, which no photo shows.", "",
        *rows_of(_COLUMNS, trainings), "", verdict(trainings), "",
    ]  # fmt: skip
    return {"surplus": trainings}, lines


def main() -> None:
    """Print the tables, or one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true")
    parser.add_argument("capture", type=Path, nargs="*", default=[DEMO])
    parser.add_argument("--steps", type=int, default=800)
    parser.add_argument("--surplus", type=Path, nargs="*", default=[DEMO], metavar="CAPTURE")
    parser.add_argument("--needed", action="store_true", help="also without each planned step")
    parser.add_argument("--write", action="store_true")
    words = sys.argv[1:]
    own, extra = (words[: words.index("--")], words[words.index("--") + 1 :]) if "--" in words else (words, [])
    options = parser.parse_args(own)
    shared.compile_everything()
    surplus = {path.resolve() for path in options.surplus}
    found: dict[str, Any] = {}
    lines = [
        "# What the plan saves",
        "",
        f"Made by `python benchmarks/plan.py CAPTURE ... --write`: trainings of {options.steps:,} steps on "
        f"{os.cpu_count()} processors; quality on held-out views.",
        "",
    ]  # fmt: skip
    for folder in options.capture:
        capture = Capture(folder.resolve(), extra)
        lines += [heading(2, capture.name), ""]
        sections = [
            section_of_omissions(capture, options.steps, options.needed),
            section_of_parts(capture, options.steps),
            section_of_pinholes(capture),
            *([section_of_surplus(capture, options.steps)] if capture.folder in surplus else []),
        ]
        found[capture.name] = {key: value for figures, _ in sections for key, value in figures.items()}
        lines += [line for _, text in sections for line in text]
    if options.write:
        documents.save_text("plan", "\n".join(lines).rstrip() + "\n")
    print(json.dumps(found) if options.json else "\n".join(lines))


if __name__ == "__main__":
    main()
