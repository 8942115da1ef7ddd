"""Splats as PLY in the layout of 3D Gaussian splatting: names, order, types and limits of the properties.

Opacities are logits and scales are logarithms. `f_rest` has all red coefficients first, then green, then blue. Two
properties are this program's own: `object_id` as uint32 and, if any splat is unobserved, `unobserved` as uchar. So
are four comments: `background R G B`, the color behind the splats, in display space from 0 to 1; `low_pass V`,
the variance in square pixels of the filter with which they are to be drawn; `up X Y Z`, the unit vector that is up; and
`object ID "NAME"`, the name of an object as a string of JSON.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..class_table import LARGEST_ID
from ..errors import InputError
from ..splats.blending import EPS_2D, LEAST_EPS_2D, USUAL_EPS_2D
from .json_file import parse_json
from .ply import read_comments, read_vertices

MEANS = ("x", "y", "z")
NORMALS = ("nx", "ny", "nz")
OPACITY = "opacity"
SCALES = ("scale_0", "scale_1", "scale_2")
QUATS = ("rot_0", "rot_1", "rot_2", "rot_3")
OBJECT_ID = "object_id"
UNOBSERVED = "unobserved"
"""Splats that fill a hole and that no photo shows."""

FORMER_UNOBSERVED = "invented"
"""Name of the property `unobserved` in files written by older versions."""

SMALLEST_QUAT = 1e-12
"""Quaternions without a component above this limit are no rotations."""

LARGEST_SHOWN_LOG_SCALE = 80.0
"""Larger scales are not shown in Blender, whose float32 arithmetic they leave."""

_DC = ("f_dc_0", "f_dc_1", "f_dc_2")
_REST = "f_rest_"
_BLUR, _BACKGROUND, _UP, _NAME = "low_pass", "background", "up", "object"
_MOST_OF_NAMES = 1 << 16
"""Characters of all names in a header, above which it has none: some programs read no headers beyond 128 KB."""

_UNIT_WITHIN = 1e-3
"""Largest difference of a direction's length from 1."""

_ANTIALIASED = ("antialiased 1", "splatrendermode: mip")
"""Comments, in lower case, of Postshot and of Brush about splats that were trained with antialiasing."""

REQUIRED = (*MEANS, *_DC, OPACITY, *SCALES, *QUATS)
_ROWS_AT_ONCE = 1 << 14
"""Number of rows checked at a time, small enough to stay in the CPU cache."""


def property_names(degree: int) -> list[str]:
    """Return the properties of a file with this spherical-harmonics degree, in file order, without `unobserved`."""
    rest = 3 * ((degree + 1) ** 2 - 1)
    return [*MEANS, *NORMALS, *_DC, *(f"{_REST}{i}" for i in range(rest)), OPACITY, *SCALES, *QUATS, OBJECT_ID]


def sh_names(coefficients: int) -> list[tuple[str, str, str]]:
    """Return the properties of each spherical-harmonics coefficient for red, green and blue."""
    rest = coefficients - 1
    return [_DC, *((f"{_REST}{k}", f"{_REST}{rest + k}", f"{_REST}{2 * rest + k}") for k in range(rest))]


@dataclass(frozen=True)
class Description:
    """What the comments of a header tell about the splats.

    Attributes:
        up: the direction that is up, or None.
        background: red, green and blue, 0 .. 1, of what is behind them, or None.
        names: names of objects by ID.
    """

    up: list[float] | None = None
    background: list[float] | None = None
    names: dict[int, str] = field(default_factory=dict)


def description_comments(description: Description) -> list[str]:
    """Return the comments of the header that `read_description` reads."""
    comments = []
    if description.background:
        comments.append(f"{_BACKGROUND} " + " ".join(f"{value:.4f}" for value in description.background))
    if description.up:
        comments.append(f"{_UP} " + " ".join(f"{value:.6g}" for value in description.up))
    names = [f"{_NAME} {i} {json.dumps(name)}" for i, name in sorted(description.names.items())]
    return comments + (names if sum(map(len, names)) <= _MOST_OF_NAMES else [])


def read_description(path: Path) -> Description:
    """Return what the comments of a file tell that was read as splats; nothing if it is no PLY."""
    up = background = None
    names: dict[int, str] = {}
    for comment in read_comments(path):
        word, _, rest = comment.partition(" ")
        try:
            if word == _UP:
                up = _three_numbers(rest)
            elif word == _BACKGROUND:
                background = _three_numbers(rest)
            elif word == _NAME:
                number, _, text = rest.partition(" ")
                if text.startswith('"'):
                    names[int(number)] = parse_json(text)
        except ValueError:
            continue
    background = background and np.clip(background, 0.0, 1.0).tolist()
    return Description(up if up and abs(math.hypot(*up) - 1.0) < _UNIT_WITHIN else None, background, names)


