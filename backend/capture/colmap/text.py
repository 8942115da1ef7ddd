"""Reader of the text files of a COLMAP model: cameras.txt, images.txt and points3D.txt."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from ...shared.errors import InputError
from ...shared.formats.regular_file import read_regular
from .model import CAMERA_MODELS, EXPORT_AGAIN, Camera, RawImage, RawPoints, decode_name

_PARAMETER_COUNTS = {name: count for name, count in CAMERA_MODELS.values()}


def _read_lines(path: Path) -> list[bytes]:
    return [line.rstrip(b"\r") for line in read_regular(path).split(b"\n")]


def _malformed_line(path: Path, number: int, expected: str) -> InputError:
    return InputError(f"{path} is malformed or truncated at line {number}: expected {expected}; {EXPORT_AGAIN}.")


def _warn_if_count_differs(lines: list[bytes], found: int, path: Path, content: str, warnings: list[str]) -> None:
    """Warn if the count in the file's header comment is wrong; not an error, since these files are edited by hand."""
    for line in lines[:10]:
        match = re.match(rb"#\s*Number of \w+:\s*(\d+)", line)
        if match and int(match[1]) != found:
            warnings.append(f"{path} declares {int(match[1])} {content} but contains {found}.")
            return


def read_cameras_text(path: Path) -> dict[int, Camera]:
    """Read cameras.txt; returns the cameras by ID."""
    cameras: dict[int, Camera] = {}
    for number, line in enumerate(_read_lines(path), 1):
        fields = line.split()
        if not fields or fields[0].startswith(b"#"):
            continue
        expected = "CAMERA_ID MODEL WIDTH HEIGHT PARAMETERS"
        if len(fields) < 4:
            raise _malformed_line(path, number, expected)
        model = fields[1].decode("utf-8", "replace")
        if model not in _PARAMETER_COUNTS:
            raise InputError(f"{path} gives a camera the model {model}, which is not one of COLMAP's; {EXPORT_AGAIN}.")
        if len(fields) != 4 + _PARAMETER_COUNTS[model]:
            raise _malformed_line(path, number, f"{_PARAMETER_COUNTS[model]} parameters of {model}")
        try:
            camera_id, width, height = int(fields[0]), int(fields[2]), int(fields[3])
            cameras[camera_id] = Camera(camera_id, model, width, height, tuple(float(f) for f in fields[4:]))
        except ValueError as error:
            raise _malformed_line(path, number, expected) from error
    return cameras


def read_images_text(path: Path, warnings: list[str]) -> list[RawImage]:
    """Read images.txt; only observations of a triangulated point are kept."""
    lines = _read_lines(path)
    images = []
    at = 0
    while at < len(lines):
        line = lines[at]
        at += 1
        if not line.strip() or line.startswith(b"#"):
            continue
        fields = line.split(None, 9)
        expected = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
        if len(fields) < 10:
            raise _malformed_line(path, at, expected)
        try:
            pose = tuple(float(f) for f in fields[1:8])
            camera_id = int(fields[8])
        except ValueError as error:
            raise _malformed_line(path, at, expected) from error
        observed = np.zeros((0, 3))
        if at < len(lines):
            try:
                observed = np.array(lines[at].split(), np.float64).reshape(-1, 3)
            except ValueError as error:
                raise _malformed_line(path, at + 1, "X Y POINT3D_ID for each observation of an image") from error
            at += 1
        # Observations without a point have the ID -1, or 2^64 - 1 if it was printed as unsigned.
        observed = observed[(observed[:, 2] >= 0) & (observed[:, 2] < 2.0**62)]
        name = decode_name(fields[9], path)
        images.append(RawImage(name, camera_id, pose[:4], pose[4:], observed[:, :2], observed[:, 2].astype(np.int64)))
    _warn_if_count_differs(lines, len(images), path, "images", warnings)
    return images


def read_points_text(path: Path, warnings: list[str]) -> RawPoints:
    """Read points3D.txt without the tracks."""
    lines = _read_lines(path)
    ids, xyz, rgb, errors = [], [], [], []
    for number, line in enumerate(lines, 1):
        fields = line.split(None, 8)
        if not fields or fields[0].startswith(b"#"):
            continue
        try:
            if len(fields) < 8:
                raise ValueError
            ids.append(int(fields[0]))
            if not 0 <= ids[-1] < 2**63:
                raise ValueError
            xyz.append((float(fields[1]), float(fields[2]), float(fields[3])))
            rgb.append((int(fields[4]) & 255, int(fields[5]) & 255, int(fields[6]) & 255))
            errors.append(float(fields[7]))
        except ValueError as error:
            raise _malformed_line(path, number, "POINT3D_ID X Y Z R G B ERROR TRACK") from error
    _warn_if_count_differs(lines, len(ids), path, "points", warnings)
    return RawPoints(
        np.array(ids, np.int64),
        np.array(xyz, np.float64).reshape(-1, 3),
        np.array(rgb, np.uint8).reshape(-1, 3),
        np.array(errors, np.float64),
    )
