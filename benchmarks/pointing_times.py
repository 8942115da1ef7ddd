"""Seconds that objects by strokes take over the number of splats: graph, first solution, and update.

    python benchmarks/pointing_times.py DIR [--copies 1 7]

DIR is a reconstruction whose capture has masks of all its objects, as that of `make demo`. One stroke marks each object
in two photos, as in `benchmarks/pointing.py`; the update is that of the last stroke, the median of five. With n copies,
each splat becomes n smaller ones at random places within it.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from backend.capture import load_capture
from backend.model.generate import Generated
from backend.pointing import strokes as strokes_file
from benchmarks import shared
from benchmarks.pointing import open_splats, strokes_of

UPDATES = 5


def multiplied(splats: Generated, copies: int) -> Generated:
    """Return splats each of which is replaced by smaller ones at random places within it."""
    if copies == 1:
        return splats
    parts = [each.repeat_interleave(copies, 0) for each in splats.only_valid()[:7]]
    generator = torch.Generator().manual_seed(0)
    shrunk = parts[2] / copies ** (1 / 3)
    places = torch.randn(parts[2].shape, generator=generator) * parts[2] * (1 - copies ** (-2 / 3)) ** 0.5
    w, axis = torch.nn.functional.normalize(parts[1], dim=1).split((1, 3), 1)
    turn = 2 * torch.linalg.cross(axis, places)
    parts[0] = parts[0] + places + w * turn + torch.linalg.cross(axis, turn)
    parts[2] = shrunk
    return Generated(*parts)


def main() -> None:
    """Measure, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--copies", type=int, nargs="+", default=[1, 7])
    options = parser.parse_args()
    shared.compile_everything()
    opened = open_splats(options.folder)
    assert opened.capture is not None
    truth = load_capture(opened.capture.folder, opened.folder.cache)
    drawn = json.loads(json.dumps(strokes_of(truth, 2)))
    strokes = strokes_file.strokes_of(drawn, "the truth", opened.views.names)
    rows = []
    for copies in options.copies:
        splats = multiplied(opened.splats, copies)
        started = time.perf_counter()
        pointer = opened._replace(splats=splats).pointer(lambda _done, _total: None)
        graph = time.perf_counter() - started
        fewer = replace(strokes, strokes=strokes.strokes[:-1])
        pointer.solve(fewer)  # What the strokes show is kept.
        seconds: dict[str, list[float]] = {"first": [], "update": []}
        for _ in range(UPDATES):
            pointer._latest = None
            for name, drawn in (("first", fewer), ("update", strokes)):
                started = time.perf_counter()
                pointer.solve(drawn)
                seconds[name].append(time.perf_counter() - started)
        first, update = (f"{np.median(seconds[name]):.2f}" for name in ("first", "update"))
        rows.append((f"{len(splats.means):,}", f"{graph:.0f}", first, update))
    print("\n".join(shared.table(("splats", "graph", "first solution", "update"), rows)))


if __name__ == "__main__":
    main()
