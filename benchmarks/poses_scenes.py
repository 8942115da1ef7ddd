"""Photos of `benchmarks/poses.py` with exact poses: a walk, a turntable, a panorama, and many large photos.

    .venv-bpy/bin/python benchmarks/poses_scenes.py OUT [NAME ...]

Makes OUT/NAME/capture, with the layout of the demo capture; what is there already is kept.
"""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks import suite_scenes
from benchmarks.suite_scenes import Stage, scene

SEED = 300
SIZE, LARGE = (640, 480), (1000, 750)


def walk(seed: int) -> Stage:
    """The frames of a film: 15 seconds around a room, looking at its walls."""
    stage = suite_scenes.room(seed)
    views = []
    for i in range(225):
        along = i / 225
        angle = 2 * math.pi * along
        center = np.array([-0.75 * math.cos(angle), -0.5 * math.sin(angle), 0.25 + 0.25 * math.sin(3 * angle)])
        center += 0.01 * np.array([math.sin(1.3 * i), math.cos(1.1 * i), math.sin(0.9 * i)])
        target = np.array([1.7 * math.cos(angle), 1.4 * math.sin(angle), -0.3])
        views.append(scene.look_at(i, center, target))
    return stage._replace(views=views)


def turntable(seed: int) -> Stage:
    """Objects on a turning table, 5 degrees apart; `benchmarks/poses.py` adds the background at rest."""
    built, objs = suite_scenes.things(("mug", "bottle", "books", "teapot", "gear"), seed)
    rng = scene.rng_for(seed, 11)
    for obj, (x, y) in zip(objs, suite_scenes.ring(len(objs), 0.24, rng), strict=True):
        suite_scenes.place(obj, (x, y, 0.0), float(rng.uniform(0, 2 * math.pi)), 1.0)
    suite_scenes.add(built, objs, "table", suite_scenes.shapes.table(0.4), [suite_scenes.materials.table], seed)
    views = []
    for i in range(72):
        angle = 2 * math.pi * i / 72
        views.append(scene.look_at(i, np.array([1.1 * math.cos(angle), 1.1 * math.sin(angle), 0.55]), np.zeros(3)))
    return Stage(built, objs, views)


def panorama(seed: int) -> Stage:
    """A room from one spot."""
    stage = suite_scenes.room(seed)
    views = []
    for i in range(24):
        angle = 2 * math.pi * i / 24
        target = np.array([1.7 * math.cos(angle), 1.4 * math.sin(angle), -0.3])
        views.append(scene.look_at(i, np.array([0.0, 0.0, 0.3]), target))
    return stage._replace(views=views)


def large(seed: int) -> Stage:
    """200 photos of 24 objects on a table, from two rings around it."""
    built, objs = scene.build(24, seed)
    return Stage(built, objs, scene.cameras(200, seed))


SCENES = {make.__name__: make for make in (walk, turntable, panorama, large)}


def main() -> None:
    """Make the captures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("names", nargs="*", metavar="NAME")
    options = parser.parse_args()
    for name in options.names or SCENES:
        size, samples = (LARGE, 4) if name == "large" else (SIZE, 8)
        suite_scenes.make_stage(SCENES[name], options.out / name / "capture", SEED, samples=samples, size=size)


if __name__ == "__main__":
    main()
