"""Votes: known results on synthetic scenes, guarantees of the strategies, and the labeled PLY."""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from backend.capture import Keypoints, Points, View, load_capture
from backend.labels import read_points, vote, voting, write_points
from backend.labels.voting import _Ballots, needed_to_be_unlabeled
from backend.shared.errors import InputError
from backend.shared.events import Reporter

STRATEGIES = ["majority", "probability", "correspondence"]


@dataclass
class Given:
    """A capture made of arrays."""

    points: Points
    views: list[View]
    masks: list[np.ndarray]
    seen: list[np.ndarray]
    names: dict[int, str]
    known_ids: np.ndarray | None = None

    @property
    def train_indices(self):
        return tuple(range(len(self.views)))

    @property
    def object_ids(self):
        if self.known_ids is not None:
            return self.known_ids
        return np.array(sorted({int(i) for mask in self.masks for i in np.unique(mask)} - {0}), np.int64)

    def ids_in(self, index):
        return tuple(np.unique(self.masks[index]).tolist())

    def mask(self, index, downscale=1):
        return self.masks[index].astype(np.int64)

    def keypoints(self, index):
        view, seen = self.views[index], self.seen[index]
        camera = self.points.xyz[seen] @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
        pixels = camera @ view.K.T
        return Keypoints(pixels[:, :2] / pixels[:, 2:], seen)


def given(masks, xyz, seen=None, viewmats=None, names=None) -> Given:
    """Return a capture with one view per mask, a focal length of 8, a centered principal point, and cameras at the
    origin unless `viewmats` is given."""
    xyz = np.asarray(xyz, float)
    height, width = masks[0].shape
    K = np.array([[8.0, 0, width / 2], [0, 8.0, height / 2], [0, 0, 1]])
    viewmats = viewmats if viewmats is not None else [np.eye(4)] * len(masks)
    views = [
        View(f"{i}", Path(f"{i}.png"), Path(f"{i}m.png"), K, viewmat, width, height, 1)
        for i, viewmat in enumerate(viewmats)
    ]
    count = len(xyz)
    points = Points(xyz, np.zeros((count, 3), np.uint8), np.zeros(count, np.float32), np.arange(count))
    return Given(points, views, list(masks), seen or [np.zeros(0, np.int64)] * len(masks), names or {})


def plain(*ids: int) -> list[np.ndarray]:
    return [np.full((8, 8), i) for i in ids]


def test_majority_wins_and_ties_go_to_smallest_id():
    votes = vote(given([*plain(5, 2, 2, 5, 9), *elsewhere(0)], [[0, 0, 1.0]]))
    assert votes.ids.tolist() == [2] and votes.margins.tolist() == [0.0] and votes.visible.tolist() == [6]
    votes = vote(given([*plain(5, 5, 2, 5), *elsewhere(0)], [[0, 0, 1.0]]))
    assert votes.ids.tolist() == [5] and votes.margins.tolist() == pytest.approx([0.4])
    assert votes.counts == {2: 0, 5: 1, 7: 0}


def elsewhere(*ids: int) -> list[np.ndarray]:
    """Return masks with an ID at the center, and object 7 in a corner."""
    masks = plain(*ids)
    for mask in masks:
        mask[0, 0] = 7
    return masks


def test_unlabeled_is_a_candidate():
    votes = vote(given(elsewhere(0, 0, 0, 7), [[0, 0, 1.0]]))
    assert votes.ids.tolist() == [0] and votes.margins.tolist() == [0.5] and votes.counts == {7: 0}
    votes = vote(given(elsewhere(0, 0, 7, 7), [[0, 0, 1.0]]))
    assert votes.ids.tolist() == [7] and votes.margins.tolist() == [0.0], "half is not enough"
    votes = vote(given(elsewhere(0, 0, 7, 5), [[0, 0, 1.0]]))
    assert votes.ids.tolist() == [5] and votes.margins.tolist() == [0.0], "differing IDs are still objects"
    votes = vote(given(elsewhere(0, 0, 0), [[0, 0, 1.0]]))
    assert votes.ids.tolist() == [0] and votes.margins.tolist() == [1.0] and votes.visible.tolist() == [3]


def test_ignored_pixels_do_not_vote():
    capture = given(elsewhere(-1, -1, -1, 7), [[0, 0, 1.0]])
    capture.known_ids = np.array([7])
    votes = vote(capture)
    assert votes.ids.tolist() == [7] and votes.margins.tolist() == [1.0] and votes.visible.tolist() == [1]


