# SPDX-License-Identifier: GPL-3.0-or-later
"""Writing to a file's data from timers and handlers, also where Blender has forgotten to allow it again.

Blender forbids Python to write while it draws; in Blender 4, by one flag for all threads. Where a render by Cycles, or
another engine in Python, begins in the middle of a drawing, the flag is again as it was then when the render has ended:
whatever a timer or a handler writes is refused ("Writing to ID classes in this context is not allowed") until Blender
is closed. What Blender calls to read a property may write at all times, so that is how it is called here.
"""

from collections.abc import Callable
from functools import wraps
from threading import local

import bpy
from bpy.props import BoolProperty


class _Waiting(local):
    """The calls of one thread: a render updates the scene in a thread of its own, too."""

    def __init__(self) -> None:
        self.calls: list[Callable[[], None]] = []


_waiting = _Waiting()


def allowed(function: Callable) -> Callable:
    """Decorator of what Blender calls by itself, a timer or a handler: `function` may write to the file's data."""

    @wraps(function)
    def wrapper(*arguments):
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


def _call(_manager) -> bool:
    _waiting.calls.pop()()
    return True


def register():
    bpy.types.WindowManager.objectgs_may_write = BoolProperty(get=_call, options={"HIDDEN", "SKIP_SAVE"})


def unregister():
    del bpy.types.WindowManager.objectgs_may_write
