# SPDX-License-Identifier: GPL-3.0-or-later
"""Writing to Blender's data from timers and handlers, also where Blender wrongly forbids it.

Blender forbids Python to write to its data while it draws; Blender 4 does so with one flag for all threads. When a
render by Cycles, or by another engine in Python, starts while Blender draws, the flag is restored to "forbidden" at the
end of the render. From then on, all writing by timers and handlers fails ("Writing to ID classes in this context is not
allowed") until Blender is closed. The getter of a property may always write, so functions are called by such a getter.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from threading import local
from typing import Any

import bpy
from bpy.props import BoolProperty


class _Waiting(local):
    """The pending calls of one thread; renders update the scene in a thread of their own."""

    def __init__(self) -> None:
        self.calls: list[Callable[[], None]] = []


_waiting = _Waiting()


def allowed(function: Callable) -> Callable:
    """Decorate a timer or handler, so that it may write to Blender's data."""

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


def _call(_manager: Any) -> bool:
    _waiting.calls.pop()()
    return True


def register() -> None:
    bpy.types.WindowManager.objectgs_may_write = BoolProperty(get=_call, options={"HIDDEN", "SKIP_SAVE"})


def unregister() -> None:
    del bpy.types.WindowManager.objectgs_may_write