def test_masks_without_labels_do_not_vote():
    votes = vote(given([*plain(0, 0, 0), *elsewhere(5)], [[0, 0, 1.0]]))
    assert votes.ids.tolist() == [5] and votes.margins.tolist() == [1.0] and votes.visible.tolist() == [1]


def test_one_bad_mask_labels_no_point(write_capture, tmp_path):
    """One mask of many shows an object where all others are unlabeled."""
    scene = write_capture(views=24, points=100)
    capture = load_capture(scene.folder, tmp_path / "cache")
    masks = [np.where(ids == 1, 1, 0) for ids in scene.ids]
    masks[capture.train_indices[3]][:] = 1
    capture.mask = lambda index, downscale=1: masks[index]  # type: ignore[method-assign]
    capture.ids_in = lambda index: tuple(np.unique(masks[index]))  # type: ignore[method-assign]
    for strategy in ("majority", "correspondence"):
        votes = vote(capture, strategy)
        assert (votes.ids[scene.point_objects != 1] == 1).sum() <= 5
        assert (votes.ids[scene.point_objects == 1] == 1).mean() > 0.9


def test_incomplete_masks_lose_few_points(write_capture, tmp_path):
    """Each object is missing from every tenth mask, and a tenth of its pixels from all of them."""
    scene = write_capture(views=24, size=(192, 144), points=200)
    capture = load_capture(scene.folder, tmp_path / "cache")
    rng = np.random.default_rng(0)
    masks = [np.where(rng.random(ids.shape) < 0.1, 0, ids) for ids in scene.ids]
    for i in (1, 2, 5):
        for index in rng.choice(24, 2, replace=False):
            masks[index][masks[index] == i] = 0
    capture.mask = lambda index, downscale=1: masks[index]  # type: ignore[method-assign]
    assert (vote(capture).ids == scene.point_objects).mean() > 0.95


def test_pixel_containing_projection_votes():
    mask = np.arange(1, 65).reshape(8, 8)
    x, y = np.meshgrid(np.arange(8), np.arange(8))
    for within in (0.01, 0.5, 0.99):
        xyz = np.stack([(x.ravel() + within - 4) / 8, (y.ravel() + within - 4) / 8, np.ones(64)], 1) * 3.0
        assert vote(given([mask], xyz), occlusion=False).ids.tolist() == list(range(1, 65))


def test_points_behind_or_outside_do_not_vote():
    xyz = [[0, 0, -1.0], [0, 0, 0.0], [0.51, 0, 1.0], [-0.51, 0, 1.0], [0, 0.5, 1.0], [0, -0.51, 1.0], [0, 0, 1e-9]]
    votes = vote(given(plain(3), [*xyz, [0, 0, 1.0]]), occlusion=False)
    assert votes.visible.tolist() == [0, 0, 0, 0, 0, 0, 1, 1]
    assert votes.ids.tolist() == [0, 0, 0, 0, 0, 0, 3, 3]


def test_only_training_views_with_masks_vote(write_capture, tmp_path):
    scene = write_capture(views=9, points=5)
    capture = load_capture(scene.folder, tmp_path / "cache")
    requested = []
    original = capture.mask
    capture.mask = lambda index, downscale=1: (requested.append(index), original(index, downscale))[1]  # type: ignore
    vote(capture)
    assert set(requested) == set(capture.train_indices) and 0 not in requested and 8 not in requested


def test_correspondence_uses_only_observations():
    masks = plain(1, 2, 2)
    capture = given(masks, [[0, 0, 1.0], [0.1, 0, 1.0]], seen=[np.array([0]), np.array([1]), np.array([1, 1])])
    votes = vote(capture, "correspondence")
    assert votes.ids.tolist() == [1, 2] and votes.visible.tolist() == [1, 2]


def test_only_points_without_votes_are_projected_again(monkeypatch):
    x, y = np.meshgrid(np.arange(40) + 0.5, np.arange(40) + 0.5)
    wall = np.stack([(x.ravel() - 20) / 8, (y.ravel() - 20) / 8, np.ones(1600)], 1)
    xyz = np.concatenate([wall, [[0.0, 0.0, 4.0]]])
    projected, checks = [], []
    project = voting.find_visible_points

    def find(capture, positions, *others):
        projected.append((positions.shape[1], len(checks)))
        return project(capture, positions, *others)

    reporter = Reporter()
    reporter.check = lambda: checks.append(0)
    monkeypatch.setattr(voting, "find_visible_points", find)
    votes = vote(given([np.full((40, 40), 1), np.full((40, 40), 2)], xyz), reporter=reporter)
    assert votes.visible[-1] == 2
    assert projected == [(1601, 0), (1601, 0), (1, 1), (1, 2)]


