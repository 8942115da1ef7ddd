# SPDX-License-Identifier: GPL-3.0-or-later
"""Training in several processes on one machine against one: quality at the same number of steps, and time.

Each row is a whole `train`, of which the time of training alone is compared. A step is a view, whatever the number of
processes. The cores are shared out: processes on a machine with few cores cannot be faster.

    python benchmarks/processes.py CAPTURE [CAPTURE ...] [--steps 2000] [--processes 1 2 4] [--seeds 0] [--device cpu]
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
if str(ROOT) not in sys.path:
    sys.path.insert(0, str(ROOT))

from backend.commands.setup.machine import cores
from benchmarks.shared import spread, table


def main() -> None:
    """Measure, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="+", type=Path, metavar="CAPTURE")
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--processes", nargs="+", type=int, default=[1, 2, 4])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args()
    rows = []
    for capture in options.captures:
        found: dict[int, list[dict[str, Any]]] = {}
        for count in options.processes:
            found[count] = [measure(capture, count, options.steps, seed, options.device) for seed in options.seeds]
        alone = found[options.processes[0]]
        for count, runs in found.items():
            speed = [one["seconds"] / run["seconds"] for one, run in zip(alone, runs, strict=True)]
            change = [run["psnr"] - one["psnr"] for one, run in zip(alone, runs, strict=True)]
            rows.append(
                [
                    capture.name if capture.name != "capture" else capture.parent.name, str(count),
                    spread([run["psnr"] for run in runs], "{:.2f}"), spread(change, "{:+.2f}"),
                    spread([run["miou"] for run in runs], "{:.4f}"), spread([run["seconds"] for run in runs], "{:.0f}"),
                    spread(speed, "{:.2f}"),
                ]
            )  # fmt: skip
            print(rows[-1], file=sys.stderr, flush=True)
    head = ["capture", "processes", "PSNR, dB", "change, dB", "mIoU", "training, s", "speed-up"]
    print(f"{options.steps:,} steps, {options.device}, {cores()} cores", *table(head, rows), sep="\n")


def measure(capture: Path, count: int, steps: int, seed: int, device: str) -> dict[str, Any]:
    """Train on a capture, and return the quality on its held-out views and the seconds of training."""
    launcher = [] if count == 1 else ["-m", "torch.distributed.run", "--nproc-per-node", str(count)]
    with tempfile.TemporaryDirectory() as out:
        words = ["-m", "backend", "train", str(capture), "--out", out, "--steps", str(steps), "--seed", str(seed)]
        done = subprocess.run(
            [sys.executable, *launcher, *words, "--device", device, "--json"], cwd=ROOT, capture_output=True, text=True
        )
        if done.returncode:
            sys.exit(done.stderr or done.stdout)
        lines = [json.loads(line) for line in done.stdout.splitlines() if line.startswith('{"type": "done"')]
        return dict(lines[-1])


if __name__ == "__main__":
    main()
