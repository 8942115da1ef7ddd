# SPDX-License-Identifier: GPL-3.0-or-later
"""Meshes listed in meshes.json: their files and the collections that show them."""

from __future__ import annotations

import zlib
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
    of_target: dict[int, list[ListedMesh]] = {}
    for mesh, target in assigned:
        if target is not None:
            of_target.setdefault(target, []).append(mesh)
    # Skip meshes that are part of a mesh made later from the merged object.
    return [
        (mesh, target)
        for mesh, target in assigned
        if target is None or not any(_replaces(other, mesh, target) for other in of_target[target])
    ], warnings


def _replaces(other: ListedMesh, mesh: ListedMesh, target: int) -> bool:
    """Return whether a mesh contains another one of its collection.

    Of meshes of the same objects, which were merged in different directions, the object's own one is shown.
    """
    own, others = set(mesh.ids or ()), set(other.ids or ())
    return others > own or (others == own and other.object_id == target != mesh.object_id)


def stamp_of(path: Path, known: str) -> tuple[str, bool]:
    """Return a stamp of a file, and whether its content is still that of a known stamp.

    Copying a project or saving the file again changes the time alone. A file of the known time is not read.

    Args:
        path: the file.
        known: an earlier stamp; earlier versions stored the time alone. "" for a missing file.

    Returns:
        The time in ns, the size and the checksum as a string, or "" for a missing file; and whether nothing has
        changed but the time.
    """
    try:
        modified = str(path.stat().st_mtime_ns)
        known_time, _, known_content = known.partition(":")
        if modified == known_time and known_content:
            return known, True
        data = path.read_bytes()
    except OSError:
        return "", not known
    content = f"{len(data)}:{zlib.crc32(data):08x}"
    return f"{modified}:{content}", modified == known_time or content == known_content
