"""Levels of detail: what merging keeps, bounds of blocks, and the choice for a view."""

import numpy as np
import pytest
import torch

from backend.raster import Camera, rasterize
from backend.shared.splats.level_selection import PlacedLevels, marks_of_places, select
from backend.shared.splats.levels import BLOCK, GROUP, LEVELS, Stopped, build_levels
from backend.shared.splats.picking import View, rotations

UNLIMITED = 1 << 40
COUNT = 20 * BLOCK + 77


def cloud(count: int = COUNT, seed: int = 0) -> tuple[np.ndarray, ...]:
    """Return random splats in a flat box, float32."""
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(count, 4))
    return tuple(
        values.astype(np.float32)
        for values in (
            rng.uniform(-1, 1, (count, 3)) * (4.0, 4.0, 0.5),
            quats,
            np.exp(rng.normal(-3.5, 0.5, (count, 3))),
            rng.uniform(0.1, 0.95, count),
            rng.normal(0, 0.3, (count, 4, 3)),
        )
    )


def covariances(quats: np.ndarray, scales: np.ndarray) -> np.ndarray:
    quats = quats.astype(np.float64)
    axes = rotations(quats / np.linalg.norm(quats, axis=1, keepdims=True)) * scales[:, None]
    return axes @ axes.swapaxes(1, 2)


def weights(opacities: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """Opacity times mean projected area, from the trace of the adjugate of the covariance."""
    squares = scales.astype(np.float64) ** 2
    return opacities * np.sqrt((squares * np.roll(squares, 1, axis=1)).sum(1))


def at(splats, levels, places) -> list[np.ndarray]:
    """Return the splats at places."""
    drawn = len(levels.order)
    own, merged = levels.order[places[places < drawn]], places[places >= drawn] - drawn
    return [np.concatenate([a[own], b[merged].astype(np.float32)]) for a, b in zip(splats, levels.merged)]


def places_of(levels, block: int, level: int) -> np.ndarray:
    return levels.firsts[block, level] + np.arange(levels.counts[block, level])


def members(levels, places: np.ndarray) -> np.ndarray:
    """Return the first BLOCK-th places of the splats that those at `places` stand for."""
    found = []
    for place in places.tolist():
        block, level = np.argwhere((levels.firsts <= place) & (place < levels.firsts + levels.counts))[0]
        size = GROUP**level
        first = levels.firsts[block, 0] + (place - levels.firsts[block, level]) * size
        found.append(first + np.arange(size))
    return np.concatenate(found)


def view_from(eye, target=(0.0, 0.0, 0.0), width: int = 160, height: int = 120, focal: float = 150.0) -> View:
    forward = np.subtract(target, eye, dtype=float)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, (0.0, 0.3, 1.0))
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3, :3] = right, np.cross(forward, right), forward
    matrix[:3, 3] = -matrix[:3, :3] @ eye
    return View(matrix, focal, focal, width / 2, height / 2, width, height)


def image(splats, view: View) -> np.ndarray:
    K = np.array([[view.fx, 0, view.cx], [0, view.fy, view.cy], [0, 0, 1]])
    tensors = [torch.from_numpy(np.ascontiguousarray(values)) for values in splats]
    ids = torch.zeros(len(splats[0]), dtype=torch.int32)
    return rasterize(*tensors, ids, Camera(view.viewmat, K, view.width, view.height)).color.numpy()


@pytest.fixture(scope="module")
def built():
    splats = cloud()
    return splats, build_levels(*splats)


