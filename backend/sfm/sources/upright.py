"""What is up in photos, by the sensors of the camera: EXIF's elevation, the gimbals of drones, and Apple's phones."""

from __future__ import annotations

import re
import struct
import warnings
from pathlib import Path

import numpy as np
from PIL import ExifTags
from PIL import Image as PilImage

_GIMBAL = re.compile(rb"Gimbal(Roll|Pitch)Degree[^-+0-9.]{1,4}([-+]?[0-9.]+)")
"""Roll and pitch in degrees in a drone's XMP data, as an attribute or an element."""
_LEVEL = 3.0
"""Largest roll of a camera that counts as level, in degrees."""

_APPLE = b"Apple iOS\0"
"""Beginning of the maker notes of Apple's phones, which a version and the byte order follow."""
_GRAVITY, _SIGNED_RATIONALS = 8, 10
"""Tag of the maker notes with the acceleration at rest in units of g, which points down, and its type."""
_STILL = (0.9, 1.1)
"""Acceleration of phones that are held still enough, in units of g."""
_CLEAR = 0.35
"""Least share of gravity along the height of a photo. Of phones that lie flat, the lower side is not known."""


def up_in_camera(path: Path) -> np.ndarray | None:
    """Return what is up in a photo, or None where it does not tell.

    That is in the EXIF data as the camera's elevation, in the XMP data of drones as the pitch of the gimbal, and in the
    maker notes of Apple's phones as gravity.

    Returns:
        (3,) unit vector in the camera, with x to the right in the stored picture, y down and z forward.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with PilImage.open(path) as image:
                exif, xmp, size = image.getexif(), image.info.get("xmp", b""), image.size
                details = exif.get_ifd(ExifTags.IFD.Exif)
        orientation = exif.get(ExifTags.Base.Orientation, 1)
        notes = details.get(ExifTags.Base.MakerNote)
        if isinstance(notes, bytes) and notes.startswith(_APPLE):
            is_front = "front" in str(details.get(ExifTags.Base.LensModel, ""))
            return None if is_front else _by_gravity(_apple_gravity(notes), size, orientation)
        stored = details.get(ExifTags.Base.CameraElevationAngle)
        if orientation != 1:  # These tell nothing of the roll.
            return None
        return _by_elevation(_gimbal_pitch(xmp) if stored is None else float(stored))
    except (OSError, KeyError, TypeError, ValueError, ZeroDivisionError, struct.error):
        return None


def _by_elevation(degrees: float) -> np.ndarray | None:
    """Return what is up for a level camera that looks above the horizon by an angle."""
    if not -90.0 <= degrees <= 90.0:
        return None
    return np.array([0.0, -np.cos(np.radians(degrees)), np.sin(np.radians(degrees))])


def _gimbal_pitch(xmp: object) -> float:
    """Return the pitch of a gimbal in degrees; raises ValueError or KeyError if it is not level or unknown."""
    told = {name: float(value) for name, value in _GIMBAL.findall(xmp if isinstance(xmp, bytes) else b"")}
    if abs(told.get(b"Roll", 0.0)) > _LEVEL:
        raise ValueError
    return told[b"Pitch"]


def _apple_gravity(notes: bytes) -> np.ndarray:
    """Return gravity (3,) by the maker notes of a phone: to its right, to its top, and out of its screen.

    Raises:
        ValueError, ZeroDivisionError, struct.error: They do not tell.
    """
    order = {b"MM": ">", b"II": "<"}[notes[12:14]]
    (entries,) = struct.unpack_from(f"{order}H", notes, 14)
    for start in range(16, 16 + 12 * entries, 12):
        tag, kind, values, offset = struct.unpack_from(f"{order}HHII", notes, start)
        if (tag, kind, values) == (_GRAVITY, _SIGNED_RATIONALS, 3):
            numbers = struct.unpack_from(f"{order}6i", notes, offset)
            return np.array([above / below for above, below in zip(numbers[::2], numbers[1::2], strict=True)])
    raise ValueError


def _by_gravity(gravity: np.ndarray, size: tuple[int, int], orientation: object) -> np.ndarray | None:
    """Return what is up in a photo of a phone's back camera.

    Its sensor has its right side at the lower end of the phone. A photo without an orientation may have been turned
    upright since, by a quarter if it is higher than wide.

    Args:
        gravity: (3,) by `_apple_gravity`.
        size: width and height of the photo.
        orientation: that of EXIF.
    """
    length = float(np.linalg.norm(gravity))
    if not _STILL[0] <= length <= _STILL[1]:
        return None
    x, y, z = gravity / length
    down = np.array([-y, -x, -z])
    if orientation == 1:
        width, height = size
        if width == height:
            return None
        if height > width:
            down = np.array([-down[1], down[0], down[2]])
        if abs(down[1]) < _CLEAR:
            return None
        if down[1] < 0:
            down[:2] = -down[:2]
    return -down
