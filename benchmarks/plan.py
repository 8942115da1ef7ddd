"""What the plan saves: trainings with all of its omissions and with none.

    python benchmarks/plan.py [CAPTURE ...] [--json] [--steps 1500] [--each] [--needed] [--write] [-- TRAIN OPTIONS]

Each is a training of its own, measured on the held-out views. `--each` also takes the omissions back one at a time;
`--needed` leaves out, one at a time, what the plan does, to see what it is needed for. Decisions that depend on what is
asked for apply with the options of `train` behind `--`, for instance `-- --primitive 2d --no-meshes`, or
`-- --only mug`. `--write` leaves the tables in docs/plan.md.
"""

from __future__ import annotations

import argparse
import functools
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks import shared  # noqa: E402

DEMO = ROOT / "build/demo/capture"
SAME_PSNR = 0.1
"""Within so many dB two trainings are equally good."""

_COLUMNS = (
    ("seconds", "seconds", "{:.0f}"), ("cpu_seconds", "of the processors", "{:.0f}"), ("train", "training", "{:.0f}"),
    ("peak_mb", "memory", "{:,.0f} MB"), ("psnr", "PSNR", "{:.2f} dB"), ("miou", "mIoU", "{:.4f}"),
    ("splats", "splats", "{:,}"),
)  # fmt: skip


def backend(*words: object) -> tuple[list[dict[str, Any]], float, float]:
    """Run a command; its events, and how long it took on the clock and on the processors."""
    before, started = os.times(), time.monotonic()
    done = subprocess.run(
        [sys.executable, "-m", "backend", *map(str, words), "--json"], cwd=ROOT, capture_output=True, text=True
    )
    if done.returncode:
        raise RuntimeError(done.stdout.splitlines()[-1] if done.stdout else done.stderr)
    seconds, after = time.monotonic() - started, os.times()
    busy = sum(after[2:4]) - sum(before[2:4])
    return [json.loads(line) for line in done.stdout.splitlines()], seconds, busy


def measured(capture: Path, options: list[str]) -> dict[str, Any]:
    """One training and its figures."""
    with tempfile.TemporaryDirectory(prefix="objectgs-benchmark-") as scratch:
        out = Path(scratch) / "out"
        events, seconds, busy = backend("train", capture, "--out", out, *options)
        quality = backend("evaluate", out)[0][-1]
        memory = json.loads((out / "objectgs.json").read_text())
        stages = {stage["name"]: stage for stage in memory["stages"]}
        return {
            "cpu_seconds": busy,
            "seconds": seconds,
            **{name: stages[name]["seconds"] for name in ("read", "vote", "train", "export") if name in stages},
            "peak_mb": stages["train"]["peak_rss_mb"],
            "psnr": quality.get("psnr"),
            "miou": quality.get("miou"),
            "steps": events[-1]["steps"],
            "splats": memory["export"]["splats"],
            "curve": [(event["seconds"], event["psnr"]) for event in events if event["type"] == "quality"],
        }


def trainings(capture: Path, options: list[str], each: bool, needed: bool) -> tuple[list[str], dict[str, list[str]]]:
    """What the plan leaves out, and what to train, by what is said of it: options that are added."""
    plan = backend("plan", capture, *options)[0][-1]["plan"]
    open_to_choice = [own for own in plan if own["can_override"]]
    left_out = [own["key"] for own in open_to_choice if own["done"] is False]
    found = {"as planned": [], "nothing left out": ["--keep", "all"]}
    if each and len(left_out) > 1:
        found |= {f"with {key}": ["--keep", key] for key in left_out}
    if needed:
        found |= {f"without {own['key']}": ["--leave-out", own["key"]] for own in open_to_choice if own["done"]}
    return left_out, found


def verdict(found: dict[str, dict[str, Any]]) -> str:
    """What the omissions save, and what they cost."""
    planned, whole = found["as planned"], found["nothing left out"]
    change = ", ".join(
        f"{abs(1 - planned[key] / whole[key]):.0%} {'less' if planned[key] <= whole[key] else 'more'} {name}"
        for key, name in (("seconds", "time"), ("cpu_seconds", "time of the processors"), ("peak_mb", "memory"))
    )
    text = f"As planned, as many steps take {change}"
    if planned["psnr"] is None:
        return f"{text}."
    gain = planned["psnr"] - whole["psnr"]
    text += f"; {gain:+.2f} dB{', worse' if gain < -SAME_PSNR else ', equal' if gain <= SAME_PSNR else ''}."
    if (sooner := as_good_after(planned, whole["psnr"])) is None:
        return text
    part = sooner / whole["seconds"]
    return f"{text} It is as good as with nothing left out after {sooner:.0f} s, {part:.0%} of the other's time."


def as_good_after(planned: dict[str, Any], psnr: float) -> float | None:
    """After how many seconds a training, and what came before it, was measured to be so good; None: never."""
    before = planned["seconds"] - planned["train"]
    return next((before + seconds for seconds, found in planned["curve"] if found >= psnr), None)


def section(capture: Path, left_out: list[str], found: dict[str, dict[str, Any]]) -> list[str]:
    """A capture's table, in Markdown."""

    def cells(row: dict[str, Any]) -> list[str]:
        return ["" if row.get(key) is None else form.format(row[key]) for key, _, form in _COLUMNS]

    head = ("", *(title for _, title, _ in _COLUMNS))
    rows = shared.table(head, ((name, *cells(row)) for name, row in found.items()))
    name = "demo" if capture == DEMO else capture.name
    title = f"## {name[0].upper()}{name[1:]}"
    return [title, "", f"Left out: {', '.join(left_out) or 'nothing'}.", "", *rows, "", verdict(found), ""]


def main() -> None:
    """Print the tables, or one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true")
    parser.add_argument("capture", type=Path, nargs="*", default=[DEMO])
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--each", action="store_true", help="also with each thing that the plan leaves out")
    parser.add_argument("--needed", action="store_true", help="also without each thing that the plan does")
    parser.add_argument("--write", action="store_true")
    words = sys.argv[1:]
    own, extra = (words[: words.index("--")], words[words.index("--") + 1 :]) if "--" in words else (words, [])
    options = parser.parse_args(own)
    captures = [capture.resolve() for capture in options.capture]
    whole: dict[str, Any] = {}
    lines = [
        "# What the plan saves",
        "",
        f"Made by `python benchmarks/plan.py CAPTURE ... --write`: trainings of {options.steps:,} steps on "
        f"{os.cpu_count()} processors, as planned and with nothing left out; quality on held-out views.",
        "",
    ]  # fmt: skip
    for capture in captures:
        left_out, wanted = trainings(capture, extra, options.each, options.needed)
        results = shared.Results(ROOT / "build" / "plan", shared.digest(shared.sources(), str(capture)), len(wanted))
        found = {}
        for name, more in wanted.items():
            train = ["--steps", str(options.steps), *extra, *more]
            found[name] = results.get(
                f"{capture} {' '.join(train)}",
                functools.partial(measured, capture, train),
                lambda row: f"{row['seconds']:.0f} s, {row['peak_mb']:.0f} MB, PSNR {row['psnr']}",
            )
        if results.failures:
            sys.exit("\n".join(results.failures.values()))
        whole[capture.name] = {"options": extra, "trainings": found}
        lines += section(capture, left_out, found)
    if options.write:
        (ROOT / "docs" / "plan.md").write_text("\n".join(lines).rstrip() + "\n")
    print(json.dumps(whole) if options.json else "\n".join(lines))


if __name__ == "__main__":
    main()
