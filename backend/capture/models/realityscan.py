"""Reader of RealityScan's (RealityCapture's) CSV export "Internal/External camera parameters".

Its world has z up. `heading`, `pitch` and `roll` are degrees: the camera, with OpenGL's axes, is rotated by the roll
about y, then by the pitch about x, then by the negative heading about z. `f` is for a side of 36 mm, and `px` and `py`
are fractions of a side, which is the longer one.
"""

from __future__ import annotations

import csv
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ..colmap import Model
from .draft import FLIP, Draft, shorten
from .lens import Lens, brown

_PROGRAM = "RealityScan"
_POSE = ("x", "y", "alt", "heading", "pitch", "roll")
_REQUIRED = (*_POSE, "f")
_OPTIONAL = ("px", "py", "k1", "k2", "k3", "k4", "t1", "t2")
_FILM = 36.0
_HEADER_WITHIN = 3
"""The header is in one of the first lines; the number of cameras may be before it."""


def recognizes(head: bytes) -> bool:
    """Return whether a file that starts with these bytes lists cameras of RealityScan."""
    lines = head.removeprefix(b"\xef\xbb\xbf").splitlines()[:_HEADER_WITHIN]
    return any(line.lower().replace(b" ", b"").startswith((b"#name,x,y", b"name,x,y")) for line in lines)


def read(file: Path) -> Model:
    """Read the CSV file and the point cloud beside it.

    Args:
        file: The file, in the folder with the photos or beside images/.

    Returns:
        The model, in RealityScan's coordinates.

    Raises:
        InputError: The file is damaged or lacks columns, or there is no point cloud.
    """
    draft = Draft(file, _PROGRAM)
    try:
        rows = list(csv.reader(draft.text().splitlines()))
    except csv.Error as error:
        raise draft.refusal(f"cannot be read as CSV ({error})") from error
    columns: list[str] = []
    for number, row in enumerate(rows, 1):
        cells = [cell.strip() for cell in row]
        if not columns:
            names = [cell.lstrip("#").strip().lower() for cell in cells]
            if names[:1] == ["name"]:
                columns = names
                missing = [name for name in _REQUIRED if name not in columns]
                if missing:
                    raise draft.refusal(
                        f"has no column {', '.join(missing)}: choose the format Internal/External camera parameters"
                    )
            continue
        if not any(cells):
            continue
        if len(cells) != len(columns):
            raise draft.refusal(f"is malformed or truncated at line {number}: expected {len(columns)} values")
        values = dict(zip(columns, cells, strict=True))
        try:
            numbers = {name: float(values[name] or 0) for name in (*_REQUIRED, *_OPTIONAL) if name in values}
        except ValueError as error:
            raise draft.refusal(f"is malformed at line {number}: expected numbers after the name") from error
        draft.add(values["name"], partial(_lens, draft, values["name"], numbers), _pose(numbers))
    if not columns:
        raise draft.refusal("has no header with the names of its columns")
    return draft.finish_with_point_cloud(export="the point cloud or the mesh")


def _pose(numbers: dict[str, float]) -> np.ndarray:
    """Return the camera-to-world matrix (4, 4) with OpenCV's axes."""
    position = [numbers[name] for name in _POSE[:3]]
    angles = np.array([-numbers["heading"], numbers["pitch"], numbers["roll"]])
    if not np.isfinite(angles).all():
        return np.full((4, 4), np.nan)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("ZXY", angles, degrees=True).as_matrix()
    pose[:3, 3] = position
    return pose @ FLIP


def _lens(draft: Draft, name: str, numbers: dict[str, float], width: int, height: int) -> Lens:
    side = max(width, height)
    focal = numbers["f"] * side / _FILM
    px, py, k1, k2, k3, k4, t1, t2 = (numbers.get(key, 0.0) for key in _OPTIONAL)
    center = width / 2 + px * side, height / 2 + py * side
    try:
        return brown((focal, focal), center, (k1, k2, k3, k4), (t1, t2), (width, height))
    except ValueError as error:
        raise draft.refusal(f"gives image {shorten(name)} a lens that cannot be used: {error}") from error
