"""Export of splats as binary glTF with the extension KHR_gaussian_splatting: exact, with a node for each object.

The extension defines the attributes of a primitive of points, of which programs that do not know it show the points
(https://github.com/KhronosGroup/glTF, extensions/2.0/Khronos/KHR_gaussian_splatting).
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..model.splats import Splats, objects_of
from ..shared.color import srgb
from ..shared.errors import InputError
from ..shared.formats.atomic import atomic_file
from ..shared.splats.spherical_harmonics import C0

EXTENSION = "KHR_gaussian_splatting"

_HEADER = struct.Struct("<4sIIII")
_CHUNK = struct.Struct("<II")
_VERSION, _JSON, _BINARY = 2, 0x4E4F534A, 0x004E4942
_LARGEST = 2**32 - 1
"""Largest number of bytes of a file."""
_POINTS, _ARRAY_BUFFER = 0, 34962
_COMPONENTS = {np.dtype("<f4"): 5126, np.dtype("<u2"): 5123}
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


def write_gltf(path: Path, splats: Splats, names: Mapping[int, str]) -> list[str]:
    """Write splats as binary glTF, atomically.

    Each object is a node at the center of its splats, with its ID in `extras`; positions are relative to it, so that
    float32 suffices far from the origin, too. `COLOR_0` has the colors of the points for programs that do not know the
    extension.

    Args:
        path: The file to write.
        splats: The splats, in the axes that the file should have (glTF is Y up), of degree 3 at most.
        names: object ID -> name of the node, for all IDs of the splats. Equal names are allowed.

    Returns:
        No warnings.

    Raises:
        InputError: The file would be larger than glTF allows.
    """
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    meshes: list[dict[str, Any]] = []
    nodes: list[dict[str, Any]] = []
    blocks: list[NDArray] = []
    size = 0
    for object_id, part, center in objects_of(splats):
        attributes = {}
        for name, values in _attributes(part, center).items():
            attributes[name] = len(accessors)
            accessor = {
                "bufferView": len(views),
                "componentType": _COMPONENTS[values.dtype],
                "count": len(values),
                "type": _TYPES[values.shape[1]],
            }
            if values.dtype != np.dtype("<f4"):
                accessor["normalized"] = True
            if name == "POSITION":
                accessor |= {"min": values.min(0).tolist(), "max": values.max(0).tolist()}
            accessors.append(accessor)
            views.append({"buffer": 0, "byteOffset": size, "byteLength": values.nbytes, "target": _ARRAY_BUFFER})
            blocks.append(values)
            size += values.nbytes
        kernel = {EXTENSION: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}}
        name = names[object_id]
        nodes.append(
            {"name": name, "mesh": len(meshes), "translation": center.tolist(), "extras": {"object_id": object_id}}
        )
        meshes.append({"name": name, "primitives": [{"attributes": attributes, "mode": _POINTS, "extensions": kernel}]})
    content = {
        "asset": {"version": "2.0", "generator": "ObjectGS for Blender"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": list(range(len(nodes)))}],
        "nodes": nodes,
        "meshes": meshes,
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": size}],
    }
    text = json.dumps(content, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    whole = _HEADER.size + len(text) + _CHUNK.size + size
    if whole > _LARGEST:
        raise InputError(
            f"{path} would have {whole / 1e9:.1f} GB, more than a glTF file can; export fewer objects, a lower degree "
            "of spherical harmonics, or PLY."
        )
    with atomic_file(path) as file:
        file.write(_HEADER.pack(b"glTF", _VERSION, whole, len(text), _JSON) + text + _CHUNK.pack(size, _BINARY))
        for block in blocks:
            file.write(block.data)
    return []


def _attributes(splats: Splats, center: NDArray[np.float64]) -> dict[str, NDArray]:
    """Return semantic -> values (N, components); that of each lies at a multiple of four bytes."""
    color = np.clip(0.5 + C0 * splats.sh[:, 0], 0, 1)
    shown = np.column_stack([srgb.decode(color), splats.opacities])
    values = {
        "POSITION": splats.means - center,
        "COLOR_0": np.rint(np.clip(shown, 0, 1) * 65535),
        f"{EXTENSION}:ROTATION": splats.quats[:, [1, 2, 3, 0]],
        f"{EXTENSION}:SCALE": splats.scales,
        f"{EXTENSION}:OPACITY": splats.opacities[:, None],
    }
    for degree in range(splats.degree + 1):
        for order in range(2 * degree + 1):
            values[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{order}"] = splats.sh[:, degree**2 + order]
    types = {"COLOR_0": "<u2"}
    return {name: np.ascontiguousarray(given, types.get(name, "<f4")) for name, given in values.items()}
