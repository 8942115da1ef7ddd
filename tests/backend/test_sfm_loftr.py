"""Matches without a search for features: true ones of a rendered room, and those of a small network of transformers."""

import json
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import closing
from itertools import combinations
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch
from PIL import Image

from backend.commands.capture import photo_matches
from backend.sfm import database, pairs, worker
from backend.sfm.learned import checkpoint, joining, loftr, positions
from backend.sfm.learned.photos import LONGEST_SIDE, add_photos, scaled_gray
from backend.shared.errors import EXIT_DONE, InputError
from backend.shared.events import Reporter
from backend.shared.formats.json_file import write_json
from backend.shared.stopping import StoppingReporter, StopRequest

from .command_result import assert_rejected
from .rendered_photos import FOCAL, HEIGHT, WIDTH, photo, photo_and_places, pose_errors, ring, write_photos

ROOT = Path(__file__).parents[2]
CELL = 8
WRONG = 0.1
"""Fraction of wrong matches of the stand-in."""


class StandIn:
    """Matches photos of the room by the places that they show, at a detail of each cell that differs between pairs."""

    def __init__(self, matrices) -> None:
        self.matrices = matrices
        self.rng = np.random.default_rng(0)
        self.pairs = 0
        self.shown = []
        self.numbers = {}
        for number, matrix in enumerate(matrices):
            image, places = photo_and_places(matrix)
            self.shown.append(places)
            self.numbers[scaled_gray(Image.fromarray(image), CELL).tobytes()] = number

    def match(self, first, second):
        self.pairs += 1
        here, there = (self.numbers[gray.tobytes()] for gray in (first, second))
        detail = np.hypot(*np.gradient(first.astype(float)))
        detail *= 1 + 0.2 * self.rng.standard_normal(detail.shape)
        cells = detail.reshape(HEIGHT // CELL, CELL, WIDTH // CELL, CELL).transpose(0, 2, 1, 3)
        best = cells.reshape(*cells.shape[:2], -1).argmax(2)
        y = (np.arange(HEIGHT // CELL)[:, None] * CELL + best // CELL).ravel()
        x = (np.arange(WIDTH // CELL) * CELL + best % CELL).ravel()
        places, matrix = self.shown[here][y, x], self.matrices[there]
        seen = places @ matrix[:, :3].T + matrix[:, 3]
        pixels = FOCAL * seen[:, :2] / seen[:, 2:] + [WIDTH / 2, HEIGHT / 2]
        columns, rows = np.clip(pixels, 0, [WIDTH - 1, HEIGHT - 1]).astype(int).T
        is_visible = (pixels > 0).all(1) & (pixels < [WIDTH, HEIGHT]).all(1)
        is_visible &= np.linalg.norm(self.shown[there][rows, columns] - places, axis=1) < 0.05
        pixels += 0.3 * self.rng.standard_normal(pixels.shape)
        is_wrong = self.rng.random(len(pixels)) < WRONG
        pixels[is_wrong] = self.rng.random((is_wrong.sum(), 2)) * [WIDTH, HEIGHT]
        certainty = np.where(is_wrong, 0.2, 0.8) + 0.2 * self.rng.random(len(pixels))
        found = np.column_stack([x + 0.5, y + 0.5, pixels, certainty])[is_visible]
        return found[np.argsort(-found[:, 4])].astype(np.float32)


@pytest.fixture
def stand_in():
    return StandIn(ring())


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    """A folder with images/ of the ring, and the names."""
    folder = tmp_path_factory.mktemp("photos")
    write_photos(folder / "images", ring())
    return folder / "images", sorted(path.name for path in (folder / "images").iterdir())


def match_all(path, photos, stand_in, some=None):
    images, names = photos
    positions.match_photos(path, images, some or combinations(names, 2), stand_in.match, CELL)


def join(path, matched, photos, masks=None):
    add_photos(path, photos[0], [photos[1]])
    joining.join_pairs(path, matched, photos[1], masks, worker.verification())


def rows_of(path, *tables):
    with closing(sqlite3.connect(path)) as connection:
        return {table: set(connection.execute(f"SELECT * FROM {table}")) for table in tables}


@pytest.mark.long
def test_poses_follow_from_joined_matches(photos, tmp_path, stand_in):
    images, names = photos
    match_all(tmp_path / "p.db", photos, stand_in)
    join(tmp_path / "d.db", tmp_path / "p.db", photos)
    (tmp_path / "names.json").write_text(json.dumps(names))
    worker.map_globally(str(tmp_path / "d.db"), str(images), str(tmp_path), str(tmp_path / "names.json"))
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    refined, listed = tmp_path / "sparse" / "0", tmp_path / "names.json"
    worker.refine(str(tmp_path / "0"), str(refined), str(tmp_path / "d.db"), str(listed))
    degrees, places = pose_errors(tmp_path, ring())
    assert len(degrees) == len(names) and degrees.max() < 0.5 and places.max() < 0.005
    model = pycolmap.Reconstruction(tmp_path / "sparse" / "0")
    assert model.num_points3D() > 1000 and model.compute_mean_track_length() > 3.3
    matches = [count for *_, count in database.verified_pairs(tmp_path / "d.db", names)]
    assert len(matches) == stand_in.pairs and sum(matches) > 7000


def test_places_near_each_other_become_one_feature():
    """Of the place that most pairs show; in units of the scaled photo, which has half the size."""
    places = [(20.2, 40.6, 0.5), (20.6, 40.2, 0.5), (23.9, 40.4, 0.9), (24.2, 40.4, 0.4), (100.0, 0.0, 0.1)]
    found = joining.shared_features(np.float32(places), 0.5)
    assert np.allclose(found, [(20.4, 40.4), (24.2, 40.4), (100.0, 0.0)])
    assert joining.shared_features(np.zeros((0, 3), np.float32), 1.0).shape == (0, 2)


def test_features_are_limited_to_those_most_pairs_show(monkeypatch):
    monkeypatch.setattr(joining, "MOST_FEATURES", 2)
    places = np.float32([(10, 10, 0.9), (20, 10, 0.5), (20, 10, 0.5), (30, 10, 0.95)])
    assert np.array_equal(joining.shared_features(places, 1.0), [(20, 10), (30, 10)])


def test_matches_are_one_to_one_between_near_features(tmp_path):
    """The most certain matches; the second photo comes first in the database."""
    for name in ("a.png", "b.png"):
        Image.new("L", (96, 64)).save(tmp_path / name)
    kept = [(10.5, 10.5, 20.5, 10.5, 0.9), (30.5, 10.5, 60.5, 10.5, 0.8), (50.1, 10.5, 70.5, 30.5, 0.7)]
    of_known_features = [(10.6, 10.5, 40.5, 10.5, 0.5), (80.5, 40.5, 60.6, 10.5, 0.4)]
    far = [(90.5, 20.5, 41.9, 10.5, 0.3)]  # In the pixel beside a feature without a match, but farther than one.
    rows = np.float32([*kept, *of_known_features, *far])
    pair, path = ("a.png", "b.png"), tmp_path / "d.db"
    positions.match_photos(tmp_path / "p.db", tmp_path, [pair], lambda *_: rows, 1)
    add_photos(path, tmp_path, [["b.png"], ["a.png"]])
    joining.join_pairs(path, tmp_path / "p.db", pair, None, worker.verification())
    ids = database.image_ids(path)
    assert ids["b.png"] < ids["a.png"]
    with pycolmap.Database.open(path) as stored:
        first, second = (np.asarray(stored.read_keypoints(ids[name])) for name in pair)
        matches = np.asarray(stored.read_matches(ids["b.png"], ids["a.png"]))
    found = np.hstack([first[matches[:, 1]], second[matches[:, 0]]])
    assert len(found) == 3 and np.abs(found - rows[:3, :4]).max() < 0.1


def test_known_pairs_are_kept(photos, tmp_path, stand_in, monkeypatch):
    """Neither matched again nor, while features stay, verified again; further pairs replace all features at once."""
    names, path, matched = photos[1], tmp_path / "d.db", tmp_path / "p.db"
    verified = []
    real = joining.write_pair
    monkeypatch.setattr(joining, "write_pair", lambda *all: (verified.append(all[1][0].name), real(*all)))
    some = [(names[1], names[0]), (names[1], names[2])]
    match_all(matched, photos, stand_in, some)
    match_all(matched, photos, stand_in, some)
    assert database.count_positions(matched) == stand_in.pairs == 2
    join(path, matched, photos)
    join(path, matched, photos)
    assert database.count_pairs(path) == len(verified) == 2
    tables = ("keypoints", "matches", "two_view_geometries")
    before = rows_of(path, *tables)
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute("DELETE FROM two_view_geometries WHERE pair_id = (SELECT MIN(pair_id) FROM matches)")
        connection.execute("DELETE FROM matches WHERE pair_id = (SELECT MIN(pair_id) FROM matches)")
    join(path, matched, photos)
    assert rows_of(path, *tables) == before and len(verified) == 3, "as after a stop"
    match_all(matched, photos, stand_in)
    join(path, matched, photos)
    join(tmp_path / "new.db", matched, photos)
    assert database.count_pairs(path) == stand_in.pairs == len(names) * (len(names) - 1) // 2
    assert rows_of(path, *tables) == rows_of(tmp_path / "new.db", *tables)


def test_photos_that_are_left_out_need_no_mask(photos, tmp_path, stand_in):
    images, names = photos
    match_all(tmp_path / "p.db", photos, stand_in, combinations(names[:3], 2))
    join(tmp_path / "d.db", tmp_path / "p.db", photos)
    (tmp_path / "masks").mkdir()
    mask = np.zeros((HEIGHT // 2, WIDTH // 2), np.uint8)  # Of half the size.
    mask[:, 60:] = 255
    for name in names[:2]:
        Image.fromarray(mask).save(tmp_path / "masks" / f"{name}.png")
    join(tmp_path / "d.db", tmp_path / "p.db", (images, names[:2]), tmp_path / "masks")
    assert database.count_pairs(tmp_path / "d.db") == 1
    ids = database.image_ids(tmp_path / "d.db")
    with pycolmap.Database.open(tmp_path / "d.db") as stored:
        for name in names[:2]:
            points = np.asarray(stored.read_keypoints(ids[name]))
            assert len(points) > 200 and points[:, 0].min() >= 120
        assert not stored.exists_keypoints(ids[names[2]])
        assert len(stored.read_matches(ids[names[0]], ids[names[1]])) > 100


def test_places_are_pixels_of_the_full_photo(tmp_path):
    """Of photos with other sizes and proportions, both scaled to multiples of 32."""
    sizes = {"a.png": (2 * LONGEST_SIDE, 1536), "b.png": (300, 400)}
    for name, size in sizes.items():
        Image.new("L", size).save(tmp_path / name)
    shapes = []

    def match(first, second):
        shapes.append((first.shape, second.shape))
        return np.float32([[512, 384, 144, 192, 0.5]])

    positions.match_photos(tmp_path / "p.db", tmp_path, [("b.png", "a.png")], match, loftr.MULTIPLE)
    assert shapes == [((768, 1024), (384, 288))]
    with positions.opened(tmp_path / "p.db") as found:
        assert positions.listed(found) == [("a.png", "b.png")]
        assert np.allclose(positions.of_pair(found, "a.png", "b.png"), [[1024, 768, 150, 200, 0.5]])
        assert np.allclose(positions.of_photo(found, "a.png"), [[1024, 768, 0.5]])
        assert np.allclose(positions.of_photo(found, "b.png"), [[150, 200, 0.5]])
        assert positions.of_photo(found, "c.png").shape == (0, 3)


@pytest.fixture(scope="module")
def network(tmp_path_factory):
    """A checkpoint with random weights, whose features tell places apart, normalized by a photo."""
    transformers = pytest.importorskip("transformers")
    torch.manual_seed(0)
    config = transformers.EfficientLoFTRConfig(
        stage_num_blocks=[1, 1, 1, 1], out_features=[16, 16, 32, 64], hidden_size=64, num_attention_layers=1,
        activation_function="tanh", coarse_matching_temperature=0.02, coarse_matching_threshold=0.1,
    )  # fmt: skip
    model = transformers.EfficientLoFTRForKeypointMatching(config).train()
    with torch.no_grad():
        for part in model.modules():
            if isinstance(part, torch.nn.Conv2d):
                torch.nn.init.kaiming_normal_(part.weight)
            if isinstance(part, torch.nn.BatchNorm2d):
                part.weight.fill_(1.0)
                part.momentum = None
        for layer in model.efficientloftr.local_feature_transformer.layers:
            for attention in (layer.self_attention, layer.cross_attention):
                attention.mlp.layer_norm.weight.fill_(1e-3)
        model(torch.tensor(np.stack([gray()[:192]] * 2), dtype=torch.float32)[None, :, None] / 255)
    folder = tmp_path_factory.mktemp("networks") / "loftr"
    model.save_pretrained(folder)
    return folder


def gray(number=0):
    return np.asarray(Image.fromarray(photo(ring()[number])).convert("L"))


def test_matches_are_where_photos_show_the_same(network):
    """Parts of a photo that are moved by whole cells; the certain ones first, within the smaller photo."""
    model, whole = loftr.EfficientLoFTR(network), np.ascontiguousarray(gray()[:192, :256])
    part = np.ascontiguousarray(gray()[32:160, 64:288])
    for first, second, moved in ((whole, part, (-64, -32)), (part, whole, (64, 32))):
        found = model.match(first, second)
        assert found.dtype == np.float32 and len(found) > 150
        errors = np.linalg.norm(found[:, 2:4] - found[:, :2] - moved, axis=1)
        assert (errors < 0.1).mean() > 0.95
        assert (np.diff(found[:, 4]) <= 0).all() and 0.1 < found[:, 4].min() <= found[:, 4].max() <= 1.0
        for places, image in ((found[:, :2], first), (found[:, 2:4], second)):
            assert (places > 12).all() and (places < np.array(image.shape[::-1]) - 11).all(), "away from borders"
    in_cells = (model.match(whole, whole)[:, :2] - 0.5) % CELL
    assert len(np.unique(in_cells, axis=0)) > 20, "each pixel of a cell can be the best"


def test_cells_are_those_of_transformers(network):
    """It lists matches by the cell of the second photo for the first photo, and by that of the first for the second."""
    transformers = pytest.importorskip("transformers")
    grays = [np.ascontiguousarray(gray()[y : y + 192, x : x + 256]) for y, x in ((0, 0), (16, 8))]
    reference = transformers.EfficientLoFTRForKeypointMatching.from_pretrained(network).eval()
    with torch.inference_mode():
        found = reference(torch.tensor(np.stack(grays), dtype=torch.float32)[None, :, None] / 255)
    of_first = found.matches[0, 0].numpy()
    expected = {(int(i), int(j)): found.matching_scores[0, 0, j] for j, i in enumerate(of_first) if i >= 0}
    ours = {}
    for *places, certainty in loftr.EfficientLoFTR(network).match(*grays):
        x, y, u, v = np.floor((np.array(places) + 3.0) / CELL + 0.01).astype(int)
        ours[y * 32 + x, v * 32 + u] = certainty
    common = ours.keys() & expected.keys()
    assert len(common) > 0.97 * max(len(ours), len(expected)) > 200
    assert max(abs(ours[pair] - expected[pair]) for pair in common) < 1e-3


def test_cells_match_if_each_is_the_best_of_the_other(network):
    model = loftr.EfficientLoFTR(network)
    first, second = torch.tensor([[1.0, 0.0], [0.99, 0.0], [0.0, 1.0]]), torch.tensor([[0.0, 1.0], [1.0, 0.0]])
    of_first, of_second, certainty = model._mutual(first, second, torch.ones(3) > 0, torch.ones(2) > 0)
    assert of_first.tolist() == [2, 0] and of_second.tolist() == [0, 1]
    over_first = np.exp(50.0) / (np.exp(50.0) + np.exp(49.5) + 1)
    assert certainty.numpy() == pytest.approx([1.0, over_first], abs=1e-5)
    of_first, _, _ = model._mutual(first, second, torch.tensor([True, True, False]), torch.ones(2) > 0)
    assert of_first.tolist() == [0]


def test_best_pixels_are_found_within_cells(network):
    """Two matches whose best pixels are known, one with a neighbor that is as likely in the last features."""
    model = loftr.EfficientLoFTR(network)
    side, wide, last = 8, 10, 8
    first, second = torch.zeros(2, side**2, 16), torch.zeros(2, wide**2, 16)
    for number, (pixel, other) in enumerate((((2, 5), (6, 3)), ((7, 0), (1, 1)))):
        first[number, pixel[1] * side + pixel[0], 0] = 30.0
        second[number, (other[1] + 1) * wide + other[0] + 1, 0] = 30.0
    # Of the second, one pixel right of the center of the window, which is one up and left of the best.
    first[1, 0 * side + 7, -last] = 100.0
    second[1, 1 * wide + 2, -last] = 100.0
    in_first, in_second = model._within_cells(first, second)
    assert np.allclose(in_first, [(2 - 3, 5 - 3), (7 - 3, 0 - 3)])
    assert np.allclose(in_second, [(6 - 3, 3 - 3), (1 - 3 + 1, 1 - 3)], atol=1e-3)


def test_plain_and_tiny_photos_do_not_match(network):
    model = loftr.EfficientLoFTR(network)
    for size in ((32, 32), (96, 64)):
        assert model.match(np.full(size, 128, np.uint8), np.full(size, 128, np.uint8)).shape[1] == 5
    assert model.match(np.zeros((32, 32), np.uint8), np.ascontiguousarray(gray()[:96, :96])).shape == (0, 5)


def test_other_weights_are_refused(network, photos, tmp_path, run_command):
    folder = shutil.copytree(network, tmp_path / "networks")
    before = json.loads((folder / "config.json").read_text())

    def rejected(*words):
        result = run_command("sfm", photos[0], "--out", tmp_path / "capture", "--matcher", folder)
        assert_rejected(result, str(folder), *words)
        assert not (tmp_path / "capture").exists()

    for change in ({"num_attention_layers": 2}, {"hidden_size": 32}, {"stage_stride": "x"}):
        (folder / "config.json").write_text(json.dumps(before | change))
        rejected("do not fit its config.json", "copy")
        with pytest.raises(InputError, match="do not fit its config"):
            loftr.EfficientLoFTR(folder)
    (folder / "config.json").write_text(json.dumps(before | {"model_type": "loftr"}))
    rejected("is of a model of the type loftr; choose a checkpoint of LightGlue or EfficientLoFTR as --matcher")


@pytest.mark.long
def test_killed_matching_goes_on(network, photos, tmp_path):
    """Killed at any moment, it keeps all pairs that were matched before."""
    images, names = photos
    matched, listed = tmp_path / "p.db", tmp_path / "pairs.txt"
    chosen = list(combinations(names[:4], 2))
    database.write_pairs(listed, chosen)
    command = [sys.executable, "-m", "backend.sfm.worker", "1", "match-places", network, matched, images, listed]
    process = subprocess.Popen(command, cwd=ROOT, env=os.environ | {"OMP_NUM_THREADS": "1"}, stdin=subprocess.PIPE)
    until = time.monotonic() + 60
    while database.count_positions(matched) < 2 and process.poll() is None and time.monotonic() < until:
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    before = rows_of(matched, database.POSITIONS)[database.POSITIONS]
    assert 2 <= len(before) < len(chosen)
    worker.match_places(str(network), str(matched), str(images), str(listed))
    after = rows_of(matched, database.POSITIONS)[database.POSITIONS]
    assert before < after and {row[:2] for row in after} == set(chosen)


def prepare(capture, network, photos, stand_in, left=()):
    """Write a capture's matched places, of all pairs but those left; return their file and the database."""
    work, digest = capture / "sfm", checkpoint.fingerprint(network)
    work.mkdir(parents=True)
    (work / "source.json").write_text("{}")
    matched = work / positions.name_of(digest)
    match_all(matched, photos, stand_in, [pair for pair in combinations(photos[1], 2) if pair not in left])
    return matched, work / database.name_of(False, digest)


@pytest.mark.long
def test_command_matches_what_is_left_and_poses_are_right(
    network, photos, tmp_path, stand_in, run_command, no_dense_points
):
    """The whole command in its processes; all pairs but one were matched before."""
    images, names = photos
    matched, path = prepare(tmp_path / "capture", network, photos, stand_in, [(names[0], names[1])])
    result = run_command("sfm", images, "--out", tmp_path / "capture", "--matcher", network)
    assert result.code == EXIT_DONE, result.err
    assert database.count_positions(matched) == database.count_pairs(path) == stand_in.pairs + 1
    assert not (path.parent / database.NAME).exists(), "SIFT is not needed"
    degrees, places = pose_errors(tmp_path / "capture", ring())
    assert len(degrees) == len(names) and degrees.max() < 1.0 and places.max() < 0.01


@pytest.mark.long
def test_pairs_of_large_sets_are_chosen_by_sift(network, photos, tmp_path, stand_in, monkeypatch):
    for module in (pairs, photo_matches):
        monkeypatch.setattr(module, "ALL_UP_TO", 2)
    monkeypatch.setattr(pairs, "NEIGHBORS", 2)
    images, names = photos
    capture = tmp_path / "capture"
    matched, path = prepare(capture, network, photos, stand_in)
    shutil.copytree(images, capture / "images")
    write_json(capture / "sfm" / photo_matches.GROUPS, [{"names": names, "camera": None}])
    reporter = StoppingReporter(Reporter(), StopRequest())
    wanted = photo_matches.Wanted(capture, names, [], network)
    assert photo_matches.match_photos(wanted, images, False, reporter) == path
    chosen = database.read_pairs(capture / "sfm" / "pairs.txt")
    assert {name for pair in chosen for name in pair} == set(names) and len(chosen) < stand_in.pairs
    assert database.count_features(capture / "sfm" / database.NAME) == len(names)
    assert database.count_positions(matched) == database.count_pairs(path) == stand_in.pairs
