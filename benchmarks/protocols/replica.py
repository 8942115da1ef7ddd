"""Replica, as rendered for Semantic-NeRF; the folder Sequence_1 of a scene has

rgb/rgb_N.png                                the photos, 90 degrees wide
depth/depth_N.png                            depth along the camera's axis in millimeters, 0 where unknown
semantic_instance/semantic_instance_N.png    object IDs; 0 and negative ones are unlabeled
traj_w_c.txt                                 a row of 16 numbers for each N: camera to world, OpenCV axes
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from backend.capture import default_split
from backend.shared.errors import InputError

from .captures import Frame, need, read_pixels, write_capture
from .metrics import Results
from .panoptic import FIGURES, NOTES, panoptic

__all__ = ["AFTER_TRAINING", "FIGURES", "NOTES", "TRAINING", "convert", "measure", "paper"]

TRAINING = ()
AFTER_TRAINING = ("evaluate",)

EVERY = 5
"""Every 5th frame is a view, and every 8th view a test view."""

MOST_POINTS = 100_000


def paper(scene: str) -> dict[str, float]:
    """Return the paper's figures, which are means over its scenes."""
    return {"psnr": 40.26, "ssim": 0.9842, "lpips": 0.0280, "miou": 88.39, "dice": 92.39, "accuracy": 95.65}


def convert(scene: Path, folder: Path, every: int = EVERY) -> None:
    """Write a scene as a capture to a new folder.

    Args:
        scene: The scene.
        folder: A folder that does not exist.
        every: One of this many frames is a view.

    Raises:
        InputError: The scene lacks something.
    """
    sequence = need(scene / "Sequence_1", "the frames rendered for Semantic-NeRF")
    numbers = range(0, len(_poses(sequence)), every)
    held_out = set(default_split(len(numbers)))
    trained = [number for at, number in enumerate(numbers) if at not in held_out]
    xyz, rgb = _points(sequence, trained)
    write_capture(folder, _frames(sequence, numbers, held_out), xyz, rgb, {})


def _poses(sequence: Path) -> np.ndarray:
    """Return the cameras' poses (N, 4, 4), camera to world."""
    path = need(sequence / "traj_w_c.txt", "the poses of the frames")
    try:
        poses = np.loadtxt(path, ndmin=2).reshape(-1, 4, 4)
    except ValueError as error:
        raise InputError(f"{path} is not a table of 16 numbers a row; put the original file back.") from error
    return poses


def _intrinsics(width: int, height: int) -> np.ndarray:
    """Return the intrinsics (3, 3) of an image 90 degrees wide."""
    return np.array([[width / 2, 0, width / 2], [0, width / 2, height / 2], [0, 0, 1]])


def _frames(sequence: Path, numbers: range, held_out: set[int]) -> Iterator[Frame]:
    poses = _poses(sequence)
    for at, number in enumerate(numbers):
        photo = need(sequence / "rgb" / f"rgb_{number}.png", "a photo")
        labels = read_pixels(need(_of(sequence, "semantic_instance", number), "the object IDs of a frame"))
        # 16-bit images have no sign, so negative IDs are stored as large ones.
        ids = np.maximum(labels.astype(np.uint16).view(np.int16), 0)
        height, width = ids.shape
        viewmat = np.linalg.inv(poses[number])
        yield Frame(f"rgb_{number:05d}.png", photo, _intrinsics(width, height), viewmat, ids, at in held_out)


def _of(sequence: Path, what: str, number: int) -> Path:
    return sequence / what / f"{what}_{number}.png"


def _points(sequence: Path, numbers: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Return at most MOST_POINTS points of the frames' depth (M, 3) in the world, and their colors (M, 3) uint8."""
    poses, rng = _poses(sequence), np.random.default_rng(0)
    share = MOST_POINTS // len(numbers)
    xyz, rgb = [], []
    for number in numbers:
        depth = read_pixels(need(_of(sequence, "depth", number), "the depth of a frame")) / 1000
        photo = read_pixels(need(_of(sequence, "rgb", number), "a photo"))[..., :3]
        known = np.flatnonzero(depth > 0)
        row, column = np.unravel_index(rng.permutation(known)[:share], depth.shape)
        K = _intrinsics(depth.shape[1], depth.shape[0])
        pixels = np.stack([column + 0.5, row + 0.5, np.ones(len(row))], 1)
        seen = pixels @ np.linalg.inv(K).T * depth[row, column, None]
        xyz.append(seen @ poses[number, :3, :3].T + poses[number, :3, 3])
        rgb.append(photo[row, column])
    return np.concatenate(xyz), np.concatenate(rgb)


def measure(scene: Path, capture: Path, results: Results) -> dict[str, Any]:
    """Return the panoptic scores of a reconstruction."""
    return panoptic(results.quality)
