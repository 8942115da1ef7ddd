"""Real spherical harmonics up to degree 3, with the order and signs of 3D Gaussian splatting (Kerbl et al. 2023), and
how their coefficients change under a rotation."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

C0 = math.sqrt(1 / 4 / math.pi)
"""The constant harmonic: a splat's mean color is 0.5 + C0 * f_dc."""

HIGHEST_DEGREE = 3

C1 = math.sqrt(3 / 4 / math.pi)
C2, C20 = math.sqrt(15 / 4 / math.pi), math.sqrt(5 / 16 / math.pi)
C30, C31, C32, C33 = (math.sqrt(value / math.pi) for value in (7 / 16, 21 / 32, 105 / 4, 35 / 32))
"""Factors of the harmonics of degree 1, 2 and 3 in `basis`."""


def basis(directions: NDArray, degree: int) -> NDArray:
    """Evaluate the harmonics of degree 0 to `degree`.

    Args:
        directions: unit directions (n, 3).
        degree: 0 to HIGHEST_DEGREE.

    Returns:
        (n, (degree + 1)^2), of the directions' float type.

    Raises:
        ValueError: if the degree is out of range.
    """
    x, y, z = np.asarray(directions).T
    xx, yy, zz = x * x, y * y, z * z
    bands = [
        [np.full_like(x, C0)],
        [-C1 * y, C1 * z, -C1 * x],
        [C2 * x * y, -C2 * y * z, C20 * (2 * zz - xx - yy), -C2 * x * z, C2 / 2 * (xx - yy)],
        [
            -C33 * y * (3 * xx - yy), C32 * x * y * z, -C31 * y * (4 * zz - xx - yy),
            C30 * z * (2 * zz - 3 * xx - 3 * yy),
            -C31 * x * (4 * zz - xx - yy), C32 / 2 * z * (xx - yy), -C33 * x * (xx - 3 * yy),
        ],
    ]  # fmt: skip
    if not 0 <= degree <= HIGHEST_DEGREE:
        raise ValueError(f"spherical harmonics of degree {degree} are not supported, expected 0 to {HIGHEST_DEGREE}")
    return np.stack([harmonic for band in bands[: degree + 1] for harmonic in band], 1)


def rotation_blocks(matrix: NDArray, degree: int) -> list[NDArray[np.float64]]:
    """Compute how coefficients change when the splats that they color are rotated.

    From a direction d, the rotated splat has the color that it had before from matrix^T @ d.

    Args:
        matrix: the rotation (3, 3), possibly with a reflection.
        degree: 0 to HIGHEST_DEGREE.

    Returns:
        For each band l from 0 to `degree` a matrix (2 l + 1, 2 l + 1): new = block @ old.
    """
    after = basis(_DIRECTIONS, degree)
    before = basis(_DIRECTIONS @ np.asarray(matrix, np.float64), degree)
    bands = [slice(band * band, (band + 1) ** 2) for band in range(degree + 1)]
    return [np.linalg.lstsq(after[:, band], before[:, band], rcond=None)[0] for band in bands]


def rotate(sh: NDArray, matrix: NDArray) -> NDArray:
    """Rotate the coefficients of splats.

    Args:
        sh: coefficients (n, K, 3).
        matrix: the rotation (3, 3) of the splats.

    Returns:
        The coefficients (n, K, 3) of the rotated splats, of the same float type.
    """
    rotated = np.array(sh)
    for band, block in enumerate(rotation_blocks(matrix, math.isqrt(sh.shape[1]) - 1)):
        if band:
            at = slice(band * band, (band + 1) ** 2)
            rotated[:, at] = np.einsum("ij,njc->nic", block, sh[:, at])
    return rotated


def _fibonacci_sphere(count: int) -> NDArray[np.float64]:
    """Evenly distributed unit directions (count, 3)."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.arange(count) * math.pi * (3 - math.sqrt(5))
    return np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z], 1)


_DIRECTIONS = _fibonacci_sphere(32)
"""More directions than each band has harmonics."""
