"""Poses of photos alone: against the exact poses of rendered photos, after stops, and with photos that do not fit."""

import io
import json
import shutil
import sqlite3
import subprocess
import sys
import threading
from contextlib import closing
from dataclasses import replace
from itertools import combinations
from pathlib import PureWindowsPath

import numpy as np
import psutil
import pycolmap
import pytest
from matplotlib.figure import Figure
from PIL import Image, ImageFilter
from scipy.spatial.transform import Rotation

from backend.capture import load_capture
from backend.cli import main as command_line
from backend.commands.capture import photo_matches
from backend.commands.capture import sfm as sfm_command
from backend.sfm import agreement, check, database, pairs, stages, worker
from backend.sfm.background import stands_still
from backend.sfm.former_frame import Pose, similarity
from backend.sfm.learned.photos import add_photos
from backend.sfm.model import centers_of, former_on_error
from backend.sfm.sources.photos import Photo
from backend.shared.errors import EXIT_BAD_INPUT, EXIT_CANCELLED, EXIT_DONE, Cancelled, InputError
from backend.shared.events import Reporter
from backend.shared.formats import photos_source
from backend.shared.photos import source_files
from backend.shared.photos.former_model import keep_former

from .command_result import assert_rejected
from .rendered_photos import HEIGHT, VIEWS, WIDTH, photo, pose, pose_errors, ring, write_photos


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    """A folder with images/ of the ring, masks/ and names, and the exact poses."""
    folder = tmp_path_factory.mktemp("photos") / "room"
    write_photos(folder / "images", ring())
    (folder / "masks").mkdir()
    for number in range(VIEWS):
        Image.fromarray(np.ones((HEIGHT, WIDTH), np.uint8)).save(folder / "masks" / f"photo {number + 1}.png")
    (folder / "labels.json").write_text('{"1": "box"}')
    return folder


@pytest.fixture(scope="module")
def made(photos, tmp_path_factory):
    """The capture that `sfm` makes of them."""
    capture = tmp_path_factory.mktemp("made") / "room"
    assert command_line.main(["sfm", str(photos), "--out", str(capture)]) == EXIT_DONE
    return capture


def test_poses_are_those_of_the_photos(made, photos):
    report = json.loads((made / "sfm" / "sfm.json").read_text())
    assert report["registered"] == report["photos"] == VIEWS and not report["left_out"]
    assert report["points"] > 300 and report["reprojection_error"] < 0.6
    degrees, positions = pose_errors(made, ring())
    assert len(degrees) == VIEWS and np.median(degrees) < 0.3 and np.median(positions) < 0.01
    assert report["files"] and source_files.has_poses_of(made, photos_source.PhotosSource([photos]))
    assert (made / "masks" / "photo 1.png").exists() and (made / "labels.json").exists()
    for path in (photos / "images").iterdir():
        assert (made / "images" / path.name).read_bytes() == path.read_bytes()


def to_world(capture, xyz: np.ndarray, matrices) -> np.ndarray:
    """Return points of a capture (n, 3) in the world of the rendered photos."""
    model = pycolmap.Reconstruction(capture / "sparse" / "0")
    images = [model.find_image_with_name(f"photo {number + 1}.png") for number in range(len(matrices))]
    here = np.array([image.projection_center() for image in images])
    there = np.array([-matrix[:, :3].T @ matrix[:, 3] for matrix in matrices])
    a, b = here - here.mean(0), there - there.mean(0)
    u, s, vt = np.linalg.svd(b.T @ a)
    flip = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    scale = (s * np.diag(flip)).sum() / (a**2).sum()
    return scale * (xyz - here.mean(0)) @ (u @ flip @ vt).T + there.mean(0)


def test_points_of_patches_lie_on_the_surfaces(made):
    model = pycolmap.Reconstruction(made / "sparse" / "0")
    added = np.array([point.xyz for point in model.points3D.values() if not point.track.elements])
    assert len(added) > 300
    x, y, z = to_world(made, added, ring()).T
    distances = [np.abs(z), np.abs(y - 2.5), np.abs(x + 2.5)]
    for low, high in (((-0.6, -0.3, 0.0), (0.0, 0.4, 0.7)), ((0.4, -0.7, 0.0), (0.9, 0.0, 0.4))):
        outside = np.maximum(np.maximum(np.array(low) - np.array([x, y, z]).T, np.array([x, y, z]).T - high), 0)
        inside = np.minimum(np.array([x, y, z]).T - low, high - np.array([x, y, z]).T).min(1)
        distances.append(np.where((outside > 0).any(1), np.linalg.norm(outside, axis=1), inside))
    assert np.percentile(np.min(distances, 0), 90) < 0.04, "of a room 5 wide"


