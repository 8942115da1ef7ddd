# SPDX-License-Identifier: GPL-3.0-or-later
"""What operators do when something fails."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import bpy

from ...backend.shared.errors import InputError
from ...objectgs_addon.blender import messages


def reports_errors(
    execute: Callable[[Any, bpy.types.Context], set[str] | None],
) -> Callable[[Any, bpy.types.Context], set[str]]:
    """Decorate an operator's `execute`, so that expected errors are reported in one sentence and cancel the operator.

    Expected are InputError, errors of files, and RuntimeError, which Blender's own operators raise. An `execute` that
    returns nothing has finished.
    """

    @functools.wraps(execute)
    def run(self: Any, context: bpy.types.Context) -> set[str]:
        try:
            return execute(self, context) or {"FINISHED"}
        except (InputError, OSError, RuntimeError) as error:
            self.report({"ERROR"}, messages.sentence(error))
            return {"CANCELLED"}

    return run
