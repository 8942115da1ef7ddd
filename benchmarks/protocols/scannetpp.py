"""ScanNet++.

    dslr/resized_undistorted_images/, resized_images/ or undistorted_images/     the photos; the first is used
    dslr/colmap/                                   the COLMAP model of resized_images
    dslr/nerfstudio/transforms_undistorted.json    the camera of undistorted photos, from the dataset's toolbox
    dslr/train_test_lists.json                     {"train": [photos], "test": [photos]}
    scans/mesh_aligned_0.05.ply                    the scene as a mesh, in meters
    scans/segments.json                            {"segIndices": the segment of each vertex}
    scans/segments_anno.json                       {"segGroups": [{"objectId", "label", "segments"}, ...]}

Object IDs of a photo are those of the mesh where a z-buffer shows it. Objects are numbered from 1 by objectId.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import trimesh

from backend.capture.colmap import Camera, Image, Model, read_model
from backend.capture.files import read_image
from backend.capture.undistort import Pinhole, is_pinhole, pinhole_for, resample_image
from backend.mesh.texture.zbuffer import draw_mesh
from backend.raster import Camera as RasterCamera
from backend.shared.errors import InputError
from backend.shared.formats.json_file import parse_json

from . import panoptic as panoptic_scores
from .captures import Frame, need, write_capture
from .metrics import Results, percent, score_instances

TRAINING = ()
AFTER_TRAINING = ("evaluate",)

_INSTANCES = {
    "chamfer": ("Chamfer distance (m)", "{:.4f}"),
    "precision": ("precision (%)", "{:.1f}"),
    "recall": ("recall (%)", "{:.1f}"),
    "f1": ("F1 (%)", "{:.1f}"),
    "missing": ("objects without points", "{:.0f}"),
}
POINTS = ("anchors", "splats")

FIGURES = {
    **panoptic_scores.FIGURES,
    **{f"{kind}_{key}": (f"{kind}: {label}", form) for kind in POINTS for key, (label, form) in _INSTANCES.items()},
}

NOTES = (
    *panoptic_scores.NOTES,
    "In 3D, the anchors and the splats of each object are compared with the vertices of the labeled mesh, at 2 cm. "
    "Objects without points have a precision, recall and F1 of 0, and no Chamfer distance. The paper does not say "
    "which points it compares.",
)

_PHOTOS = ("resized_undistorted_images", "resized_images", "undistorted_images")


def paper(scene: str) -> dict[str, float]:
    """Return the paper's figures, which are means over its scenes."""
    instances = {"chamfer": 0.1132, "precision": 36.3, "recall": 86.1, "f1": 43.4}
    return {
        "psnr": 30.24, "ssim": 0.9327, "lpips": 0.1488, "miou": 95.38, "dice": 97.48, "accuracy": 99.07,
        **{f"{kind}_{key}": value for kind in POINTS for key, value in instances.items()},
    }  # fmt: skip


class LabeledMesh(NamedTuple):
    """The scene's mesh: vertices (V, 3) in meters, faces (F, 3), ids (V,) of the vertices, and names by ID."""

    vertices: np.ndarray
    faces: np.ndarray
    ids: np.ndarray
    names: dict[int, str]


def read_mesh(scene: Path) -> LabeledMesh:
    """Read the labeled mesh of a scene; of objects that share a segment, it belongs to the first.

    Raises:
        InputError: A file is missing, or it belongs to another mesh.
    """
    scans = scene / "scans"
    path = need(scans / "mesh_aligned_0.05.ply", "the scene's mesh")
    mesh = trimesh.load(path, process=False)
    segments_file, groups_file = scans / "segments.json", scans / "segments_anno.json"
    try:
        segments = np.array(_read_json(segments_file, "the segments of the mesh")["segIndices"], np.int64)
        groups = sorted(_read_json(groups_file, "the objects")["segGroups"], key=lambda group: group["objectId"])
        id_of: dict[int, int] = {}
        for number, group in enumerate(groups, 1):
            for segment in group["segments"]:
                id_of.setdefault(int(segment), number)
        names = {number: f"{group['label']} {number}" for number, group in enumerate(groups, 1)}
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{segments_file} or {groups_file} has another layout ({error!r}); put it back.") from error
    if len(segments) != len(mesh.vertices):
        raise InputError(f"{segments_file} has {len(segments)} vertices, and {path} {len(mesh.vertices)}.")
    distinct, at = np.unique(segments, return_inverse=True)
    ids = np.array([id_of.get(segment, 0) for segment in distinct.tolist()])[at]
    return LabeledMesh(np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int32), ids, names)


