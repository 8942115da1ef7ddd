"""Writing and reading of cameras.json for captures and for imported splats."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..capture import Capture, Upright, compute_upright
from ..shared.formats.photos_source import read_up
from ..shared.reconstruction.cameras import NAME, Cameras, CameraView, read_cameras, write_cameras
from ..shared.reconstruction.folder import Reconstruction


def write_capture_cameras(folder: Reconstruction, capture: Capture) -> None:
    """Write cameras.json for a capture: its views and its upright transform."""
    held_out = set(capture.test_indices)
    views = [
        CameraView(
            view.name, view.image_file, view.mask_file, view.width, view.height, view.K, view.viewmat, i in held_out
        )
        for i, view in enumerate(capture.views)
    ]
    viewmats, up = np.array([view.viewmat for view in capture.views]), read_up(capture.folder)
    upright = compute_upright(viewmats, capture.points.xyz, None if up is None else np.array(up))
    write_cameras(folder.folder, Cameras(capture.folder.resolve(), upright.origin, _matrix(upright), views))


def write_splat_cameras(folder: Reconstruction, centers: np.ndarray, up: Sequence[float] | None = None) -> None:
    """Write cameras.json for splats with centers (N, 3), without photos.

    If `up` is not given, it is -Y, as usual for COLMAP's first camera, refined by the centers' largest level plane.
    """
    upright = compute_upright(np.eye(4)[None], centers, None if up is None else np.array(up))
    write_cameras(folder.folder, Cameras(None, upright.origin, _matrix(upright), ()))


def read_upright(folder: Reconstruction) -> Upright:
    """Read the upright transform from cameras.json; return the identity if there is no such file.

    Raises:
        InputError: The file is invalid.
    """
    if not (folder.folder / NAME).exists():
        return Upright(np.zeros(3), np.eye(3), np.zeros(3))
    cameras = read_cameras(folder.folder)
    return Upright(cameras.origin, cameras.upright[:3, :3], cameras.upright[:3, 3])


def _matrix(upright: Upright) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = upright.rotation, upright.translation
    return matrix
