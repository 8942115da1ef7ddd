"""cameras.json: the capture's cameras, and the transform that turns its coordinates upright.

    {"capture": "/captures/garden", "origin": [x, y, z],
     "upright": {"rotation": [[...], ...], "translation": [x, y, z]},
     "cameras": [{"name": "0001.jpg", "image": "cache/images/0001.png", "mask": null, "width": 640, "height": 480,
                  "K": [[...], ...], "viewmat": [[...], ...], "held_out": false}, ...]}

Paths of images and masks are relative to the reconstruction folder if they are inside it, and absolute otherwise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..formats.json_file import plain, read_json, write_json

NAME = "cameras.json"


@dataclass(frozen=True)
class CameraView:
    """A view of the capture.

    Attributes:
        name: name of the image in the capture.
        image: absolute path of the undistorted image.
        mask: absolute path of the object ID mask, or None.
        width, height: size in pixels.
        K: intrinsics (3, 3) in pixels; the center of the first pixel is (0.5, 0.5).
        viewmat: (4, 4) from the capture's coordinates to the camera's (x right, y down, z forward).
        held_out: whether the view is excluded from training, for evaluation.
    """

    name: str
    image: Path
    mask: Path | None
    width: int
    height: int
    K: np.ndarray
    viewmat: np.ndarray
    held_out: bool

    @property
    def aspect(self) -> float:
        """Pixel aspect ratio, width over height: fy / fx."""
        return float(self.K[1, 1] / self.K[0, 0])


@dataclass(frozen=True)
class Cameras:
    """The cameras of a reconstruction.

    Attributes:
        capture: folder of the capture, or None.
        origin: (3,) offset that Blender subtracts from the capture's coordinates, which may be large.
        upright: (4, 4) from the coordinates relative to `origin` to coordinates with z up.
        views: the views in the order of the capture.
    """

    capture: Path | None
    origin: np.ndarray
    upright: np.ndarray
    views: Sequence[CameraView]


def write_cameras(folder: Path, cameras: Cameras) -> None:
    """Write cameras.json into the reconstruction `folder`."""

    def stored(path: Path) -> str:
        path, inside = path.resolve(), folder.resolve()
        return path.relative_to(inside).as_posix() if path.is_relative_to(inside) else str(path)

    content = {
        "capture": cameras.capture,
        "origin": cameras.origin,
        "upright": {"rotation": cameras.upright[:3, :3], "translation": cameras.upright[:3, 3]},
        "cameras": [
            {
                "name": view.name,
                "image": stored(view.image),
                "mask": None if view.mask is None else stored(view.mask),
                "width": view.width,
                "height": view.height,
                "K": view.K,
                "viewmat": view.viewmat,
                "held_out": view.held_out,
            }
            for view in cameras.views
        ],
    }
    write_json(folder / NAME, plain(content))


def read_cameras(folder: Path) -> Cameras:
    """Read cameras.json from the reconstruction `folder`.

    Raises:
        InputError: The file is missing, or one of its fields is invalid.
    """
    path = folder / NAME
    if not path.is_file():
        raise InputError(
            f"{folder} is no reconstruction, since it has no {NAME}; choose one that an import has written."
        )
    content = read_json(path)
    try:
        upright = np.eye(4)
        upright[:3, :3] = _finite(content["upright"]["rotation"], (3, 3))
        upright[:3, 3] = _finite(content["upright"]["translation"], (3,))
        capture = content.get("capture")
        return Cameras(
            None if capture is None else Path(capture),
            _finite(content["origin"], (3,)),
            upright,
            [_view(entry, folder) for entry in content["cameras"]],
        )
    except (AttributeError, KeyError, TypeError, ValueError, OverflowError, np.linalg.LinAlgError) as error:
        raise InputError(f"{path} is not a valid list of cameras ({error!r}); run Import again.") from error


def _view(entry: Any, folder: Path) -> CameraView:
    mask = entry.get("mask")
    view = CameraView(
        name=str(entry["name"]),
        image=folder / entry["image"],
        mask=None if mask is None else folder / mask,
        width=int(entry["width"]),
        height=int(entry["height"]),
        K=_finite(entry["K"], (3, 3)),
        viewmat=_finite(entry["viewmat"], (4, 4)),
        held_out=bool(entry["held_out"]),
    )
    if view.width < 1 or view.height < 1 or view.K[0, 0] <= 0 or view.K[1, 1] <= 0:
        raise ValueError(f"camera {view.name} has no size or no focal length")
    np.linalg.inv(view.viewmat)
    view.name.encode()  # Blender requires valid Unicode, but JSON escapes may encode lone surrogates.
    return view


def _finite(value: Any, shape: tuple[int, ...]) -> np.ndarray:
    array = np.array(value, np.float64)
    if array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"{shape} finite numbers were expected")
    return array
