"""Time that the panels and timers of the extension take in Blender's main thread.

A Blender with a window shows a reconstruction of many objects, and its sidebar is redrawn repeatedly. Measured is the
time in each panel's draw(), in the list's filter and rows, and in the timer that polls jobs; not the time in which
Blender draws what they describe, which depends on the graphics card.

    .venv/bin/python benchmarks/panels.py [--objects 60] [--splats 5000] [--redraws 40]
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
if str(ROOT) not in sys.path:
    sys.path.insert(0, str(ROOT))

from backend.export import write_splats
from backend.model.splats import Splats
from backend.shared.formats.points_ply import LabeledPoints, write_points
from tests.window import harness

PACKAGE = harness.PACKAGE
MEASURE = f"""
import sys, time
panels = sys.modules["{PACKAGE}.objectgs_addon.panels"]
background = sys.modules["{PACKAGE}.objectgs_addon.running.background"]
times = bpy.app.driver_namespace["times"] = {{}}
def record(name, call, *arguments):
    began = time.perf_counter()
    try:
        return call(*arguments)
    finally:
        times.setdefault(name, []).append(time.perf_counter() - began)
def drawing(name, call):
    # Blender passes as many arguments as the function has.
    def draw(self, context):
        return record(name, call, self, context)
    return draw
for cls in panels.CLASSES:
    for method in ("draw", "draw_header_preset"):
        if method in vars(cls):
            setattr(cls, method, drawing(f"{{cls.bl_idname}}.{{method}}", getattr(cls, method)))
rows, poll = panels.ObjectList.filter_items, background.queue.poll
def filter_items(self, context, data, name):
    return record("rows.filter", rows, self, context, data, name)
panels.ObjectList.filter_items = filter_items
background.queue.poll = lambda: record("queue.poll", poll)
"""
OPEN = """
import sys
bpy.ops.objectgs.open_reconstruction("EXEC_DEFAULT", directory={folder!r})
area = window_context()["area"]
area.spaces.active.show_region_ui = True
"""
REDRAW = """
for region in window_context()["area"].regions:
    if region.type == "UI":
        region.active_panel_category = "ObjectGS"
        region.tag_redraw()
"""


def write_reconstruction(folder: Path, objects: int, splats: int) -> None:
    """Write a reconstruction of `objects` balls with `splats` splats each."""
    rng = np.random.default_rng(0)
    count = objects * splats
    ids = np.repeat(np.arange(1, objects + 1), splats)
    centers = np.stack([np.arange(objects) % 8, np.arange(objects) // 8, np.zeros(objects)], 1)
    means = centers[ids - 1] + 0.15 * rng.normal(size=(count, 3))
    quats = np.tile([1.0, 0, 0, 0], (count, 1))
    sh = np.zeros((count, 1, 3))
    (folder / "images").mkdir(parents=True)
    write_splats(
        folder / "splats.ply",
        Splats(means.astype(np.float32), quats, np.full((count, 3), 0.01), np.full(count, 0.9), sh, ids),
    )
    points = means[::100]
    write_points(
        folder / "points.ply",
        LabeledPoints(
            points, np.full(points.shape, 128, np.uint8), ids[::100], np.ones(len(points)), np.ones(len(points), int)
        ),
    )
    camera = {
        "name": "0.png", "image": "images/0.png", "mask": None, "width": 640, "height": 480,
        "K": [[600.0, 0, 320], [0, 600.0, 240], [0, 0, 1]], "viewmat": np.eye(4).tolist(), "held_out": False,
    }  # fmt: skip
    upright = {"rotation": np.eye(3).tolist(), "translation": [0.0, 0, 0]}
    (folder / "cameras.json").write_text(
        json.dumps({"capture": str(folder), "origin": [0, 0, 0], "cameras": [camera], "upright": upright})
    )
    entries = [{"id": i, "name": f"object {i}", "color": [200, 3 * i, 10], "points": 1} for i in range(1, objects + 1)]
    (folder / "objects.json").write_text(json.dumps({"edits": {}, "objects": entries}))


def main() -> None:
    """Measure, and print a table of milliseconds."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--objects", type=int, default=60)
    parser.add_argument("--splats", type=int, default=5000)
    parser.add_argument("--redraws", type=int, default=40)
    options = parser.parse_args()
    found = harness.blenders()
    if not found:
        raise SystemExit("No Blender with a window was found; set OBJECTGS_BLENDER to one of version 4.2 or newer.")
    archive = max((ROOT / "build").glob("objectgs-*.zip"), key=lambda path: path.stat().st_mtime)
    for name, (command, variables) in found.items():
        with tempfile.TemporaryDirectory(prefix="objectgs-benchmark-") as scratch:
            folder = Path(scratch) / "reconstruction"
            write_reconstruction(folder, options.objects, options.splats)
            blender = harness.Blender(command, variables, Path(scratch) / "blender", Path(scratch) / "shots")
            try:
                blender.wait_for("True", timeout=120)
                blender.install(archive, Path(sys.executable))
                blender.run(OPEN.format(folder=str(folder)), timeout=120)
                blender.run(REDRAW)
                blender.run(MEASURE)
                for _ in range(options.redraws):
                    blender.run(REDRAW, timeout=120)
                times = blender.run("result = bpy.app.driver_namespace['times']")
            finally:
                blender.close()
        print(f"Blender {name}: {options.objects} objects of {options.splats:,} splats, milliseconds a call")
        print(f"{'':45} {'median':>8} {'maximum':>8} {'calls':>6}")
        for what, seconds in sorted(times.items(), key=lambda pair: -np.median(pair[1])):
            print(f"{what:45} {1000 * np.median(seconds):8.2f} {1000 * max(seconds):8.2f} {len(seconds):6}")


if __name__ == "__main__":
    main()