def test_occlusion_ignores_hidden_views_except_observations():
    """A wall of points with ID 1 hides a point of ID 2 behind it, in two views of three."""
    x, y = np.meshgrid(np.arange(40) + 0.5, np.arange(40) + 0.5)
    wall = np.stack([(x.ravel() - 20) / 8, (y.ravel() - 20) / 8, np.ones(1600)], 1)
    behind = np.array([[0.0, 0.0, 4.0]])
    away = np.eye(4)
    away[2, 3] = -2.0  # this camera is between the wall and the point
    masks = [np.full((40, 40), 1), np.full((40, 40), 1), np.full((40, 40), 2)]
    xyz, viewmats = np.concatenate([wall, behind]), [np.eye(4), np.eye(4), away]
    assert vote(given(masks, xyz, viewmats=viewmats), occlusion=False).ids[-1] == 1
    votes = vote(given(masks, xyz, viewmats=viewmats))
    assert votes.ids[-1] == 2 and votes.visible[-1] == 1 and (votes.ids[:-1] == 1).all()
    seen = [np.array([1600]), np.array([1600]), np.zeros(0, np.int64)]
    assert vote(given(masks, xyz, seen, viewmats)).ids[-1] == 1, "COLMAP observed the point in these views"
    hidden = vote(given(masks[:2], xyz, viewmats=viewmats[:2]))
    assert hidden.ids[-1] == 1 and hidden.visible[-1] == 2, (
        "a point hidden in all views gets the votes of all projections"
    )


def test_synthetic_scene_gives_known_ids(write_capture, tmp_path):
    scene = write_capture(views=24, size=(192, 144), points=800)
    capture = load_capture(scene.folder, tmp_path / "cache")
    share = {}
    for strategy in STRATEGIES:
        for occlusion in (False, True):
            votes = vote(capture, strategy, occlusion=occlusion)
            share[strategy, occlusion] = (votes.ids == scene.point_objects).mean()
            assert votes.counts == {i: int((votes.ids == i).sum()) for i in (1, 2, 5)} and votes.warnings == []
            assert ((votes.margins >= 0) & (votes.margins <= 1)).all()
    assert share["majority", True] > 0.985 and share["correspondence", True] > 0.96
    assert share["majority", False] > 0.985, "on convex objects, the visible side outvotes the hidden one"
    assert share["probability", True] > share["probability", False] + 0.05


def test_noisy_masks_are_outvoted(write_capture, tmp_path):
    scene = write_capture(views=24, points=100)
    capture = load_capture(scene.folder, tmp_path / "cache")
    rng = np.random.default_rng(0)
    noisy = [np.where(rng.random(m.shape) < 0.3, rng.choice([1, 2, 5], m.shape), m) for m in scene.ids]
    capture.mask = lambda index, downscale=1: noisy[index]  # type: ignore[method-assign]
    votes = vote(capture)
    right = votes.ids == scene.point_objects
    assert right.mean() > 0.93
    assert votes.margins[right].mean() > votes.margins[~right].mean() + 0.2, "wrong IDs have small margins"


