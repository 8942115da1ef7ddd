"""Validation of models, whichever program made them."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...shared.errors import InputError
from .model import COLMAP, Camera, Image, Model, RawImage, export_again

_LARGEST_SIDE = 1 << 20
_FARTHEST = 1e12
"""Largest absolute coordinate of points and cameras; beyond, distances have no precision left."""


def validate(model: Model, raw: list[RawImage]) -> Model:
    """Check a model as read from its files, and compute its images.

    Args:
        model: The model without images.
        raw: The images as stored.

    Returns:
        The model with its images; points with NaN or Inf are left out, with a warning.

    Raises:
        InputError: The model cannot be used; the message names the file.
    """
    again = export_again(model.program)
    images_file, points_file = model.file("images"), model.file("points3D")
    if not raw:
        how = "run COLMAP's mapper until it registers images"
        if model.program != COLMAP:
            how = f"align the photos in {model.program}, then export the cameras again"
        raise InputError(f"{images_file} contains no image with a pose; {how}.")
    used: set[int] = set()
    names: set[str] = set()
    for image in raw:
        if image.camera_id not in model.cameras:
            raise InputError(
                f"{images_file} gives image {image.name} the camera {image.camera_id}, which "
                f"{model.file('cameras').name} does not hold; {again}."
            )
        if image.name in names:
            raise InputError(f"{images_file} contains two images named {image.name}; {again}.")
        names.add(image.name)
        used.add(image.camera_id)
    for camera_id in sorted(used):
        check_camera(model.cameras[camera_id], model.file("cameras"), again)

    with np.errstate(invalid="ignore"):
        finite = (np.abs(model.xyz) <= _FARTHEST).all(1)
    if not finite.all():
        model.warnings.append(
            f"{points_file} contains {int((~finite).sum())} points whose coordinates are not finite or exceed "
            f"{_FARTHEST:g}; they are left out."
        )
    if int(finite.sum()) < 4:
        raise InputError(f"{points_file} contains only {int(finite.sum())} points, and at least 4 are needed; {again}.")
    xyz, ids = model.xyz[finite], model.ids[finite]
    order = np.argsort(ids, kind="stable")
    sorted_ids = ids[order]

    images = []
    for image in raw:
        at = np.minimum(np.searchsorted(sorted_ids, image.point_ids), len(ids) - 1)
        known = (sorted_ids[at] == image.point_ids) & np.isfinite(image.xy).all(1)
        viewmat = _compute_viewmat(image, images_file, again)
        images.append(Image(image.name, image.camera_id, viewmat, image.xy[known], order[at[known]]))
    largest = np.finfo(np.float32).max
    error = np.clip(model.error[finite], -largest, largest).astype(np.float32)
    return replace(model, images=images, xyz=xyz, rgb=model.rgb[finite], error=error, ids=ids)


def check_camera(camera: Camera, path: Path, again: str) -> None:
    """Raise InputError if a camera of the file `path` has an impossible size or parameters that no lens has.

    Args:
        camera: The camera.
        path: The file, for messages.
        again: What the user should do.
    """
    who = f"{path} gives camera {camera.id} ({camera.model})"
    if not (0 < camera.width <= _LARGEST_SIDE and 0 < camera.height <= _LARGEST_SIDE):
        raise InputError(f"{who} the impossible size {camera.width}x{camera.height}; {again}.")
    if not all(math.isfinite(value) for value in camera.params):
        raise InputError(f"{who} parameters that are not numbers (NaN or infinite); {again}.")
    if camera.model != "EQUIRECTANGULAR" and not camera.params[0]:
        raise InputError(f"{who} a focal length of 0; {again}.")


def _compute_viewmat(image: RawImage, path: Path, again: str) -> np.ndarray:
    q = np.array(image.quaternion, np.float64)
    t = np.array(image.translation, np.float64)
    with np.errstate(over="ignore"):
        norm = float(np.linalg.norm(q)) if np.isfinite(q).all() else math.nan
    if not (np.isfinite(t).all() and 1e-6 < norm < 1e6):
        raise InputError(
            f"{path} gives image {image.name} a pose that is not a number (NaN, infinite or zero); {again}."
        )
    if np.abs(t).max() > _FARTHEST:
        raise InputError(f"{path} gives image {image.name} a position beyond {_FARTHEST:g}; {again}.")
    w, x, y, z = q / norm
    viewmat = np.eye(4)
    viewmat[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    viewmat[:3, 3] = t
    return viewmat