def test_wrong_matches_do_not_move_poses(made, tmp_path):
    """On average over ten sets of wrong matches, since one may happen to move few poses."""
    options = pycolmap.BundleAdjustmentOptions()
    options.ceres.use_gpu = options.print_summary = options.refine_principal_point = False

    def error(model, name):
        folder = tmp_path / name / "sparse" / "0"
        folder.mkdir(parents=True)
        model.write(folder)
        return np.median(pose_errors(tmp_path / name, ring())[0])

    right = pycolmap.Reconstruction(made / "sparse" / "0")
    pycolmap.bundle_adjustment(right, options)
    plain, robust = [], []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        model = pycolmap.Reconstruction(made / "sparse" / "0")
        for number in model.reg_image_ids():
            for point in model.image(number).points2D:
                if point.has_point3D() and rng.random() < 0.15:
                    point.xy = np.array(point.xy) + rng.choice([-1, 1], 2) * rng.uniform(1.0, 4.0, 2)
        least_squares = pycolmap.Reconstruction(model)
        pycolmap.bundle_adjustment(least_squares, options)
        plain.append(error(least_squares, f"plain {seed}"))
        worker.adjust(model)
        worker.remove_outliers(model)
        robust.append(error(model, f"robust {seed}"))
    assert np.mean(robust) < 1.5 * error(right, "right"), (robust, plain)
    assert np.mean(plain) > 2 * np.mean(robust), (robust, plain)


@pytest.mark.long
def test_capture_can_be_imported_and_is_kept_by_a_second_run(made, run_command, tmp_path, monkeypatch):
    assert run_command("import", made, "--out", tmp_path / "out").code == EXIT_DONE
    before = pycolmap.Reconstruction(made / "sparse" / "0").num_reg_images()
    monkeypatch.chdir(made.parent)  # COLMAP's processes run elsewhere.
    result = run_command("sfm", made.name, "--out", made.name)
    assert result.code == EXIT_DONE and pycolmap.Reconstruction(made / "sparse" / "0").num_reg_images() == before


@pytest.mark.long
def test_stopped_command_goes_on(photos, tmp_path, run_command, monkeypatch):
    """Features and matches are kept; the pairs that are known are not matched again."""
    capture = tmp_path / "capture"
    real = stages.run_stage

    def stop_after_matching(reporter, log, arguments, count, total):
        if arguments[0] == "global":
            reporter.stop._stopped = True
        return real(reporter, log, arguments, count, total)

    monkeypatch.setattr("backend.commands.capture.sfm.run_stage", stop_after_matching)
    assert run_command("sfm", photos, "--out", capture).code == EXIT_CANCELLED
    path = capture / "sfm" / database.NAME
    assert not (capture / "sparse").exists()
    assert database.count_features(path) == VIEWS and database.count_pairs(path) == VIEWS * (VIEWS - 1) // 2
    monkeypatch.undo()
    assert run_command("sfm", photos, "--out", capture).code == EXIT_DONE
    assert (capture / "sparse" / "0" / "images.bin").exists()


def test_photos_share_a_camera_after_a_stop_among_them(photos, tmp_path):
    path, listed = tmp_path / database.NAME, tmp_path / "groups.json"
    names = sorted(path.name for path in (photos / "images").iterdir())
    for count in (2, 3):
        listed.write_text(json.dumps([{"names": names[:count], "camera": None}]))
        worker.extract(str(path), str(photos / "images"), str(listed))
    with pycolmap.Database.open(path) as stored:
        assert stored.num_images() == 3 and stored.num_cameras() == stored.num_rigs() == 1


def test_photos_with_a_camera_each_are_given_to_the_threads_at_once(photos, tmp_path, monkeypatch):
    path, listed, calls = tmp_path / database.NAME, tmp_path / "groups.json", []
    names = sorted(path.name for path in (photos / "images").iterdir())[:5]
    real = pycolmap.extract_features

    def counted(*arguments, image_names, **options):
        calls.append(image_names)
        real(*arguments, image_names=image_names, **options)

    monkeypatch.setattr(pycolmap, "extract_features", counted)
    lens = {"model": "SIMPLE_PINHOLE", "params": [300.0, WIDTH / 2, HEIGHT / 2]}
    groups = [([names[0]], lens), (names[1:3], None), ([names[3]], None), ([names[4]], None)]
    listed.write_text(json.dumps([{"names": own, "camera": camera} for own, camera in groups]))
    worker.extract(str(path), str(photos / "images"), str(listed))
    assert calls == [names[1:3], [names[0], *names[3:]]]
    with pycolmap.Database.open(path) as stored:
        cameras = {image.name: image.camera_id for image in stored.read_all_images()}
        assert stored.num_cameras() == len(set(cameras.values())) == 4 and cameras[names[1]] == cameras[names[2]]
        known = {name: stored.read_camera(number).has_prior_focal_length for name, number in cameras.items()}
    assert [name for name in names if known[name]] == names[:1]


def test_killed_mapper_leaves_the_earlier_model(made, photos, tmp_path, monkeypatch, run_command):
    capture = shutil.copytree(made, tmp_path / "capture")
    before = (capture / "sparse" / "0" / "images.bin").read_bytes()
    monkeypatch.setattr(stages, "_KILLED", (0,))
    source = photos_source.read_source(capture)
    result = run_command("sfm", photos, "--out", capture, "--set", "2", "--features", "objects")
    assert result.code == EXIT_BAD_INPUT and "The system ended the stage extract" in result.err
    assert photos_source.read_source(capture) == source, "that of the model"
    assert (capture / "sparse" / "0" / "images.bin").read_bytes() == before


