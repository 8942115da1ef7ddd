"""One stage of COLMAP in a process of its own, since it cannot be stopped otherwise: `python -m backend.sfm.worker`.

The first argument is the number of threads, followed by the stage and its arguments:

    worker extract DATABASE IMAGES GROUPS.json [MASKS]   features of the photos in each group, which share a camera
    worker match DATABASE [PAIRS.txt]   matches of the pairs, or of all
    worker extract-learned MODEL DATABASE IMAGES GROUPS.json [MASKS]   as extract, by the networks of a checkpoint
    worker match-learned MODEL DATABASE [PAIRS.txt]   as match, of features by extract-learned
    worker match-places MODEL MATCHED IMAGES PAIRS.txt   places that the pairs show in common, by a network
    worker join-pairs MATCHED DATABASE IMAGES GROUPS.json [MASKS]   features at these places, and verified matches
    worker incremental|global DATABASE IMAGES OUT NAMES.json [calibrated]   poses of the named photos, and points
    worker refine MODEL OUT DATABASE NAMES.json [calibrated]   the same without wrong matches, and with the lens that
        photos show

Each group is {"names": [...], "camera": null or {"model": ..., "params": [...]}}, the lens if it is known. Lenses that
are calibrated are kept.

Photos and pairs whose results are in the database are skipped. Each line on standard output is one more photo with a
pose. The process ends when its standard input is closed.
"""

from __future__ import annotations

import json
import os
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pycolmap

from ..shared.stopping import take_stdin
from .database import camera_of, listed_names, read_pairs, restore_names, verified_pairs
from .rig import tie_rigs

