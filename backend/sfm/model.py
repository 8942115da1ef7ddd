"""The models that mappers made of a set of photos: choice of the best, removal of wrong poses, size, and reasons."""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pycolmap

from ..shared.errors import InputError
from ..shared.formats.atomic import replace_file, require_still_there, write_atomic
from ..shared.formats.photos_source import SOURCE, WORK
from ..shared.photos.former_model import forget_former, keep_former, put_former_back
from . import database
from .agreement import Agreement, measure_agreement

SPARSE = Path("sparse") / "0"
DISTANCE = 2.0
"""Median distance of points from the cameras that see them in a finished model, in units that are meters on average."""
FEWEST_FEATURES = 100
_LEAST_SET = 0.05
"""Number of photos of a separate set relative to the largest, below which they are photos without a pose."""
_LEAST_ANGLE = 1.5
"""Median angle in degrees between the rays of a point, below which photos show no parallax."""


class Candidate(NamedTuple):
    """A model of a mapper.

    Attributes:
        mapper: "global" or "incremental".
        model: the cameras, poses and points.
        agreement: how it agrees with the matches.
        sets: numbers of trusted photos of the mapper's models, which are separate, the largest first; without those
            that are too small to be a scene.
    """

    mapper: str
    model: pycolmap.Reconstruction
    agreement: Agreement
    sets: list[int]


def read_candidate(mapper: str, folder: Path, path: Path, number: int) -> Candidate | None:
    """Return the model with most trusted photos that a mapper wrote to the subfolders of `folder`, or one after it.

    Args:
        mapper: its name.
        folder: contains a folder for each model.
        path: the database with the matches.
        number: 1 for the largest model, 2 for the next, and so on.

    Returns:
        The model, or None if there are fewer.
    """
    models = []
    for each in sorted(folder.iterdir()) if folder.is_dir() else ():
        if (each / "images.bin").exists():
            models.append(pycolmap.Reconstruction(each))
    measured = [(model, measure_agreement(model, path)) for model in models if model.num_reg_images() > 1]
    measured.sort(key=lambda found: (len(found[1].trusted), found[0].num_points3D()), reverse=True)
    sizes = [len(agreement.trusted) for _, agreement in measured]
    sets = [size for size in sizes if size > 0 and size >= _LEAST_SET * sizes[0]]
    if not measured or number > max(len(sets), 1):
        return None
    return Candidate(mapper, *measured[number - 1], sets)


def best_of(candidates: Iterable[Candidate]) -> Candidate | None:
    """Return the candidate with most photos whose poses are trusted; of equals, the one with more observations."""
    return max(
        candidates,
        key=lambda each: (len(each.agreement.trusted), each.model.compute_num_observations()),
        default=None,
    )


def drop_untrusted(candidate: Candidate) -> list[str]:
    """Remove the poses of a model that are not trusted, and return the names of their photos."""
    model = candidate.model
    images = {number: model.image(number) for number in model.reg_image_ids()}
    dropped = {number: image for number, image in images.items() if image.name not in candidate.agreement.trusted}
    names = sorted(image.name for image in dropped.values())
    for frame in {image.frame_id for image in dropped.values()}:
        model.deregister_frame(frame)
    return names


def require_parallax(model: pycolmap.Reconstruction, photos: Path) -> None:
    """Raise InputError if the photos of a model were taken from one spot."""
    centers = {number: model.image(number).projection_center() for number in model.reg_image_ids()}
    angles = []
    for point in model.points3D.values():
        rays = np.array([centers[each.image_id] for each in point.track.elements if each.image_id in centers])
        rays = point.xyz - rays
        rays = rays / np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
        angles.append(np.degrees(np.arccos(np.clip((rays @ rays.T).min(), -1.0, 1.0))) if len(rays) else 0.0)
    if not angles or float(np.median(angles)) < _LEAST_ANGLE:
        raise InputError(one_spot(photos))


def one_spot(photos: Path) -> str:
    """Return the sentence about photos without parallax."""
    return (
        f"The photos in {photos} were taken from one spot, so they show no depth; take them from different places, a "
        "step apart."
    )


def still_background(photos: Path) -> str:
    """Return the sentence about objects that turn before a background at rest."""
    return (
        f"The background in the photos in {photos} stands still, so they do not tell from where the objects are seen; "
        "if these turned, add masks of them as IDs in masks/, or put them before a plain wall; else move the camera."
    )


