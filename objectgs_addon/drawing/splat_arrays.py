# SPDX-License-Identifier: GPL-3.0-or-later
"""Splats of mesh carriers as arrays, for drawing and picking.

The arrays are cached by the session UID of the mesh, never by the mesh itself. They are dropped when another file is
opened, or when no object has the mesh any more. When the mesh is updated, and on undo and redo, they are read again,
and kept if they are the same as before, so that what is made of them need not be made again.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import bpy
import numpy as np

from ...backend.shared.splats.blending import EPS_2D
from ...backend.shared.splats.picking import Cloud
from .. import scene
from ..scene import carrier


@dataclass(frozen=True, eq=False)
class SplatArrays:
    """Visible splats of a carrier as float32 arrays in the object's local coordinates.

    Attributes:
        means: (N, 3).
        quats: (N, 4) wxyz.
        scales: (N, 3).
        opacities: (N,).
        harmonics: (N, K, 3) spherical harmonics coefficients for red, green and blue.
        vertices: (N,) indices of the splats among the vertices of the carrier; None if all are visible.
        blur: variance in square pixels of the low-pass filter with which they are drawn.
    """

    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    harmonics: np.ndarray
    vertices: np.ndarray | None = None
    blur: float = EPS_2D

    def is_same(self, other: SplatArrays) -> bool:
        """Return whether these are the same splats."""
        pairs = ((getattr(self, field.name), getattr(other, field.name)) for field in fields(self))
        return all(np.array_equal(own, theirs) for own, theirs in pairs)

    @cached_property
    def cloud(self) -> Cloud:
        """The splats in the form required for picking."""
        return Cloud(self.means, self.quats, self.scales, self.opacities, self.blur)


@dataclass(frozen=True)
class Labels:
    """Colors in which single splats are drawn instead of their own.

    Attributes:
        of_splats: (N,) int64, for each splat 0, or the number of its color, from 1.
        colors: (L, 3) sRGB-encoded.
    """

    of_splats: np.ndarray
    colors: np.ndarray


_held: dict[int, SplatArrays] = {}
_before: dict[int, SplatArrays] = {}
"""Session UID of a mesh -> its splats before an update, if they have not been read since."""
_labels: dict[int, Labels] = {}
"""Session UID of a mesh -> the labels of all its splats."""
_visible_labels: dict[int, tuple[SplatArrays, Labels]] = {}
"""Session UID of a mesh -> its visible splats, and their labels."""
_selected: dict[int, np.ndarray | None] = {}


def arrays_of(mesh: bpy.types.Mesh) -> SplatArrays | None:
    """Return the splats of a carrier's mesh, or None if attributes are missing or, in Edit Mode, cannot be read."""
    found = _held.get(mesh.session_uid)
    if (
        found is None
        and not mesh.is_editmode
        and all(name in mesh.attributes for name in ("radiance:base", "scale", "rotation"))
    ):
        found, before = _read(mesh), _before.pop(mesh.session_uid, None)
        if before is not None and found.is_same(before):
            found = before
        _held[mesh.session_uid] = found
    return found


def selected_of(mesh: bpy.types.Mesh) -> np.ndarray | None:
    """Return which of a carrier's visible splats are selected, (N,) bool; None if there are none."""
    if mesh.session_uid not in _selected:
        if mesh.is_editmode:
            return None
        arrays, selected = arrays_of(mesh), scene.selected_splats(mesh)
        if arrays is not None and arrays.vertices is not None:
            selected = selected[arrays.vertices]
        _selected[mesh.session_uid] = selected if selected.any() else None
    return _selected[mesh.session_uid]


def selection_changed(mesh: bpy.types.Mesh) -> None:
    """Drop the cached selection of a mesh."""
    _selected.pop(mesh.session_uid, None)


def splats_changed(mesh: bpy.types.Mesh) -> None:
    """Read the splats and the selection of a mesh again when they are needed."""
    if mesh.session_uid in _held:
        _before[mesh.session_uid] = _held.pop(mesh.session_uid)
    _selected.pop(mesh.session_uid, None)


