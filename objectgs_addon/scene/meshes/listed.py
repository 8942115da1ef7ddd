# SPDX-License-Identifier: GPL-3.0-or-later
"""Meshes listed in meshes.json: their files and the collections that show them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ....backend.shared.reconstruction.folder import Reconstruction
from ....backend.shared.reconstruction.meshes import read_meshes
from ..object_display import Objects


@dataclass(frozen=True)
class ListedMesh:
    """A mesh of a reconstruction folder.

    Attributes:
        key: key in meshes.json.
        ids: IDs of the objects it was made from; None for the whole scene.
        object_id: ID of the object whose own mesh it is; None for a set of objects or the whole scene.
        mesh: mesh file.
        texture: texture file.
        name: displayed name.
    """

    key: str
    ids: tuple[int, ...] | None
    object_id: int | None
    mesh: Path
    texture: Path
    name: str

    def written(self) -> str:
        """Return the modification times of its files in ns as a string, since Blender's integers have 32 bits."""
        return " ".join(_modified(path) for path in (self.mesh, self.texture))


def read_listed(folder: Path) -> list[ListedMesh]:
    """Read the list of meshes in a reconstruction folder.

    Args:
        folder: the reconstruction folder.

    Returns:
        The meshes that have a file, in the order of meshes.json; empty if meshes.json is missing.

    Raises:
        InputError: meshes.json cannot be used.
    """
    meshes_folder = Reconstruction(folder).meshes
    return [
        ListedMesh(
            entry.key,
            entry.ids,
            entry.object_id,
            meshes_folder / entry.file,
            meshes_folder / (entry.texture or f"{entry.key}.png"),
            entry.name,
        )
        for entry in read_meshes(meshes_folder).values()
        if entry.file is not None
    ]


def assign_to_collections(
    listed: list[ListedMesh], objects: Objects
) -> tuple[list[tuple[ListedMesh, int | None]], list[str]]:
    """Choose the collection of each mesh.

    Args:
        listed: the meshes of the folder.
        objects: the merges and left-out objects.

    Returns:
        The meshes to show, each with the ID of the object whose collection holds it (None for the reconstruction's
        own), and warnings about meshes made before objects were split.
    """
    assigned: list[tuple[ListedMesh, int | None]] = []
    warnings = []
    for mesh in listed:
        if mesh.object_id is None:
            assigned.append((mesh, None))
            continue
        targets = {objects.shown_as(object_id) for object_id in mesh.ids or ()}
        target = targets.pop() if len(targets) == 1 else None
        if target is not None:
            assigned.append((mesh, target))
        elif targets:
            warnings.append(
                f"The mesh of {objects.name(mesh.object_id)} was made when other objects were merged with "
                "it and is not shown; extract it again."
            )
    of_target: dict[int, list[set[int]]] = {}
    for mesh, target in assigned:
        if target is not None:
            of_target.setdefault(target, []).append(set(mesh.ids or ()))
    # Skip meshes that are part of a mesh made later from the merged object.
    return [
        (mesh, target)
        for mesh, target in assigned
        if target is None or not any(other > set(mesh.ids or ()) for other in of_target[target])
    ], warnings


def _modified(path: Path) -> str:
    try:
        return str(path.stat().st_mtime_ns)
    except OSError:
        return ""
