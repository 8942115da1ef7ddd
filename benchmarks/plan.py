"""What the plan saves: trainings with all of its omissions and with none.

    python benchmarks/plan.py [CAPTURE] [--json] [--steps 1500 | --minutes 2] [--each] [--needed] [-- TRAIN OPTIONS]

Each is a training of its own, measured on the held-out views. `--each` also takes the omissions back one at a time;
`--needed` leaves out, one at a time, what the plan does, to see what it is needed for. Decisions that depend on what is
asked for apply with the options of `train` behind `--`, for instance `-- --primitive 2d --no-meshes`, or
`-- --only mug`.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
FIGURES = ("cpu_seconds", "seconds", "read", "vote", "train", "export", "peak_mb", "psnr", "miou", "steps", "splats")
SAME_PSNR = 0.1
"""What is left out must not cost more than this, in dB."""


def backend(*words: object) -> tuple[list[dict[str, Any]], float, float]:
    """Run a command; its events, and how long it took on the clock and on the processors."""
    before, started = os.times(), time.monotonic()
    done = subprocess.run(
        [sys.executable, "-m", "backend", *map(str, words), "--json"], cwd=ROOT, capture_output=True, text=True
    )
    if done.returncode:
        sys.exit(done.stdout.splitlines()[-1] if done.stdout else done.stderr)
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
        }


def trainings(capture: Path, options: list[str], each: bool, needed: bool) -> dict[str, list[str]]:
    """What to train, by what is said of it: options that are added."""
    plan = backend("plan", capture, *options)[0][-1]["plan"]
    open_to_choice = [own for own in plan if own["can_override"]]
    left_out = [own["key"] for own in open_to_choice if own["done"] is False]
    found = {"as planned": [], "nothing left out": ["--keep", "all"]}
    if each and len(left_out) > 1:
        found |= {f"with {key}": ["--keep", key] for key in left_out}
    if needed:
        found |= {f"without {own['key']}": ["--leave-out", own["key"]] for own in open_to_choice if own["done"]}
    return found


def main() -> None:
    """Print the table, or one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true")
    parser.add_argument("capture", type=Path, nargs="?", default=ROOT / "build/demo/capture")
    length = parser.add_mutually_exclusive_group()
    length.add_argument("--steps", type=int, default=1500)
    length.add_argument("--minutes", type=float)
    parser.add_argument("--each", action="store_true", help="also with each thing that the plan leaves out")
    parser.add_argument("--needed", action="store_true", help="also without each thing that the plan does")
    words = sys.argv[1:]
    own, extra = (words[: words.index("--")], words[words.index("--") + 1 :]) if "--" in words else (words, [])
    options = parser.parse_args(own)
    capture = options.capture.resolve()
    length_options = ["--minutes", str(options.minutes)] if options.minutes else ["--steps", str(options.steps)]
    found: dict[str, dict[str, Any]] = {}
    for name, more in trainings(capture, extra, options.each, options.needed).items():
        found[name] = measured(capture, [*length_options, *extra, *more])
        figures = ", ".join(f"{key} {found[name][key]}" for key in ("cpu_seconds", "peak_mb", "psnr", "miou"))
        print(f"{name}: {figures}", file=sys.stderr, flush=True)
    planned, whole = found["as planned"], found["nothing left out"]
    costs = None if planned["psnr"] is None else whole["psnr"] - planned["psnr"]
    if options.json:
        print(json.dumps({"capture": capture.name, "options": extra, "trainings": found, "psnr_lost": costs}))
        return
    width = max(map(len, found)) + 2
    print(" " * width + "".join(f"{name:>12s}" for name in FIGURES))
    for name, row in found.items():
        cells = (row.get(figure) for figure in FIGURES)
        print(f"{name:{width}s}" + "".join(" " * 12 if value is None else f"{value:12,.3f}" for value in cells))
    if costs is not None:
        verdict = "as good" if costs <= SAME_PSNR else "worse"
        print(f"What is left out costs {costs:+.2f} dB: {verdict} within {SAME_PSNR} dB.")


if __name__ == "__main__":
    main()
