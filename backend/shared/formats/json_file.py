"""Reading and writing of JSON files."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from .atomic import write_atomic
from .regular_file import read_regular

LARGEST = 64 << 20
"""Bytes of the largest file that `read_json` reads; cameras.json of 10,000 views has 10 MB."""


def plain(value: Any, where: str = "value") -> Any:
    """Convert NumPy values, paths and tuples to JSON types, NaN and infinity to None; raise ValueError for others."""
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, np.generic | np.ndarray):
        return plain(value.tolist(), where)
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, Mapping):
        return {str(key): plain(entry, f"{where}.{key}") for key, entry in value.items()}
    if isinstance(value, Sequence):
        return [plain(entry, f"{where}[{i}]") for i, entry in enumerate(value)]
    raise ValueError(f"{where} is a {type(value).__name__}, which JSON cannot hold")


def write_json(path: Path, value: Any, indent: int | None = 1) -> None:
    """Write `value` as JSON, atomically; raise ValueError for NaN and infinity, which are not valid JSON.

    indent: spaces before the entries of each level; None: all in one line, for large files.
    """
    write_atomic(path, (json.dumps(value, indent=indent, ensure_ascii=False, allow_nan=False) + "\n").encode())


def parse_json(text: str | bytes) -> Any:
    """Parse JSON; raise ValueError if it is invalid, contains NaN or infinity, or is nested too deeply.

    Halves of surrogate pairs, which UTF-8 cannot write, become question marks.
    """

    def refuse(constant: str) -> None:
        raise ValueError(f"{constant} is not valid in JSON")

    try:
        value = json.loads(text, parse_constant=refuse)
        if "\\ud" in (text if isinstance(text, str) else text.decode("latin-1")).lower():
            value = json.loads(json.dumps(value, ensure_ascii=False).encode(errors="replace"))
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error
    return value


def read_json(path: Path, largest: int | None = None) -> Any:
    """Read a JSON file of up to `largest` bytes; raise InputError that names the file if it is missing or invalid."""
    try:
        return parse_json(read_regular(path, largest or LARGEST).decode("utf-8"))
    except FileNotFoundError as error:
        raise InputError(f"{path} does not exist; run the step that creates it first.") from error
    except (OSError, ValueError) as error:
        raise InputError(
            f"{path} cannot be read as JSON ({error}); repair it, or delete it and run the step that creates it."
        ) from error