def centers_of(model: pycolmap.Reconstruction) -> dict[str, np.ndarray]:
    """Return the centers (3,) of the posed cameras by name of the photo."""
    images = (model.image(number) for number in model.reg_image_ids())
    return {image.name: image.projection_center() for image in images}


def rotations_of(model: pycolmap.Reconstruction) -> dict[str, np.ndarray]:
    """Return the rotations (3, 3) from the world to the posed cameras by name of the photo."""
    images = (model.image(number) for number in model.reg_image_ids())
    return {image.name: image.cam_from_world().matrix()[:, :3] for image in images}


def common_size(model: pycolmap.Reconstruction) -> float:
    """Return the factor that puts points `DISTANCE` from their cameras in the median, for models of unknown size."""
    distances = [
        np.linalg.norm(model.points3D[point.point3D_id].xyz - image.projection_center())
        for image in (model.image(number) for number in model.reg_image_ids())
        for point in image.get_observation_points2D()
    ]
    middle = float(np.median(distances)) if distances else 0.0
    return DISTANCE / middle if middle > 0 else 1.0


def scaling(factor: float) -> np.ndarray:
    """Return the similarity transform (3, 4) that scales about the origin."""
    return np.column_stack([np.eye(3) * factor, np.zeros(3)])


def transform(model: pycolmap.Reconstruction, similarity: np.ndarray) -> None:
    """Apply a similarity transform (3, 4) to a model."""
    model.transform(pycolmap.Sim3d(similarity))


def add_points(model: pycolmap.Reconstruction, xyz: np.ndarray, rgb: np.ndarray) -> None:
    """Add points (n, 3) with colors (n, 3) uint8 that no feature belongs to."""
    for position, color in zip(xyz, rgb, strict=True):
        model.add_point3D(position, pycolmap.Track(), color)


def remove_points(model: pycolmap.Reconstruction, ids: np.ndarray) -> None:
    """Remove points with these IDs (n,)."""
    for point_id in ids.tolist():
        model.delete_point3D(point_id)


def write_model(model: pycolmap.Reconstruction, capture: Path) -> None:
    """Write a model as the sparse/0 of a capture, replacing the one there at the end."""
    target = capture / SPARSE
    require_still_there(capture)
    target.parent.mkdir(exist_ok=True)
    part, old = target.with_name("new"), target.with_name("old")
    for folder in (part, old):
        shutil.rmtree(folder, ignore_errors=True)
    part.mkdir()
    model.write(part)
    if target.exists():
        replace_file(target, old)
    replace_file(part, target)
    shutil.rmtree(old, ignore_errors=True)


@contextmanager
def former_on_error(capture: Path) -> Iterator[None]:
    """Put the present sparse/0 and sfm/source.json of a capture back, or remove a new model, on any exception."""
    target, source = capture / SPARSE, capture / WORK / SOURCE
    has_former, made_from = target.exists(), source.read_bytes()
    if has_former:
        keep_former(capture)
    try:
        yield
    except BaseException:
        if has_former:
            put_former_back(capture)
        else:
            shutil.rmtree(target, ignore_errors=True)
            write_atomic(source, made_from)
        raise
    forget_former(capture)


def reasons(path: Path, names: Sequence[str], posed: Iterable[str], wrong: Iterable[str]) -> Mapping[str, str]:
    """Return why photos have no pose: name -> a few words.

    Args:
        path: the database.
        names: all photos.
        posed: those with a pose.
        wrong: those whose pose was removed.
    """
    ids = database.image_ids(path)
    features = database.feature_counts(path)
    partners: dict[int, int] = {}
    for first, second, _, _ in database.verified_pairs(path, names):
        for number in (first, second):
            partners[number] = partners.get(number, 0) + 1
    found = {}
    has_pose, is_wrong = set(posed), set(wrong)
    for name in names:
        identity = ids.get(name)
        if name in has_pose:
            continue
        if name in is_wrong:
            found[name] = "its matches contradict each other"
        elif identity is None:
            found[name] = "COLMAP cannot read it with the camera of the others; save it as JPEG, or use a camera each"
        elif features.get(identity, 0) < FEWEST_FEATURES:
            found[name] = "it shows too few details, as when it is blurred or plain"
        elif not partners.get(identity):
            found[name] = "it shows nothing that another photo shows"
        else:
            found[name] = f"it matches {partners[identity]} other photos, but not well enough to place it"
    return found
