# SPDX-License-Identifier: GPL-3.0-or-later
"""The splats of mesh carriers as arrays, read once: what the viewport draws and what a click meets.

Held by the mesh's number of this session, never by the mesh itself; forgotten when the mesh changes, after undo, and
when another file is opened.
"""

from dataclasses import dataclass
from functools import cached_property

import bpy
import numpy as np

from ..backend.picking import Cloud
from . import scene
from .scene import carrier


@dataclass(frozen=True)
class SplatArrays:
    """Of the splats that are not hidden one by one; float32, in the object's space: means (N, 3), quats (N, 4) wxyz,
    scales (N, 3), opacities (N,), and harmonics (N, K, 3), the coefficients of each band for red, green and blue."""

    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    harmonics: np.ndarray

    @cached_property
    def cloud(self) -> Cloud:
        """Arranged for picking."""
        return Cloud(self.means, self.quats, self.scales, self.opacities)


_held: dict[int, SplatArrays] = {}


def arrays_of(mesh: bpy.types.Mesh) -> SplatArrays | None:
    """The splats of a carrier's mesh; None where it has lost the attributes."""
    found = _held.get(mesh.session_uid)
    if found is None and all(name in mesh.attributes for name in ("radiance:base", "scale", "rotation")):
        found = _held[mesh.session_uid] = _read(mesh)
    return found


def _read(mesh) -> SplatArrays:
    base = carrier.read(mesh, "radiance:base")
    coefficients = [base[:, :3]]
    while (name := f"radiance:sh_{len(coefficients)}") in mesh.attributes:
        coefficients.append(carrier.read(mesh, name))
    arrays = (carrier.read(mesh, "position"), carrier.read(mesh, "rotation"), carrier.read(mesh, "scale"),
              np.ascontiguousarray(base[:, 3]), np.stack(coefficients, axis=1))
    hidden = scene.hidden_splats(mesh)
    return SplatArrays(*arrays) if hidden is None else SplatArrays(*(values[~hidden] for values in arrays))


def _forget(*_) -> None:
    _held.clear()


def _changed(_scene, depsgraph) -> None:
    # Objects count as changed when they are moved, too, since their modifiers may look at their place.
    for update in depsgraph.updates:
        if update.is_updated_geometry and isinstance(update.id, bpy.types.Mesh):
            _held.pop(update.id.original.session_uid, None)


_forget, _changed = bpy.app.handlers.persistent(_forget), bpy.app.handlers.persistent(_changed)
_HANDLERS = (("depsgraph_update_post", _changed), ("undo_post", _forget), ("redo_post", _forget),
             ("load_pre", _forget))


def register():
    for name, handler in _HANDLERS:
        getattr(bpy.app.handlers, name).append(handler)


def unregister():
    for name, handler in reversed(_HANDLERS):
        getattr(bpy.app.handlers, name).remove(handler)
    _forget()