SEED = 0
LONGEST_SIDE = 1600
"""Side in pixels to which larger photos are scaled for the search of features."""
MOST_FEATURES = 4096
FEWEST_POSES = 3
_LENSES = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
_FISHEYE_LENSES = ("SIMPLE_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
"""COLMAP's lenses with none, one and two terms of distortion."""
_WORTH = 0.98
"""Median residual with a further term of distortion, relative to that without, below which it is used."""
_WORTH_FISHEYE = 0.8
"""Median residual of a fisheye lens, relative to that of another, below which it is used; 0.96 or more for others."""
_SAMPLES = 64
"""Number of pixels to which a fisheye lens is fitted."""
_FARTHEST = (10.0, 6.0, 5.0)
"""Distances of observations, relative to the median, above which they are removed, one adjustment after another."""
_SPREAD, _FINEST = 2.0, 0.05
"""Scale of the loss relative to the median distance, and its least value in pixels."""
_SETTLED = 1e-5
"""Relative decrease of the loss in a step below which an adjustment ends. Without such a limit it goes on for a
hundred steps, which move poses by less than a hundredth of their errors."""
_BLOCK = 64
"""Number of pairs after which matches are written to the database."""
_TRIALS = 2000
"""Largest number of samples when a pair is verified. COLMAP's 10,000 take three times as long in all; what they find
beyond are pairs with few inliers, 2% of all matches."""
_ERRORS = 2
"""Level of COLMAP's messages from which on they are kept."""
_threads = -1
"""Number of threads of this process; -1: all cores."""
_FAINT = 0.003
"""Least contrast of a feature, below COLMAP's 0.0067: plain or small photos have too few otherwise, and others reach
`MOST_FEATURES` anyway."""


def extract(database: str, images: str, groups: str, masks: str = "") -> None:
    """Find the features of photos; each group of names shares a camera, whose focal length EXIF may tell.

    With masks, features are where MASKS/NAME.png is not black.
    """
    pycolmap.Database.open(database).close()
    restore_names(Path(database))
    listed = _read_groups(groups)
    shared = [group.names for group in listed if len(group.names) > 1]
    # COLMAP's threads take a photo each, so those with a camera of their own are given to it at once.
    alone = [group.names[0] for group in listed if len(group.names) == 1]
    for names in [*shared, alone] if alone else shared:
        is_shared = names is not alone
        reader = pycolmap.ImageReaderOptions()
        if masks:
            reader.mask_path = masks
        if is_shared:
            reader.existing_camera_id = camera_of(Path(database), names)
        options = pycolmap.FeatureExtractionOptions()
        options.use_gpu, options.num_threads = False, _threads
        options.max_image_size = LONGEST_SIDE
        options.sift.max_num_features = MOST_FEATURES
        options.sift.peak_threshold = _FAINT
        pycolmap.extract_features(
            database, images, image_names=names, reader_options=reader, extraction_options=options,
            camera_mode=pycolmap.CameraMode.SINGLE if is_shared else pycolmap.CameraMode.PER_IMAGE,
        )  # fmt: skip
    for group in listed:
        _calibrate(database, group)


class _Group(NamedTuple):
    """Photos that share a camera, and its lens if that is known: {"model": ..., "params": [...]}."""

    names: list[str]
    camera: dict[str, Any] | None


def _read_groups(path: str) -> list[_Group]:
    return [_Group(**each) for each in json.loads(Path(path).read_text(encoding="utf-8"))]


def _calibrate(database: str, group: _Group) -> None:
    """Give the photos of a group their lens if it is known, also if their features were found without."""
    if group.camera is None:
        return
    with pycolmap.Database.open(database) as opened:
        names = set(group.names)
        for number in {image.camera_id for image in opened.read_all_images() if image.name in names}:
            camera = opened.read_camera(number)
            camera.model, camera.params = getattr(pycolmap.CameraModelId, group.camera["model"]), group.camera["params"]
            camera.has_prior_focal_length = True
            opened.update_camera(camera)


def match(database: str, pairs: str = "") -> None:
    """Match and verify pairs of photos, those in a file or all."""
    options = pycolmap.FeatureMatchingOptions()
    options.use_gpu, options.num_threads = False, _threads
    if pairs:
        listed = pycolmap.ImportedPairingOptions()
        listed.match_list_path, listed.block_size = pairs, _BLOCK
        with listed_names(Path(database)):
            pycolmap.match_image_pairs(database, options, listed, verification())
    else:
        every = pycolmap.ExhaustivePairingOptions()
        every.block_size = int(_BLOCK**0.5)
        pycolmap.match_exhaustive(database, options, every, verification())


def verification() -> pycolmap.TwoViewGeometryOptions:
    """Return how the matches of a pair are verified."""
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed, options.ransac.max_num_trials = SEED, _TRIALS
    return options


def extract_learned(checkpoint: str, database: str, images: str, groups: str, masks: str = "") -> None:
    """Find features as `extract`, by the networks of a checkpoint."""
    from .learned import lightglue  # It imports torch, which takes seconds.

    listed = _read_groups(groups)
    detect = lightglue.LightGlue(Path(checkpoint)).detect
    lightglue.find_features(
        Path(database), Path(images), [group.names for group in listed], Path(masks) if masks else None, detect
    )
    for group in listed:
        _calibrate(database, group)


def match_learned(checkpoint: str, database: str, pairs: str = "") -> None:
    """Match and verify pairs of photos, those in a file or all, by the networks of a checkpoint."""
    from .learned import lightglue

    listed = read_pairs(Path(pairs)) if pairs else None
    lightglue.match_pairs(Path(database), listed, lightglue.LightGlue(Path(checkpoint)).match, verification())


def match_places(checkpoint: str, matched: str, images: str, pairs: str) -> None:
    """Find what pairs of photos show in common, by a network without a search for features."""
    from .learned import loftr, positions

    network = loftr.EfficientLoFTR(Path(checkpoint))
    positions.match_photos(Path(matched), Path(images), read_pairs(Path(pairs)), network.match, loftr.MULTIPLE)


def join_pairs(matched: str, database: str, images: str, groups: str, masks: str = "") -> None:
    """Make features of what pairs show in common, as `extract`, and verify the pairs' matches."""
    from .learned import joining, photos

    listed = _read_groups(groups)
    photos.add_photos(Path(database), Path(images), [group.names for group in listed])
    for group in listed:
        _calibrate(database, group)
    names = {name for group in listed for name in group.names}
    joining.join_pairs(Path(database), Path(matched), names, Path(masks) if masks else None, verification())


def map_incrementally(database: str, images: str, out: str, names: str, calibrated: str = "") -> None:
    """Add one photo after another to the model."""
    options = pycolmap.IncrementalPipelineOptions()
    if calibrated:
        options.ba_refine_focal_length = options.ba_refine_extra_params = False
        options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
    options.image_names = json.loads(Path(names).read_text(encoding="utf-8"))
    options.random_seed, options.min_model_size, options.num_threads = SEED, FEWEST_POSES, _threads

    def tell() -> None:
        print("pose", flush=True)

    pycolmap.incremental_mapping(database, images, out, options=options, next_image_callback=tell)


def map_globally(database: str, images: str, out: str, names: str, calibrated: str = "") -> None:
    """Solve for all rotations, then all positions at once (GLOMAP)."""
    options = pycolmap.GlobalPipelineOptions()
    if calibrated:
        adjustment = options.mapper.bundle_adjustment
        adjustment.refine_focal_length = adjustment.refine_extra_params = False
    options.image_names = json.loads(Path(names).read_text(encoding="utf-8"))
    options.random_seed, options.min_model_size, options.num_threads = SEED, FEWEST_POSES, _threads
    pycolmap.global_mapping(database, images, out, options=options)


def refine(model: str, out: str, database: str, names: str, calibrated: str = "") -> None:
    """Refine poses and points without wrong matches, with the lens that the photos show unless it is calibrated.

    Cameras that are fixed to each other keep their relative poses. The lens is a pinhole with as few terms of radial
    distortion as suffice: a term that the photos do not determine bends the whole scene a little, and without any,
    photos are used unchanged. Mappers approximate a fisheye lens by strong distortion; it is recognized where a fisheye
    lens with one term fits better than a pinhole with one.
    """
    start = pycolmap.Reconstruction(model)
    tie_rigs(start, left_out(start, database, json.loads(Path(names).read_text(encoding="utf-8"))))
    if calibrated:
        adjust(start, keep_lens=True)
        remove_outliers(start, keep_lens=True)
        start.write(out)
        return
    fits = [_with_lens(start, kind, no_distortion, terms) for terms, kind in enumerate(_LENSES)]
    distorted = fits[-1].model
    one_term = _with_lens(distorted, _FISHEYE_LENSES[1], equidistant, 1)
    if one_term.typical < min(_WORTH_FISHEYE * fits[1].typical, fits[-1].typical):
        fits = [_with_lens(distorted, kind, equidistant, terms) for terms, kind in enumerate(_FISHEYE_LENSES)]
    chosen = fits[0]
    for fit in fits[1:]:
        if fit.typical < _WORTH * chosen.typical:
            chosen = fit
    remove_outliers(chosen.model)
    chosen.model.write(out)


def left_out(model: pycolmap.Reconstruction, database: str, names: list[str]) -> list[pycolmap.Image]:
    """Return the named photos of a database that match nothing, which mappers leave out of their models.

    Others that are not in a model have matches that contradict every pose, or are too few to tell.
    """
    matched = {number for pair in verified_pairs(Path(database), names) for number in pair[:2]}
    wanted = set(names) - {image.name for image in model.images.values()}
    with pycolmap.Database.open(database) as opened:
        return [
            pycolmap.Image(name=image.name, camera_id=image.camera_id, image_id=image.image_id)
            for image in opened.read_all_images()
            if image.name in wanted and image.image_id not in matched
        ]


class _Fit(NamedTuple):
    """A model that was adjusted, and the median distance of its observations in pixels."""

    model: pycolmap.Reconstruction
    typical: float


def _with_lens(
    model: pycolmap.Reconstruction, kind: str, first_params: Callable[[pycolmap.Camera, int], list[float]], terms: int
) -> _Fit:
    """Return a model with a lens of another kind, adjusted."""
    found = pycolmap.Reconstruction(model)
    for camera in found.cameras.values():
        params = first_params(camera, terms)
        camera.model, camera.params = getattr(pycolmap.CameraModelId, kind), params
    adjust(found)
    return _Fit(found, _typical(residuals(found)))


def no_distortion(camera: pycolmap.Camera, terms: int) -> list[float]:
    """Return focal length, principal point, the first term of distortion if there is one, and zeros for others."""
    return [*camera.params, 0.0, 0.0][: 3 + terms]


def equidistant(camera: pycolmap.Camera, terms: int) -> list[float]:
    """Return the fisheye lens nearest to a camera with radial distortion.

    A ray at the angle a to the optical axis is seen f (a + k1 a^3 + k2 a^5) from the principal point, in pixels. The
    coefficients are fitted to pixels from there to the corner.

    Args:
        camera: whose params begin with the focal length and the principal point (2).
        terms: number of terms k.
    """
    center = np.array(camera.params[1:3])
    radii = np.linspace(0.0, np.hypot(camera.width, camera.height) / 2, _SAMPLES + 1)[1:]
    slopes = np.asarray(camera.cam_from_img(center + radii[:, None] * [1.0, 0.0]))[:, 0]
    is_seen = np.isfinite(slopes) & (slopes > 0)
    angles = np.arctan(slopes[is_seen])
    powers = angles[:, None] ** (1 + 2 * np.arange(1 + terms))
    found = np.linalg.lstsq(powers, radii[is_seen], rcond=None)[0]
    return [found[0], *center, *(found[1:] / found[0])]


def remove_outliers(model: pycolmap.Reconstruction, keep_lens: bool = False) -> None:
    """Remove observations that are far from where an adjusted model expects them, and adjust it again, in turns.

    Matches that are wrong by a few pixels, at edges of objects or on repeated textures, pass COLMAP's filter of 4
    pixels and move poses by several times the error of the others.
    """
    for most in _FARTHEST:
        observed = residuals(model)
        typical = _typical(observed)
        for distance, image, index in observed:
            # Of a point with two observations, the first that goes takes the other with it.
            if distance > most * typical and model.image(image).points2D[index].has_point3D():
                model.delete_observation(image, index)
        adjust(model, keep_lens)
    model.update_point_3d_errors()


def adjust(model: pycolmap.Reconstruction, keep_lens: bool = False) -> None:
    """Adjust poses, points and, unless kept, lenses, under Cauchy's loss, which hardly counts wrong matches."""
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_extra_params = not keep_lens
    options.refine_principal_point = options.ceres.use_gpu = options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = max(_SPREAD * _typical(residuals(model)), _FINEST)
    options.ceres.solver_options.function_tolerance = _SETTLED
    options.ceres.solver_options.num_threads = _threads
    pycolmap.bundle_adjustment(model, options)


def _typical(observed: list[tuple[float, int, int]]) -> float:
    """Return the median distance of observations."""
    return float(np.median([distance for distance, _, _ in observed]))


def residuals(model: pycolmap.Reconstruction) -> list[tuple[float, int, int]]:
    """Return the distance in pixels, the image ID and the index of each observation of a point."""
    found = []
    for number in model.reg_image_ids():
        image = model.image(number)
        camera, matrix = model.camera(image.camera_id), image.cam_from_world().matrix()
        seen = [(index, point) for index, point in enumerate(image.points2D) if point.has_point3D()]
        if not seen:
            continue
        world = np.array([model.points3D[point.point3D_id].xyz for _, point in seen])
        expected = np.asarray(camera.img_from_cam(world @ matrix[:, :3].T + matrix[:, 3]))
        distances = np.linalg.norm(expected - np.array([point.xy for _, point in seen]), axis=1)
        distances = np.where(np.isfinite(distances), distances, np.inf)
        found += [(float(d), number, index) for d, (index, _) in zip(distances, seen, strict=True)]
    return found


STAGES: dict[str, Callable[..., None]] = {
    "extract": extract,
    "match": match,
    "extract-learned": extract_learned,
    "match-learned": match_learned,
    "match-places": match_places,
    "join-pairs": join_pairs,
    "incremental": map_incrementally,
    "global": map_globally,
    "refine": refine,
}
_OF_NETWORKS = ("extract-learned", "match-learned", "match-places")
"""Those that import torch."""


def _end_with(parent: int) -> None:
    """End this process when the one at the other end of a pipe is gone, so that the next one can use the database."""
    # Without Python's buffer, whose lock would be held when the process ends by itself.
    while os.read(parent, 1):
        pass
    os._exit(1)


def main(threads: str, name: str, *arguments: str) -> None:
    """Run a stage with a number of threads."""
    global _threads
    _threads = int(threads)
    # Before torch is imported, for the networks. On macOS, torch and pycolmap have an OpenMP each, whose threads may
    # crash beside those of the other.
    os.environ["OMP_NUM_THREADS"] = "1" if sys.platform == "darwin" and name in _OF_NETWORKS else threads
    threading.Thread(target=_end_with, args=(take_stdin(),), daemon=True).start()
    pycolmap.logging.minloglevel = _ERRORS
    STAGES[name](*arguments)


if __name__ == "__main__":
    main(*sys.argv[1:])
