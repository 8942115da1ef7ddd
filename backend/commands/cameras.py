"""The cameras of a capture, and of imported splats, as cameras.json holds them."""

from __future__ import annotations

import numpy as np

from ..capture import Capture, Upright, compute_upright
from ..shared.reconstruction.cameras import NAME, Cameras, CameraView, read_cameras, write_cameras
from ..shared.reconstruction.folder import Reconstruction


def write_capture_cameras(folder: Reconstruction, capture: Capture) -> None:
    """Write cameras.json of a capture: its views, and how to stand it up."""
    held_out = set(capture.test_indices)
    views = [
        CameraView(
            view.name, view.image_file, view.mask_file, view.width, view.height, view.K, view.viewmat, i in held_out
        )
        for i, view in enumerate(capture.views)
    ]
    upright = compute_upright(np.array([view.viewmat for view in capture.views]), capture.points.xyz)
    write_cameras(folder.folder, Cameras(capture.folder.resolve(), upright.origin, _matrix(upright), views))


def write_splat_cameras(folder: Reconstruction, centers: np.ndarray) -> None:
    """Write cameras.json of splats without photos.

    Up is where it is for COLMAP's first camera, mostly, or square to the plane that most of the centers (N, 3) lie in.
    """
    upright = compute_upright(np.eye(4)[None], centers)
    write_cameras(folder.folder, Cameras(None, upright.origin, _matrix(upright), ()))


def read_upright(folder: Reconstruction) -> Upright:
    """How cameras.json stands the capture up; where there is none, as it is.

    Raises:
        InputError: the file cannot be used.
    """
    if not (folder.folder / NAME).exists():
        return Upright(np.zeros(3), np.eye(3), np.zeros(3))
    cameras = read_cameras(folder.folder)
    return Upright(cameras.origin, cameras.upright[:3, :3], cameras.upright[:3, 3])


def _matrix(upright: Upright) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = upright.rotation, upright.translation
    return matrix
