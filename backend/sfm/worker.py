"""One stage of COLMAP in a process of its own, since it cannot be stopped otherwise: `python -m backend.sfm.worker`.

    worker extract DATABASE IMAGES GROUPS.json     features of the photos in each group, which share a camera
    worker match DATABASE [PAIRS.txt]              matches of the pairs, or of all
    worker incremental|global DATABASE IMAGES OUT  camera poses and points
    worker lens MODEL OUT                          the same with a second term of distortion, where photos show one

Photos and pairs whose results are in the database are skipped. Each line on standard output is one more photo with a
pose.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path

import pycolmap

SEED = 0
LONGEST_SIDE = 1600
"""Side in pixels to which larger photos are scaled for the search of features."""
MOST_FEATURES = 4096
FEWEST_POSES = 3
_WORTH = 0.98
"""Reprojection error with a second term of distortion, relative to that with one, below which it is used."""
_BLOCK = 64
"""Number of pairs after which matches are written to the database."""
_ERRORS = 2
"""Level of COLMAP's messages from which on they are kept."""
_FAINT = 0.003
"""Least contrast of a feature, below COLMAP's 0.0067: plain or small photos have too few otherwise, and others reach
`MOST_FEATURES` anyway."""


def extract(database: str, images: str, groups: str) -> None:
    """Find the features of photos; each group of names shares a camera, whose focal length EXIF may tell."""
    for group in json.loads(Path(groups).read_text(encoding="utf-8")):
        options = pycolmap.FeatureExtractionOptions()
        options.use_gpu = False
        options.max_image_size = LONGEST_SIDE
        options.sift.max_num_features = MOST_FEATURES
        options.sift.peak_threshold = _FAINT
        pycolmap.extract_features(
            database, images, image_names=group, camera_mode=pycolmap.CameraMode.SINGLE,
            extraction_options=options,
        )  # fmt: skip


def match(database: str, pairs: str = "") -> None:
    """Match and verify pairs of photos, those in a file or all."""
    options = pycolmap.FeatureMatchingOptions()
    options.use_gpu = False
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    if pairs:
        listed = pycolmap.ImportedPairingOptions()
        listed.match_list_path, listed.block_size = pairs, _BLOCK
        pycolmap.match_image_pairs(database, options, listed, verification)
    else:
        every = pycolmap.ExhaustivePairingOptions()
        every.block_size = int(_BLOCK**0.5)
        pycolmap.match_exhaustive(database, options, every, verification)


def map_incrementally(database: str, images: str, out: str) -> None:
    """Add one photo after another to the model."""
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed, options.min_model_size = SEED, FEWEST_POSES

    def tell() -> None:
        print("pose", flush=True)

    pycolmap.incremental_mapping(database, images, out, options=options, next_image_callback=tell)


def map_globally(database: str, images: str, out: str) -> None:
    """Solve for all rotations, then all positions at once (GLOMAP)."""
    options = pycolmap.GlobalPipelineOptions()
    options.random_seed, options.min_model_size = SEED, FEWEST_POSES
    pycolmap.global_mapping(database, images, out, options=options)


def refine_lens(model: str, out: str) -> None:
    """Refine a model with one and with two terms of radial distortion, and write the second if it is worth it.

    One term is safer where the photos do not determine the second, which then bends the whole scene a little.
    """
    refined = {}
    for kind in ("SIMPLE_RADIAL", "RADIAL"):
        found = refined[kind] = pycolmap.Reconstruction(model)
        for camera in found.cameras.values():
            if kind == "RADIAL":
                camera.model, camera.params = pycolmap.CameraModelId.RADIAL, [*camera.params, 0.0]
        options = pycolmap.BundleAdjustmentOptions()
        options.refine_principal_point = options.ceres.use_gpu = options.print_summary = False
        pycolmap.bundle_adjustment(found, options)
        found.update_point_3d_errors()
    one, two = (found.compute_mean_reprojection_error() for found in refined.values())
    refined["RADIAL" if two < _WORTH * one else "SIMPLE_RADIAL"].write(out)


STAGES: dict[str, Callable[..., None]] = {
    "extract": extract,
    "match": match,
    "incremental": map_incrementally,
    "global": map_globally,
    "lens": refine_lens,
}

if __name__ == "__main__":
    pycolmap.logging.minloglevel = _ERRORS
    STAGES[sys.argv[1]](*sys.argv[2:])
