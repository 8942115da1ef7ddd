# SPDX-License-Identifier: GPL-3.0-or-later
"""Runs inside a Blender with a window: executes the scripts that a test leaves in a folder, one after another.

    blender --python driver.py -- FOLDER

FOLDER/<n>.py is executed in the main thread, from a timer, as a user's own action would be: it may write even where
Blender forbids that to timers. The value of its variable `result` comes back as FOLDER/<n>.json, or the traceback if
it fails.
"""

import json
import sys
import traceback
from pathlib import Path

import bpy

FOLDER = Path(sys.argv[sys.argv.index("--") + 1])
_next = 1


def window_context():
    """The first window with its largest 3D viewport, for operators that need one."""
    window = bpy.context.window_manager.windows[0]
    areas = [area for area in window.screen.areas if area.type == "VIEW_3D"]
    if not areas:
        return {"window": window}
    area = max(areas, key=lambda area: area.width * area.height)
    region = next(region for region in area.regions if region.type == "WINDOW")
    return {"window": window, "area": area, "region": region}


def _execute(script: Path) -> dict:
    names = {"bpy": bpy, "window_context": window_context, "result": None}
    try:
        exec(compile(script.read_text(encoding="utf-8"), str(script), "exec"), names)
        return {"result": names["result"]}
    except BaseException:
        return {"error": traceback.format_exc()}


def _look() -> float:
    # What Blender calls to read a property may write.
    return bpy.data.window_managers[0].driver_look


def _execute_next(_manager) -> float:
    global _next
    script = FOLDER / f"{_next}.py"
    if script.exists():
        answer = _execute(script)
        part = FOLDER / f"{_next}.part"
        part.write_text(json.dumps(answer), encoding="utf-8")
        part.rename(FOLDER / f"{_next}.json")
        _next += 1
    return 0.05


bpy.types.WindowManager.driver_look = bpy.props.FloatProperty(get=_execute_next)
bpy.app.timers.register(_look, first_interval=0.5, persistent=True)
