"""Rigs: cameras that are fixed to each other, with a folder for each one in which photos of a moment have one name."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap

_FEWEST = 4
"""Number of moments from which on two folders may be of a rig."""
_TURN = 1.0
"""Largest median difference between the relative rotations of two cameras of a rig, in degrees."""
_SHIFT = 0.02
"""The same of relative positions, as a fraction of the length of the diagonal of all positions."""


def tie_rigs(model: pycolmap.Reconstruction, left_out: Sequence[pycolmap.Image] = ()) -> list[list[str]]:
    """Make rigs of cameras whose photos of the same name lie in several folders, if they keep their relative poses.

    The poses of a rig's cameras are determined together from then on, and a photo without a pose gets that which the
    others of its moment tell.

    Args:
        model: the poses; changed in place.
        left_out: photos that match nothing; those of a rig are added if another one of their moment has a pose.

    Returns:
        The folders of each rig, with slashes at the end.
    """
    rigs = _find(model)
    if not rigs:
        return []
    _add(model, left_out, rigs)
    # COLMAP takes all images whose names begin with a folder, also those in folders inside.
    names = {number: image.name for number, image in model.images.items()}
    flat = {folder: f"{number}/" for number, folder in enumerate({_folder(name) for name in names.values()})}
    configs = []
    for folders in rigs:
        config, cameras = pycolmap.RigConfig(), []
        for number, folder in enumerate(folders):
            camera = pycolmap.RigConfigCamera()
            camera.image_prefix, camera.ref_sensor = flat[folder], number == 0
            cameras.append(camera)
        config.cameras = cameras
        configs.append(config)
    for number, name in names.items():
        folder = _folder(name)
        model.images[number].name = flat[folder] + name[len(folder) :]
    # It takes the names and cameras of the images from a database.
    with tempfile.TemporaryDirectory() as made, pycolmap.Database.open(Path(made) / "rigs.db") as database:
        for camera in model.cameras.values():
            database.write_camera(camera, True)
        for rig in model.rigs.values():
            database.write_rig(rig, True)
        for frame in model.frames.values():
            database.write_frame(frame, True)
        for image in model.images.values():
            database.write_image(image, True)
        pycolmap.apply_rig_config(configs, database, model)
    for number, name in names.items():
        model.images[number].name = name
    return rigs


def rigs_of(model: pycolmap.Reconstruction) -> list[list[str]]:
    """Return the folders of each rig with several cameras in a model, with slashes at the end."""
    found: dict[int, set[str]] = {}
    for frame in model.frames.values():
        folders = {_folder(model.image(data.id).name) for data in frame.image_ids}
        if len(folders) > 1:
            found.setdefault(frame.rig_id, set()).update(folders)
    return [sorted(folders) for folders in found.values()]


def _find(model: pycolmap.Reconstruction) -> list[list[str]]:
    """Return the folders of each rig, the one with most posed photos first."""
    moments: dict[str, dict[str, np.ndarray]] = {}
    counts: dict[str, int] = {}
    cameras: dict[str, set[int]] = {}
    centers = []
    for number in model.reg_image_ids():
        image = model.image(number)
        folder = _folder(image.name)
        moments.setdefault(image.name[len(folder) :], {})[folder] = image.cam_from_world().matrix()
        counts[folder] = counts.get(folder, 0) + 1
        cameras.setdefault(folder, set()).add(image.camera_id)
        centers.append(image.projection_center())
    size = float(np.linalg.norm(np.ptp(centers, axis=0))) if centers else 0.0
    # A rig's cameras differ, and each keeps its lens.
    left = sorted((folder for folder in counts if folder and len(cameras[folder]) == 1), key=lambda f: (-counts[f], f))
    found = []
    while left:
        first, rest = left[0], left[1:]
        fixed = [
            other
            for other in rest
            if cameras[other] != cameras[first]
            and _are_fixed([(m[first], m[other]) for m in moments.values() if first in m and other in m], size)
        ]
        if fixed:
            found.append([first, *fixed])
        left = [folder for folder in rest if folder not in fixed]
    return found


def _add(model: pycolmap.Reconstruction, photos: Sequence[pycolmap.Image], rigs: list[list[str]]) -> None:
    """Add photos, without poses, to a model if they are of a rig and another one of their moment has a pose."""
    cameras = {image.name: image.camera_id for image in (model.image(number) for number in model.reg_image_ids())}
    lenses = {_folder(name): camera for name, camera in cameras.items()}
    for photo in photos:
        folder = _folder(photo.name)
        moment = [other + photo.name[len(folder) :] for rig in rigs if folder in rig for other in rig]
        if photo.camera_id == lenses.get(folder) and any(name in cameras for name in moment):
            model.add_image_with_trivial_frame(photo)


def _are_fixed(pairs: Sequence[tuple[np.ndarray, np.ndarray]], size: float) -> bool:
    """Return whether two cameras keep their relative pose, from their poses (3, 4) at each moment."""
    if len(pairs) < _FEWEST:
        return False
    turns = np.array([second[:, :3] @ first[:, :3].T for first, second in pairs])
    shifts = np.array([second[:, 3] - turn @ first[:, 3] for turn, (first, second) in zip(turns, pairs, strict=True)])
    u, _, vt = np.linalg.svd(turns.sum(0))
    cosines = (np.einsum("nij,ij->n", turns, u @ vt) - 1) / 2
    turn = np.degrees(np.median(np.arccos(np.clip(cosines, -1.0, 1.0))))
    shift = np.median(np.linalg.norm(shifts - np.median(shifts, axis=0), axis=1))
    return bool(turn < _TURN and shift < _SHIFT * size)


def _folder(name: str) -> str:
    """Return the folder of a photo with a slash at the end, "" for none."""
    return name[: name.rfind("/") + 1]
