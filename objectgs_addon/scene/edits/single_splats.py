# SPDX-License-Identifier: GPL-3.0-or-later
"""Edits of single splats as attributes of their carriers: which are deleted, which are selected, and their keys."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass

import bpy
import numpy as np

from ....backend.shared.formats.splat_ply import MEANS, ids_of, sh_names
from ....backend.shared.reconstruction.edits.splat_edits import SplatEdits, digest_of
from ....backend.shared.splats.keys import NO_KEY, splat_keys
from .. import carrier
from ..kinds import OBJECT_ID
from ..shading.modifiers import update_groups
from ..shading.node_groups import HIDDEN

KEY = "objectgs_key"
"""Attribute of a carrier's vertices: the halves of the splat's key, low one first; 0 for splats that fill a hole."""
DELETED = "objectgs_deleted"
"""Boolean attribute: splats that are deleted or outside of the crop; they are also in HIDDEN."""
SELECTED = "objectgs_selected"

SPLAT_EDITS = "objectgs_splat_edits"
"""Custom property of the root collection: `ShownEdits` as JSON."""


@dataclass(frozen=True)
class ShownEdits:
    """The edits of single splats that a reconstruction shows.

    Attributes:
        digest: hash of the edits in the folder.
        deleted: number of deleted splats.
        assigned: number of splats that are assigned to another object.
        missing: number of edits that match no splat.
        cropped: the scene is cropped to a box.
    """

    digest: str = ""
    deleted: int = 0
    assigned: int = 0
    missing: int = 0
    cropped: bool = False

    @property
    def match(self) -> bool:
        """Whether any deleted or assigned splat is one of those that are shown."""
        return self.deleted + self.assigned > self.missing


def shown_edits(root: bpy.types.Collection) -> ShownEdits | None:
    """Return the edits of single splats that a reconstruction shows; None if it shows no splats."""
    stored = root.get(SPLAT_EDITS)
    return ShownEdits(**json.loads(stored)) if isinstance(stored, str) else None


def remember_edits(root: bpy.types.Collection, edits: SplatEdits, missing: int) -> None:
    """Store which edits of single splats a reconstruction shows; missing: number of those that match no splat."""
    shown = ShownEdits(digest_of(edits), edits.deleted, edits.assigned, missing, edits.crop is not None)
    root[SPLAT_EDITS] = json.dumps(asdict(shown))


def table_keys(table: np.ndarray) -> np.ndarray:
    """Return the (n,) uint64 keys of a table of splats."""
    return splat_keys(captured_positions(table), np.stack([table[name] for name in sh_names(1)[0]], axis=1))


def captured_positions(table: np.ndarray) -> np.ndarray:
    """Return the (n, 3) float64 positions of a table of splats in capture coordinates."""
    return np.stack([table[axis].astype(np.float64) for axis in MEANS], axis=1)


def edited_attributes(table: np.ndarray, edits: SplatEdits) -> dict[str, tuple[str, np.ndarray]]:
    """Return the carrier attributes of splats with their keys and, where they are edited, with the edits.

    Args:
        table: (n,) rows of splats.ply.
        edits: the edits of single splats.
    """
    keys = table_keys(table)
    attributes = {KEY: ("INT32_2D", keys.view(np.int32).reshape(-1, 2))}
    if edits:
        applied = edits.apply(keys, ids_of(table), captured_positions(table))
        attributes[OBJECT_ID] = "INT", carrier.stored_ids(applied.object_ids)
        if not applied.kept.all():
            attributes[DELETED] = attributes[HIDDEN] = "BOOLEAN", ~applied.kept
    return attributes


def keys_of(mesh: bpy.types.Mesh) -> np.ndarray:
    """Return the (n,) uint64 keys of a carrier's splats; NO_KEY for those that cannot be edited."""
    if KEY not in mesh.attributes:  # Shown by an older version.
        return np.full(len(mesh.vertices), NO_KEY, np.uint64)
    return np.ascontiguousarray(carrier.read(mesh, KEY)).view(np.uint64).reshape(-1)


def deleted_splats(mesh: bpy.types.Mesh) -> np.ndarray:
    """Return an (n,) bool mask of a carrier's splats that are deleted or outside of the crop."""
    return _mask(mesh, DELETED)


def selected_splats(mesh: bpy.types.Mesh) -> np.ndarray:
    """Return an (n,) bool mask of a carrier's selected splats."""
    return _mask(mesh, SELECTED)


def select_splats(mesh: bpy.types.Mesh, selected: np.ndarray) -> None:
    """Select the splats of a carrier in a mask (n,), and no others; caches of the selection must be dropped.

    Blender is not told that the mesh has changed, since it would evaluate the splats anew, which takes long.
    """
    if selected.any():
        carrier.write(mesh, SELECTED, "BOOLEAN", selected)
    elif SELECTED in mesh.attributes:
        mesh.attributes.remove(mesh.attributes[SELECTED])


def delete_splats(obj: bpy.types.Object, deleted: np.ndarray) -> None:
    """Delete the splats of a carrier in a mask (n,), in addition to those that are deleted already."""
    mesh = obj.data
    update_groups(obj)
    carrier.write(mesh, DELETED, "BOOLEAN", deleted_splats(mesh) | deleted)
    carrier.write(mesh, HIDDEN, "BOOLEAN", _mask(mesh, HIDDEN) | deleted)
    select_splats(mesh, selected_splats(mesh) & ~deleted)
    mesh.update()


def _mask(mesh: bpy.types.Mesh, name: str) -> np.ndarray:
    if name not in mesh.attributes:
        return np.zeros(len(mesh.vertices), bool)
    return carrier.read(mesh, name)
