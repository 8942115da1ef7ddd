# SPDX-License-Identifier: GPL-3.0-or-later
"""The meshes that meshes.json lists: their files, and the collection in which each is shown."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ....backend.shared.reconstruction.folder import Reconstruction
from ....backend.shared.reconstruction.meshes import read_meshes
from ..objects_file import Objects


@dataclass(frozen=True)
class ListedMesh:
    """A mesh of a reconstruction folder.

    key: in meshes.json; ids: the objects it was made of, None: the whole scene; object_id: the object whose own mesh it
    is, None for a set or the whole scene; mesh, texture: its files; name: as shown.
    """

    key: str
    ids: tuple[int, ...] | None
    object_id: int | None
    mesh: Path
    texture: Path
    name: str

    def written(self) -> str:
        """Modification times of its files, as text, since Blender's integers are too short for nanoseconds."""
        return " ".join(_modified(path) for path in (self.mesh, self.texture))


def read_listed(folder: Path) -> list[ListedMesh]:
    """Read which meshes a reconstruction folder holds.

    Args:
        folder: the reconstruction folder.

    Returns:
        The meshes that were made, in the order of meshes.json; none where there is no such file.

    Raises:
        InputError: meshes.json cannot be used.
    """
    place = Reconstruction(folder).meshes
    return [
        ListedMesh(
            entry.key,
            entry.ids,
            entry.object_id,
            place / entry.file,
            place / (entry.texture or f"{entry.key}.png"),
            entry.name,
        )
        for entry in read_meshes(place).values()
        if entry.file is not None
    ]


def assign_to_collections(
    listed: list[ListedMesh], objects: Objects
) -> tuple[list[tuple[ListedMesh, int | None]], list[str]]:
    """Choose the collection of each mesh.

    Args:
        listed: the meshes of the folder.
        objects: says which objects are merged and which are left out.

    Returns:
        The meshes to show, each with the ID of the object in whose collection it lies (None: the reconstruction's), and
        warnings about the others.
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
    # The mesh of an object that was merged before this mesh was made is a part of this one.
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