def _three_numbers(text: str) -> list[float] | None:
    values = [float(value) for value in text.split()]
    return values if len(values) == 3 and np.isfinite(values).all() else None


def blur_comment(variance: float) -> str:
    """Return the comment of the header with the low-pass filter of the splats."""
    return f"{_BLUR} {variance:g}"


def read_blur(path: Path) -> float:
    """Return the variance of the low-pass filter of splats that `read_splat_table` has read.

    It is that of 3D Gaussian splatting if the file does not say. Splats that were trained with antialiasing look best
    with that of this program, since what it adds to them is not taken from their opacity.
    """
    comments = read_comments(path)
    for comment in comments:
        name, _, value = comment.partition(" ")
        if name == _BLUR:
            try:
                blur = float(value)
            except ValueError:
                continue
            if LEAST_EPS_2D <= blur <= USUAL_EPS_2D:
                return blur
    return EPS_2D if any(" ".join(text.lower().split()) in _ANTIALIASED for text in comments) else USUAL_EPS_2D


def splat_dtype(names: Iterable[str], position: str = "f4") -> np.dtype:
    """Return the type of a row with these properties; `position` is the type of x, y and z, `f4` or `f8`."""
    kinds = {**dict.fromkeys(MEANS, position), OBJECT_ID: "u4", UNOBSERVED: "u1"}
    return np.dtype([(name, "<" + kinds.get(name, "f4")) for name in names])


def read_splat_table(path: Path, foreign: bool = False) -> np.ndarray:
    """Read a PLY file of splats, written by this or another program.

    Args:
        path: The file to read.
        foreign: Whether to accept also what only other programs write: spherical harmonics of degree 4, and discs
            without the third scale, as of 2D Gaussian splatting.

    Returns:
        A structured array (N,) with the file's properties, which include `REQUIRED`, apart from that scale, and whole
        spherical-harmonics degrees; other properties, order and number types are the file's. Values are not checked.

    Raises:
        InputError: The file is missing, truncated, ASCII, or not a PLY of splats.
    """
    table = read_vertices(path)
    names = table.dtype.names or ()
    missing = [name for name in REQUIRED if name not in names]
    if missing and not (foreign and missing == [SCALES[2]]):
        raise InputError(
            f"{path} is a PLY file but not one of Gaussian splats: it has no property {', '.join(missing)}."
        )
    rest = sum(name.startswith(_REST) for name in names)
    if rest not in (0, 9, 24, 45) and not (foreign and rest == 72):
        raise InputError(f"{path} has {rest} properties f_rest_*; 0, 9, 24 or 45 were expected.")
    if any(f"{_REST}{i}" not in names for i in range(rest)):
        raise InputError(f"{path} has {rest} properties f_rest_*, but they are not numbered from 0.")
    return table


def coefficients_of(table: np.ndarray) -> int:
    """Return the number of spherical-harmonics coefficients per channel in a table of `read_splat_table`."""
    return sum(name.startswith(_REST) for name in table.dtype.names or ()) // 3 + 1


def unobserved_of(table: np.ndarray) -> np.ndarray:
    """Return which splats are unobserved, (N,) bool; all False if the file does not say."""
    marked = next((name for name in (UNOBSERVED, FORMER_UNOBSERVED) if name in (table.dtype.names or ())), None)
    return np.zeros(len(table), bool) if marked is None else table[marked] != 0


def ids_of(table: np.ndarray) -> np.ndarray:
    """Return the (N,) int64 object IDs of a table of splats or anchors, 0 if it has none; others are clamped."""
    if OBJECT_ID not in (table.dtype.names or ()):
        return np.zeros(len(table), np.int64)
    ids = table[OBJECT_ID]
    if ids.dtype.kind == "f":
        ids = np.rint(np.nan_to_num(ids, nan=0.0))
    return np.clip(ids.astype(np.int64), 0, LARGEST_ID)


def shown_rows(table: np.ndarray, names: Sequence[str] = REQUIRED) -> np.ndarray:
    """Find the rows that can be shown, (N,) bool: finite in the properties `names`, and with a rotation and a scale
    within limits if these are among them."""
    keep = np.empty(len(table), bool)
    for start in range(0, len(table), _ROWS_AT_ONCE):
        rows = table[start : start + _ROWS_AT_ONCE]
        good = np.isfinite(sum(rows[name].astype(np.float64) for name in names))
        if QUATS[0] in names:
            good &= np.maximum.reduce([np.abs(rows[name]) for name in QUATS]) > SMALLEST_QUAT
            good &= np.maximum.reduce([rows[name] for name in SCALES]) < LARGEST_SHOWN_LOG_SCALE
        keep[start : start + _ROWS_AT_ONCE] = good
    return keep
