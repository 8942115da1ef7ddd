"""Export and import of splats as binary glTF with the extension KHR_gaussian_splatting: exact, a node for each object.

The extension defines the attributes of a primitive of points, of which programs that do not know it show the points
(https://github.com/KhronosGroup/glTF, extensions/2.0/Khronos/KHR_gaussian_splatting).
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..model.splats import PlacedSplats, Splats, objects_of
from ..shared.color import srgb
from ..shared.errors import InputError
from ..shared.formats.atomic import atomic_file
from ..shared.formats.json_file import parse_json
from ..shared.formats.regular_file import read_regular
from ..shared.splats.blending import LEAST_EPS_2D, USUAL_EPS_2D
from ..shared.splats.spherical_harmonics import C0
from .ply import DEGREE_KEPT

EXTENSION = "KHR_gaussian_splatting"
LOW_PASS = "objectgs_low_pass"
"""Variance in square pixels of the filter with which the splats are to be drawn."""

_HEADER = struct.Struct("<4sIIII")
_CHUNK = struct.Struct("<II")
_VERSION, _JSON, _BINARY = 2, 0x4E4F534A, 0x004E4942
_LARGEST = 2**32 - 1
"""Largest number of bytes of a file."""
_POINTS, _ARRAY_BUFFER = 0, 34962
_DTYPES: dict[int, np.dtype] = {
    5120: np.dtype("i1"), 5121: np.dtype("u1"), 5122: np.dtype("<i2"), 5123: np.dtype("<u2"), 5126: np.dtype("<f4"),
}  # fmt: skip
_CODES = {dtype: code for code, dtype in _DTYPES.items()}
_LARGEST_OF = {np.dtype("i1"): 127, np.dtype("u1"): 255, np.dtype("<i2"): 32767, np.dtype("<u2"): 65535}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_TYPES = {width: name for name, width in _WIDTHS.items()}


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
                "componentType": _CODES[values.dtype],
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
        "asset": {"version": "2.0", "generator": "ObjectGS for Blender", "extras": {LOW_PASS: splats.blur}},
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


def read_gltf(path: Path) -> list[PlacedSplats]:
    """Read the splats of a binary glTF, written by this or another program.

    Args:
        path: The file to read.

    Returns:
        The splats of each primitive that has any, in the order of the nodes, Y up.

    Raises:
        InputError: The file cannot be read, is damaged or compressed, or has no splats.
    """
    content, binary = _unpack(path)
    try:
        found = list(_read_nodes(content, binary))
    except InputError as error:
        raise InputError(f"{path} {error}") from error
    except (AttributeError, IndexError, KeyError, OverflowError, TypeError, ValueError) as error:
        raise InputError(f"{path} is a damaged glTF; export it again.") from error
    if not found:
        raise InputError(f"{path} has no splats ({EXTENSION}); import its meshes with Blender's own importer.")
    return found


def _unpack(path: Path) -> tuple[Any, bytes]:
    """Return the JSON and the binary chunk of a file."""
    try:
        data = read_regular(path)
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}); check the file.") from error
    if len(data) < _HEADER.size or data[:4] != b"glTF":
        raise InputError(f"{path} is not a binary glTF; export it again as .glb.")
    _, version, whole, size, kind = _HEADER.unpack_from(data)
    at = _HEADER.size + size
    if version != _VERSION or kind != _JSON or whole > len(data) or at > len(data):
        raise InputError(f"{path} is truncated or not of glTF {_VERSION}; export it again.")
    binary = b""
    if at + _CHUNK.size <= len(data):
        size, kind = _CHUNK.unpack_from(data, at)
        binary = data[at + _CHUNK.size : at + _CHUNK.size + size] if kind == _BINARY else b""
    try:
        return parse_json(data[_HEADER.size : at].decode()), binary
    except ValueError as error:
        raise InputError(f"{path} is a damaged glTF; export it again.") from error


def _read_nodes(content: Any, binary: bytes) -> Iterator[PlacedSplats]:
    """Yield the splats of all nodes, parents first; messages of InputError lack the path of the file."""
    nodes = content.get("nodes", [])
    below = {child for node in nodes for child in node.get("children", [])}
    blur = content.get("asset", {}).get("extras", {}).get(LOW_PASS)
    waiting = [(index, np.eye(4)) for index in reversed(range(len(nodes))) if index not in below]
    seen = set()
    while waiting:
        index, above = waiting.pop()
        if index in seen:
            raise InputError("is damaged: a node is below several others or itself; export it again.")
        seen.add(index)
        node = nodes[index]
        matrix = above @ _matrix_of(node)
        if not np.isfinite(matrix).all():
            raise InputError("is damaged: a node is not at a place; export it again.")
        waiting += [(child, matrix) for child in reversed(node.get("children", []))]
        if "mesh" not in node:
            continue
        mesh = content["meshes"][node["mesh"]]
        for primitive in mesh["primitives"]:
            extension = primitive.get("extensions", {}).get(EXTENSION)
            if extension is None:
                continue
            if extension.get("extensions"):
                raise InputError(
                    f"has splats in the form {', '.join(map(str, extension['extensions']))}, which is not read; export "
                    "it uncompressed, or as PLY."
                )
            values = {
                name: _values(content, binary, number)
                for name, number in primitive["attributes"].items()
                if name == "POSITION" or name.startswith(EXTENSION)
            }
            extras = node.get("extras")
            object_id = extras.get("object_id") if isinstance(extras, dict) else None
            name = str(node.get("name") or mesh.get("name") or "")
            yield PlacedSplats(_splats_of(values, blur), matrix, name, object_id)


def low_pass_of(stored: Any) -> float:
    """Return the variance of the filter that a file of ours names, or the usual one of other programs."""
    return float(stored) if isinstance(stored, float) and LEAST_EPS_2D <= stored <= USUAL_EPS_2D else USUAL_EPS_2D


def _matrix_of(node: Any) -> NDArray[np.float64]:
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    matrix = np.eye(4)
    x, y, z, w = node.get("rotation", (0, 0, 0, 1))
    turn = Rotation.from_quat([x, y, z, w]).as_matrix()
    matrix[:3, :3] = turn * np.array(node.get("scale", (1, 1, 1)), np.float64)
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix


def _values(content: Any, binary: bytes, number: int) -> NDArray[np.float64]:
    """Return the values (N, components) of an accessor."""
    accessor = content["accessors"][number]
    if "sparse" in accessor or "bufferView" not in accessor:
        raise InputError("has sparse attributes, which are not read; export it again without, or as PLY.")
    view = content["bufferViews"][accessor["bufferView"]]
    if view["buffer"] or "uri" in content["buffers"][0] or view.get("extensions"):
        raise InputError("has attributes outside of it or compressed; export it again as one .glb, or as PLY.")
    dtype, width = _DTYPES[accessor["componentType"]], _WIDTHS[accessor["type"]]
    row, count = dtype.itemsize * width, int(accessor["count"])
    start, step = view.get("byteOffset", 0) + accessor.get("byteOffset", 0), view.get("byteStride", row)
    if min(start, count - 1, step - row) < 0 or start + (count - 1) * step + row > len(binary):
        raise InputError("is truncated or damaged: attributes end after the file; export it again.")
    values = np.ndarray((count, width), dtype, binary, start, (step, dtype.itemsize)).astype(np.float64)
    return np.maximum(values / _LARGEST_OF.get(dtype, 1), -1) if accessor.get("normalized") else values


def _splats_of(values: dict[str, NDArray[np.float64]], blur: Any) -> Splats:
    """Return the splats of the attributes of a primitive."""
    bands: list[NDArray] = []
    for degree in range(DEGREE_KEPT + 1):
        names = [f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{order}" for order in range(2 * degree + 1)]
        if not all(name in values for name in names):
            break
        bands += [values[name] for name in names]
    means = values["POSITION"]
    return Splats(
        means,
        values[f"{EXTENSION}:ROTATION"][:, [3, 0, 1, 2]],
        values[f"{EXTENSION}:SCALE"],
        values[f"{EXTENSION}:OPACITY"][:, 0],
        np.stack(bands, 1).astype(np.float32),
        np.zeros(len(means), np.int64),
        blur=low_pass_of(blur),
    )
