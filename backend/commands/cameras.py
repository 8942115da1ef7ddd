"""cameras.json: the capture's cameras and how to stand it up, for programs that show it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..capture import Capture, Upright, stand_up
from ..protocol import InputError, Reconstruction, plain, read_json, write_json


def write_cameras(folder: Reconstruction, capture: Capture) -> None:
    """Write cameras.json: the views in the capture's coordinates, `origin` and the `upright` transform.

    Images and masks are absolute paths, or relative to the reconstruction folder where they lie in it.
    """
    stood = stand_up(np.array([view.viewmat for view in capture.views]), capture.points.xyz)
    held_out = set(capture.test_indices)
    value = {
        "capture": capture.folder.resolve(),
        "origin": stood.origin,
        "upright": {"rotation": stood.rotation, "translation": stood.translation},
        "cameras": [
            {
                "name": view.name,
                "image": _place(view.image_file, folder.folder),
                "mask": None if view.mask_file is None else _place(view.mask_file, folder.folder),
                "width": view.width, "height": view.height, "K": view.K, "viewmat": view.viewmat,
                "held_out": index in held_out,
            }
            for index, view in enumerate(capture.views)
        ],
    }  # fmt: skip
    write_json(folder.cameras, plain(value))


def write_no_cameras(folder: Reconstruction, centres: np.ndarray) -> None:
    """Write cameras.json of splats (N, 3) whose photos nobody has: up is where it is for COLMAP's first camera, mostly,
    or square to the plane that most of them lie in."""
    stood = stand_up(np.eye(4)[None], centres)
    upright = {"rotation": stood.rotation, "translation": stood.translation}
    write_json(folder.cameras, plain({"capture": None, "origin": stood.origin, "upright": upright, "cameras": []}))


def read_upright(folder: Reconstruction) -> Upright:
    """How cameras.json stands the capture up; where there is none, as it is. InputError where it cannot be used."""
    if not folder.cameras.exists():
        return Upright(np.zeros(3), np.eye(3), np.zeros(3))
    content = read_json(folder.cameras)
    try:
        found = Upright(
            np.array(content["origin"], np.float64).reshape(3),
            np.array(content["upright"]["rotation"], np.float64).reshape(3, 3),
            np.array(content["upright"]["translation"], np.float64).reshape(3),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{folder.cameras} does not say how the capture stands upright; run import again.") from error
    return found


def _place(path: Path, folder: Path) -> str:
    path, folder = path.resolve(), folder.resolve()
    return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else str(path)