@pytest.mark.parametrize("is_first", [False, True])
def test_stop_at_the_end_leaves_the_earlier_model(made, photos, tmp_path, monkeypatch, run_command, is_first):
    out = shutil.copytree(made, tmp_path / "capture")
    if is_first:
        shutil.rmtree(out / "sparse")
    before = {path: path.read_bytes() for path in (out / "sparse").rglob("*") if path.is_file()}
    report = (out / "sfm" / "sfm.json").read_bytes()

    def left_out() -> list[str]:
        return photos_source.read_source(out).leave_out

    def stopped(found, *_):
        assert (out / "sparse" / "0").is_dir() and left_out() == ["photo 7.png"]
        raise Cancelled("Stopped")

    monkeypatch.setattr(sfm_command, "_densify", stopped)
    assert run_command("sfm", photos, "--out", out, "--leave-out", "photo 7.png").code == EXIT_CANCELLED
    assert left_out() == (["photo 7.png"] if is_first else [])
    assert {path: path.read_bytes() for path in (out / "sparse").rglob("*") if path.is_file()} == before
    assert (out / "sfm" / "sfm.json").read_bytes() == report


def test_stop_after_a_killed_run_leaves_the_model_before_both(made, photos, tmp_path, monkeypatch, run_command):
    out, wanted = shutil.copytree(made, tmp_path / "capture"), photos_source.PhotosSource([photos])
    before, source = (path.read_bytes() for path in (out / "sparse/0/images.bin", out / "sfm/source.json"))

    def stopped(*_):
        raise Cancelled("Stopped")

    keep_former(out)
    (out / "sparse/0/images.bin").write_bytes(b"half-made")
    photos_source.write_source(out, replace(wanted, leave_out=["photo 7.png"]))
    assert not source_files.has_poses_of(out, wanted)
    monkeypatch.setattr(sfm_command, "match_photos", stopped)
    assert run_command("sfm", photos, "--out", out).code == EXIT_CANCELLED
    assert (out / "sparse/0/images.bin").read_bytes() == before and (out / "sfm/source.json").read_bytes() == source
    assert source_files.has_poses_of(out, wanted)
    assert {path.name for path in (out / "sparse/0").iterdir()} == {path.name for path in (made / "sparse/0").iterdir()}
    with former_on_error(out):
        assert not source_files.has_poses_of(out, wanted)
    assert source_files.has_poses_of(out, wanted)


@pytest.mark.long
def test_photos_that_do_not_fit_are_named_with_the_reason(photos, tmp_path, run_command, no_dense_points):
    folder = shutil.copytree(photos / "images", tmp_path / "mixed")
    Image.fromarray(photo(ring()[0], seed=900)).save(folder / "zz other room.png")
    Image.fromarray(np.full((HEIGHT, WIDTH, 3), 128, np.uint8)).save(folder / "zz plain.png")
    (folder / "zz broken.jpg").write_bytes(b"\xff\xd8\xff")
    result = run_command("sfm", folder, "--out", tmp_path / "capture")
    assert result.code == EXIT_DONE
    left_out = json.loads((tmp_path / "capture" / "sfm" / "sfm.json").read_text())["left_out"]
    assert set(left_out) == {"zz other room.png", "zz plain.png", "zz broken.jpg"}
    assert "nothing that another photo shows" in left_out["zz other room.png"]
    assert "too few details" in left_out["zz plain.png"] and "damaged" in left_out["zz broken.jpg"]


@pytest.mark.long
def test_weak_photos_are_named_and_left_out_by_request(photos, tmp_path, run_command):
    folder = shutil.copytree(photos / "images", tmp_path / "mixed")
    blurred = Image.fromarray(photo(ring(count=13)[5])).filter(ImageFilter.GaussianBlur(3.0))
    blurred.save(folder / "photo 3b.png")
    capture = tmp_path / "capture"
    assert run_command("sfm", folder, "--out", capture).code == EXIT_DONE
    report = json.loads((capture / "sfm" / "sfm.json").read_text())
    unsure = {**report["weak"], **report["left_out"]}
    assert list(unsure) == ["photo 3b.png"]
    assert set(report["figures"]["photo 1.png"]) == {"support", "error", "points"}
    with Image.open(capture / "sfm" / "sfm.png") as picture:
        assert picture.width > 1000
    moved = pycolmap.Reconstruction(capture / "sparse" / "0")
    rotation = Rotation.from_rotvec([0.3, 1.0, -2.0]).as_matrix()
    moved.transform(pycolmap.Sim3d(np.column_stack([5 * rotation, [1.0, 20.0, 3.0]])))
    moved.write(capture / "sparse" / "0")
    shutil.rmtree(folder)
    assert_rejected(run_command("sfm", tmp_path / "other", "--out", capture), "other does not exist")
    result = run_command("sfm", folder, "--out", capture, "--leave-out", "photo 3b.png")
    assert result.code == EXIT_DONE and "its copies in" in result.err + result.out
    report = json.loads((capture / "sfm" / "sfm.json").read_text())
    assert report["left_out"] == {"photo 3b.png": "it was left out by request"} and not report["weak"]
    assert report["registered"] == VIEWS and report["photos"] == VIEWS + 1
    again, former = centers_of(pycolmap.Reconstruction(capture / "sparse" / "0")), centers_of(moved)
    size = np.ptp(list(former.values()), axis=0).max()
    away = [np.linalg.norm(again[name] - former[name]) for name in again]
    assert np.median(away) < 0.01 * size, "the scene has not moved"


