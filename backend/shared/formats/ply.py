"""Vertices of PLY files as structured NumPy arrays with one field per property."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np

from ..errors import InputError
from .atomic import atomic_file
from .regular_file import open_regular

LONGEST_HEADER = 1 << 20

_BLOCK = 1_000_000
"""Number of vertices that are read at a time where not all are kept."""
_WORDS = {
    "i1": ("char", "int8"),
    "u1": ("uchar", "uint8"),
    "i2": ("short", "int16"),
    "u2": ("ushort", "uint16"),
    "i4": ("int", "int32"),
    "u4": ("uint", "uint32"),
    "f4": ("float", "float32"),
    "f8": ("double", "float64"),
}
_KINDS = {word: kind for kind, words in _WORDS.items() for word in words}


def vertex_header(dtype: np.dtype, count: int, comments: Sequence[str] = ()) -> bytes:
    """Return the header of a little-endian file of `count` vertices; the fields of `dtype` are scalars of PLY types."""
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {text}" for text in comments)]
    lines.append(f"element vertex {count}")
    for name in dtype.names or ():
        field = dtype[name]
        if f"{field.kind}{field.itemsize}" not in _WORDS:
            raise ValueError(f"PLY has no type for the property {name} ({field})")
        lines.append(f"property {_WORDS[f'{field.kind}{field.itemsize}'][0]} {name}")
    return "\n".join([*lines, "end_header", ""]).encode("ascii")


def write_vertices(path: Path, table: np.ndarray, comments: Sequence[str] = ()) -> None:
    """Write a structured array (N,) of scalar fields as binary little-endian PLY, atomically."""
    write_vertex_blocks(path, table.dtype, len(table), [table], comments)


def write_vertex_blocks(
    path: Path, dtype: np.dtype, count: int, blocks: Iterable[np.ndarray], comments: Sequence[str] = ()
) -> None:
    """Write `count` vertices as `write_vertices`, without having all of them in memory.

    Args:
        path: The file to write.
        dtype: The scalar fields of all vertices.
        count: Number of vertices.
        blocks: Structured arrays of this type, which have `count` vertices together.
        comments: Comments of the header.

    Raises:
        ValueError: They have another number of vertices; the file is not written.
    """
    packed = np.dtype([(name, dtype[name].newbyteorder("<")) for name in dtype.names or ()])
    with atomic_file(path) as file:
        file.write(vertex_header(packed, count, comments))
        written = 0
        for block in blocks:
            file.write(np.ascontiguousarray(block.astype(packed, copy=False)).data)
            written += len(block)
        if written != count:
            raise ValueError(f"{path} was to have {count} vertices, not {written}")


def read_vertices(path: Path) -> np.ndarray:
    """Read the vertices of a PLY file; later elements are ignored.

    Args:
        path: The file to read. ASCII files are refused, since they round numbers.

    Returns:
        A structured array (N,) with the file's property names, order and types.

    Raises:
        InputError: The file is missing or truncated, is ASCII, or has no vertices with scalar properties.
    """
    try:
        with open_regular(path) as file:
            _, dtype, count = _read_header(file, path, text=False)
            _check_size(path, count, os.fstat(file.fileno()).st_size - file.tell(), dtype.itemsize)
            return np.fromfile(file, dtype, count)
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror or error}).") from error


def read_chosen_vertices(path: Path, choose: Callable[[int], np.ndarray]) -> tuple[int, np.ndarray]:
    """Read some vertices of a PLY file, binary or ASCII, without having all of them in memory.

    Args:
        path: The file to read.
        choose: Returns the rows that are wanted of a number of vertices, ascending.

    Returns:
        The number of all vertices, and a structured array of the chosen ones.

    Raises:
        InputError: The file is missing or truncated, or has no vertices with scalar properties.
    """
    try:
        with open_regular(path) as file:
            order, dtype, count = _read_header(file, path, text=True)
            available = os.fstat(file.fileno()).st_size - file.tell()
            # In text a digit and a separator for each value at least, which limits what a wrong count can allocate.
            size, more = (dtype.itemsize, 0) if order else (2 * len(dtype.names or ()), 1)
            _check_size(path, count, available + more, size)
            rows = choose(count)
            table = np.zeros(len(rows), dtype)
            for first in range(0, count, _BLOCK):
                last = min(first + _BLOCK, count)
                block = np.fromfile(file, dtype, last - first) if order else _read_text(file, path, dtype, last - first)
                if len(block) < last - first:
                    raise _truncated(path, count, first + len(block))
                begin, end = np.searchsorted(rows, [first, last])
                table[begin:end] = block[rows[begin:end] - first]
            return count, table
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror or error}).") from error


def read_comments(path: Path) -> list[str]:
    """Return the comments in the header of a PLY file that `read_vertices` has read.

    Raises:
        InputError: The file cannot be read.
    """
    try:
        with open_regular(path) as file:
            head = file.read(LONGEST_HEADER)
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror or error}).") from error
    lines = head[: max(head.find(b"end_header"), 0)].decode("ascii", "replace").splitlines()
    return [line[len("comment ") :] for line in lines if line.startswith("comment ")]


def _check_size(path: Path, count: int, available: int, size: int) -> None:
    if available < count * size:
        raise _truncated(path, count, available // size)


def _truncated(path: Path, count: int, there: int) -> InputError:
    return InputError(f"{path} is truncated: its header specifies {count} vertices, but only {there} are there.")


def _read_text(file: BinaryIO, path: Path, dtype: np.dtype, most: int) -> np.ndarray:
    """Read at most this many vertices of an ASCII file from where it is on; fewer if it ends before."""
    names = dtype.names or ()
    try:
        values = np.loadtxt(file, np.float64, comments=None, ndmin=2, max_rows=most, encoding="latin-1")
    except ValueError as error:
        raise InputError(f"{path} has a vertex that is not {len(names)} numbers; save it as binary PLY.") from error
    table = np.zeros(len(values), dtype)
    if not len(values):
        return table
    if values.shape[1] != len(names):
        raise InputError(f"{path} has a vertex that is not {len(names)} numbers; save it as binary PLY.")
    for column, name in zip(values.T, names):
        if dtype[name].kind != "f":
            limits = np.iinfo(dtype[name])
            column = np.clip(np.nan_to_num(column), limits.min, limits.max)
        with np.errstate(over="ignore"):
            table[name] = column
    return table


def _read_header(file: BinaryIO, path: Path, text: bool) -> tuple[str, np.dtype, int]:
    """Read a header, up to the first vertex; returns the byte order ("" for ASCII) and the vertices' type and count."""
    head = file.read(LONGEST_HEADER)
    if not head.startswith(b"ply"):
        raise InputError(f"{path} is not a PLY file.")
    end = head.find(b"end_header")
    newline = head.find(b"\n", end)
    if end < 0 or newline < 0:
        raise InputError(f"{path} has no complete PLY header; it may be truncated.")
    order: str | None = None
    count = -1
    fields: list[tuple[str, str]] = []
    element = ""
    for line in head[:end].decode("ascii", "replace").splitlines():
        words = line.split()
        if not words or words[0] in ("ply", "comment", "obj_info"):
            continue
        if words[0] == "format" and len(words) >= 2:
            if words[1] == "ascii" and not text:
                raise InputError(f"{path} is an ASCII PLY file; only binary ones are read. Save it as binary PLY.")
            order = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}.get(words[1])
        elif words[0] == "element" and len(words) == 3 and words[2].isdigit():
            if count >= 0:
                break
            element = words[1]
            size = int(words[2])
            if element == "vertex":
                count = size
            elif element == "chunk":
                raise InputError(
                    f"{path} is a compressed PLY of PlayCanvas or SuperSplat; export it there as uncompressed PLY."
                )
            elif size:
                raise InputError(f"{path} has an element {element} before its vertices, which is not supported.")
        elif words[0] == "property" and element == "vertex":
            if len(words) != 3 or words[1] not in _KINDS:
                raise InputError(f"{path} has a vertex property that is not a plain number: {line.strip()!r}.")
            fields.append((words[2], _KINDS[words[1]]))
        elif words[0] != "property":
            raise InputError(f"{path} has an invalid PLY header line: {line.strip()!r}.")
    if order is None or count < 0 or not fields:
        raise InputError(f"{path} has no format or no vertices in its PLY header.")
    try:
        dtype = np.dtype([(name, order + kind) for name, kind in fields])
    except ValueError as error:
        raise InputError(f"{path} names a vertex property twice.") from error
    file.seek(newline + 1)
    return order, dtype, count
