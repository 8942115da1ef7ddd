"""Features and matches by networks: with a stand-in for them, and with small ones that are made with transformers."""

import json
import shutil
import sqlite3
import sys
from contextlib import closing
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch
from PIL import ExifTags, Image

from backend.networks.checkpoint_folder import PACKAGE
from backend.sfm import database, pairs, worker
from backend.sfm.learned import checkpoint, lightglue
from backend.sfm.learned.photos import LONGEST_SIDE
from backend.shared.errors import EXIT_DONE, InputError
from backend.shared.formats import photos_source

from .command_result import assert_rejected
from .rendered_photos import FOCAL, HEIGHT, WIDTH, photo, ring, write_photos

REQUIREMENTS = Path(__file__).parents[2] / "requirements"
STEP = 12
"""Distance in pixels of the corners that the stand-in finds."""


class StandIn:
    """Finds the strongest pixel of each cell, describes it by its surroundings, and takes the nearest descriptors."""

    def __init__(self) -> None:
        self.images: list[tuple[int, ...]] = []
        self.pairs: list[tuple[int, int]] = []

    def detect(self, gray):
        self.images.append(gray.shape)
        values = gray.astype(np.float32)
        edges = np.hypot(*np.gradient(values))
        points, descriptors = [], []
        for top in range(STEP, gray.shape[0] - 2 * STEP, STEP):
            for left in range(STEP, gray.shape[1] - 2 * STEP, STEP):
                y, x = np.unravel_index(edges[top : top + STEP, left : left + STEP].argmax(), (STEP, STEP))
                patch = values[top + y - 8 : top + y + 9, left + x - 8 : left + x + 9].ravel()
                points.append((left + x + 0.5, top + y + 0.5))
                descriptors.append((patch - patch.mean()) / max(np.linalg.norm(patch - patch.mean()), 1e-6))
        return lightglue.Features(np.float32(points), np.float32(descriptors), gray.shape[::-1])

    def match(self, first, second):
        self.pairs.append((len(first.points), len(second.points)))
        cosines = first.descriptors @ second.descriptors.T
        best = cosines.argmax(1)
        kept = np.flatnonzero((cosines.argmax(0)[best] == np.arange(len(best))) & (cosines.max(1) > 0.8))
        return np.column_stack([kept, best[kept]])


@pytest.fixture
def stand_in():
    return StandIn()


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    """A folder with images/ of the ring, one of them plain, and the names."""
    folder = tmp_path_factory.mktemp("photos")
    write_photos(folder / "images", ring()[:4])
    Image.fromarray(np.full((HEIGHT, WIDTH, 3), 128, np.uint8)).save(folder / "images" / "plain.png")
    return folder / "images", sorted(path.name for path in (folder / "images").iterdir())


def test_points_are_pixels_of_the_full_photo(stand_in):
    """A photo of twice the longest side, with a border between black and white at one column of the small image."""
    column = 300
    pixels = np.zeros((1536, 2 * LONGEST_SIDE), np.uint8)
    pixels[:, 2 * column :] = 255
    found = lightglue.features_of(Image.fromarray(pixels), None, stand_in.detect)
    assert stand_in.images == [(768, LONGEST_SIDE)] and found.size == (2048, 1536)
    at_edge = found.points[np.abs(found.points[:, 0] - 2 * column) < STEP]
    centers = {2 * (column - 0.5), 2 * (column + 0.5)}
    assert len(at_edge) > 20 and set(at_edge[:, 0]) == centers, "of the pixels beside it, doubled"
    small = lightglue.features_of(Image.fromarray(pixels[:300, 400:800]), None, stand_in.detect)
    assert stand_in.images[-1] == (300, 400), "small photos are not enlarged"
    assert len(small.points) == len(small.descriptors) and small.points.dtype == small.descriptors.dtype == np.float32


