"""Time that Blender's main thread is blocked during training and while a result is shown.

A timer inside a Blender with a window should tick every 10 ms; its longest gap is the delay that the user notices.
Requires a Blender that tests/window can drive, the extension's zip (make zip) and a capture. "Undrawn" is the same
training without drawing the panels, which takes most of the time on a machine without a graphics card. "Blender's own"
is the delay without this extension: the sidebar is redrawn as often, with Blender's own tab, first idle and then while
the same training runs outside Blender at the same low priority.

    .venv/bin/python benchmarks/window.py build/demo/capture [--json]
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tests.window import harness

PACKAGE = "bl_ext.user_default.objectgs"
NAMES = f"""
from {PACKAGE}.objectgs_addon import scene
from {PACKAGE}.objectgs_addon.running import background
owner = bpy.context.scene
root = owner.objectgs.active
"""
START = """
import time
gaps = bpy.app.driver_namespace["gaps"] = []
bpy.app.driver_namespace["last"] = time.perf_counter()
def tick():
    now = time.perf_counter()
    gaps.append(now - bpy.app.driver_namespace["last"])
    bpy.app.driver_namespace["last"] = now
    return 0.01
bpy.app.driver_namespace["tick"] = tick
bpy.app.timers.register(tick)
"""
BEGUN = (
    "background.queue.running is not None and background.queue.running.step and background.queue.running.progress < 0.8"
)
DRAW_OWN = """
for region in window_context()['area'].regions:
    if region.type == 'UI':
        region.active_panel_category = 'View'
def draw():
    running_redraw()
    return 1.0
running_redraw = background.redraw
bpy.app.driver_namespace["draw"] = draw
bpy.app.timers.register(draw)
"""
STOP = """
bpy.app.timers.unregister(bpy.app.driver_namespace["tick"])
gaps = sorted(bpy.app.driver_namespace["gaps"])
result = {"ticks": len(gaps), "median_ms": 1000 * gaps[len(gaps) // 2], "p99_ms": 1000 * gaps[int(0.99 * len(gaps))],
          "longest_ms": 1000 * gaps[-1]}
"""


def measure(
    name: str, command, variables, capture: Path, archive: Path, seconds: float, size
) -> dict[str, dict[str, float]]:
    """Measure the timer's gaps in one Blender: at rest, during training, and for Blender on its own."""
    folder = Path(tempfile.mkdtemp(prefix="objectgs-window-"))
    blender = harness.Blender(command, variables, folder, folder / "shots", size)
    found: dict[str, dict[str, float]] = {}
    try:
        blender.wait_for("True", timeout=120)
        blender.install(archive, Path(sys.executable))
        blender.run("window_context()['area'].spaces.active.show_region_ui = True")
        time.sleep(2)
        blender.run(
            "for region in window_context()['area'].regions:\n"
            "    if region.type == 'UI':\n"
            "        region.active_panel_category = 'ObjectGS'"
        )
        time.sleep(2)
        blender.run(START)
        time.sleep(10)
        found["at rest"] = blender.run(STOP)
        blender.run(
            NAMES + f"bpy.ops.objectgs.import_capture(directory={str(capture)!r}, folder={str(folder / 'out')!r})"
        )
        wait(blender, "owner.objectgs.active is not None")
        blender.run(NAMES + f"root.objectgs.minutes = {seconds / 60}; bpy.ops.objectgs.train()")
        wait(blender, BEGUN)
        blender.run(START)
        wait(blender, "background.queue.running is None or background.queue.running.progress > 0.9", 1.0)
        found["training"] = blender.run(STOP)
        wait(blender, "background.queue.running is None")
        blender.run(NAMES + f"root.objectgs.minutes = {2 * seconds / 60}; bpy.ops.objectgs.train()")
        wait(blender, BEGUN)
        blender.run(NAMES + "background.shown, background.redraw = background.redraw, lambda: None")
        blender.run(START)
        wait(blender, "background.queue.running is None or background.queue.running.progress > 0.9", 1.0)
        found["training, undrawn"] = blender.run(STOP)
        wait(blender, "background.queue.running is None")
        blender.run(NAMES + "background.redraw = background.shown")
        blender.run(NAMES + DRAW_OWN)
        time.sleep(10)  # wait until the result of the previous training is shown
        blender.run(START)
        time.sleep(10)
        found["Blender's own, no training"] = blender.run(STOP)
        outside = train_outside(capture, folder / "outside", seconds)
        time.sleep(10)  # wait until the training has read the capture
        blender.run(START)
        while outside.poll() is None:
            time.sleep(1)
        found["Blender's own"] = blender.run(STOP)
    finally:
        blender.close()
    return found


def train_outside(capture: Path, folder: Path, seconds: float) -> subprocess.Popen:
    """Start the same training as the extension does, outside Blender."""
    command = [sys.executable, "-m", "backend", "train", str(capture), "--out", str(folder), "--minutes"]
    return subprocess.Popen(
        [*command, str(seconds / 60)], cwd=harness.ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        process_group=0, preexec_fn=lambda: os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0)),
    )  # fmt: skip


def wait(blender: harness.Blender, expression: str, interval: float = 0.5) -> None:
    """Wait until an expression is true inside Blender."""
    for _ in range(1000):
        if blender.run(NAMES + f"result = bool({expression})"):
            return
        time.sleep(interval)
    raise harness.Failed(f"condition timed out: {expression}")


def main() -> None:
    """Measure in every installed Blender."""

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--seconds", type=float, default=60.0, help="length of the training")
    parser.add_argument("--size", type=int, nargs=2, default=harness.SIZE, help="pixels of the window")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    archive = max((harness.ROOT / "build").glob("objectgs-*.zip"), key=lambda path: path.stat().st_mtime)
    results = {
        name: measure(name, *how, options.capture.resolve(), archive, options.seconds, tuple(options.size))
        for name, how in harness.blenders().items()
    }
    if options.json:
        print(json.dumps(results))
        return
    for name, found in results.items():
        for when, gaps in found.items():
            print(
                f"Blender {name}, {when}: longest {gaps['longest_ms']:.0f} ms, 99 % below {gaps['p99_ms']:.0f} ms, "
                f"median {gaps['median_ms']:.0f} ms of {gaps['ticks']:.0f} ticks"
            )


if __name__ == "__main__":
    main()
