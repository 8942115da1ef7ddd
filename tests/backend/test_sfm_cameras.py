"""Cameras that are known before poses are computed: their lenses, and which are fixed to each other."""

import json
import shutil
import sqlite3
from contextlib import closing

import numpy as np
import pycolmap
import pytest
from PIL import Image

from backend.cli import main as command_line
from backend.sfm import rig, worker
from backend.sfm.model import centers_of
from backend.shared.errors import EXIT_DONE

from .command_result import assert_rejected
from .rendered_photos import FOCAL, HEIGHT, WIDTH, photo, pose_errors, ring, write_photos

LENS = f"OPENCV {WIDTH} {HEIGHT} {FOCAL} {FOCAL} {WIDTH / 2} {HEIGHT / 2} 0 0 0 0"
TURN = np.array([[np.cos(0.1), 0, np.sin(0.1)], [0, 1, 0], [-np.sin(0.1), 0, np.cos(0.1)]])
BESIDE = np.column_stack([TURN, [-0.3, 0.02, 0.0]])
"""The world of a rig's first camera in its second one."""


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    folder = tmp_path_factory.mktemp("photos") / "room"
    write_photos(folder, ring())
    return folder


def write_lenses(folder, *lenses: str):
    folder.mkdir(exist_ok=True)
    lines = ["# Camera list", *(f"{number} {lens}" for number, lens in enumerate(lenses, 1))]
    (folder / "cameras.txt").write_text("\n".join(lines))
    return folder / "cameras.txt"


@pytest.mark.long
def test_calibrated_lens_is_kept(photos, tmp_path, no_dense_points):
    lenses = write_lenses(tmp_path / "lenses", "OPENCV 640 480 600 600 320 240 0 0 0 0", LENS)
    capture = tmp_path / "room"
    # First without: features and matches are kept, and the lens is what counts from then on.
    assert command_line.main(["sfm", str(photos), "--out", str(capture)]) == EXIT_DONE
    (free,) = pycolmap.Reconstruction(capture / "sparse" / "0").cameras.values()
    assert free.params[0] != FOCAL
    assert command_line.main(["sfm", str(photos), "--out", str(capture), "--calibration", str(lenses)]) == EXIT_DONE
    (camera,) = pycolmap.Reconstruction(capture / "sparse" / "0").cameras.values()
    assert camera.model.name == "OPENCV" and [float(value) for value in LENS.split()[3:]] == list(camera.params)
    degrees, positions = pose_errors(capture, ring())
    assert len(degrees) == len(ring()) and np.median(degrees) < 0.1 and np.median(positions) < 0.002


@pytest.mark.parametrize(
    ("lenses", "sentence"),
    [
        (["OPENCV 640 480 600 600 320 240 0 0 0 0"], f"has no camera of {WIDTH}x{HEIGHT} pixels"),
        ([LENS, LENS], f"has several cameras of {WIDTH}x{HEIGHT} pixels"),
        ([], "contains no camera"),
        (["OPENCV 640 480 600"], "parameters of OPENCV"),
        (["OPENCV 640 480 nan 600 320 240 0 0 0 0"], "parameters that are not numbers"),
    ],
)
def test_calibrations_that_do_not_fit_are_refused(photos, tmp_path, run_command, lenses, sentence):
    write_lenses(tmp_path / "lenses", *lenses)
    result = run_command("sfm", photos, "--out", tmp_path / "room", "--calibration", tmp_path / "lenses")
    assert_rejected(result, sentence, "lenses")
    assert not (tmp_path / "room" / "sparse").exists()


def test_calibration_must_exist(photos, tmp_path, run_command):
    result = run_command("sfm", photos, "--out", tmp_path / "room", "--calibration", tmp_path / "none")
    assert_rejected(result, "is not a calibration")
    assert not (tmp_path / "room").exists()


def both(matrices) -> dict[str, np.ndarray]:
    """Return the poses of a rig's two cameras by name."""
    found = {}
    for number, matrix in enumerate(matrices):
        found[f"left/{number}.png"] = matrix
        found[f"right/{number}.png"] = np.column_stack(
            [BESIDE[:, :3] @ matrix[:, :3], BESIDE[:, :3] @ matrix[:, 3] + BESIDE[:, 3]]
        )
    return found


