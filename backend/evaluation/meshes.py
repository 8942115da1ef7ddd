"""Evaluation of meshes: distances from true surfaces, if available; topology; texture quality on held-out views."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy.spatial import cKDTree

from ..mesh.texture.zbuffer import draw_mesh
from ..raster import Camera, devices
from ..shared.errors import InputError
from ..shared.events import Reporter
from ..shared.formats.mesh_ply import Mesh, read_mesh
from ..shared.formats.regular_file import read_regular, require_regular
from ..shared.reconstruction.meshes import MeshEntry, read_meshes
from ..training.scene import Scene
from .mesh_shape import Shape, shape_of
from .truth import TrueMesh, Truth

THRESHOLDS = (0.02, 0.005)
"""Distance thresholds of precision, recall and F1, in the capture's units: the one commonly used in papers on object
meshes, and a stricter one."""
SAMPLES = 30_000
_NEIGHBORS = 6
_SUBPIXELS = 3
_PIXELS_AT_ONCE = 500_000
"""Number of pixels of a photo that are compared at a time, each of which takes about a kilobyte."""


class SampledSurface:
    """A triangle mesh with sample points, to measure distances to and from.

    points (SAMPLES, 3): uniform over the area, with a fixed seed; normals (SAMPLES, 3): unit normals.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, samples: int = SAMPLES) -> None:
        corners = np.asarray(vertices, np.float64)[faces]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        double_area = np.linalg.norm(cross, axis=1)
        kept = double_area > 0
        self._corners, cross, double_area = corners[kept], cross[kept], double_area[kept]
        if not len(double_area):
            raise ValueError("a surface without area cannot be sampled")
        rng = np.random.default_rng(0)
        ends = np.cumsum(double_area)
        face = np.minimum(np.searchsorted(ends, rng.random(samples) * ends[-1], side="right"), len(ends) - 1)
        root, along = np.sqrt(rng.random(samples)), rng.random(samples)
        weights = np.stack([1 - root, root * (1 - along), root * along], 1)
        self.points = np.einsum("nc,ncx->nx", weights, self._corners[face])
        normals = cross / double_area[:, None]
        self.normals = normals[face]
        # Includes the center of each face, so that the nearest anchors belong to the nearest faces.
        self.anchors = np.concatenate([self.points, self._corners.mean(1)])
        self.anchor_normals = np.concatenate([self.normals, normals])
        self._face = np.concatenate([face, np.arange(len(ends))])
        self._tree = cKDTree(self.anchors)

    def distances(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the distances (n,) of points (n, 3) from this surface, and the index of the nearest anchor, (n,)."""
        _, near = self._tree.query(points, min(_NEIGHBORS, len(self.anchors)), workers=-1)
        near = near.reshape(len(points), -1)
        best = np.full(len(points), np.inf)
        for column in near.T:
            best = np.minimum(best, _to_triangles(points, self._corners[self._face[column]]))
        return np.sqrt(best), near[:, 0]


def _to_triangles(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return the squared distances (n,) of points (n, 3) from non-degenerate triangles (n, 3, 3)."""
    edges = np.roll(corners, -1, axis=1) - corners
    normal = np.cross(edges[:, 0], -edges[:, 2])
    within = np.ones(len(points), bool)
    nearest = np.full(len(points), np.inf)
    for k in range(3):
        edge, away = edges[:, k], points - corners[:, k]
        within &= np.einsum("nx,nx->n", np.cross(edge, away), normal) >= 0
        length = np.maximum(np.einsum("nx,nx->n", edge, edge), 1e-300)
        along = np.clip(np.einsum("nx,nx->n", away, edge) / length, 0, 1)
        offset = away - along[:, None] * edge
        nearest = np.minimum(nearest, np.einsum("nx,nx->n", offset, offset))
    height = np.einsum("nx,nx->n", points - corners[:, 0], normal)
    return np.where(within, height**2 / np.einsum("nx,nx->n", normal, normal), nearest)


def agreement(accuracy: np.ndarray, completeness: np.ndarray) -> dict[str, float | None]:
    """Compute the chamfer distance, and precision, recall and F1 score at each of THRESHOLDS.

    The chamfer distance is the mean of the two mean distances.

    Args:
        accuracy: (n,) distances of the mesh's points from the truth.
        completeness: (m,) distances of the truth's points from the mesh.

    Returns:
        The figures by name; all None if n or m is 0.
    """
    names = ["precision", "recall", "f1"]
    out: dict[str, float | None] = dict.fromkeys(["chamfer", *names, *(f"{name}_005" for name in names)])
    if len(accuracy) and len(completeness):
        out["chamfer"] = float(accuracy.mean() + completeness.mean()) / 2
        for threshold, suffix in zip(THRESHOLDS, ("", "_005")):
            precision, recall = float((accuracy <= threshold).mean()), float((completeness <= threshold).mean())
            both = precision + recall
            out |= {
                f"precision{suffix}": precision,
                f"recall{suffix}": recall,
                f"f1{suffix}": 2 * precision * recall / both if both else 0.0,
            }
    return out


def against_truth(mesh: Mesh, true: TrueMesh, truth: Truth, ids: Sequence[int]) -> dict[str, float | None]:
    """Compare a mesh with the true surface of the objects `ids`.

    The seen part of the true surface is visible in at least two views. The seen part of the mesh would be visible in at
    least two views without the rest of the scene, and its nearest true points are seen. Thus, a surface that no camera
    observed, such as the back of a wall, counts only in the figures over the whole surface.

    Args:
        mesh: The mesh to measure.
        true: The true surface.
        truth: The truth that contains `true`.
        ids: The IDs of its objects.

    Returns:
        `agreement` over the seen parts, the same over the whole surfaces (keys that end in "_all"), and `seen`, the
        seen fraction of the true surface's area.
    """
    made, wanted = SampledSurface(mesh.vertices, mesh.faces), SampledSurface(true.vertices, true.faces)
    seen = truth.seen(wanted.anchors, wanted.anchor_normals, ids)
    accuracy, nearest = wanted.distances(made.points)
    completeness, _ = made.distances(wanted.points)
    seen_points = seen[: len(wanted.points)]
    counted = seen[nearest] & truth.seen_alone(made.points, made.normals, mesh.vertices, mesh.faces)
    return {
        **agreement(accuracy[counted], completeness[seen_points]),
        **{f"{name}_all": value for name, value in agreement(accuracy, completeness).items()},
        "seen": float(seen_points.mean()),
    }


def read_texture(path: Path) -> np.ndarray:
    """Read a mesh's texture (S, S, 3) uint8 sRGB. Raises InputError if the file cannot be read."""
    try:
        with Image.open(require_regular(path)) as image:
            return np.asarray(image.convert("RGB"))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError(f"{path} cannot be read ({error}); make the meshes again.") from error


def sample_texture(texture: np.ndarray, uvs: np.ndarray) -> np.ndarray:
    """Sample a texture bilinearly at uvs (n, 2), (0, 0) at the lower left; returns colors (n, 3) float32, 0 .. 1."""
    height, width = texture.shape[:2]
    x = np.clip(uvs[:, 0] * width - 0.5, 0, width - 1)
    y = np.clip((1 - uvs[:, 1]) * height - 0.5, 0, height - 1)
    column, row = x.astype(int), y.astype(int)
    right, below = np.minimum(column + 1, width - 1), np.minimum(row + 1, height - 1)
    across, down = (x - column)[:, None].astype(np.float32), (y - row)[:, None].astype(np.float32)
    upper = texture[row, column] * (1 - across) + texture[row, right] * across
    lower = texture[below, column] * (1 - across) + texture[below, right] * across
    return (upper * (1 - down) + lower * down) / np.float32(255)


@dataclass
class TextureScore:
    """Sums over views for the quality of a texture.

    Attributes:
        pixels: Number of pixels in the object's masks.
        covered: Number of these pixels that the mesh covers.
        squares: Sum of the squared errors over the covered pixels and their three channels.
    """

    pixels: int = 0
    covered: int = 0
    squares: float = 0.0

    def figures(self) -> dict[str, float | None]:
        """Return texture_psnr in dB over the covered pixels of all views, and texture_coverage; None if unknown."""
        if not self.covered:
            return {"texture_psnr": None, "texture_coverage": 0.0 if self.pixels else None}
        mean = max(self.squares / (3 * self.covered), 1e-10)
        return {"texture_psnr": -10 * math.log10(mean), "texture_coverage": self.covered / self.pixels}


def texture_score(
    mesh: Mesh, texture: np.ndarray, scene: Scene, ids: Sequence[int] | None, indices: Sequence[int]
) -> TextureScore:
    """Compare renders of a textured mesh with photos, at the common exposure.

    Args:
        mesh: The mesh, rendered without the rest of the scene.
        texture: (S, S, 3) uint8 sRGB.
        scene: The scene with the photos and masks.
        ids: The objects whose mask pixels are compared; None for all pixels.
        indices: The views to compare.
    """
    score = TextureScore()
    vertices = scene.normalization.to_scene(mesh.vertices)
    classes = None if ids is None else scene.classes.classes_among(ids)
    for index in indices:
        if ids is not None and set(ids).isdisjoint(scene.capture.ids_in(index)):
            continue
        photo, labels = scene.target(index)
        if classes is None:
            wanted = np.ones(photo.shape[1:], bool)
        elif labels is None:
            continue
        else:
            wanted = np.isin(devices.host(labels), classes)
        if not wanted.any():
            continue
        rows, columns = np.flatnonzero(wanted.any(1)), np.flatnonzero(wanted.any(0))
        pixels = devices.host(photo)
        # In bands, since the parts of their pixels take much memory.
        height = max(_PIXELS_AT_ONCE // (columns[-1] + 1 - columns[0]), 1)
        for first in range(rows[0], rows[-1] + 1, height):
            part = slice(first, min(first + height, rows[-1] + 1)), slice(columns[0], columns[-1] + 1)
            K = scene.camera(index).K.copy()
            K[:2, 2] -= columns[0], first
            camera = replace(scene.camera(index), K=K)
            _add(score, mesh, vertices, texture, camera, wanted[part], pixels[:, part[0], part[1]])
    return score


def _add(
    score: TextureScore,
    mesh: Mesh,
    vertices: np.ndarray,
    texture: np.ndarray,
    camera: Camera,
    wanted: np.ndarray,
    photo: np.ndarray,
) -> None:
    """Add the pixels of a part of a view to a score.

    Args:
        score: The sums.
        mesh, texture: As for `texture_score`.
        vertices: The vertices of the mesh in scene units.
        camera: The camera, whose image begins with the part.
        wanted: (h, w) bool, the pixels that are compared.
        photo: (3, h, w) the photo.
    """
    height, width = wanted.shape
    K = camera.K.copy()
    K[:2] *= _SUBPIXELS
    _, face, weights = draw_mesh(
        vertices, mesh.faces, replace(camera, K=K, width=width * _SUBPIXELS, height=height * _SUBPIXELS)
    )
    drawn = face >= 0
    colors = np.zeros((*face.shape, 3), np.float32)
    uvs = np.einsum("nc,ncx->nx", weights[drawn], mesh.uvs[face[drawn]])
    colors[drawn] = sample_texture(texture, uvs)
    blocks = (height, _SUBPIXELS, width, _SUBPIXELS)
    count = drawn.reshape(blocks).sum((1, 3))
    # A pixel counts as covered if at least half of it is; its color is the mean over the covered part.
    covered = wanted & (2 * count >= _SUBPIXELS**2)
    pixels = colors.reshape(*blocks, 3).sum((1, 3))[covered] / count[covered][:, None]
    error = pixels - photo.transpose(1, 2, 0)[covered]
    score.pixels += int(wanted.sum())
    score.covered += int(covered.sum())
    score.squares += float((error.astype(np.float64) ** 2).sum())


def mesh_entries(folder: Path, trained_steps: int, reporter: Reporter) -> dict[str, MeshEntry]:
    """Return the meshes of the current state of the model: single objects by ID, then sets and the whole scene.

    Args:
        folder: The folder `meshes` of a reconstruction.
        trained_steps: Number of training steps of the model. Meshes of another state are left out, with a warning.
        reporter: Receives the warning.

    Raises:
        InputError: meshes.json cannot be read.
    """
    entries = read_meshes(folder)
    current = [entry for entry in entries.values() if entry.trained_steps == trained_steps]
    if len(current) < len(entries):
        reporter.warning(
            f"{len(entries) - len(current)} of {len(entries)} meshes in {folder} are of an earlier state of the model "
            "and are left out; run `mesh` again."
        )
    current.sort(key=lambda entry: (entry.object_id is None, entry.object_id or 0, entry.key))
    return {entry.key: entry for entry in current}


def digest(folder: Path, entry: MeshEntry) -> str:
    """Return a hash of a mesh's files, which identifies the run that wrote them."""
    sha = hashlib.sha256()
    for name in (entry.file, entry.texture):
        if name and (folder / name).exists():
            sha.update(read_regular(folder / name))
    return sha.hexdigest()[:16]


def evaluate_mesh(
    folder: Path,
    entry: MeshEntry,
    scene: Scene,
    truth: Truth | None,
    indices: Sequence[int],
    reporter: Reporter,
) -> dict[str, Any]:
    """Measure all figures of one mesh; lengths are in the capture's units.

    Args:
        folder: The folder of the meshes.
        entry: The mesh's entry in meshes.json.
        scene: The scene with the photos and masks.
        truth: The true surfaces, or None.
        indices: The held-out views.
        reporter: Receives a warning for each file that cannot be read.

    Returns:
        The figures by name; None for those that cannot be measured.
    """
    ids = entry.ids
    names = [*agreement(np.zeros(0), np.zeros(0))]
    out: dict[str, Any] = {
        **dict.fromkeys(["vertices", "faces", "unobserved", *Shape.__dataclass_fields__]),
        **dict.fromkeys([*names, *(f"{name}_all" for name in names), "seen", "texture_psnr", "texture_coverage"]),
        "why": entry.why,
    }
    if not entry.file:
        return out
    try:
        mesh = read_mesh(folder / entry.file)
    except InputError as error:
        reporter.warning(str(error))
        return {**out, "why": "its file cannot be read"}
    out |= {"vertices": len(mesh.vertices), "faces": len(mesh.faces), "digest": digest(folder, entry)}
    corners = mesh.vertices[mesh.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    if not np.isfinite(mesh.vertices).all() or not (area > 0).any():
        return {**out, "why": "it has no surface"}
    out |= vars(shape_of(mesh.vertices, mesh.faces))
    out["unobserved"] = float(mesh.unobserved.mean())
    true = None if truth is None else truth.of(list(truth.meshes) if ids is None else ids)
    if true is not None and truth is not None:
        out |= against_truth(mesh, true, truth, list(truth.meshes) if ids is None else ids)
    if mesh.texture:
        try:
            texture = read_texture(folder / mesh.texture)
        except InputError as error:
            reporter.warning(str(error))
        else:
            out |= texture_score(mesh, texture, scene, ids, indices).figures()
    return out
