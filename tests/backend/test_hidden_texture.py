"""Texture of parts that no photo shows, on patterns that are known there, too."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.ndimage import gaussian_filter

from backend.mesh.texture.atlas import fill, find_texels
from backend.mesh.texture.completion import complete
from backend.mesh.texture.hidden import Textured, complete_hidden_parts

SIZE = 160
ROWS, COLUMNS = np.indices((SIZE, SIZE))
SHADOW = 0.5 + ROWS / (2 * SIZE)


def planks(rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Planks 16 pixels wide with dark joints, of two colors in turn; the colors (..., 3) from 0 to 1."""
    which, across = np.divmod(rows, 16)
    color = np.where((which % 2 == 0)[..., None], [0.7, 0.5, 0.3], [0.5, 0.35, 0.2])
    return np.where(((across < 2) | ((columns + 40 * which) % 80 < 2))[..., None], 0.1, color)


def disc(row: float, column: float, radius: float) -> np.ndarray:
    return np.hypot(ROWS - row, COLUMNS - column) < radius


def psnr(found: np.ndarray, true: np.ndarray) -> float:
    return float(-10 * np.log10(np.mean((found - true) ** 2)))


@pytest.mark.parametrize(("row", "column", "radius"), [(80, 80, 18), (60, 95, 25), (30, 120, 8)])
def test_pattern_is_continued(row, column, radius):
    true, hidden = planks(ROWS, COLUMNS), disc(row, column, radius)
    given = np.where(hidden[..., None], np.nan, true)
    found = complete(np.nan_to_num(given), ~hidden, hidden)
    assert (found[~hidden] == true[~hidden]).all()
    smooth = np.nan_to_num(given).astype(np.float32)
    fill(smooth, ~hidden)
    assert psnr(found[hidden], true[hidden]) > psnr(smooth[hidden], true[hidden]) + 3.0
    again = complete(np.where(hidden[..., None], 0.9, true), ~hidden, hidden)
    np.testing.assert_array_equal(again, found, "what is not known does not matter, and nothing is random")


def test_noise_keeps_its_strength():
    """Means of many patches would be blurred."""
    noise = gaussian_filter(np.random.default_rng(0).normal(0, 1, (SIZE, SIZE, 3)), (1.5, 1.5, 0))
    hidden = disc(80, 80, 20)
    found = complete(noise, ~hidden, hidden)
    assert 0.6 < found[hidden].std() / noise[hidden].std() < 1.2


def test_too_little_is_known():
    hidden = np.ones((40, 40), bool)
    hidden[::5] = False
    assert complete(np.zeros((40, 40, 3)), ~hidden, hidden) is None
    assert complete(np.zeros((40, 40, 3)), np.zeros((40, 40), bool), np.ones((40, 40), bool)) is None


def sheet(height) -> trimesh.Trimesh:
    """A sheet of 40 x 40 squares from (0, 0) to (1, 1), of some height(x, y), with its outside above."""
    y, x = np.mgrid[:41, :41] / 40
    corner = np.ravel_multi_index(np.mgrid[:40, :40].reshape(2, -1), (41, 41))
    faces = np.concatenate([corner[:, None] + [0, 1, 42], corner[:, None] + [0, 42, 41]])
    return trimesh.Trimesh(np.stack([x, y, height(x, y)], 2).reshape(-1, 3), faces, process=False)


def surface_of(mesh: trimesh.Trimesh, seen: np.ndarray) -> Textured:
    """The sheet, whose texture is the view from above with the row 0 at y = 1."""
    uvs = mesh.vertices[mesh.faces][..., :2].astype(np.float32)
    texels = find_texels(uvs, SIZE, 0, SIZE)
    count = np.maximum(np.bincount(texels.face, minlength=len(uvs)), 1)
    shown = np.bincount(texels.face, seen.ravel()[texels.indices], len(uvs)) / count
    parts = lambda: (find_texels(uvs, SIZE, first, SIZE // 4) for first in range(0, SIZE, SIZE // 4))  # noqa: E731
    return Textured(mesh.vertices, mesh.faces.astype(np.int32), shown, parts, len(texels.indices))


def completed(mesh, true, hidden) -> tuple[np.ndarray, np.ndarray]:
    """The texture before and after, of uniform gray where it is hidden, and with shading."""
    before = np.rint(255 * np.where(hidden[..., None], 0.4, true)).astype(np.uint8)
    after = before.copy()
    done: list[float] = []
    complete_hidden_parts(after, ~hidden, surface_of(mesh, ~hidden), done.append)
    assert done == sorted(done) and all(0 <= each <= 1 for each in done)
    return before, after


@pytest.mark.parametrize("bend", [0.0, 0.02])
def test_table_under_things_continues(bend):
    true = planks(ROWS, COLUMNS) * SHADOW[..., None]
    hidden = disc(50, 60, 14) | disc(110, 100, 17)
    before, after = completed(sheet(lambda x, y: bend * np.sin(6 * x)), true, hidden)
    near = gaussian_filter(hidden.astype(float), 3) > 0.02
    assert (after[~near] == before[~near]).all()
    for part in (hidden & (ROWS < 80), hidden & (ROWS >= 80)):
        assert psnr(after[part] / 255, true[part]) > 18
    # Darker at the top of the picture, as around it.
    upper, lower = hidden & (ROWS < 80), hidden & (ROWS >= 80)
    assert after[upper].mean() / after[lower].mean() == pytest.approx(true[upper].mean() / true[lower].mean(), rel=0.1)


def test_only_enclosed_flat_parts_change():
    true = planks(ROWS, COLUMNS)
    dome = sheet(lambda x, y: 0.8 * np.sqrt(np.maximum(0.3 - (x - 0.5) ** 2 - (y - 0.5) ** 2, 0)))
    for mesh, hidden in (
        (sheet(lambda x, y: 0 * x), COLUMNS > 60),
        (sheet(lambda x, y: 0 * x), ~disc(80, 80, 40)),
        (dome, disc(80, 80, 50)),
        (sheet(lambda x, y: 0 * x), disc(80, 80, 3)),
        (sheet(lambda x, y: 0 * x), np.zeros((SIZE, SIZE), bool)),
        (sheet(lambda x, y: 0 * x), np.ones((SIZE, SIZE), bool)),
    ):
        before, after = completed(mesh, true, hidden)
        np.testing.assert_array_equal(after, before)
