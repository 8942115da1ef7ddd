"""Spherical harmonics in NumPy: agreement with the rasterizer, and exact rotation."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from backend.raster.reference import sh_colors
from backend.shared.splats.spherical_harmonics import basis, rotate, rotation_blocks

RNG = np.random.default_rng(0)
DIRECTIONS = RNG.normal(size=(200, 3))
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_basis_matches_rasterizer(degree):
    sh = RNG.normal(size=(200, (degree + 1) ** 2, 3)) * 0.05
    wanted = sh_colors(torch.from_numpy(sh), torch.from_numpy(DIRECTIONS)).numpy()
    found = np.einsum("nk,nkc->nc", basis(DIRECTIONS, degree), sh) + 0.5
    np.testing.assert_allclose(found, wanted, atol=1e-14)
    assert basis(DIRECTIONS.astype(np.float32), degree).dtype == np.float32


def test_fourth_degree_is_rejected():
    with pytest.raises(ValueError, match="degree 4"):
        basis(DIRECTIONS, 4)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("mirrored", [False, True])
def test_rotation_keeps_color_for_rotated_directions(degree, mirrored):
    for turn in Rotation.random(20, rng=1).as_matrix():
        turn = turn @ np.diag([1, -1 if mirrored else 1, 1])
        sh = RNG.normal(size=(5, (degree + 1) ** 2, 3))
        before = np.einsum("dk,nkc->dnc", basis(DIRECTIONS, degree), sh)
        after = np.einsum("dk,nkc->dnc", basis(DIRECTIONS @ turn.T, degree), rotate(sh, turn))
        np.testing.assert_allclose(after, before, atol=1e-13)
        for block in rotation_blocks(turn, degree):
            np.testing.assert_allclose(block @ block.T, np.eye(len(block)), atol=1e-13)