def test_probability_follows_the_votes_and_the_seed():
    count = 4000
    capture = given([*plain(3, 3, 3, 8), *elsewhere(0)], np.tile([[0.0, 0.0, 1.0]], (count, 1)))
    one, again, other = (vote(capture, "probability", seed=seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one.ids, again.ids)
    assert (one.ids != other.ids).any()
    assert (one.ids == 3).mean() == pytest.approx(0.6, abs=0.03) and set(one.ids) == {0, 3, 8}
    assert (one.ids == 0).mean() == pytest.approx(0.2, abs=0.03)
    assert set(one.margins[one.ids == 3]) == {np.float32(0.4)} and set(one.margins[one.ids == 8]) == {np.float32(0)}


def test_unknown_strategy_is_rejected():
    with pytest.raises(ValueError):
        vote(given(plain(1), [[0, 0, 1.0]]), "loudest")  # type: ignore[arg-type]


def test_capture_without_masks_has_no_labels(write_capture, tmp_path):
    capture = load_capture(write_capture(masks=False).folder, tmp_path / "cache")
    for strategy in STRATEGIES:
        votes = vote(capture, strategy)
        assert not votes.ids.any() and not votes.visible.any() and votes.counts == {} and votes.warnings == []


def test_objects_with_few_points_give_warnings():
    masks = [np.repeat([[1, 1, 1, 1, 2, 2, 2, 2]], 8, 0)]
    masks[0][0, 0] = 70_000
    xyz = np.concatenate([np.tile([[-0.2, 0, 1.0]], (30, 1)), np.tile([[0.2, 0, 1.0]], (5, 1))])
    reported = []

    class RecordingReporter(Reporter):
        def warning(self, message):
            reported.append(message)

    votes = vote(given(masks, xyz, names={2: "cup", 70_000: "pin"}), reporter=RecordingReporter())
    assert votes.counts == {1: 30, 2: 5, 70_000: 0} and reported == votes.warnings and len(reported) == 2
    assert "70000 (pin)" in reported[0] and "Fewer than 20" in reported[1] and "2 (cup)" in reported[1]


def test_ballots_stay_exact_beyond_their_slots(monkeypatch):
    """Many IDs at a point overflow the slots; the counts must stay exact."""
    import backend.labels.voting as module

    monkeypatch.setattr(module, "_MERGE_AT", 500)
    rng = np.random.default_rng(0)
    ballots, expected = _Ballots(50, 40), [Counter() for _ in range(50)]
    for _ in range(150):
        points = rng.permutation(50)[:40]
        ids = np.minimum(rng.geometric(0.1, 40) - 2, 39)
        ballots.add(points, ids)
        for point, i in zip(points, ids):
            expected[point][int(i)] += 1
    chosen, margins = ballots.count(None)
    for point, counter in enumerate(expected):
        objects = {i: count for i, count in counter.items() if i >= 0}
        best = min(objects, key=lambda i: (-counter[i], i))
        others = max(count for i, count in objects.items() if i != best)
        assert chosen[point] == best
        assert margins[point] == pytest.approx((counter[best] - others) / counter.total(), abs=1e-6)


@pytest.mark.long
def test_large_votes_limit_time_and_memory():
    import tracemalloc

    rng = np.random.default_rng(0)
    count, views = 200_000, 100
    xyz = rng.uniform(-1, 1, (count, 3)) + np.array([0, 0, 3.0])
    blocks = np.unique(rng.integers(1, 4_000_000_000, 1000))
    true = np.kron(rng.choice(blocks, (24, 32)), np.ones((10, 10), np.int64))
    masks = []
    for _ in range(views):
        wrong = np.kron(rng.choice(blocks, (24, 32)), np.ones((10, 10), np.int64))
        masks.append(np.where(rng.random(true.shape) < 0.1, wrong, true))
    capture = given(masks, xyz)
    capture.known_ids = blocks
    view = capture.views[0]
    K = np.array([[320.0, 0, 160], [0, 320.0, 120], [0, 0, 1]])
    capture.views = [View(view.name, view.image_file, view.mask_file, K, view.viewmat, 320, 240, 1)] * views
    tracemalloc.start()
    start = time.perf_counter()
    votes = vote(capture)
    seconds, peak = time.perf_counter() - start, tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    x, y = xyz[:, 0] / xyz[:, 2] * 320 + 160, xyz[:, 1] / xyz[:, 2] * 320 + 120
    inside = (x >= 0) & (x < 320) & (y >= 0) & (y < 240)
    assert inside.mean() > 0.5 and (votes.visible[~inside] == 0).all() and (votes.visible[inside] > 0).all()
    right = votes.ids[inside] == true[y[inside].astype(int), x[inside].astype(int)]
    assert right.mean() > 0.999
    assert seconds < 60 and peak < 1e9, (seconds, peak)


# The labeled point cloud


def test_points_round_trip(tmp_path):
    rng = np.random.default_rng(0)
    count = 1000
    xyz = rng.normal(size=(count, 3)) + np.array([5e5, 4.5e6, 100])
    points = Points(
        xyz, rng.integers(0, 256, (count, 3)).astype(np.uint8), np.zeros(count, np.float32), np.arange(count)
    )
    votes = vote(given(plain(4_294_967_295, 4_294_967_295, 70_000), np.tile([[0.0, 0.0, 1.0]], (count, 1))))
    path = tmp_path / "points.ply"
    write_points(path, points, votes)
    found = read_points(path)
    np.testing.assert_array_equal(found.xyz, xyz)
    np.testing.assert_array_equal(found.rgb, points.rgb)
    np.testing.assert_array_equal(found.ids, votes.ids)
    np.testing.assert_array_equal(found.margins, votes.margins)
    np.testing.assert_array_equal(found.visible, votes.visible)
    assert found.ids.dtype == np.int64 and set(found.ids) == {4_294_967_295}
    header = path.read_bytes().split(b"end_header")[0].decode()
    assert "format binary_little_endian 1.0" in header and "property uint object_id" in header
    assert not list(tmp_path.glob("*.part"))


def test_damaged_point_clouds_are_rejected(tmp_path):
    path = tmp_path / "points.ply"
    with pytest.raises(InputError, match="does not exist"):
        read_points(path)
    count = 10
    points = Points(np.zeros((count, 3)), np.zeros((count, 3), np.uint8), np.zeros(count, np.float32), np.arange(count))
    write_points(path, points, vote(given(plain(1), np.tile([[0.0, 0.0, 1.0]], (count, 1)))))
    whole = path.read_bytes()
    for data in (whole[:-1], whole[:200], whole[:20], b"", whole + b"x", b"ply\nformat ascii 1.0\nend_header\n"):
        path.write_bytes(data)
        with pytest.raises(InputError, match=r"points\.ply"):
            read_points(path)


def test_points_file_is_readable_from_header(tmp_path):
    """The header alone is sufficient to read the file."""
    points = Points(np.array([[1.0, 2, 3]]), np.array([[4, 5, 6]], np.uint8), np.zeros(1, np.float32), np.zeros(1, int))
    write_points(tmp_path / "points.ply", points, vote(given(plain(7), [[0.0, 0.0, 1.0]])))
    data = (tmp_path / "points.ply").read_bytes()
    head, body = data.split(b"end_header\n", 1)
    kinds = {"double": "<f8", "uchar": "u1", "uint": "<u4", "float": "<f4"}
    fields = [line.split()[1:] for line in head.decode().splitlines() if line.startswith("property")]
    row = np.frombuffer(body, np.dtype([(name, kinds[kind]) for kind, name in fields]))[0]
    assert [row[name] for name in ("x", "y", "z", "red", "green", "blue", "object_id")] == [1, 2, 3, 4, 5, 6, 7]


def test_gaps_in_masks_do_not_make_background():
    """Points of objects, unlabeled in 40 % of the views at random, and points of the background, in nearly all."""
    rng = np.random.default_rng(0)
    votes = rng.integers(8, 30, 2000).astype(np.int32)
    on_object = np.arange(2000) < 800
    unlabeled = np.where(on_object, rng.binomial(votes, 0.4), rng.binomial(votes, 0.98))
    background = unlabeled > needed_to_be_unlabeled(unlabeled, votes) * votes
    assert background[on_object].mean() < 0.02 and background[~on_object].mean() > 0.95
    # Half of the votes would take a tenth of the objects' points.
    assert (unlabeled > votes / 2)[on_object].mean() > 0.1


def test_bad_masks_do_not_make_objects():
    """A tenth of the masks show an object everywhere, where others show a background around objects without gaps."""
    rng = np.random.default_rng(0)
    votes = rng.integers(8, 30, 2000).astype(np.int32)
    on_object = np.arange(2000) < 300
    unlabeled = np.where(on_object, 0, rng.binomial(votes, 0.9))
    background = unlabeled > needed_to_be_unlabeled(unlabeled, votes) * votes
    assert not background[on_object].any() and background[~on_object].mean() > 0.99
    assert (needed_to_be_unlabeled(np.array([0, 1, 3]), np.array([0, 1, 3])) >= 0.5).all()


def test_ids_that_differ_in_each_photo_are_warned_about(write_capture, tmp_path):
    scene = write_capture(views=12, points=200)
    right = vote(load_capture(scene.folder, tmp_path / "right"))
    assert not any("another ID" in text for text in right.warnings)
    for turn, (name, ids) in enumerate(zip(scene.names, scene.ids, strict=True)):
        number = np.zeros(6, np.uint8)
        number[[1, 2, 5]] = np.roll([1, 2, 5], turn)
        Image.fromarray(number[ids]).save(scene.folder / "masks" / name)
    wrong = vote(load_capture(scene.folder, tmp_path / "wrong"))
    assert any("another ID in each photo" in text and "Import Masks" in text for text in wrong.warnings)