@pytest.fixture(scope="module")
def pairs(tmp_path_factory, module_without_dense_points):
    """The capture of a rig of two cameras."""
    folder = tmp_path_factory.mktemp("rig")
    for name, matrix in both(ring(5)).items():
        path = folder / "photos" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(photo(matrix)).save(path)
    assert command_line.main(["sfm", str(folder / "photos"), "--out", str(folder / "capture")]) == EXIT_DONE
    return folder / "capture"


@pytest.mark.long
def test_cameras_of_a_rig_keep_their_relative_pose(pairs):
    model = pycolmap.Reconstruction(pairs / "sparse" / "0")
    poses = {model.image(i).name: model.image(i).cam_from_world().matrix() for i in model.reg_image_ids()}
    relative = [poses[f"right/{i}.png"][:, :3] @ poses[f"left/{i}.png"][:, :3].T for i in range(5)]
    assert np.ptp(relative, axis=0).max() < 1e-9
    assert json.loads((pairs / "sfm" / "sfm.json").read_text())["rigs"] == [["left/", "right/"]]
    true = both(ring(5))
    degrees, positions = pose_errors(pairs, list(true.values()), list(true))
    assert len(degrees) == 10 and np.median(degrees) < 0.2 and np.median(positions) < 0.003


def test_photo_without_pose_gets_that_of_its_rig(pairs):
    model = pycolmap.Reconstruction(pairs / "sfm" / "chosen")
    (lost,) = (image for image in model.images.values() if image.name == "right/3.png")
    before = lost.cam_from_world().matrix()
    model.deregister_frame(lost.frame_id)
    assert rig.tie_rigs(model) == [["left/", "right/"]] == rig.rigs_of(model)
    (found,) = (image for image in model.images.values() if image.name == "right/3.png")
    assert np.abs(found.cam_from_world().matrix() - before).max() < 0.05


def test_photo_that_matches_nothing_gets_the_pose_of_its_rig(pairs, tmp_path):
    model = pycolmap.Reconstruction(pairs / "sfm" / "chosen")
    (lost,) = (image for image in model.images.values() if image.name == "right/3.png")
    before = lost.cam_from_world().matrix()
    lost.name = "other/3.png"
    names = [*(image.name for image in model.images.values()), "right/3.png"]
    path = shutil.copyfile(pairs / "sfm" / "database.db", tmp_path / "database.db")
    assert not worker.left_out(model, str(path), names), "its matches contradict the pose that it had"
    with closing(sqlite3.connect(path)) as opened, opened:
        opened.execute("DELETE FROM two_view_geometries")
    assert not worker.left_out(model, str(path), names[:-1]), "it is not used"
    (photo,) = worker.left_out(model, str(path), names)
    assert (photo.name, photo.camera_id) == ("right/3.png", lost.camera_id)
    photo.image_id = 100
    alone = pycolmap.Image(name="right/9.png", camera_id=lost.camera_id, image_id=101)
    other = pycolmap.Image(name="right/4.png", camera_id=lost.camera_id % 2 + 1, image_id=102)
    assert rig.tie_rigs(model, [photo, alone, other]) == [["left/", "right/"]]
    assert np.abs(model.image(100).cam_from_world().matrix() - before).max() < 0.05
    assert model.num_images() == 11 == model.num_reg_images()


@pytest.mark.parametrize("second", ["right/", "left/right/"])
def test_photos_in_a_folder_inside_one_of_a_rig_are_not_of_it(pairs, second):
    model = pycolmap.Reconstruction(pairs / "sfm" / "chosen")
    for image in model.images.values():
        image.name = image.name.replace("right/4.png", "left/close/4.png").replace("right/", second)
    before = centers_of(model)
    assert rig.tie_rigs(model) == [["left/", second]] == rig.rigs_of(model)
    after = centers_of(model)
    assert after.keys() == before.keys() and "left/close/4.png" in after
    assert after["left/close/4.png"] == pytest.approx(before["left/close/4.png"])


def test_cameras_that_move_on_their_own_are_no_rig(pairs):
    model = pycolmap.Reconstruction(pairs / "sfm" / "chosen")
    # The same names, but of other moments.
    names = {f"right/{i}.png": f"right/{(i * 2 + 1) % 5}.png" for i in range(5)}
    for image in model.images.values():
        image.name = names.get(image.name, image.name)
    assert rig.tie_rigs(model) == [] == rig.rigs_of(model)
