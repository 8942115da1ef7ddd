# SPDX-License-Identifier: GPL-3.0-or-later
"""Driver inside a Blender with a window: executes the scripts that a test writes to a folder, one after another.

    blender --python driver.py -- FOLDER

FOLDER/<n>.py is executed in the main thread, from a timer, but with the permissions of a user's action: it can write
data that timers must not write. The value of its variable `result`, or the traceback of its failure, is written to
FOLDER/<n>.json.
"""

import json
import sys
import traceback
from pathlib import Path

import bpy

FOLDER = Path(sys.argv[sys.argv.index("--") + 1])
_next = 1


def window_context():
    """Return the context of the first window and its largest 3D viewport, for operators that require one."""
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


def _poll() -> float:
    # Unlike a timer, the getter of a property may write.
    return bpy.data.window_managers[0].driver_poll


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


bpy.types.WindowManager.driver_poll = bpy.props.FloatProperty(get=_execute_next)
bpy.app.timers.register(_poll, first_interval=0.5, persistent=True)
