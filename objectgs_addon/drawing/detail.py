# SPDX-License-Identifier: GPL-3.0-or-later
"""Levels of detail of the splats that are drawn, built by a thread where a scene has many.

They are cached for the identity of the arrays, and dropped with these. New levels are drawn once all of a scene
are built, since the textures are filled again for them; until then, all splats of their objects are drawn.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace

from ...backend.shared.splats.levels import BLOCK, Levels, Stopped, build_levels
from .entries import DrawnObject
from .splat_arrays import SplatArrays

MOST = 1_000_000
"""Scenes of no more splats are fast enough without levels."""

SMALLEST = 16 * BLOCK
"""Objects of fewer splats are drawn without."""

_built: weakref.WeakKeyDictionary[SplatArrays, Future[Levels | None]] = weakref.WeakKeyDictionary()
_drawn: weakref.WeakSet[SplatArrays] = weakref.WeakSet()
"""Splats whose levels have been drawn."""
_thread: ThreadPoolExecutor | None = None


def with_levels(objs: Sequence[DrawnObject]) -> list[DrawnObject]:
    """Return objects with their levels of detail, if they have so many splats that they need any.

    The first call for an object's splats starts to build them; see `is_building`.
    """
    if sum(len(obj.splats.means) for obj in objs) <= MOST:
        return list(objs)
    futures = [_future(obj.splats) if len(obj.splats.means) >= SMALLEST else None for obj in objs]
    if all(future is None or future.done() for future in futures):
        _drawn.update(obj.splats for obj, future in zip(objs, futures) if future is not None)
    return [
        replace(obj, levels=future.result()) if future is not None and obj.splats in _drawn else obj
        for obj, future in zip(objs, futures)
    ]


def is_building() -> bool:
    """Return whether levels are being built."""
    return not all(future.done() for future in list(_built.values()))


def _future(splats: SplatArrays) -> Future[Levels | None]:
    global _thread
    if splats not in _built:
        thread = _thread = _thread or ThreadPoolExecutor(1, "objectgs-levels")
        kept = weakref.ref(splats)
        arrays = (splats.means, splats.quats, splats.scales, splats.opacities, splats.harmonics)
        _built[splats] = thread.submit(_build, arrays, lambda: kept() is None or thread is not _thread)
    return _built[splats]


def _build(arrays: tuple, is_dropped: Callable[[], bool]) -> Levels | None:
    """Build levels; None if they are no longer needed, or if that fails, since all splats can be drawn instead."""
    try:
        return None if is_dropped() else build_levels(*arrays, is_dropped)
    except Stopped:
        return None
    except (ArithmeticError, MemoryError, ValueError) as error:
        print(f"ObjectGS: all splats are drawn, since their levels of detail cannot be built: {error}", flush=True)
        return None


def unregister() -> None:
    """Stop building."""
    global _thread
    _built.clear()
    _drawn.clear()
    thread, _thread = _thread, None
    if thread is not None:
        thread.shutdown(cancel_futures=True)