def test_every_splat_has_one_place(built):
    splats, levels = built
    assert sorted(levels.order.tolist()) == list(range(COUNT))
    assert np.array_equal(levels.means[:COUNT], splats[0][levels.order])
    assert np.array_equal(levels.means[COUNT:], levels.merged.means)
    assert levels.counts[:20].tolist() == [[BLOCK // GROUP**level for level in range(LEVELS)]] * 20
    taken = np.concatenate([places_of(levels, block, level) for block in range(20) for level in range(LEVELS)])
    assert sorted([*taken.tolist(), *places_of(levels, 20, 0).tolist()]) == list(range(len(levels.means)))
    assert levels.counts[20].tolist() == [77] * LEVELS and np.isinf(levels.errors[20, 1:]).all()


def test_merging_keeps_weight_mean_covariance_and_color(built):
    splats, levels = built
    for block in (0, 7, 19):
        sums = []
        for level in range(LEVELS):
            means, quats, scales, opacities, harmonics = at(splats, levels, places_of(levels, block, level))
            own = weights(opacities, scales)
            share = own / own.sum()
            mean = share @ means
            away = means - mean
            spread = np.einsum("n,ni,nj->ij", share, away, away)
            covariance = np.einsum("n,nij->ij", share, covariances(quats, scales)) + spread
            color = np.einsum("n,nkc->kc", share, harmonics)
            sums.append(np.concatenate([[own.sum()], mean, covariance.ravel(), color.ravel()]))
        assert np.allclose(sums[1:], sums[0], rtol=1e-4, atol=5e-4)
        assert np.allclose(np.array(sums)[:, :13], sums[0][:13], rtol=1e-4, atol=1e-6)


def test_error_is_the_weighted_distance_from_the_splats(built):
    splats, levels = built
    for block in (3, 11):
        own = at(splats, levels, places_of(levels, block, 0))
        share = weights(own[3], own[2]).reshape(-1)
        for level in range(1, LEVELS):
            centers = np.repeat(at(splats, levels, places_of(levels, block, level))[0], GROUP**level, axis=0)
            square = (share * ((own[0] - centers) ** 2).sum(1)).sum() / share.sum()
            assert levels.errors[block, level] == pytest.approx(np.sqrt(square), rel=1e-4)


def test_identical_splats_merge_to_themselves():
    quats = np.tile([[0.9, 0.1, -0.3, 0.2]], (BLOCK, 1))
    scales = np.tile([[0.1, 0.3, 0.2]], (BLOCK, 1))
    harmonics = np.tile(np.random.default_rng(0).normal(size=(1, 4, 3)), (BLOCK, 1, 1))
    levels = build_levels(np.full((BLOCK, 3), 2.0), quats, scales, np.full(BLOCK, 0.01), harmonics)
    assert np.allclose(levels.merged.means, 2.0) and np.abs(levels.errors).max() < 1e-9
    assert np.allclose(np.sort(levels.merged.scales, axis=1), (0.1, 0.2, 0.3), rtol=1e-5)
    found = covariances(levels.merged.quats, levels.merged.scales)
    assert np.allclose(found, covariances(quats, scales)[0], rtol=1e-4, atol=1e-7)
    assert np.allclose(np.linalg.norm(levels.merged.quats, axis=1), 1.0)
    assert np.allclose(levels.merged.harmonics, harmonics[0], atol=2e-3)
    # As many times as opaque, since so many lie in the same place.
    for level in range(1, LEVELS):
        places = places_of(levels, 0, level) - BLOCK
        assert np.allclose(levels.merged.opacities[places], 0.01 * GROUP**level, rtol=1e-4)


def test_splats_of_no_extent_merge_to_finite_ones():
    levels = build_levels(
        np.zeros((BLOCK, 3)),
        np.eye(4)[np.zeros(BLOCK, int)],
        np.zeros((BLOCK, 3)),
        np.ones(BLOCK),
        np.zeros((BLOCK, 1, 3)),
    )
    assert all(np.isfinite(values).all() for values in levels.merged)


def test_splats_that_are_not_drawn_have_no_place():
    splats = cloud()
    splats[3][:500] = 0.0
    splats[0][500] = np.nan
    splats[1][501] = 0.0
    splats[2][502] = np.inf
    levels = build_levels(*splats)
    assert sorted(levels.order.tolist()) == list(range(503, COUNT))
    splats[3][:] = 0.0
    levels = build_levels(*splats)
    assert len(levels.order) == len(levels.means) == 0
    view = view_from((0, -9, 6))
    assert [len(places) for places in select([PlacedLevels(levels, np.eye(4))], view, 1.0, 100)] == [0]


def test_building_can_be_stopped():
    with pytest.raises(Stopped):
        build_levels(*cloud(), lambda: True)


def test_bounds_contain_the_splats(built):
    splats, levels = built
    for block in range(len(levels.centers)):
        means, _, scales, opacities, _ = at(splats, levels, places_of(levels, block, 0))
        assert np.linalg.norm(means - levels.centers[block], axis=1).max() <= levels.radii[block] + 1e-5
        assert (np.sqrt(2 * np.log(255 * opacities)) * scales.max(1)).max() <= levels.extents[block] + 1e-6


def test_blocks_lie_together(built):
    _, levels = built
    assert np.median(levels.radii) < 2.0  # Of a twentieth of a box of 8 x 8 x 1, it is at least 1.3.


@pytest.mark.parametrize("pixels", [0.0, 0.5, 2.0, 8.0, 1e9])
def test_chosen_splats_stand_for_each_splat_once(built, pixels):
    _, levels = built
    view = view_from((0, -12, 8))
    (places,) = select([PlacedLevels(levels, np.eye(4))], view, pixels, UNLIMITED)
    assert (np.diff(places) > 0).all()
    assert sorted(members(levels, places).tolist()) == list(range(COUNT))


def test_levels_become_coarser_with_distance(built):
    _, levels = built
    counts = [
        len(select([PlacedLevels(levels, np.eye(4))], view_from((0, -12 * far, 8 * far)), 1.0, UNLIMITED)[0])
        for far in (1, 2, 4, 8, 100)
    ]
    assert counts == sorted(counts, reverse=True) and counts[0] == COUNT and counts[-1] == 20 + 77
    # A large scale is as good as a small distance.
    (places,) = select([PlacedLevels(levels, np.diag([4.0, 4, 4, 1]))], view_from((0, -48, 32)), 1.0, UNLIMITED)
    assert len(places) == counts[0]


def test_orthographic_views_choose_by_scale(built):
    _, levels = built
    counts = []
    for focal in (150.0, 10.0, 1.0, 0.1):
        view = view_from((0, -12, 8), focal=focal)
        view = View(view.viewmat, focal, focal, 80, 60, 160, 120, near=-100.0, orthographic=True)
        counts.append(len(select([PlacedLevels(levels, np.eye(4))], view, 1.0, UNLIMITED)[0]))
    assert counts[-1] == 20 + 77 and counts[1:] == sorted(counts[1:], reverse=True)


@pytest.mark.parametrize("budget", [20 * BLOCK, 2000, 500, 100])
def test_the_budget_is_kept(built, budget):
    _, levels = built
    (places,) = select([PlacedLevels(levels, np.eye(4))], view_from((0, -12, 8)), 0.01, budget)
    assert budget / 5 < len(places) <= budget
    two = select([PlacedLevels(levels, np.eye(4))] * 2, view_from((0, -12, 8)), 0.01, 2 * budget)
    assert np.array_equal(two[0], two[1]) and len(two[0]) <= budget


def test_a_budget_below_the_coarsest_levels_draws_these(built):
    _, levels = built
    (places,) = select([PlacedLevels(levels, np.eye(4))], view_from((0, -12, 8)), 0.01, 1)
    assert len(places) == 20 + 77


@pytest.mark.parametrize(
    ("eye", "focal", "most"),
    [
        ((0, -12, 8), 150.0, 1.0),
        ((0, -12, 8), 2000.0, 0.7),
        ((0.2, 0.1, 0.1), 150.0, 1.0),
        ((2.0, 2.0, 1.0), 400.0, 1.0),
        ((0, -4.2, 0), 150.0, 1.0),
        ((-3.9, -3.9, 0.2), 80.0, 1.0),
    ],
)
def test_no_visible_splat_is_left_out(built, eye, focal, most):
    """The image of the blocks in view is that of all splats."""
    splats, levels = built
    view = view_from(eye, (0.3, 0.9, -0.1), focal=focal)
    (places,) = select([PlacedLevels(levels, np.eye(4))], view, 0.0, UNLIMITED)
    keep = np.sort(levels.order[places])  # Splats of the same depth keep their order.
    assert len(keep) <= most * COUNT
    assert np.array_equal(image([values[keep] for values in splats], view), image(splats, view))


def test_fewer_pixels_of_error_are_a_better_image(built):
    splats, levels = built
    view = view_from((0, -40, 25))
    whole = image(splats, view)
    counts, errors = [], []
    for pixels in (0.3, 1.0, 4.0):
        (places,) = select([PlacedLevels(levels, np.eye(4))], view, pixels, UNLIMITED)
        counts.append(len(places) / COUNT)
        errors.append(np.sqrt(((image(at(splats, levels, places), view) - whole) ** 2).mean()))
    assert counts[1] < 0.3 and counts == sorted(counts, reverse=True)
    assert errors[1] < 0.035 and errors == sorted(errors)


def test_marked_splats_are_drawn_one_by_one(built):
    _, levels = built
    marks = np.zeros(COUNT)
    marks[levels.order[5]] = 1.0
    marks[levels.order[BLOCK : 2 * BLOCK]] = 2.0
    own, mixed = marks_of_places(levels, marks)
    assert np.flatnonzero(mixed).tolist() == [0]
    assert np.array_equal(own[:COUNT], marks[levels.order])
    (places,) = select([PlacedLevels(levels, np.eye(4), mixed)], view_from((0, -1200, 800)), 1.0, 10)
    assert np.array_equal(places[:BLOCK], np.arange(BLOCK))
    assert [own[place] for place in places if levels.firsts[1, 1] <= place] == [2.0, *[0.0] * 18]


def test_an_object_of_no_size_is_no_error(built):
    """As while it is scaled to 0, also where fewer splats have to be drawn."""
    _, levels = built
    for matrix in (np.diag([0.0, 0, 0, 1]), np.diag([1.0, 0, 1, 1])):
        (places,) = select([PlacedLevels(levels, matrix)], view_from((0, -12, 8)), 1.0, 10)
        assert len(places) > 0
