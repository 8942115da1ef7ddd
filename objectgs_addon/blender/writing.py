# SPDX-License-Identifier: GPL-3.0-or-later
"""Write access to Blender's data from timers and handlers, including cases where Blender wrongly denies it.

Blender denies Python write access to its data while it draws; Blender 4 uses one flag for all threads. If a render by
Cycles, or by another Python render engine, starts while Blender draws, the end of the render restores the flag to
"denied". From then on, all writes by timers and handlers fail ("Writing to ID classes in this context is not allowed")
until Blender is closed. Property getters can always write, so such a getter calls the functions.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from threading import local
from typing import Any

import bpy
from bpy.props import BoolProperty


class _Waiting(local):
    """Pending calls of one thread; renders update the scene in a separate thread."""

    def __init__(self) -> None:
        self.calls: list[Callable[[], None]] = []


_waiting = _Waiting()


def allowed(function: Callable) -> Callable:
    """Decorate a timer or handler so that it can write to Blender's data."""

    @wraps(function)
    def wrapper(*arguments: Any) -> Any:
        found = []

        def call() -> None:
            try:
                found.append((function(*arguments), None))
            except BaseException as error:
                found.append((None, error))

        _waiting.calls.append(call)
        _ = bpy.data.window_managers[0].objectgs_may_write
        value, error = found[0]
        if error is not None:
            raise error
        return value

    return wrapper


def later(function: Callable[[], None], seconds: float) -> None:
    """Call a function once nothing has asked for it for some seconds; without a window at once."""
    if bpy.app.background:
        function()
        return
    if bpy.app.timers.is_registered(function):
        bpy.app.timers.unregister(function)
    bpy.app.timers.register(function, first_interval=seconds)


def _call(_manager: Any) -> bool:
    _waiting.calls.pop()()
    return True


def register() -> None:
    bpy.types.WindowManager.objectgs_may_write = BoolProperty(get=_call, options={"HIDDEN", "SKIP_SAVE"})


def unregister() -> None:
    del bpy.types.WindowManager.objectgs_may_write