def labels_of(mesh: bpy.types.Mesh) -> Labels | None:
    """Return the labels of a mesh's visible splats, as `show_labels` has set them; None if there are none."""
    labels, arrays = _labels.get(mesh.session_uid), arrays_of(mesh)
    if labels is None or arrays is None:
        return None
    known = _visible_labels.get(mesh.session_uid)
    if known is None or known[0] is not arrays:
        if len(labels.of_splats) != len(mesh.vertices):
            return None  # The mesh has other splats since.
        own = labels.of_splats if arrays.vertices is None else labels.of_splats[arrays.vertices]
        known = _visible_labels[mesh.session_uid] = arrays, Labels(own, labels.colors)
    return known[1]


def point_labels(mesh: bpy.types.Mesh) -> Labels | None:
    """Return the labels of a mesh of points, as `show_labels` has set them; None if there are none."""
    labels = _labels.get(mesh.session_uid)
    return labels if labels is not None and len(labels.of_splats) == len(mesh.vertices) else None


def show_labels(labels: dict[bpy.types.Mesh, np.ndarray], colors: np.ndarray) -> None:
    """Draw splats or points in other colors than their own, until this is called again.

    Args:
        labels: for each carrier (n,) the number of the color of each of its splats or points, from 1; 0 for their own
            color.
        colors: (L, 3) sRGB-encoded.
    """
    _labels.clear()
    _visible_labels.clear()
    _labels.update((mesh.session_uid, Labels(of_splats, colors)) for mesh, of_splats in labels.items())


def _read(mesh: bpy.types.Mesh) -> SplatArrays:
    base = carrier.read(mesh, "radiance:base")
    coefficients = [base[:, :3]]
    while (name := f"radiance:sh_{len(coefficients)}") in mesh.attributes:
        coefficients.append(carrier.read(mesh, name))
    arrays = (
        carrier.read(mesh, "position"),
        carrier.read(mesh, "rotation"),
        carrier.read(mesh, "scale"),
        np.ascontiguousarray(base[:, 3]),
        np.stack(coefficients, axis=1),
    )
    hidden, blur = scene.hidden_splats(mesh), scene.blur_of(mesh)
    if hidden is None:
        return SplatArrays(*arrays, blur=blur)
    return SplatArrays(*(values[~hidden] for values in arrays), vertices=np.flatnonzero(~hidden), blur=blur)


def _forget(*_: Any) -> None:
    for known in (_held, _before, _visible_labels, _selected):
        known.clear()


def _forget_unused() -> None:
    """Drop what is known of meshes that no object has; Blender keeps such meshes until the file is saved."""
    used = {mesh.session_uid for mesh in bpy.data.meshes if mesh.users}
    for known in (_held, _before, _visible_labels, _selected):
        for uid in known.keys() - used:
            del known[uid]


def _undone(*_: Any) -> None:
    _before.update(_held)
    _held.clear()
    _selected.clear()
    _forget_unused()


def _changed(_scene: Any, depsgraph: Any) -> None:
    # Only mesh updates count: objects also get geometry updates when moved, since modifiers may depend on transforms.
    for update in depsgraph.updates:
        if update.is_updated_geometry and isinstance(update.id, bpy.types.Mesh):
            splats_changed(update.id.original)
    if _held or _before:
        _forget_unused()


_forget, _undone, _changed = (bpy.app.handlers.persistent(handler) for handler in (_forget, _undone, _changed))
_HANDLERS = (("depsgraph_update_post", _changed), ("undo_post", _undone), ("redo_post", _undone), ("load_pre", _forget))


def register() -> None:
    for name, handler in _HANDLERS:
        getattr(bpy.app.handlers, name).append(handler)


def unregister() -> None:
    for name, handler in reversed(_HANDLERS):
        getattr(bpy.app.handlers, name).remove(handler)
    _forget()