def _read_json(path: Path, what: str) -> Any:
    try:
        return parse_json(need(path, what).read_bytes())
    except ValueError as error:
        raise InputError(f"{path} is not valid JSON ({error}); put the original file back.") from error


def convert(scene: Path, folder: Path) -> None:
    """Write a scene as a capture of undistorted photos to a new folder.

    Raises:
        InputError: The scene lacks something.
    """
    dslr = need(scene / "dslr", "the photos and their cameras")
    photos = next((dslr / name for name in _PHOTOS if (dslr / name).is_dir()), None)
    if photos is None:
        raise InputError(f"{dslr} has no photos; expected one of {', '.join(_PHOTOS)}.")
    model = read_model(need(dslr / "colmap", "the COLMAP model"))
    lists = _read_json(dslr / "train_test_lists.json", "the photos to train on and to test on")
    train, test = set(lists.get("train", ())), set(lists.get("test", ()))
    images = [image for image in model.images if image.name in train | test and (photos / image.name).exists()]
    if not any(image.name in train for image in images):
        raise InputError(f"{photos} has no photo to train on that {model.file('images')} has, too; put them there.")
    mesh = read_mesh(scene)
    frames = _frames(dslr, photos, model, sorted(images, key=lambda image: image.name), test, mesh)
    write_capture(folder, frames, model.xyz, model.rgb, mesh.names)


def _frames(
    dslr: Path, photos: Path, model: Model, images: list[Image], test: set[str], mesh: LabeledMesh
) -> Iterator[Frame]:
    cameras = {i: _camera(dslr, photos, camera) for i, camera in model.cameras.items()}
    targets = {i: pinhole_for(camera, model.file("cameras"), 0) for i, camera in cameras.items()}
    for image in images:
        camera, target = cameras[image.camera_id], targets[image.camera_id]
        photo: np.ndarray | Path = photos / image.name
        if not is_pinhole(camera):
            photo = np.asarray(resample_image(read_image(photos / image.name), camera, target))
        ids = seen_ids(mesh, image.viewmat, target)
        yield Frame(image.name, photo, target.K, image.viewmat, ids, image.name in test)


def _camera(dslr: Path, photos: Path, camera: Camera) -> Camera:
    """Return the camera of the photos for a camera of the COLMAP model, which is that of resized_images."""
    if "undistorted" not in photos.name or is_pinhole(camera):
        return camera
    path = dslr / "nerfstudio" / "transforms_undistorted.json"
    lens = _read_json(path, f"the camera of {photos.name}, from the dataset's toolbox")
    try:
        params = tuple(float(lens[key]) for key in ("fl_x", "fl_y", "cx", "cy"))
        return replace(camera, model="PINHOLE", width=int(lens["w"]), height=int(lens["h"]), params=params)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} has another layout ({error!r}); put the original file back.") from error


def seen_ids(mesh: LabeledMesh, viewmat: np.ndarray, pinhole: Pinhole) -> np.ndarray:
    """Return the object IDs (H, W) that a camera sees: those of the nearest vertex of the face in each pixel."""
    camera = RasterCamera(viewmat, pinhole.K, pinhole.width, pinhole.height)
    _, face, weights = draw_mesh(mesh.vertices, mesh.faces, camera)
    nearest = np.take_along_axis(mesh.faces[face], weights.argmax(-1)[..., None], -1)[..., 0]
    return np.where(face >= 0, mesh.ids[nearest], 0)


def true_points(mesh: LabeledMesh) -> dict[int, np.ndarray]:
    """Return object ID -> its vertices (n, 3) in meters."""
    return {int(i): mesh.vertices[mesh.ids == i] for i in np.unique(mesh.ids) if i > 0}


def measure(scene: Path, capture: Path, results: Results) -> dict[str, Any]:
    """Return the panoptic scores of a reconstruction, and those of its objects' points in 3D."""
    figures: dict[str, Any] = panoptic_scores.panoptic(results.quality)
    truth = true_points(read_mesh(scene))
    for kind in POINTS:
        for key, value in score_instances(results.points[kind], truth).items():
            in_percent = key in ("precision", "recall", "f1")
            figures[f"{kind}_{key}"] = percent(value) if in_percent else value
    return figures
