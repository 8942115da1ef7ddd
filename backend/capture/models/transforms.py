"""Reader of transforms.json, which nerfstudio, instant-ngp, Polycam and others write.

Poses are camera to world with OpenGL's axes. Each parameter of the cameras stands in a frame or, for all frames, beside
them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ...shared.formats.json_file import parse_json
from ..colmap import Model
from .draft import FLIP, Draft, shorten
from .lens import Lens, brown, fisheye

_BROWN = ("OPENCV", "SIMPLE_RADIAL", "RADIAL")
_QUOTIENT = ("FULL_OPENCV",)
_PINHOLE = ("PINHOLE", "SIMPLE_PINHOLE")
_FISHEYE = ("OPENCV_FISHEYE",)


def recognizes(_head: bytes) -> bool:
    """Return True: a transforms.json is recognized by its name."""
    return True


def read(file: Path) -> Model:
    """Read a transforms.json and its point cloud.

    Args:
        file: The file, beside images/.

    Returns:
        The model. If the file has an `applied_transform`, it is undone, so that the model is in the coordinates that
        the cameras had before, as in COLMAP.

    Raises:
        InputError: The file is damaged, has a camera model that is not supported, or there is no point cloud.
    """
    draft = Draft(file)
    try:
        content = parse_json(draft.text())
    except ValueError as error:
        raise draft.refusal(f"cannot be read as JSON ({error})") from error
    if not isinstance(content, dict) or not isinstance(content.get("frames"), list):
        raise draft.refusal('has no list "frames" of cameras')
    undo = _undo(draft, content.get("applied_transform"))
    for number, frame in enumerate(content["frames"], 1):
        if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
            raise draft.refusal(f"has no file_path in frame {number}")
        entry = _Entry(draft, {**content, **frame})
        pose = _matrix(draft, frame.get("transform_matrix"), f"the transform_matrix of {shorten(frame['file_path'])}")
        draft.add(frame["file_path"], entry.lens, undo @ pose @ FLIP, entry.size())
    named = content.get("ply_file_path")
    if named is not None and not isinstance(named, str):
        raise draft.refusal("has a ply_file_path that is not a path")
    # The cloud that the file names has the poses' coordinates; others may never have been transformed.
    return draft.finish_with_point_cloud(named, [undo] if named else [undo, np.eye(4)])


class _Entry:
    """The values that apply to a frame."""

    def __init__(self, draft: Draft, values: Mapping[str, Any]) -> None:
        self._draft, self._values = draft, values

    def number(self, key: str, otherwise: float) -> float:
        """Return a number, or `otherwise` if there is none."""
        found = self.optional(key)
        return otherwise if found is None else found

    def optional(self, key: str) -> float | None:
        """Return a number, or None if there is none; raises InputError for other values."""
        value = self._values.get(key)
        if value is None:
            return None
        try:
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise ValueError
            return float(value)
        except (ValueError, OverflowError) as error:
            raise self._draft.refusal(f"has the value {shorten(str(value))[:40]} for {key}, not a number") from error

    def size(self) -> tuple[int, int] | None:
        """Return the width and height, if the file has both."""
        width, height = self.optional("w"), self.optional("h")
        if width is None or height is None:
            return None
        if not (math.isfinite(width) and math.isfinite(height)):
            raise self._draft.refusal("has an infinite w or h")
        return int(width), int(height)

    def lens(self, width: int, height: int) -> Lens:
        """Return the lens of an image of this size."""
        name = self._values.get("camera_model")
        if name is None:
            name = "OPENCV_FISHEYE" if self._values.get("is_fisheye") else "OPENCV"
        model = str(name).upper()
        known = (*_PINHOLE, *_BROWN, *_QUOTIENT, *_FISHEYE)
        if model not in known:
            raise self._draft.refusal(
                f"has the camera_model {shorten(str(name))[:40]}, which is none of {', '.join(known)}"
            )
        focal = self._focal(width, height)
        center = self.number("cx", width / 2), self.number("cy", height / 2)
        k1, k2, k3, k4, p1, p2 = (self.number(key, 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
        if model in _PINHOLE:
            return Lens("PINHOLE", (*focal, *center))
        if model in _FISHEYE:
            return fisheye(focal, center, (k1, k2, k3, k4))
        if model in _QUOTIENT:
            # As in OpenCV, k4 to k6 are those of the denominator.
            rest = k3, k4, self.number("k5", 0.0), self.number("k6", 0.0)
            return Lens("FULL_OPENCV", (*focal, *center, k1, k2, p1, p2, *rest))
        try:
            return brown(focal, center, (k1, k2, k3, k4), (p1, p2), (width, height))
        except ValueError as error:
            raise self._draft.refusal(f"has a lens that cannot be used: {error}") from error

    def _focal(self, width: int, height: int) -> tuple[float, float]:
        fx = self.optional("fl_x") or _focal_of(self.optional("camera_angle_x"), width)
        fy = self.optional("fl_y") or _focal_of(self.optional("camera_angle_y"), height)
        if fx is None and fy is None:
            raise self._draft.refusal("has neither fl_x nor camera_angle_x for a frame")
        return (fx or fy or 0.0), (fy or fx or 0.0)


def _focal_of(angle: float | None, side: int) -> float | None:
    """Return the focal length in pixels of a side that is seen under an angle in radians; None without a real angle."""
    return side / 2 / math.tan(angle / 2) if angle is not None and 0 < angle < math.pi else None


def _matrix(draft: Draft, value: Any, what: str) -> np.ndarray:
    """Return a matrix of 3 x 4 or 4 x 4 numbers as (4, 4)."""
    try:
        matrix = np.array(value, np.float64)
        if matrix.shape not in ((3, 4), (4, 4)):
            raise ValueError
    except (TypeError, ValueError, OverflowError) as error:
        raise draft.refusal(f"has no 4 x 4 numbers as {what}") from error
    whole = np.eye(4)
    whole[: len(matrix)] = matrix
    if not np.allclose(whole[3], [0, 0, 0, 1], rtol=0, atol=1e-6):
        raise draft.refusal(f"has a last row other than 0, 0, 0, 1 in {what}")
    return whole


def _undo(draft: Draft, applied: Any) -> np.ndarray:
    """Return the inverse (4, 4) of the transform that was applied to the coordinates."""
    if applied is None:
        return np.eye(4)
    matrix = _matrix(draft, applied, "the applied_transform")
    try:
        inverse = np.linalg.inv(matrix)
        if not np.isfinite(inverse).all():
            raise np.linalg.LinAlgError
    except np.linalg.LinAlgError as error:
        raise draft.refusal("has an applied_transform that cannot be undone") from error
    return inverse
