"""Splats of other programs, in any of the formats that are read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..model.splats import PlacedSplats, Splats
from ..shared.class_table import LARGEST_ID
from ..shared.formats.splat_ply import Description, read_description
from .gltf import read_gltf
from .ply import cleaned, read_splats
from .splat import read_splat
from .spz import DOWN_TO_UP, read_spz
from .usd import read_usd

_READERS: dict[str, Callable[[Path], tuple[Splats, list[str]]]] = {".spz": read_spz, ".splat": read_splat}
_USD = (".usd", ".usda", ".usdc", ".usdz")


def read_foreign_splats(path: Path) -> tuple[Splats, list[str]]:
    """Read splats as SPZ or .splat, chosen by the file's suffix, or else as PLY.

    Args:
        path: The file to read.

    Returns:
        The splats, and warnings about those that were dropped.

    Raises:
        InputError: The file is missing, damaged or not in the format of its suffix.
    """
    return _READERS.get(path.suffix.lower(), read_splats)(path)


def read_foreign_scene(path: Path) -> tuple[list[PlacedSplats], list[str], Description]:
    """Read splats as glTF (.glb) or USD, with the places and names of their nodes, or as `read_foreign_splats`.

    Without IDs in the file, several nodes are an object each, from 1 up.

    Args:
        path: The file to read.

    Returns:
        The splats with object IDs, warnings about those that were dropped, and what the file tells about all.

    Raises:
        InputError: The file is missing, damaged or not in the format of its suffix.
    """
    suffix = path.suffix.lower()
    if suffix == ".glb":
        nodes, up = read_gltf(path), [0.0, 1.0, 0.0]
    elif suffix in _USD:
        nodes, axis = read_usd(path)
        up = [0.0, 0.0, 1.0] if axis == "Z" else [0.0, 1.0, 0.0]
    else:
        splats, dropped = read_foreign_splats(path)
        matrix = DOWN_TO_UP if suffix == ".spz" else np.eye(4)
        return [PlacedSplats(splats, matrix)], dropped, read_description(path)
    warnings: list[str] = []
    found: list[PlacedSplats] = []
    names: dict[int, str] = {}
    are_known = all(isinstance(node.object_id, int) and 0 <= node.object_id <= LARGEST_ID for node in nodes)
    for number, node in enumerate(nodes, 1):
        splats, more = cleaned(path, node.splats)
        object_id = node.object_id if are_known and node.object_id is not None else number * (len(nodes) > 1)
        splats.object_ids[:] = object_id
        found.append(replace(node, splats=splats, object_id=object_id))
        warnings += [sentence for sentence in more if sentence not in warnings]
        if object_id and node.name:
            names[object_id] = node.name
    return found, warnings, Description(up, names=names)
