"""Variants of the training, each in a process beside the default's, so that both run under the same load.

A host's speed can change by a third within minutes, but the ratio of two trainings that run at the same time, each on
its own core, stays the same. The results do not depend on the clock: a training with a fixed number of steps is
bit-identical at any speed.
"""

from __future__ import annotations

import math
import multiprocessing
import os
from collections.abc import Iterable, Mapping, Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from benchmarks import shared

FIGURES = ("psnr", "miou")
"""Figures by which trainings are compared; higher is better."""


def side_by_side(spec: Mapping[str, Any], capture: str, cache: str, steps: int, seeds: Sequence[int]) -> dict[str, Any]:
    """Train a variant beside the default, each on its own core.

    Args:
        spec: the variant, see `change`.
        seeds: (seed of the variant, seed of the default).

    Returns:
        The figures of both as `variant` and `default`, and `times_default`: the variant's time relative to the
        default's.

    Raises:
        RuntimeError: a training ended without a result.
    """
    context = multiprocessing.get_context("spawn")
    children: list[tuple[Any, Connection]] = []
    try:
        for core, own, seed in ((0, spec, seeds[0]), (1, {}, seeds[1])):
            mine, its = context.Pipe()
            child = context.Process(
                target=_train, args=(its, core, dict(own), capture, cache, steps, seed), daemon=True
            )
            child.start()
            its.close()
            children.append((child, mine))
            _received(mine)  # wait until it is ready, so that the next process finds the capture in the cache
        for _, pipe in children:
            pipe.send("go")
        variant, default = (_received(pipe) for _, pipe in children)
    finally:
        for child, _ in children:
            child.kill()
            child.join()
    seconds = [row["steps"] / row["steps_per_second"] for row in (variant, default)]
    return {"variant": variant, "default": default, "times_default": seconds[0] / seconds[1]}


def _received(pipe: Connection) -> Any:
    try:
        return pipe.recv()
    except EOFError:
        raise RuntimeError("a training exited without output; its last messages are above") from None


def _train(pipe: Connection, core: int, spec: dict[str, Any], capture: str, cache: str, steps: int, seed: int) -> None:
    """Train in a child process after the `go` message, send the figures, and keep the core busy until killed.

    Otherwise, the other training would speed up at its end.
    """
    if hasattr(os, "sched_setaffinity"):
        cores = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {cores[core % len(cores)]})
    import numpy as np

    from backend.capture import load_capture
    from backend.commands.setup.machine import set_threads
    from backend.labels import vote
    from backend.raster import compile_kernels
    from backend.training.budget import Budget
    from backend.training.settings import Settings
    from backend.training.trainer import Trainer

    set_threads(1)
    compile_kernels()
    change(spec)
    loaded = load_capture(Path(capture), Path(cache))
    ids = vote(loaded).ids if loaded.has_masks else np.zeros(len(loaded.points.xyz), np.int64)
    trainer = Trainer.start(loaded, ids, Settings(seed=seed, **spec.get("settings", {})))
    pipe.send("ready")
    pipe.recv()
    pipe.send(shared.train_and_measure(trainer, loaded, Budget(steps=steps)))
    while True:
        np.sort(np.random.default_rng(0).random(10**6))


def change(spec: Mapping[str, Any]) -> None:
    """Apply a variant to this process, except its `settings`, which are passed to `Settings`."""
    import torch

    from backend.training import growth_strategy, step, trainer

    if "grow_every" in spec:
        shared.replace(growth_strategy, "growth_interval", lambda step: spec["grow_every"])
    if "pyramid" in spec:
        sizes = spec["pyramid"]
        shared.replace(step, "downscale_at", lambda done, *_: next((by for until, by in sizes if done < until), 1))
    if spec.get("dense_adam"):

        def step_all(values, exp_avg, exp_avg_sq, seen, gradients, *others):
            everything = torch.zeros_like(values)
            everything[seen] = gradients
            return step_rows(values, exp_avg, exp_avg_sq, torch.arange(len(values)), everything, *others)

        step_rows = shared.replace(trainer, "step_rows", step_all)


def curve_of(rows: Iterable[Mapping[str, Any]]) -> dict[int, dict[str, float]]:
    """Return the default's figures by number of steps in ascending order, as means over seeds."""
    by_steps: dict[int, list[Mapping[str, Any]]] = {}
    for row in rows:
        by_steps.setdefault(row["steps"], []).append(row)
    return {
        steps: {name: sum(row[name] for row in found) / len(found) for name in FIGURES}
        for steps, found in sorted(by_steps.items())
    }


def in_time(curve: Mapping[int, Mapping[str, float]], steps: float) -> dict[str, float]:
    """Interpolate the default's figures at a number of steps, linearly in the logarithm of the steps.

    Raises:
        ValueError: the curve does not cover this number of steps.
    """
    known = sorted(curve)
    if not known[0] <= steps <= known[-1]:
        raise ValueError(f"{steps:.0f} steps of the default lie outside of its curve of {known[0]} to {known[-1]}.")
    later = next(at for at in known if at >= steps)
    earlier = max((at for at in known if at <= steps), default=later)
    if later == earlier:
        return dict(curve[later])
    part = math.log(steps / earlier) / math.log(later / earlier)
    return {name: (1 - part) * curve[earlier][name] + part * curve[later][name] for name in FIGURES}
