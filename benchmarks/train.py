"""Time of a training step by part, on the demo capture with 40,000 splats at its own resolution.

    python benchmarks/train.py [--json] [--capture build/demo/capture] [--splats 40000] [--steps 60]

The model is trained briefly first, so that splats have realistic sizes.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from backend.capture import load_capture
from backend.labels import vote
from backend.model.anchors import median_spacing
from backend.training import step
from backend.training.settings import Settings
from backend.training.trainer import Trainer

PARTS = ("raster", "heads", "loss", "optimizer")


class Stopwatch:
    """Timer that sums up the seconds spent in wrapped functions, by part."""

    def __init__(self) -> None:
        self.seconds = dict.fromkeys(PARTS, 0.0)

    def wrap(self, owner: object, name: str, part: str) -> None:
        """Replace `owner.name` with a version that is timed as `part`."""
        inner = getattr(owner, name)

        def timed(*arguments, **options):
            started = time.perf_counter()
            try:
                return inner(*arguments, **options)
            finally:
                self.seconds[part] += time.perf_counter() - started

        setattr(owner, name, timed)


def trainer_of(folder: Path, splats: int) -> Trainer:
    """Return a warmed-up trainer with about `splats` splats; smaller anchor cells are used if there are too few."""
    capture = load_capture(folder, Path(tempfile.mkdtemp(prefix="objectgs-benchmark-")))
    ids = vote(capture).ids if capture.has_masks else np.zeros(len(capture.points.xyz), np.int64)
    for fineness in (1.0, 0.6, 0.3):
        trainer = Trainer.start(capture, ids, Settings(voxel=fineness * median_spacing(capture.points.xyz)))
        for done in range(450):
            trainer.step(0.15 + 0.45 * done / 450)
        if trainer.splats >= splats:
            break
    anchors = trainer.model.anchors
    keep = min(1.0, splats / max(trainer.splats, 1))
    chosen = np.sort(np.random.default_rng(0).permutation(len(anchors))[: round(keep * len(anchors))])
    anchors.positions, anchors.rows, anchors.ids = anchors.positions[chosen], anchors.rows[chosen], anchors.ids[chosen]
    trainer.optimizer.rows.take(torch.from_numpy(chosen), 0)
    trainer.optimizer.average.take(torch.from_numpy(chosen), anchors.rows[:0])
    for done in range(60):
        trainer.step(0.7 + 0.001 * done)
    return trainer


def measure(trainer: Trainer, steps: int) -> dict:
    """Measure the median time of a step in ms, and the share of each part."""
    from backend.model.generate_on_cpu import Generate
    from backend.raster import _Rasterize
    from backend.training.losses.on_cpu import _ImageLoss
    from backend.training.optimizer.model_optimizer import ModelOptimizer

    watch = Stopwatch()
    watch.wrap(step, "rasterize", "raster")
    watch.wrap(_Rasterize, "backward", "raster")
    watch.wrap(step, "image_loss", "loss")
    watch.wrap(_ImageLoss, "backward", "loss")
    watch.wrap(step, "generate", "heads")
    watch.wrap(Generate, "backward", "heads")
    watch.wrap(ModelOptimizer, "update", "optimizer")
    # The backward pass of the heads' layers is the time of autograd outside the functions above.
    whole = {"seconds": 0.0}
    inner = torch.Tensor.backward

    def timed_backward(self, *arguments, **options):
        before = sum(watch.seconds.values())
        started = time.perf_counter()
        inner(self, *arguments, **options)
        whole["seconds"] += time.perf_counter() - started - (sum(watch.seconds.values()) - before)

    torch.Tensor.backward = timed_backward
    times = []
    for _ in range(steps):
        started = time.perf_counter()
        trainer.step(0.7)
        times.append(time.perf_counter() - started)
    torch.Tensor.backward = inner
    total = sum(times)
    seconds = {**watch.seconds, "heads": watch.seconds["heads"] + whole["seconds"]}
    shares = {part: seconds[part] / total for part in PARTS}
    shares["other"] = 1 - sum(shares.values())
    return {
        "step_ms": 1e3 * float(np.median(times)),
        "step_ms_quartiles": [1e3 * float(np.quantile(times, q)) for q in (0.25, 0.75)],
        "steps_per_second": 1 / float(np.median(times)),
        "splats": trainer.splats,
        "anchors": len(trainer.model.anchors),
        "threads": torch.get_num_threads(),
        "shares": shares,
    }


def main() -> None:
    """Print the table, or one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--capture", type=Path, default=ROOT / "build/demo/capture")
    parser.add_argument("--splats", type=int, default=40_000)
    parser.add_argument("--steps", type=int, default=60)
    options = parser.parse_args()
    found = measure(trainer_of(options.capture, options.splats), options.steps)
    if options.json:
        print(json.dumps(found))
        return
    print(f"{found['splats']:,} splats of {found['anchors']:,} anchors, {found['threads']} threads")
    low, high = found["step_ms_quartiles"]
    print(
        f"step {found['step_ms']:.1f} ms (quartiles {low:.1f} to {high:.1f}): {found['steps_per_second']:.1f} steps/s"
    )
    for part, share in found["shares"].items():
        print(f"{part:10s} {share:6.1%}  {share * found['step_ms']:6.1f} ms")


if __name__ == "__main__":
    main()