def test_masks_hide_features_before_the_best_are_taken(stand_in, monkeypatch):
    everywhere = lightglue.features_of(Image.fromarray(photo(ring()[0])), None, stand_in.detect)
    mask = np.zeros((HEIGHT // 2, WIDTH // 2), bool)  # Of half the size.
    mask[:, 100:] = True
    found = lightglue.features_of(Image.fromarray(photo(ring()[0])), mask, stand_in.detect)
    expected = everywhere.points[:, 0] >= 200
    assert np.array_equal(found.points, everywhere.points[expected]) and 0 < expected.sum() < len(expected)
    assert np.array_equal(found.descriptors, everywhere.descriptors[expected])
    monkeypatch.setattr(lightglue, "MOST_FEATURES", 10)
    best = lightglue.features_of(Image.fromarray(photo(ring()[0])), mask, stand_in.detect)
    assert np.array_equal(best.points, found.points[:10])


def test_database_has_features_and_cameras_as_those_of_sift(photos, tmp_path, stand_in):
    images, names = photos
    path, groups = tmp_path / "d.db", [names[:2], names[2:]]
    lightglue.find_features(path, images, groups, None, stand_in.detect)
    (tmp_path / "groups.json").write_text(json.dumps([{"names": each, "camera": None} for each in groups]))
    worker.extract(str(tmp_path / "sift.db"), str(images), str(tmp_path / "groups.json"))
    assert set(database.image_ids(path)) == set(database.image_ids(tmp_path / "sift.db")) == set(names)
    assert database.count_features(path) == len(names) == len(stand_in.images)
    with pycolmap.Database.open(path) as ours, pycolmap.Database.open(tmp_path / "sift.db") as sift:
        cameras = [[str(camera) for camera in stored.read_all_cameras()] for stored in (ours, sift)]
        assert cameras[0] == cameras[1] and len(cameras[0]) == len(groups)
        assert ours.num_rigs() == sift.num_rigs() == 2 and ours.num_frames() == sift.num_frames()
        expected = lightglue.features_of(Image.open(images / names[0]), None, stand_in.detect)
        number = database.image_ids(path)[names[0]]
        assert np.array_equal(ours.read_keypoints(number), expected.points)
    assert np.array_equal(database.largest_features(path, number, 20), expected.descriptors[:20])


def test_known_features_are_not_searched_again(photos, tmp_path, stand_in):
    """Neither after a stop between two photos, nor for photos that were left out since; photos still share a camera."""
    images, names = photos
    path = tmp_path / "d.db"
    lightglue.find_features(path, images, [names[:2]], None, stand_in.detect)
    lightglue.find_features(path, images, [names], None, stand_in.detect)
    assert len(stand_in.images) == len(names)
    with closing(sqlite3.connect(path)) as connection, connection:
        for table in ("keypoints", "descriptors"):
            connection.execute(f"DELETE FROM {table} WHERE image_id < 3")
    lightglue.find_features(path, images, [names[1:]], None, stand_in.detect)
    assert len(stand_in.images) == len(names) + 1 and database.count_features(path) == len(names) - 1
    with pycolmap.Database.open(path) as stored:
        assert stored.num_cameras() == 1


def test_pairs_are_matched_and_verified_once(photos, tmp_path, stand_in):
    images, names = photos
    path = tmp_path / "d.db"
    lightglue.find_features(path, images, [names], None, stand_in.detect)
    chosen = [(names[1], names[0]), (names[1], names[2])]
    lightglue.match_pairs(path, chosen, stand_in.match, worker.verification())
    assert database.count_pairs(path) == len(stand_in.pairs) == 2
    lightglue.match_pairs(path, None, stand_in.match, worker.verification())
    assert database.count_pairs(path) == len(stand_in.pairs) == len(names) * (len(names) - 1) // 2
    lightglue.match_pairs(path, None, stand_in.match, worker.verification())
    assert len(stand_in.pairs) == database.count_pairs(path)
    ids = database.image_ids(path)
    verified = {frozenset(pair[:2]) for pair in database.verified_pairs(path, names)}
    assert {frozenset((ids[names[i]], ids[names[i + 1]])) for i in range(3)} <= verified
    assert not any(ids["plain.png"] in pair for pair in verified)
    with pycolmap.Database.open(path) as stored:
        points = [np.asarray(stored.read_keypoints(ids[name])) for name in names[:2]]
        inliers = stored.read_two_view_geometry(ids[names[0]], ids[names[1]]).inlier_matches
    assert len(inliers) > 50
    true = [ring()[int(name.split()[1][0]) - 1] for name in names[:2]]
    assert np.median(epipolar_distances(true, [each[inliers[:, i]] for i, each in enumerate(points)])) < 1.0


def epipolar_distances(matrices, points) -> np.ndarray:
    """Return the distances in pixels of points in a second photo from the epipolar lines of those in the first."""
    (a, s), (b, t) = ((matrix[:, :3], matrix[:, 3]) for matrix in matrices)
    rotation = b @ a.T
    x, y, z = t - rotation @ s
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ rotation
    rays = [np.column_stack([(p - [WIDTH / 2, HEIGHT / 2]) / FOCAL, np.ones(len(p))]) for p in points]
    lines = rays[0] @ essential.T
    return FOCAL * np.abs((rays[1] * lines).sum(1)) / np.linalg.norm(lines[:, :2], axis=1)


def test_verification_is_that_of_colmap(photos, tmp_path, stand_in):
    images, names = photos
    ours, theirs = tmp_path / "ours.db", tmp_path / "theirs.db"
    lightglue.find_features(ours, images, [names], None, stand_in.detect)
    lightglue.match_pairs(ours, None, stand_in.match, worker.verification())
    shutil.copy(ours, theirs)
    with pycolmap.Database.open(theirs) as stored:
        stored.clear_two_view_geometries()
    listed = tmp_path / "pairs.txt"
    database.write_pairs(listed, [(a, b) for a in names for b in names if a < b])
    with database.listed_names(theirs):
        pycolmap.verify_matches(theirs, listed, worker.verification())
    assert database.verified_pairs(ours, names) == database.verified_pairs(theirs, names) != []


def test_pairs_of_large_sets_are_chosen_by_signed_descriptors(photos, tmp_path, stand_in, monkeypatch):
    images, names = photos
    path = tmp_path / "d.db"
    lightglue.find_features(path, images, [names], None, stand_in.detect)
    monkeypatch.setattr(pairs, "ALL_UP_TO", 2)
    monkeypatch.setattr(pairs, "NEIGHBORS", 1)
    chosen = pairs.choose_pairs(path, names)
    assert {name for pair in chosen for name in pair} == set(names) - {"plain.png"}
    listed = tmp_path / "pairs.txt"
    database.write_pairs(listed, chosen)
    assert database.read_pairs(listed) == chosen and any(" " in name for pair in chosen for name in pair)


def test_databases_and_the_source_tell_features_apart(tmp_path):
    names = {database.name_of(on_objects, network) for on_objects in (False, True) for network in ("", "1a", "2b")}
    assert len(names) == 6 and {database.NAME, database.ON_OBJECTS} < names
    (tmp_path / "sfm").mkdir()
    source = photos_source.PhotosSource([tmp_path / "trip"], matcher=tmp_path / "networks")
    photos_source.write_source(tmp_path, source)
    assert photos_source.read_source(tmp_path) == source
    path = tmp_path / "sfm" / "source.json"
    before = json.loads(path.read_text())
    del before["matcher"]
    path.write_text(json.dumps(before))
    assert photos_source.read_source(tmp_path).matcher is None, "as of an earlier version"


def write_checkpoint(folder, **config):
    folder.mkdir()
    (folder / "config.json").write_text(json.dumps({"model_type": "lightglue", **config}))
    (folder / "model.safetensors").write_bytes(b"")
    return folder


def test_other_folders_are_refused(photos, tmp_path, run_command):
    def refused(folder, *words):
        result = run_command("sfm", photos[0], "--out", tmp_path / "capture", "--matcher", folder)
        assert_rejected(result, str(folder), *words)
        assert not (tmp_path / "capture").exists()

    refused(tmp_path / "none", "is not a folder; choose")
    refused(photos[0], "has no config.json; choose")
    refused(write_checkpoint(tmp_path / "bert", model_type="bert"), "is of a model of the type bert; choose")
    disk = write_checkpoint(tmp_path / "disk", keypoint_detector_config={"model_type": "disk"})
    refused(disk, "is of a LightGlue for features of disk; choose")
    for number, text in enumerate(("[]", "{", "{}", '{"model_type": "lightglue", "keypoint_detector_config": 3}')):
        folder = write_checkpoint(tmp_path / f"damaged {number}")
        (folder / "config.json").write_text(text)
        refused(folder, "is not the config of a model; copy")
    empty = write_checkpoint(tmp_path / "empty")
    (empty / "model.safetensors").unlink()
    refused(empty, "has no weights (*.safetensors or *.bin); copy")


def test_missing_package_is_named_with_its_command(photos, tmp_path, run_command, monkeypatch):
    monkeypatch.setitem(sys.modules, "transformers", None)
    folder = write_checkpoint(tmp_path / "networks")
    result = run_command("sfm", photos[0], "--out", tmp_path / "capture", "--matcher", folder)
    assert_rejected(result, "needs the package transformers; run ", f'pip install "{PACKAGE}"')
    assert PACKAGE in (REQUIREMENTS / "models.txt").read_text().splitlines()
    result = run_command("sfm", photos[0], "--out", tmp_path / "capture", "--matcher", folder, "--json")
    told = json.loads(result.out.splitlines()[-1])
    assert (told["type"], told["lacks"], told["option"]) == ("error", "transformers", "--matcher")


def test_checkpoints_are_told_apart_by_their_content(tmp_path):
    first = write_checkpoint(tmp_path / "first")
    copied = shutil.copytree(first, tmp_path / "copied")
    assert checkpoint.fingerprint(first) == checkpoint.fingerprint(copied)
    (copied / "model.safetensors").write_bytes(b"others")
    other = write_checkpoint(tmp_path / "other", filter_threshold=0.2)
    assert len({checkpoint.fingerprint(folder) for folder in (first, copied, other)}) == 3


@pytest.fixture(scope="module")
def networks(tmp_path_factory):
    """A checkpoint: a SuperPoint with random weights, and a LightGlue that takes the nearest of its descriptors."""
    transformers = pytest.importorskip("transformers")
    torch.manual_seed(0)
    corners = transformers.SuperPointConfig(
        encoder_hidden_sizes=[32, 32, 32, 32], decoder_hidden_size=64, descriptor_decoder_dim=64, keypoint_threshold=0.0
    )
    config = transformers.LightGlueConfig(
        keypoint_detector_config=corners,
        descriptor_dim=64,
        num_hidden_layers=2,
        num_attention_heads=2,
        filter_threshold=0.0,
    )
    model = transformers.LightGlueForKeypointMatching(config)
    with torch.no_grad():
        for values in model.keypoint_detector.parameters():
            torch.nn.init.kaiming_normal_(values) if values.ndim > 1 else values.zero_()
        for layer in model.transformer_layers:
            for change in (layer.self_mlp.fc2, layer.cross_mlp.fc2):
                torch.nn.init.normal_(change.weight, std=1e-3)
        for layer in model.match_assignment_layers:
            layer.final_projection.weight.copy_(40 * torch.eye(64))
            layer.matchability.bias.fill_(5.0)
    folder = tmp_path_factory.mktemp("networks") / "lightglue"
    model.save_pretrained(folder)
    return folder


def test_features_and_matches_are_those_of_transformers(networks):
    """With the features of both photos given, the result is that of both photos at once."""
    transformers = pytest.importorskip("transformers")
    grays = [np.asarray(Image.fromarray(photo(matrix)).convert("L")) for matrix in ring()[:2]]
    reference = transformers.LightGlueForKeypointMatching.from_pretrained(networks).eval()
    with torch.inference_mode():
        expected = reference(torch.tensor(np.stack(grays), dtype=torch.float32)[None, :, None] / 255)
    corners = [
        points[mask > 0].numpy() * [WIDTH, HEIGHT] + 0.5
        for points, mask in zip(expected.keypoints[0], expected.mask[0], strict=True)
    ]
    to_first = expected.matches[0, 0].numpy()
    wanted = {(*corners[0][i].round(1), *corners[1][j].round(1)) for i, j in enumerate(to_first) if j >= 0}
    model = lightglue.LightGlue(networks)
    found = [model.detect(gray) for gray in grays]
    for each, points in zip(found, corners, strict=True):
        assert np.allclose(sorted(map(tuple, each.points)), sorted(map(tuple, points)), atol=1e-3)
        assert np.allclose(np.linalg.norm(each.descriptors, axis=1), 1.0, atol=1e-5) and (each.descriptors < 0).any()
    matches = {(*found[0].points[i].round(1), *found[1].points[j].round(1)) for i, j in model.match(*found)}
    assert len(matches & wanted) > 0.98 * len(matches | wanted) > 200


def test_photos_of_other_sizes_match(networks):
    """Places are relative to each photo's own size: a photo on its side matches one that is not."""
    model = lightglue.LightGlue(networks)
    gray = np.asarray(Image.fromarray(photo(ring()[0])).convert("L"))
    whole, part = model.detect(gray), model.detect(np.ascontiguousarray(gray[:, 80:240]))
    matches = model.match(whole, part)
    moved = whole.points[matches[:, 0]] - part.points[matches[:, 1]]
    assert len(matches) > 100 and (moved == [80.0, 0.0]).all(1).mean() > 0.7
    few = part._replace(points=part.points[:3], descriptors=part.descriptors[:3])
    assert model.match(few, whole)[:, 0].max(initial=0) < 3 and model.match(whole, few)[:, 1].max(initial=0) < 3


def test_plain_and_tiny_images_have_no_features(networks, tmp_path):
    model = lightglue.LightGlue(networks)
    assert model.detect(np.zeros((12, 400), np.uint8)).points.shape == (0, 2)
    assert model.detect(np.zeros((12, 400), np.uint8)).descriptors.shape == (0, 64)
    strict = shutil.copytree(networks, tmp_path / "strict")
    config = json.loads((strict / "config.json").read_text())
    config["keypoint_detector_config"]["keypoint_threshold"] = 2.0
    (strict / "config.json").write_text(json.dumps(config))
    assert len(lightglue.LightGlue(strict).detect(np.full((96, 96), 128, np.uint8)).points) == 0


def test_weights_that_do_not_fit_are_refused(networks, tmp_path):
    folder = shutil.copytree(networks, tmp_path / "networks")
    before = json.loads((folder / "config.json").read_text())
    for change in ({"num_hidden_layers": 3}, {"descriptor_dim": 32}, {"descriptor_dim": "x"}):
        (folder / "config.json").write_text(json.dumps(before | change))
        with pytest.raises(InputError, match=r"^The weights in .* do not fit its config.json \(.*\); copy .*\.$"):
            lightglue.LightGlue(folder)
    (folder / "config.json").write_text(json.dumps(before))
    (folder / "model.safetensors").write_bytes(b"damaged")
    with pytest.raises(InputError, match="do not fit its config"):
        lightglue.LightGlue(folder)


@pytest.mark.long
def test_command_goes_on_and_poses_are_right(networks, tmp_path, run_command, monkeypatch, no_dense_points):
    """The whole command in its processes, with paths from another folder, after a stop with three photos and a pair.

    The photos are enlarged, since corners are found to a pixel, and EXIF tells their focal length.
    """
    matrices = ring(count=25)[:6]
    names = [f"photo {number + 1}.jpg" for number in range(len(matrices))]
    exif, millimeters = Image.Exif(), 43.27 * FOCAL / np.hypot(WIDTH, HEIGHT)
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = round(millimeters)
    (tmp_path / "photos").mkdir()
    for name, matrix in zip(names, matrices, strict=True):
        image = Image.fromarray(photo(matrix)).resize((2 * WIDTH, 2 * HEIGHT), Image.Resampling.BICUBIC)
        image.save(tmp_path / "photos" / name, quality=95, exif=exif)
    path = tmp_path / "capture" / "sfm" / f"learned-{checkpoint.fingerprint(networks)}-database.db"
    path.parent.mkdir(parents=True)
    (path.parent / "source.json").write_text("{}")
    model = lightglue.LightGlue(networks)
    lightglue.find_features(path, tmp_path / "photos", [names[:3]], None, model.detect)
    lightglue.match_pairs(path, [(names[0], names[1])], model.match, worker.verification())

    def rows(table):
        with closing(sqlite3.connect(path)) as connection:
            return set(connection.execute(f"SELECT * FROM {table}"))

    before = {table: rows(table) for table in ("keypoints", "descriptors", "matches", "two_view_geometries")}
    monkeypatch.chdir(tmp_path)
    result = run_command("sfm", "photos", "--out", "capture", "--matcher", networks)
    assert result.code == EXIT_DONE, result.err
    assert all(before[table] and before[table] < rows(table) for table in before)
    assert database.count_features(path) == 6 and database.count_pairs(path) == 6 * 5 // 2
    with pycolmap.Database.open(path) as stored:
        (camera,) = stored.read_all_cameras()
    assert camera.has_prior_focal_length and camera.mean_focal_length() == pytest.approx(2 * FOCAL, rel=0.02)
    assert [each.name for each in path.parent.glob("*.db")] == [path.name]
    assert photos_source.read_source(tmp_path / "capture").matcher == networks.resolve()
    posed = pycolmap.Reconstruction(tmp_path / "capture" / "sparse" / "0")
    found = [posed.find_image_with_name(name).cam_from_world().matrix()[:, :3] for name in names]
    for here, there in zip(found, matrices, strict=True):
        turn = here @ found[0].T @ matrices[0][:, :3] @ there[:, :3].T
        assert np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))) < 3.0, "relative to the first"