def poses(count, seed, line=False):
    rng = np.random.default_rng(seed)
    centers = rng.normal(size=(count, 3)) * ((1, 0, 0) if line else (1, 1, 1))
    return {str(i): Pose(center, Rotation.random(random_state=rng).as_matrix()) for i, center in enumerate(centers)}


@pytest.mark.parametrize("line", [False, True])
def test_cameras_are_placed_as_they_were(line):
    """On a line, only the rotations tell how the cameras were turned about it."""
    then = poses(20, 0, line)
    turn, scale, shift = Rotation.from_rotvec([0.4, 2.0, -1.0]), 0.3, np.array([5.0, -1.0, 40.0])
    rng = np.random.default_rng(1)
    now = {
        name: Pose(turn.inv().apply((pose.center - shift) / scale), pose.rotation @ turn.as_matrix())
        for name, pose in then.items()
    }
    now |= {str(i): Pose(rng.normal(size=3) * 30, Rotation.random(random_state=rng).as_matrix()) for i in range(5)}
    found = similarity(now, then)
    assert found == pytest.approx(np.column_stack([scale * turn.as_matrix(), shift]), abs=0.02)


def test_models_that_have_little_in_common_stay_apart():
    then = poses(20, 0)
    assert similarity(then, {name: then[name] for name in list(then)[:2]}) is None
    assert similarity(then, {name: pose._replace(rotation=np.eye(3)) for name, pose in then.items()}) is None
    assert (
        similarity(poses(20, 0), {name: Pose(poses(20, 1)[name].center, then[name].rotation) for name in then}) is None
    )
    assert similarity({name: pose._replace(center=np.zeros(3)) for name, pose in then.items()}, then) is None


def test_weak_photos_are_those_unlike_the_others():
    figures = {f"{number}.jpg": check.PhotoFigures(0.98, 0.5 + 0.01 * number, 400) for number in range(9)}
    assert check.weak_photos(figures) == {}
    figures |= {
        "few.jpg": check.PhotoFigures(0.95, 0.5, 20),
        "far.jpg": check.PhotoFigures(0.95, 2.0, 400),
        "wrong.jpg": check.PhotoFigures(0.7, 0.5, 400),
    }
    weak = check.weak_photos(figures)
    assert list(weak) == ["wrong.jpg", "far.jpg", "few.jpg"]
    assert "30% of its matches" in weak["wrong.jpg"] and "20 points" in weak["few.jpg"]
    small = {name: each._replace(error=each.error / 100) for name, each in figures.items()}
    assert "far.jpg" not in check.weak_photos(small), "a fiftieth of a pixel is no error"


@pytest.mark.long
@pytest.mark.parametrize("count", [14, 40])
def test_picture_names_few_photos_and_has_whole_titles(count):
    names = [f"a long folder/DSC_{number:04}.jpg" for number in range(count)]
    figures = {name: check.PhotoFigures(1.0, 0.5, 900) for name in names}
    figure = Figure(figsize=(13, 4.2), layout="constrained")
    axes = figure.subplots(1, 3, width_ratios=(1.1, 1, 1.2))[2]
    check._draw_errors(axes, figures, names[:2])
    figure.savefig(io.BytesIO(), format="png")
    title = axes.title.get_window_extent()
    assert title.x0 > 0 and title.x1 <= figure.bbox.x1
    assert [each.get_text() for each in axes.get_legend().get_texts()] == ["median of the photos"]
    ticks, named = axes.get_xticklabels(), [each.get_text() for each in axes.texts]
    assert (
        [each.get_text()[-12:] for each in ticks] == [name[-12:] for name in names] if count == 14 else len(ticks) < 40
    )
    assert named == ([] if count == 14 else names[:2])


