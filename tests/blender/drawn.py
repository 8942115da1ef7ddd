# SPDX-License-Identifier: GPL-3.0-or-later
"""What a panel draws, as words, without a window."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any
from unittest import mock

import bpy
from objectgs.objectgs_addon.running import job_display


class _Layout:
    """Stands for Blender's layouts: keeps the texts and the names of operators, properties and lists."""

    def __init__(self, found: list[str]) -> None:
        self._found = found

    def __getattr__(self, name: str) -> Any:
        if name in ("row", "column", "box", "split", "column_flow", "grid_flow"):
            return lambda **_: self
        if name == "panel":
            return lambda _name, default_closed=False: (self, None if default_closed else self)
        return lambda *words, **named: self._add(name, words, named)

    def _add(self, name: str, words: tuple, named: dict[str, Any]) -> SimpleNamespace:
        texts = [word for word in words if isinstance(word, str) and word]
        self._found += [*texts, *([named["text"]] if named.get("text") else [])]
        return SimpleNamespace()


def texts_of(panel: type, method: str = "draw") -> str:
    """Return the texts that a panel draws, joined by spaces."""
    found: list[str] = []
    drawn = SimpleNamespace(layout=_Layout(found))
    drawn.__dict__.update((name, value.__get__(drawn)) for name, value in vars(panel).items() if callable(value))
    # Without a window, there is no region, and the interface has no scale.
    wide = SimpleNamespace(
        preferences=SimpleNamespace(system=SimpleNamespace(ui_scale=1.0)), region=SimpleNamespace(width=10_000)
    )
    with mock.patch.object(job_display, "bpy", SimpleNamespace(context=wide)):
        getattr(panel, method)(drawn, bpy.context)
    return " ".join(found)
