"""Compare plain splats with the modes of the heads on one capture, in equal time or equal steps.

    python benchmarks/modes.py [--json] [--capture build/demo/capture] [--seconds 150 | --steps 600]

`plain` is the same pipeline with the heads disabled: every splat has its own color, opacity, scale and rotation, as in
3D Gaussian splatting. Quality is measured on the held-out views.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path

import numpy as np
import torch

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from backend.capture import load_capture
from backend.labels import vote
from backend.training.budget import Budget
from backend.training.settings import Settings
from backend.training.trainer import Trainer
from benchmarks.shared import train_and_measure

VARIANTS = ("plain", "explicit", "view", "paper")


def train(capture, ids: np.ndarray, variant: str, budget: Budget) -> dict:
    """Train one variant and measure it."""
    mode = "explicit" if variant == "plain" else variant
    trainer = Trainer.start(capture, ids, Settings(mode=mode))
    if variant == "plain":
        silence(trainer)
    return train_and_measure(trainer, capture, budget)


def silence(trainer: Trainer) -> None:
    """Zero and freeze the heads, and initialize the splats with random rotations instead."""
    heads, anchors = trainer.model.heads, trainer.model.anchors
    with torch.no_grad():
        for layer in (heads.opacity, heads.shape, heads.color):
            layer.weight.zero_()
    for parameter in heads.parameters():
        parameter.requires_grad_(False)
    columns = anchors.layout.shape_columns
    shape = anchors.rows[:, columns].shape
    turned = np.random.default_rng(1).normal(0, 0.3, shape).astype(np.float32)
    anchors.rows[:, columns] += torch.from_numpy(turned)


def main() -> None:
    """Print the table, or one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--capture", type=Path, default=ROOT / "build/demo/capture")
    length = parser.add_mutually_exclusive_group()
    length.add_argument("--seconds", type=float)
    length.add_argument("--steps", type=int)
    options = parser.parse_args()
    budget = Budget(options.steps, None if options.steps else options.seconds or 150.0)
    with tempfile.TemporaryDirectory(prefix="objectgs-benchmark-") as cache:
        capture = load_capture(options.capture, Path(cache))
        ids = vote(capture).ids if capture.has_masks else np.zeros(len(capture.points.xyz), np.int64)
        found = {variant: train(capture, ids, variant, budget) for variant in VARIANTS}
    if options.json:
        print(json.dumps(found))
        return
    columns = tuple(next(iter(found.values())))
    print("variant   " + "".join(f"{name:>17s}" for name in columns))
    for variant, row in found.items():
        print(
            f"{variant:10s}" + "".join(f"{row[name]:17,.4f}" if row[name] is not None else " " * 17 for name in columns)
        )


if __name__ == "__main__":
    main()