def test_features_can_be_on_objects_alone(photos, tmp_path, run_command, no_dense_points):
    """Half of each mask is an object, and one photo has no mask; another set of photos has none at all."""
    folder = shutil.copytree(photos, tmp_path / "turntable")
    for path in (folder / "masks").iterdir():
        ids = np.zeros((HEIGHT, WIDTH), np.uint8)
        ids[:, : WIDTH // 2] = 3
        Image.fromarray(ids).save(path)
    (folder / "masks" / "photo 2.png").unlink()
    capture = tmp_path / "capture"
    run_command("sfm", folder, "--out", capture, "--features", "objects")
    path = capture / "sfm" / "objects.db"
    assert database.count_features(path) == VIEWS and not (capture / "sfm" / database.NAME).exists()
    with pycolmap.Database.open(path) as stored:
        for name, number in database.image_ids(path).items():
            columns = np.asarray(stored.read_keypoints(number))[:, 0]
            assert (columns.max() < WIDTH / 2 + 2) == (name != "photo 2.png") and len(columns) > 50
    result = run_command("sfm", folder / "images", "--out", tmp_path / "bare", "--features", "objects")
    assert result.code == EXIT_BAD_INPUT and "has no mask of any photo" in result.err


@pytest.mark.long
def test_objects_that_turn_before_a_background_at_rest(photos, tmp_path, run_command, no_dense_points):
    """The background is that of the first photo; without masks it would say that the camera stands still."""
    folder = shutil.copytree(photos, tmp_path / "turntable")
    first = np.asarray(Image.open(folder / "images" / "photo 1.png"))
    ids = np.zeros((HEIGHT, WIDTH), np.uint8)
    ids[:, WIDTH // 4 : WIDTH // 2] = 3
    for path in (folder / "images").iterdir():
        Image.fromarray(np.where(ids[..., None], np.asarray(Image.open(path)), first)).save(path)
        Image.fromarray(ids).save(folder / "masks" / path.name)
    result = run_command("sfm", folder / "images", "--out", tmp_path / "bare")
    assert result.code == EXIT_BAD_INPUT and "stands still" in result.err
    assert not (tmp_path / "bare" / "sparse").exists()
    run_command("sfm", folder, "--out", tmp_path / "capture")
    path = tmp_path / "capture" / "sfm" / "objects.db"
    assert database.count_features(path) == VIEWS, "only features on objects are used"
    source = photos_source.read_source(tmp_path / "capture")
    assert source.features == "objects", "which later steps know, too"


@pytest.mark.long
def test_separate_sets_of_photos(photos, tmp_path, run_command, monkeypatch, no_dense_points):
    """Five photos of another room have nothing in common with the seven of the first; each set can be used."""
    folder = shutil.copytree(photos / "images", tmp_path / "rooms")
    for number, matrix in enumerate(ring()[:5]):
        Image.fromarray(photo(matrix, seed=100)).save(folder / f"other {number}.png")
    capture = tmp_path / "capture"
    result = run_command("sfm", folder, "--out", capture)
    assert result.code == EXIT_DONE and "2 separate sets, of 7, 5 photos; set 1 is used" in result.out + result.err
    assert len(posed_photos(capture)) == VIEWS
    assert run_command("sfm", folder, "--out", capture, "--set", "2").code == EXIT_DONE
    assert posed_photos(capture) == {f"other {number}.png" for number in range(5)}
    result = run_command("sfm", folder, "--out", capture, "--set", "3")
    assert result.code == EXIT_BAD_INPUT and "fewer than 3 separate sets" in result.err
    assert len(posed_photos(capture)) == 5, "what was there is kept"
    monkeypatch.setattr("backend.sfm.model._LEAST_SET", 0.8)
    result = run_command("sfm", folder, "--out", capture)
    assert result.code == EXIT_DONE and "separate sets" not in result.out + result.err, "five are too few to be a scene"
    assert len(posed_photos(capture)) == VIEWS


def posed_photos(capture) -> set[str]:
    model = pycolmap.Reconstruction(capture / "sparse" / "0")
    return {model.image(number).name for number in model.reg_image_ids()}


@pytest.mark.long
def test_fisheye_lens_is_recognized(tmp_path, run_command, no_dense_points):
    """122 degrees wide, 160 from corner to corner."""
    (tmp_path / "photos").mkdir()
    for number, matrix in enumerate(ring()):
        image = Image.fromarray(photo(matrix, fisheye=150.0))
        image.save(tmp_path / "photos" / f"photo {number + 1}.png")
    capture = tmp_path / "capture"
    assert run_command("sfm", tmp_path / "photos", "--out", capture).code == EXIT_DONE
    (camera,) = pycolmap.Reconstruction(capture / "sparse" / "0").cameras.values()
    assert camera.model_name.endswith("FISHEYE") and camera.params[0] == pytest.approx(150.0, rel=0.01)
    degrees, positions = pose_errors(capture, ring())
    assert len(degrees) == VIEWS and np.median(degrees) < 0.4 and np.median(positions) < 0.003
    assert run_command("import", capture, "--out", tmp_path / "out").code == EXIT_DONE


def test_photos_from_one_spot_are_refused(tmp_path, run_command):
    targets = [(0.1 + 0.12 * step, 0.05 * step, 0.3) for step in range(6)]
    write_photos(tmp_path / "spot", [pose((2.0, -0.8, 1.2), target) for target in targets])
    result = run_command("sfm", tmp_path / "spot", "--out", tmp_path / "capture")
    assert result.code == EXIT_BAD_INPUT and "were taken from one spot" in result.err
    assert not (tmp_path / "capture" / "sparse").exists()


@pytest.mark.parametrize(
    ("count", "sentence"), [(0, "contains no photos"), (1, "contains only one photo"), (2, "No two photos in")]
)
def test_photos_that_cannot_work_are_refused(tmp_path, run_command, count, sentence):
    folder = tmp_path / "photos"
    folder.mkdir()
    for number in range(count):
        Image.fromarray(photo(ring()[0], seed=100 * number)).save(folder / f"{number}.png")
    result = run_command("sfm", folder, "--out", tmp_path / "capture")
    assert result.code == EXIT_BAD_INPUT and sentence in result.err
    assert count == 2 or not (tmp_path / "capture").exists(), "nothing is left of what could not begin"


def test_folders_of_others_are_kept(photos, tmp_path, run_command, made):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("Dear")
    result = run_command("sfm", photos, "--out", tmp_path / "mine")
    assert result.code == EXIT_BAD_INPUT and "contains other files" in result.err
    (tmp_path / "theirs" / "sfm").mkdir(parents=True)
    (tmp_path / "theirs" / "sfm" / database.NAME).write_bytes(b"of another program")
    result = run_command("sfm", photos, "--out", tmp_path / "theirs")
    assert result.code == EXIT_BAD_INPUT and "contains other files" in result.err
    assert (tmp_path / "theirs" / "sfm" / database.NAME).read_bytes() == b"of another program"
    other = shutil.copytree(made, tmp_path / "model")
    shutil.rmtree(other / "sfm")
    result = run_command("sfm", other, "--out", other)
    assert result.code == EXIT_BAD_INPUT and "has a COLMAP model already" in result.err
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["letter.txt"]


def test_pause_suspends_the_process(monkeypatch):
    """The child and its children are suspended until the pause ends; on Windows, a child runs the real Python."""
    calls = []

    class Child:
        def __init__(self, pid):
            self.pid = pid

        def children(self, recursive):
            assert recursive
            return [Child(2), Child(3)]

        def suspend(self):
            if self.pid == 3:
                raise psutil.NoSuchProcess(3)
            calls.append(f"suspend {self.pid}")

        def resume(self):
            calls.append(f"resume {self.pid}")

    monkeypatch.setattr(stages.psutil, "Process", Child)

    class Request:
        paused = True

        def __call__(self):
            threading.Event().wait(0.01)
            calls.append("waited")
            return False

    stages._wait_while_paused(type("P", (), {"pid": 1}), type("R", (), {"stop": Request()})())
    assert calls == ["suspend 1", "suspend 2", "waited", "resume 1", "resume 2"]


def test_wrong_pose_is_not_trusted(made, tmp_path):
    """A photo at another place has few matches near their epipolar lines, whatever its reprojection error is."""
    path = made / "sfm" / database.NAME
    model = pycolmap.Reconstruction(made / "sparse" / "0")
    assert len(agreement.measure_agreement(model, path).trusted) == VIEWS
    image = model.find_image_with_name("photo 3.png")
    moved = pycolmap.Rigid3d(np.column_stack([pose((-2.0, 1.5, 1.0), (0.3, 0.0, 0.2))]))
    model.frame(image.frame_id).set_cam_from_world(image.camera_id, moved)
    found = agreement.measure_agreement(model, path)
    assert found.support["photo 3.png"] < 0.3 and "photo 3.png" not in found.trusted
    assert len(found.trusted) == VIEWS - 1


def test_photo_that_matches_nothing_has_a_pose_that_no_match_contradicts(made, monkeypatch):
    path = made / "sfm" / database.NAME
    ids, real = database.image_ids(path), database.verified_pairs
    model, without = pycolmap.Reconstruction(made / "sparse" / "0"), ids["photo 3.png"]
    monkeypatch.setattr(
        agreement.database, "verified_pairs", lambda *given: [pair for pair in real(*given) if without not in pair[:2]]
    )
    support = agreement.measure_agreement(model, path).support
    assert support["photo 3.png"] == 1.0
    weak = check.weak_photos({name: check.PhotoFigures(own, 0.5, 0) for name, own in support.items()})
    assert weak["photo 3.png"] == "only 0 points determine its pose"


def test_epipolar_errors_are_angles():
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.5, 0.5, (50, 3))
    first, second = ring()[0], ring()[3]

    def seen(matrix):
        local = points @ matrix[:, :3].T + matrix[:, 3]
        return local / np.linalg.norm(local, axis=1, keepdims=True)

    assert agreement.epipolar_errors(first, second, seen(first), seen(second)).max() < 1e-9
    assert np.median(agreement.epipolar_errors(first, ring()[5], seen(first), seen(second))) > 0.005
    turned = seen(second) + 0.01 * np.cross(seen(second), second[:, :3] @ first[:, :3].T @ [0.0, 0.0, 1.0])
    assert 0 < np.median(agreement.epipolar_errors(first, second, seen(first), turned)) < 0.01, "in radians"
    assert np.isinf(agreement.epipolar_errors(first, second, seen(first)[:1] * np.nan, seen(second)[:1])).all()


def test_pairs_of_large_sets_are_those_that_show_the_same(made, monkeypatch):
    path = made / "sfm" / database.NAME
    names = sorted(database.image_ids(path))
    assert pairs.choose_pairs(path, names) is None, "all pairs of a small set"
    chosen = pairs.choose_pairs(path, [*names[:3], "unreadable.png"])
    assert sorted(chosen) == list(combinations(names[:3], 2)), "not of photos that are not used any more"
    monkeypatch.setattr(pairs, "ALL_UP_TO", 2)
    monkeypatch.setattr(pairs, "NEIGHBORS", 1)
    chosen = [[int(name.split()[1].partition(".")[0]) for name in pair] for pair in pairs.choose_pairs(path, names)]
    assert len(chosen) < VIEWS and {number for pair in chosen for number in pair} == set(range(1, VIEWS + 1))
    assert all(abs(first - second) <= 2 for first, second in chosen), "neighbors of the ring"


def test_frames_of_a_video_are_matched_with_those_that_follow(tmp_path, monkeypatch):
    """Also beside photos, and if some frames are left out."""
    names = [f"{number}.png" for number in range(12)]
    for name in names:
        Image.new("RGB", (64, 48)).save(tmp_path / name)
    add_photos(tmp_path / "d.db", tmp_path, [names])
    monkeypatch.setattr(pairs, "ALL_UP_TO", 2)
    monkeypatch.setattr(pairs, "ALONG", 2)
    videos = [["1.png", "left out.png", "2.png", "3.png", "4.png"], ["5.png", "6.png"]]
    chosen = pairs.choose_pairs(tmp_path / "d.db", names, videos)
    assert [first[0] + second[0] for first, second in chosen] == ["12", "13", "23", "24", "34", "56"]


def test_photos_that_are_not_used_any_more_do_not_tell_whether_the_background_stands_still(tmp_path):
    """Three photos of a turntable were replaced by two of a moving camera, whose pair is all that counts."""
    names, path = ["1.png", "2.png", "3.png", "new 1.png", "new 2.png"], tmp_path / "d.db"
    for name in names:
        Image.new("RGB", (64, 48)).save(tmp_path / name)
    add_photos(path, tmp_path, [names])
    points = np.random.default_rng(0).uniform(8, 40, (30, 2)).astype(np.float32)
    ids = database.image_ids(path)
    with pycolmap.Database.open(path) as stored:
        for name in names:
            stored.write_keypoints(ids[name], points + (8 if name == "new 2.png" else 0))
        geometry = pycolmap.TwoViewGeometry()
        geometry.config = int(pycolmap.TwoViewGeometryConfiguration.CALIBRATED)
        geometry.inlier_matches = np.tile(np.arange(30, dtype=np.uint32)[:, None], 2)
        for pair in [*combinations(names[:3], 2), tuple(names[3:])]:
            stored.write_two_view_geometry(*sorted(ids[name] for name in pair), geometry)
    assert stands_still(path, names) and not stands_still(path, names[3:])
    photo_matches._require_matches(path, names[3:], tmp_path)
    with pytest.raises(InputError, match="No two photos"):
        photo_matches._require_matches(path, names[2:4], tmp_path)


@pytest.mark.usefixtures("no_dense_points")
@pytest.mark.long
def test_pairs_of_photos_with_spaces_in_their_names_are_matched(made, photos, tmp_path, run_command, monkeypatch):
    """COLMAP's lists have no such names, so the database has others meanwhile, also after the process was killed."""
    monkeypatch.setattr(pairs, "ALL_UP_TO", 2)
    out = tmp_path / "capture"
    (out / "sfm").mkdir(parents=True)
    shutil.copy(made / "sfm" / "source.json", out / "sfm")
    path = out / "sfm" / database.NAME
    shutil.copy(made / "sfm" / database.NAME, path)
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute("DELETE FROM matches")
        connection.execute("DELETE FROM two_view_geometries")
    killed = database.listed_names(path)
    killed.__enter__()
    assert not any(" " in name for name in database.image_ids(path))
    assert run_command("sfm", photos, "--out", out).code == EXIT_DONE
    assert set(database.image_ids(path)) == posed_photos(out) == {f"photo {i}.png" for i in range(1, VIEWS + 1)}
    assert len(database.verified_pairs(path, posed_photos(out))) >= VIEWS - 1


def test_pairs_of_photos_whose_names_begin_as_a_comment_are_matched(made, tmp_path):
    path, listed = tmp_path / database.NAME, tmp_path / "pairs.txt"
    shutil.copy(made / "sfm" / database.NAME, path)
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute("DELETE FROM matches")
        connection.execute("DELETE FROM two_view_geometries")
        connection.execute("UPDATE images SET name = replace(name, 'photo', '#')")
    chosen = [("# 1.png", "# 2.png"), ("# 2.png", "# 3.png")]
    database.write_pairs(listed, chosen)
    assert database.read_pairs(listed) == chosen
    worker.match(str(path), str(listed))
    assert database.count_pairs(path) == 2 and "# 1.png" in database.image_ids(path)


def test_photos_can_be_given_in_a_list(photos, tmp_path, run_command, monkeypatch):
    """Where they are too many for a command line."""
    given, found = sorted((photos / "images").iterdir()), []
    listed = tmp_path / "photos.json"
    monkeypatch.setattr(sfm_command, "_run", lambda made_from, *_: found.append(made_from))
    listed.write_text(json.dumps({"photos": [str(path) for path in given[1:]], "leave_out": ["b.png"]}))
    command = "sfm", given[0], "--out", tmp_path / "capture", "--leave-out", "a.png", "--list", listed
    run_command(*command)
    assert found[0].photos == given and found[0].leave_out == ["a.png", "b.png"]
    listed.write_text('["photo 1.png"]')
    assert_rejected(run_command(*command), "is no list of photos")


def test_photos_to_leave_out_are_found_by_the_names_that_they_had():
    photos_there = [Photo(name, "", "") for name in ("a/1.jpg", "a/2.png", "b/e\u0301.jpg")]
    told = []

    class Told(Reporter):
        def warning(self, message: str) -> None:
            told.append(message)

    asked = ["a/1.HEIC", "b/\u00e9.jpg", "a/3.jpg"]
    asked += ["", ".", "a/2.v2", "broken.jpg"]
    found = sfm_command._unwanted(asked, photos_there, {"broken.jpg"}, Told())
    assert list(found) == ["a/1.jpg", "b/e\u0301.jpg"]
    assert len(told) == 1 and "a/3.jpg" in told[0] and "1.HEIC" not in told[0] and "broken" not in told[0]


def test_cameras_are_others_if_photos_share_them_in_another_way():
    def groups(*names: str, lens=None):
        return [{"names": list(each), "camera": lens} for each in names]

    def differ(before, now):
        return sfm_command._have_other_cameras(before, now)

    assert not differ(groups("ab", "c"), groups("ab", "c"))
    assert not differ(groups("ab", "c"), groups("c", "abd", "e")), "photos may come"
    assert not differ(groups("ab", "c"), groups("a")), "and go"
    assert differ(groups("ab", "c"), groups("abc")) and differ(groups("abc"), groups("ab", "c"))
    known = {"model": "PINHOLE", "params": []}
    assert differ(groups("ab", lens=known), groups("ab")), "the lens of a calibration is forgotten"
    assert not differ(groups("ab"), groups("ab", lens=known)) and not differ(
        groups("ab", lens=known), groups("ab", lens=dict(known))
    )
    other = {**known, "params": [300.0]}
    assert differ(groups("ab", lens=known), groups("ab", lens=other)), "matches were verified with the former lens"


def test_databases_in_shared_folders_can_be_named():
    assert database._uri(PureWindowsPath("C:/a b/d.db")) == "file:///C:/a%20b/d.db"
    assert database._uri(PureWindowsPath(r"\\server\share\d.db")) == "file:////server/share/d.db", "no authority"


def test_stage_ends_with_the_process_that_began_it():
    """Or the next one would find its database in use."""
    program = "import time; from backend.sfm import worker; worker.STAGES['wait'] = lambda: time.sleep(60); "
    process = subprocess.Popen(
        [sys.executable, "-c", f"{program}print(1, flush=True); worker.main('1', 'wait')"],
        cwd=stages._ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
    )  # fmt: skip
    assert process.stdin is not None and process.stdout is not None
    assert process.stdout.readline() == b"1\n"
    with pytest.raises(subprocess.TimeoutExpired):
        process.wait(1.0)
    process.stdin.close()
    assert process.wait(10) == 1
    process.stdout.close()


@pytest.mark.parametrize(("stage", "threads"), [("match", "4"), ("match-learned", "1")])
def test_networks_have_one_thread_on_macos(stage, threads):
    """The threads of torch and pycolmap, which have an OpenMP each there, may crash beside each other."""
    program = (
        "import os, sys; from backend.sfm import worker; sys.platform = 'darwin'; "
        f"worker.STAGES[{stage!r}] = lambda: print(os.environ['OMP_NUM_THREADS']); worker.main('4', {stage!r})"
    )
    # The process ends with its input.
    with subprocess.Popen(
        [sys.executable, "-c", program], cwd=stages._ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.read() == f"{threads}\n"


def test_masks_and_names_that_cannot_be_used_do_not_stop_the_search_for_points(write_capture, tmp_path):
    scene = write_capture(views=6, size=(48, 36))
    for path in sorted((scene.folder / "masks").iterdir())[1:]:
        path.unlink()
    (scene.folder / "labels.json").write_text("one name a line")
    (scene.folder / "test.txt").write_text("IMG_1.HEIC")
    with pytest.raises(InputError):
        load_capture(scene.folder, tmp_path / "cache")
    assert not load_capture(scene.folder, tmp_path / "cache", photos_only=True).has_masks
