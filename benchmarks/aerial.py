"""Synthetic aerial captures of any size, with exact object masks, for measurements of large scenes.

    .venv/bin/python benchmarks/aerial.py OUT --photos 500 [--width 320] [--points-per-photo 100] [--seed 0]

A drone flies over a town of textured boxes on a plane, in parallel lines, and looks down obliquely to four sides in
turn. The town grows with the number of photos, so that each photo shows a part of constant size. Pictures are ray
cast, with four rays a pixel, in about 20 ms each.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import backend  # noqa: F401, I001 - sets the thread wait policy, before numba is loaded
import numpy as np
from numba import njit, prange
from PIL import Image
from scipy.spatial.transform import Rotation

PITCH = 10.0
"""Distance between the centers of neighboring boxes in meters."""

HEIGHT, TILT = 26.0, math.radians(52)
"""Height of the camera in meters, and its angle below the horizon."""

SPACING = 8.0
"""Distance between neighboring photos in meters."""

FOV = math.radians(60)
"""Horizontal angle of view."""

OBJECTS = 12
"""Number of objects with an ID; every tenth box is one of them, the others and the ground have none."""

_SUPERSAMPLING = 2


@njit(cache=True)
def _hash(x, y, z, seed):
    h = np.uint64(x * 374761393 + y * 668265263 + z * 2147483647 + seed * 974711)
    h = (h ^ (h >> np.uint64(13))) * np.uint64(1274126177)
    h = (h ^ (h >> np.uint64(16))) * np.uint64(2246822519)
    return ((h ^ (h >> np.uint64(15))) & np.uint64(0xFFFFFF)) / 16777216.0


@njit(cache=True)
def _noise(u, v, w, seed, footprint):
    """Return noise of five octaves, each faded out where a pixel is larger than its cells."""
    total, size = 0.0, 4.0
    for octave in range(5):
        weight = min(max(size / (2 * footprint) - 0.5, 0.0), 1.0)
        if weight > 0:
            x, y = u / size, v / size
            i, j = int(np.floor(x)), int(np.floor(y))
            a, b = x - i, y - j
            a, b = a * a * (3 - 2 * a), b * b * (3 - 2 * b)
            low = _hash(i, j, w, seed + octave) * (1 - a) + _hash(i + 1, j, w, seed + octave) * a
            high = _hash(i, j + 1, w, seed + octave) * (1 - a) + _hash(i + 1, j + 1, w, seed + octave) * a
            total += weight * (low * (1 - b) + high * b - 0.5) * 0.3
        size *= 0.45
    return total


@njit(cache=True)
def _cast(origin, direction, boxes, count, seed):
    """Return distance along the ray, face (0 ground, 1 .. 3 the axis of a box's face) and cell of the first hit."""
    ground = -origin[2] / direction[2]
    # Walk through the columns of the grid between the height of the highest box and the ground.
    top = (boxes[:, :, 2].max() - origin[2]) / direction[2]
    t = max(top, 0.0)
    x, y = origin[0] + t * direction[0], origin[1] + t * direction[1]
    i, j = int(np.floor(x / PITCH)), int(np.floor(y / PITCH))
    while t < ground:
        if 0 <= i < count and 0 <= j < count:
            near, far, axis = t - PITCH, ground, 0
            for a in range(3):
                if a < 2:
                    middle = ((i if a == 0 else j) + 0.5) * PITCH
                    low, high = middle - boxes[i, j, a], middle + boxes[i, j, a]
                else:
                    low, high = 0.0, boxes[i, j, 2]
                first = (low - origin[a]) / direction[a]
                last = (high - origin[a]) / direction[a]
                if first > last:
                    first, last = last, first
                if first > near:
                    near, axis = first, a + 1
                far = min(far, last)
            if near < far and near > 0 and axis > 0:
                return near, axis, i, j
        next_i = ((i + (direction[0] > 0)) * PITCH - origin[0]) / direction[0]
        next_j = ((j + (direction[1] > 0)) * PITCH - origin[1]) / direction[1]
        if next_i < next_j:
            t, i = next_i, i + (1 if direction[0] > 0 else -1)
        else:
            t, j = next_j, j + (1 if direction[1] > 0 else -1)
    return ground, 0, -1, -1


@njit(parallel=True, cache=True)
def _render(viewmat, fx, width, height, boxes, colors, count, seed, image, cells, depth):
    rotation = viewmat[:3, :3].copy()
    center = -(rotation.T @ viewmat[:3, 3].copy())
    n = _SUPERSAMPLING
    for row in prange(height):
        for column in range(width):
            for k in range(n * n):
                x = (column + (k % n + 0.5) / n - width / 2) / fx
                y = (row + (k // n + 0.5) / n - height / 2) / fx
                direction = rotation[0] * x + rotation[1] * y + rotation[2]
                t, axis, i, j = _cast(center, direction, boxes, count, seed)
                px, py, pz = center + t * direction
                footprint = t / fx / n
                u, v = (py, pz) if axis == 1 else ((px, pz) if axis == 2 else (px, py))
                w = 0 if axis == 0 else 1 + axis + 4 * (i * count + j)
                noise = _noise(u, v, w, seed, footprint)
                light = (0.95, 0.6, 0.75, 1.0)[axis]
                for c in range(3):
                    base = colors[i, j, c] if axis else (0.42, 0.44, 0.36)[c]
                    image[row, column, c] += min(max((base + noise) * light, 0.0), 1.0) / (n * n)
                if k == 0:
                    cells[row, column] = i * count + j if axis else -1
                    depth[row, column] = t


class Town:
    """The boxes of a town of `count` x `count` cells: half sizes and height, colors, and object IDs (0: none)."""

    def __init__(self, count: int, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.count, self.seed = count, seed
        self.boxes = np.stack(
            [*rng.uniform(2.0, 4.2, (2, count, count)), rng.uniform(1.5, 8.0, (count, count))], axis=-1
        )
        self.colors = rng.uniform(0.2, 0.8, (count, count, 3))
        self.ids = np.zeros(count * count, np.uint16)
        chosen = rng.permutation(count * count)[: max(count * count // 10, OBJECTS)]
        self.ids[chosen] = 1 + np.arange(len(chosen)) % OBJECTS

    def render(self, viewmat: np.ndarray, fx: float, width: int, height: int) -> tuple[np.ndarray, ...]:
        """Return the image (h, w, 3) uint8, the object IDs (h, w) uint16 and depth (h, w) along the camera's axis."""
        image, cells = np.zeros((height, width, 3)), np.empty((height, width), np.int64)
        depth = np.empty((height, width))
        _render(viewmat, fx, width, height, self.boxes, self.colors, self.count, self.seed, image, cells, depth)
        return np.rint(image * 255).astype(np.uint8), np.where(cells < 0, 0, self.ids[cells]).astype(np.uint16), depth


def flight(photos: int) -> tuple[np.ndarray, int]:
    """Return the world-to-camera matrices (photos, 4, 4) of a flight, and the edge of its town in cells."""
    lines = max(round(math.sqrt(photos)), 1)
    on_line = math.ceil(photos / lines)
    count = math.ceil((max(lines, on_line) - 1) * SPACING / PITCH) + 2
    margin = (count * PITCH - np.array([on_line - 1, lines - 1]) * SPACING) / 2
    viewmats = np.tile(np.eye(4), (photos, 1, 1))
    for index in range(photos):
        line, place = divmod(index, on_line)
        place = on_line - 1 - place if line % 2 else place
        center = np.array([*(margin + SPACING * np.array([place, line])), HEIGHT])
        # Not along an axis, so that no ray is parallel to a face.
        angle = 0.3 + math.pi / 2 * index + 0.01 * line
        forward = np.array([math.cos(angle) * math.cos(TILT), math.sin(angle) * math.cos(TILT), -math.sin(TILT)])
        right = np.cross(forward, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        viewmats[index, :3, :3] = np.stack([right, np.cross(forward, right), forward])
        viewmats[index, :3, 3] = -viewmats[index, :3, :3] @ center
    return viewmats, count


def make(out: Path, photos: int, width: int = 320, points_per_photo: int = 100, seed: int = 0) -> Path:
    """Write a capture with a COLMAP model in text form, images, masks and labels.json; returns `out`."""
    height = width * 3 // 4
    fx = width / 2 / math.tan(FOV / 2)
    viewmats, count = flight(photos)
    town, rng = Town(count, seed), np.random.default_rng(seed)
    for name in ("images", "masks", "sparse/0"):
        (out / name).mkdir(parents=True, exist_ok=True)
    lines, points = [], []
    for index, viewmat in enumerate(viewmats):
        image, ids, depth = town.render(viewmat, fx, width, height)
        name = f"{index:05d}.png"
        Image.fromarray(image).save(out / "images" / name, compress_level=1)
        Image.fromarray(ids).save(out / "masks" / name)
        x, y, z, w = Rotation.from_matrix(viewmat[:3, :3]).as_quat()
        tx, ty, tz = viewmat[:3, 3]
        lines += [f"{index + 1} {w:.12f} {x:.12f} {y:.12f} {z:.12f} {tx:.9f} {ty:.9f} {tz:.9f} 1 {name}", ""]
        at = rng.choice(width * height, points_per_photo, replace=False)
        rows, columns = np.divmod(at, width)
        t = depth[rows, columns]
        # The depth is that of the first ray of the pixel.
        offset = 0.5 / _SUPERSAMPLING
        local = np.stack([(columns + offset - width / 2) / fx * t, (rows + offset - height / 2) / fx * t, t], 1)
        xyz = (local - viewmat[:3, 3]) @ viewmat[:3, :3] + rng.normal(0, 0.02, (len(at), 3))
        points.append(np.column_stack([xyz, image[rows, columns]]))
    sparse = out / "sparse" / "0"
    (sparse / "images.txt").write_text("\n".join(lines) + "\n")
    (sparse / "cameras.txt").write_text(f"1 PINHOLE {width} {height} {fx} {fx} {width / 2} {height / 2}\n")
    with (sparse / "points3D.txt").open("w") as file:
        for i, (x, y, z, r, g, b) in enumerate(np.concatenate(points).tolist(), 1):
            file.write(f"{i} {x:.4f} {y:.4f} {z:.4f} {r:.0f} {g:.0f} {b:.0f} 0.5\n")
    (out / "labels.json").write_text(json.dumps({str(i): f"Building {i}" for i in range(1, OBJECTS + 1)}))
    return out


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--photos", type=int, default=500)
    parser.add_argument("--width", type=int, default=320)
    parser.add_argument("--points-per-photo", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    print(make(options.out, options.photos, options.width, options.points_per_photo, options.seed))
