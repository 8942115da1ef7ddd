"""Cameras of other programs: the same views and points as from COLMAP, and bad files."""

from __future__ import annotations

import csv
import io
import json
import os
import re
import shutil
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image

from backend.capture import check_capture, load_capture
from backend.capture.models import Photos, read_capture_model
from backend.capture.models.lens import brown
from backend.capture.models.point_cloud import read_point_cloud
from backend.shared.errors import EXIT_BAD_INPUT, EXIT_DONE, InputError
from backend.training.exposure.gains import measure_gains, varies

from .command_result import assert_rejected
from .other_models import (
    CHUNK,
    drop_colmap,
    write_bundler,
    write_metashape,
    write_ply,
    write_realityscan,
    write_transforms,
)

OPENCV = [90.0, 92.0, 47.0, 36.5, 0.05, -0.02, 0.001, 0.002]
EQUAL = [90.0, 90.0, 47.0, 36.5, 0.05, -0.02, 0.001, 0.002]
FISHEYE = [70.0, 71.0, 47.5, 36.5, 0.02, 0.01, 0.001, 0.0005]
RADIAL = [90.0, 48.0, 36.0, 0.05, -0.02]
APPLIED = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])
"""What nerfstudio applies to COLMAP's coordinates."""


WRITERS = {
    "transforms.json": lambda scene: write_transforms(scene, points=None),
    "bundle.out": lambda scene: write_bundler(scene, points=False),
    "cameras.csv": lambda scene: write_realityscan(scene, points=None),
    "cameras.xml": write_metashape,
}


def loaded(scene, tmp_path, name):
    return load_capture(scene.folder, tmp_path / name)


def assert_same(found, wanted, observations=False):
    """Check that two captures have the same views, images, masks and points, in any order."""
    assert [view.name for view in found.views] == [view.name for view in wanted.views]
    for index, (a, b) in enumerate(zip(found.views, wanted.views)):
        np.testing.assert_allclose(a.viewmat, b.viewmat, atol=1e-9)
        np.testing.assert_allclose(a.K, b.K, atol=1e-6)
        assert (a.width, a.height) == (b.width, b.height)
        assert np.abs(found.image(index).astype(int) - wanted.image(index)).max() <= 1
        assert (found.mask(index) == wanted.mask(index)).mean() > 0.999
        if observations:
            mine, theirs = found.keypoints(index), wanted.keypoints(index)
            order, others = np.argsort(mine.point_index), np.argsort(theirs.point_index)
            np.testing.assert_array_equal(mine.point_index[order], theirs.point_index[others])
            np.testing.assert_allclose(mine.xy[order], theirs.xy[others], atol=1e-6)
    np.testing.assert_allclose(found.points.xyz, wanted.points.xyz, atol=1e-9)
    np.testing.assert_array_equal(found.points.rgb, wanted.points.rgb)
    assert found.warnings == wanted.warnings and found.counts["used"] == wanted.counts["used"]


def assert_refused(run_command, folder: Path, tmp_path: Path, *words: str) -> str:
    """Check that `check` and `import` refuse a capture with one sentence and exit code 2, and leave nothing behind."""
    before = sorted(folder.rglob("*"))
    sentence = assert_rejected(run_command("check", folder), *words)
    assert len(sentence) < 700
    out = tmp_path / "new" / "out"
    assert assert_rejected(run_command("import", folder, "--out", out), *words)
    assert not out.parent.exists() and sorted(folder.rglob("*")) == before
    return sentence


# The same as from COLMAP


def per_frame(content):
    """Move the camera into the frames, as Polycam has it."""
    for frame in content["frames"]:
        frame.update({key: content[key] for key in ("fl_x", "fl_y", "cx", "cy", "w", "h")})
        frame["file_path"] = "./" + frame["file_path"].rpartition(".")[0]
    for key in ("fl_x", "fl_y", "cx", "cy", "w", "h"):
        del content[key]


def as_instant_ngp(content):
    """Use what instant-ngp writes: no model and no size, paths from another folder."""
    del content["camera_model"], content["w"], content["h"]
    for frame in content["frames"]:
        frame["file_path"] = "../data/scene/" + frame["file_path"]


def as_polynomial(content):
    content["k3"] = content["k4"] = 0.0
    content["camera_model"] = "opencv"


@pytest.mark.parametrize("edit", [lambda content: None, per_frame, as_instant_ngp, as_polynomial])
@pytest.mark.parametrize("applied", [None, APPLIED])
def test_transforms_give_the_same_capture(write_capture, tmp_path, edit, applied):
    scene = write_capture(views=9, model="OPENCV", params=OPENCV)
    wanted = loaded(scene, tmp_path, "colmap")
    drop_colmap(scene)
    write_transforms(scene, edit, applied=applied)
    assert_same(loaded(scene, tmp_path, "other"), wanted)


def test_transforms_of_fisheye(write_capture, tmp_path):
    scene = write_capture(model="OPENCV_FISHEYE", params=FISHEYE)
    wanted = loaded(scene, tmp_path, "colmap")
    drop_colmap(scene)

    def edit(content):
        content.update(zip(("k1", "k2", "k3", "k4"), FISHEYE[4:]))
        del content["p1"], content["p2"]
        content["camera_model"] = "OPENCV_FISHEYE"

    write_transforms(scene, edit)
    assert_same(loaded(scene, tmp_path, "other"), wanted)
    write_transforms(
        scene, lambda content: (edit(content), content.pop("camera_model"), content.update(is_fisheye=True))
    )
    assert_same(loaded(scene, tmp_path, "again"), wanted)


def test_transforms_of_full_opencv(write_capture, tmp_path):
    rest = (0.01, 0.03, -0.01, 0.005)
    scene = write_capture(model="FULL_OPENCV", params=[*OPENCV, *rest])
    wanted = loaded(scene, tmp_path, "colmap")
    drop_colmap(scene)
    write_transforms(
        scene, lambda content: content.update(zip(("k3", "k4", "k5", "k6"), rest), camera_model="FULL_OPENCV")
    )
    assert_same(loaded(scene, tmp_path, "other"), wanted)
    assert read_capture_model(scene.folder).cameras[1].params == (*OPENCV, *rest)


def test_transforms_with_angle_alone(write_capture, tmp_path):
    scene = write_capture()
    wanted = loaded(scene, tmp_path, "colmap")
    drop_colmap(scene)

    def edit(content):
        for key in ("fl_x", "fl_y", "cx", "cy", "w", "h"):
            del content[key]
        content["camera_angle_x"] = 2 * np.arctan(0.5)

    write_transforms(scene, edit)
    assert_same(loaded(scene, tmp_path, "other"), wanted)


@pytest.mark.parametrize("name", ["points3D.ply", "my cloud.ply"])
@pytest.mark.parametrize("transformed", [True, False])
def test_cloud_that_is_not_named_may_be_in_either_coordinates(write_capture, tmp_path, name, transformed):
    """A cloud beside transforms.json may have been transformed like the poses, or be COLMAP's."""
    scene = write_capture()
    applied = np.eye(4)
    applied[:3] = [[0, 0, 1, 40], [1, 0, 0, -30], [0, 1, 0, 20]]
    wanted = loaded(scene, tmp_path, "colmap")
    drop_colmap(scene)
    write_transforms(scene, points=None, applied=applied)
    write_ply(
        scene.folder / name, scene.xyz @ applied[:3, :3].T + applied[:3, 3] if transformed else scene.xyz, scene.rgb
    )
    assert_same(loaded(scene, tmp_path, "other"), wanted)


def test_sixth_order_and_eighth_order_coefficients(write_capture, tmp_path):
    scene = write_capture(model="FULL_OPENCV", params=[*OPENCV, 0.01, 0, 0, 0])
    wanted = loaded(scene, tmp_path, "colmap")
    drop_colmap(scene)
    write_transforms(scene, lambda content: content.update(k3=0.01))
    assert_same(loaded(scene, tmp_path, "other"), wanted)
    k, size = (0.05, -0.06, 0.03, 0.02), (4000, 3000)
    lens = brown((3000.0, 3010.0), (2010.0, 1490.0), k, (0.001, 0.002), size)
    camera = pycolmap.Camera(model=lens.model, width=size[0], height=size[1], params=list(lens.params))
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(-0.65, 0.65, 30), np.linspace(-0.5, 0.5, 30)))
    s = x * x + y * y
    factor = 1 + k[0] * s + k[1] * s**2 + k[2] * s**3 + k[3] * s**4
    u = x * factor + 2 * 0.001 * x * y + 0.002 * (s + 2 * x * x)
    v = y * factor + 2 * 0.002 * x * y + 0.001 * (s + 2 * y * y)
    projected = np.asarray(camera.img_from_cam(np.column_stack([x, y, np.ones_like(x)])))
    assert np.abs(projected - np.column_stack([3000 * u + 2010, 3010 * v + 1490])).max() < 0.1


@pytest.mark.parametrize(
    ("name", "listed"),
    [("bundle.out", "list.txt"), ("scene.bundle.out", "scene.list.txt"), ("a.out", "my photo list.txt")],
)
@pytest.mark.parametrize("params", [RADIAL, RADIAL[:4], RADIAL[:3]])
def test_bundler_gives_the_same_capture(write_capture, tmp_path, name, listed, params):
    model = ["SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"][len(params) - 3]
    scene = write_capture(views=9, model=model, params=params, names=[f"a {i}/photo.png" for i in range(9)])
    wanted = loaded(scene, tmp_path, "colmap")
    drop_colmap(scene)
    write_bundler(scene, name, listed)
    assert_same(loaded(scene, tmp_path, "other"), wanted, observations=True)


def test_bundler_without_points_or_poses(write_capture, tmp_path):
    scene = write_capture(views=9, model="RADIAL", params=RADIAL)
    wanted = loaded(scene, tmp_path, "colmap")
    drop_colmap(scene)
    path = write_bundler(scene, points=False)
    write_ply(scene.folder / "points3D.ply", scene.xyz, scene.rgb)
    assert_same(loaded(scene, tmp_path, "other"), wanted)
    lines = path.read_text().split("\n")
    lines[2:7] = ["0 0 0"] * 5
    path.write_text("\n".join(lines))
    (scene.folder / "list.txt").write_text("".join(f"C:\\shot\\{name} 0 90.5\n" for name in scene.names))
    found = loaded(scene, tmp_path, "again")
    assert [view.name for view in found.views] == scene.names[1:]
    assert any("1 of 9 photos in" in warning for warning in found.warnings)


@pytest.mark.parametrize("header", ["", "#cameras 9\r\n"])
def test_realityscan_gives_the_same_capture(write_capture, tmp_path, header):
    scene = write_capture(views=9, model="OPENCV", params=EQUAL)
    wanted = loaded(scene, tmp_path, "colmap")
    drop_colmap(scene)
    path = write_realityscan(scene)
    path.write_text(header + path.read_text("utf-8-sig"))
    assert_same(loaded(scene, tmp_path, "other"), wanted)


def test_realityscan_angles_are_those_of_its_documentation(write_capture):
    """Level cameras: heading 0 looks north, 90 east; pitch 90 is level, 0 looks down; the roll turns clockwise."""
    scene = write_capture(views=4)
    drop_colmap(scene)
    write_realityscan(scene)
    rows = [["#name", "x", "y", "alt", "heading", "pitch", "roll", "f"]]
    rows += [
        [name, 1, 2, 3, *angles, 36]
        for name, angles in zip(scene.names, [(0, 90, 0), (90, 90, 0), (0, 0, 0), (180, 90, 0)])
    ]
    text = io.StringIO()
    csv.writer(text).writerows(rows)
    (scene.folder / "cameras.csv").write_text(text.getvalue())
    ahead = np.array([[1, 12, 3], [11, 2, 3], [1, 2, -7], [1, -8, 3]])
    write_ply(scene.folder / "cloud.ply", ahead, np.zeros((4, 3), int))
    images = {image.name: image for image in read_capture_model(scene.folder).images}
    forward = [images[name].viewmat[2, :3] for name in scene.names]
    np.testing.assert_allclose(forward, [[0, 1, 0], [1, 0, 0], [0, 0, -1], [0, -1, 0]], atol=1e-12)
    np.testing.assert_allclose(images[scene.names[0]].viewmat[1, :3], [0, 0, -1], atol=1e-12)
    np.testing.assert_allclose(
        [images[name].viewmat @ [1, 2, 3, 1] for name in scene.names], [[0, 0, 0, 1]] * 4, atol=1e-12
    )


@pytest.mark.parametrize("newer", [False, True])
@pytest.mark.parametrize("cloud", ["world", "chunk", "obj"])
def test_metashape_gives_the_same_capture(write_capture, tmp_path, newer, cloud):
    scene = write_capture(views=9, model="OPENCV", params=OPENCV)
    wanted = loaded(scene, tmp_path, "colmap")
    drop_colmap(scene)
    write_metashape(scene, newer=newer)
    if cloud == "obj":
        lines = ["# points", "mtllib a.mtl"]
        lines += [
            f"v {x!r} {y!r} {z!r} {r / 255!r} {g / 255!r} {b / 255!r}"
            for (x, y, z), (r, g, b) in zip(scene.xyz.tolist(), scene.rgb.tolist())
        ]
        (scene.folder / "cloud.obj").write_text("\n".join([*lines, "f 1 2 3"]))
    else:
        inverse = np.linalg.inv(CHUNK) if cloud == "chunk" else np.eye(4)
        write_ply(scene.folder / "cloud.ply", scene.xyz @ inverse[:3, :3].T + inverse[:3, 3], scene.rgb)
    assert_same(loaded(scene, tmp_path, "other"), wanted)


AROUND = [(1, (0.0, 0.0, 0.0), 0.7), (2, (5.0, 0.3, 3.0), 0.9), (5, (-4.0, 0.2, 5.0), 0.9), (3, (-3.0, 0.0, -5.0), 0.9)]
"""Spheres among the cameras and behind them, so that each view has a part of them."""


def write_colored(write_capture):
    """Write a scene whose points have colors of its photos."""
    scene = write_capture(views=9, points=150, spheres=AROUND)
    scene.rgb = np.stack([np.full_like(scene.point_objects, 90), scene.point_objects * 40, scene.point_objects], 1)
    drop_colmap(scene)
    return scene


def placed(matrix, xyz):
    return xyz @ matrix[:3, :3].T + matrix[:3, 3]


@pytest.mark.parametrize("scale", [0.1, 0.4, 2.5])
@pytest.mark.parametrize("within", ["world", "chunk"])
def test_metashape_point_cloud_is_placed_by_its_colors(write_capture, scale, within):
    """A scale alone, as scale bars give it, must not shrink the cloud into the middle of all views."""
    scene = write_colored(write_capture)
    chunk = np.diag([scale, scale, scale, 1.0])
    write_metashape(scene, chunk=chunk)
    xyz = scene.xyz if within == "world" else placed(np.linalg.inv(chunk), scene.xyz)
    write_ply(scene.folder / "cloud.ply", xyz, scene.rgb)
    np.testing.assert_allclose(read_capture_model(scene.folder).xyz, scene.xyz, atol=1e-9)


@pytest.mark.parametrize("scale", [0.1, 2.5])
@pytest.mark.parametrize("transformed", [True, False])
def test_point_cloud_beside_transforms_is_placed_by_its_colors(write_capture, scale, transformed):
    scene = write_colored(write_capture)
    applied = np.diag([scale, scale, scale, 1.0])
    write_transforms(scene, points=None, applied=applied)
    write_ply(scene.folder / "cloud.ply", placed(applied, scene.xyz) if transformed else scene.xyz, scene.rgb)
    np.testing.assert_allclose(read_capture_model(scene.folder).xyz, scene.xyz, atol=1e-9)


@pytest.mark.parametrize("kind", ["fisheye", "equidistant_fisheye"])
def test_metashape_of_fisheye(write_capture, tmp_path, kind):
    scene = write_capture(model="OPENCV_FISHEYE", params=FISHEYE)
    wanted = loaded(scene, tmp_path, "colmap")
    drop_colmap(scene)
    path = write_metashape(scene, kind=kind)
    write_ply(scene.folder / "cloud.ply", scene.xyz, scene.rgb)
    assert_same(loaded(scene, tmp_path, "other"), wanted)
    scene = write_capture(
        name="prism", model="THIN_PRISM_FISHEYE", params=[*FISHEYE[:6], 0.002, 0.003, *FISHEYE[6:], 0, 0]
    )
    wanted = loaded(scene, tmp_path, "colmap2")
    drop_colmap(scene)
    # P1 is p2, and P2 is p1.
    (scene.folder / path.name).write_text(path.read_text().replace("</k4>", "</k4><p1>0.003</p1><p2>0.002</p2>"))
    write_ply(scene.folder / "cloud.ply", scene.xyz, scene.rgb)
    assert_same(loaded(scene, tmp_path, "other2"), wanted)


def test_metashape_cameras_that_are_not_used_are_reported(write_capture, tmp_path):
    scene = write_capture(views=9, model="OPENCV", params=OPENCV)
    drop_colmap(scene)
    path = write_metashape(scene, newer=True)
    write_ply(scene.folder / "cloud.ply", scene.xyz, scene.rgb)
    text = path.read_text().replace('label="view_001" component_id="0"', 'label="view_001" component_id="7"')
    text = text.replace('label="view_002"', 'enabled="false" label="view_002"')
    text = re.sub(r'(label="view_003"[^>]*>)<transform>.*?</transform>', r"\1", text)
    path.write_text(text)
    found = loaded(scene, tmp_path, "other")
    assert [view.name for view in found.views] == [scene.names[i] for i in (0, 4, 5, 6, 7, 8)]
    assert any("3 of 9 cameras" in warning and "largest component" in warning for warning in found.warnings)


def test_point_cloud_of_a_map_is_told_to_be_exported_in_local_coordinates(write_capture, run_command, tmp_path):
    """Metashape places chunks with GPS by coordinates from the Earth's center, and exports clouds in those of a map."""
    scene = write_capture(model="OPENCV", params=OPENCV)
    drop_colmap(scene)
    chunk = CHUNK.copy()
    chunk[:3, 3] = 3.9e6, 0.7e6, 5.0e6
    path = write_metashape(scene, chunk=chunk)
    write_ply(scene.folder / "cloud.ply", scene.xyz + np.array([5e5, 5.4e6, 300.0]), scene.rgb)
    words = (str(path), "cloud.ply", "in the chunk's local coordinates, not in those of a map")
    assert_refused(run_command, scene.folder, tmp_path, *words)
    write_ply(scene.folder / "cloud.ply", placed(np.linalg.inv(chunk), scene.xyz), scene.rgb)
    np.testing.assert_allclose(read_capture_model(scene.folder).xyz, scene.xyz, atol=1e-6)


@pytest.mark.parametrize(
    ("sensor", "why"),
    [
        ('<sensor id="8" label="360" type="spherical"/>', "the camera type spherical for the sensor 360"),
        ('<sensor id="8" label="scan" type="frame"/>', "no calibration for the sensor scan"),
    ],
)
def test_metashape_cameras_without_a_usable_lens_are_left_out(write_capture, tmp_path, sensor, why):
    scene = write_capture(views=9, model="OPENCV", params=OPENCV)
    drop_colmap(scene)
    path = write_metashape(scene, newer=True)
    write_ply(scene.folder / "cloud.ply", scene.xyz, scene.rgb)
    text = path.read_text().replace("<sensors>", f"<sensors>{sensor}")
    for number in range(6):
        text = text.replace(f'<camera id="{number}" sensor_id="3"', f'<camera id="{number}" sensor_id="8"')
    path.write_text(text)
    found = loaded(scene, tmp_path, "other")
    assert [view.name for view in found.views] == scene.names[6:]
    warning = next(warning for warning in found.warnings if why in warning)
    assert "6 of 9 cameras" in warning and not any("disabled" in warning for warning in found.warnings)


def test_cameras_of_a_rig_without_an_own_pose_are_explained(write_capture, tmp_path):
    scene = write_capture(views=4, model="OPENCV", params=OPENCV)
    drop_colmap(scene)
    path = write_metashape(scene)
    write_ply(scene.folder / "cloud.ply", scene.xyz, scene.rgb)
    path.write_text(re.sub(r'(label="view_003")[^>]*>.*?</transform>', r'\1 master_id="0">', path.read_text()))
    assert any(
        "or have only the pose of another camera of their rig" in w for w in loaded(scene, tmp_path, "a").warnings
    )


def test_two_images_that_fit_one_photo_are_refused_by_what_the_file_calls_them(write_capture):
    scene = write_capture(views=4)
    drop_colmap(scene)

    def of_two_cameras(content):
        for frame, place in zip(content["frames"], ("cam1/0.png", "cam2/0.png", "1.png", "2.png")):
            frame["file_path"] = place

    for number, name in enumerate(scene.names[:3]):
        (scene.folder / "images" / name).rename(scene.folder / "images" / f"{number}.png")
    write_transforms(scene, of_two_cameras)
    with pytest.raises(
        InputError, match=r"both cam1/0\.png and cam2/0\.png, which fit the same photo, 0\.png; put the"
    ):
        read_capture_model(scene.folder)


def test_names_that_fit_several_photos_are_reported(write_capture, tmp_path):
    """Cameras number photos anew in each folder."""
    scene = write_capture(views=4)
    drop_colmap(scene)
    write_realityscan(scene)
    images = scene.folder / "images"
    for folder in ("100MEDIA", "101MEDIA"):
        (images / folder).mkdir()
        for name in scene.names:
            shutil.copy(images / name, images / folder / name)
    for name in scene.names[:2]:
        (images / name).unlink()
    found = loaded(scene, tmp_path, "some")
    assert [view.name for view in found.views] == scene.names[2:]
    several = f"{scene.names[0]} both 100MEDIA/{scene.names[0]} and 101MEDIA/{scene.names[0]}"
    assert any(warning.startswith("2 images") and several in warning for warning in found.warnings)
    for name in scene.names[2:]:
        (images / name).unlink()
    with pytest.raises(InputError, match=f"4 images .*{several}"):
        loaded(scene, tmp_path, "none")


@pytest.mark.parametrize("beside", [False, True])
def test_images_that_are_no_photos_do_not_count(beside, write_capture):
    """Thumbnails of a NAS and, where photos are beside the cameras, kept masks and renders of a reconstruction."""
    scene = write_capture(views=4)
    folders = [".thumbs", "@eaDir", "day/@eaDir"]
    images = scene.folder / "images"
    if beside:
        drop_colmap(scene)
        write_transforms(scene)
        for path in images.iterdir():
            path.rename(scene.folder / path.name)
        images.rmdir()
        images = scene.folder
        folders += ["masks-given", "masks-segments", "sfm/photos", "garden/views"]
    for folder in folders:
        (images / folder).mkdir(parents=True)
        Image.new("RGB", (64, 48)).save(images / folder / f"{scene.names[0]}.png")
    if beside:
        (scene.folder / "garden" / "objectgs.json").write_text("{}")
    assert not [text for text in check_capture(scene.folder)["warnings"] if "are not in the model" in text]
    assert sorted(Photos(scene.folder).names) == sorted(scene.names)


def test_photos_may_lie_beside_the_cameras(write_capture, tmp_path):
    """As RealityScan and NeRF datasets have it; masks are never taken for photos."""
    scene = write_capture(views=4)
    wanted = loaded(scene, tmp_path, "colmap")
    drop_colmap(scene)
    write_realityscan(scene)
    for index in range(4):
        wanted.image(index)  # It is cached, since the photos move.
    for path in (scene.folder / "images").iterdir():
        path.rename(scene.folder / path.name)
    (scene.folder / "images").rmdir()
    found = loaded(scene, tmp_path, "other")
    assert_same(found, wanted)
    assert found.views[0].image_file == scene.folder / scene.names[0]
    (scene.folder / scene.names[1]).unlink()
    found = loaded(scene, tmp_path, "again")
    assert [view.name for view in found.views] == [scene.names[i] for i in (0, 2, 3)]
    assert found.counts["missing"] == 1 and found.counts["registered"] == 4
    assert any("1 of 4 images in the model are not in" in w and scene.names[1] in w for w in found.warnings)


@pytest.mark.parametrize("model", ["PINHOLE", "OPENCV"])
def test_images_observe_points_that_are_not_hidden(write_capture, tmp_path, model):
    scene = write_capture(views=6, points=400, model=model, params=None if model == "PINHOLE" else OPENCV)
    drop_colmap(scene)
    write_transforms(scene)
    found = loaded(scene, tmp_path, "cache")
    for index in range(6):
        keypoints, seen = found.keypoints(index), scene.seen[index]
        right = np.isin(keypoints.point_index, seen)
        assert right.mean() > 0.9 and right.sum() > 0.5 * len(seen)
        where = dict(zip(seen.tolist(), scene.pixels[index]))
        raw = found._raw[index][1]
        np.testing.assert_allclose(raw.xy[right], [where[i] for i in raw.point_index[right].tolist()], atol=1e-6)


def test_lens_that_folds_over_observes_only_its_view(write_capture):
    scene = write_capture(views=3)
    drop_colmap(scene)
    write_transforms(scene, changed("k1", -0.8))
    model = read_capture_model(scene.folder)
    for image in model.images:
        local = model.xyz[image.point_index] @ image.viewmat[:3, :3].T + image.viewmat[:3, 3]
        assert len(local) > 10 and (np.linalg.norm(local[:, :2] / local[:, 2:], axis=1) < (1 / 2.4) ** 0.5).all()


def test_exposure_is_measured_on_point_clouds(write_capture, tmp_path):
    scene = write_capture(views=9, points=150)
    drop_colmap(scene)
    write_transforms(scene)
    before = measure_gains(loaded(scene, tmp_path, "same"))
    for name in scene.names[2::2]:
        path = scene.folder / "images" / name
        Image.fromarray((np.asarray(Image.open(path)) * 0.6).astype(np.uint8)).save(path)
    change = measure_gains(loaded(scene, tmp_path, "other")) / before
    assert varies(change)
    assert np.median(change[[2, 4, 6]]) / np.median(change[[1, 3, 5, 7]]) == pytest.approx(0.6, abs=0.05)


def test_colmap_is_preferred(write_capture, tmp_path):
    scene = write_capture()
    (scene.folder / "transforms.json").write_text("{")
    assert len(loaded(scene, tmp_path, "cache").views) == 6


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("stray", ["cameras.txt", "images.txt"])
def test_stray_file_of_colmap_hides_no_other_format(write_capture, run_command, tmp_path, name, stray):
    """Metashape's Omega Phi Kappa and Bundler's list may be called so."""
    scene = write_capture(model="RADIAL", params=RADIAL) if name == "bundle.out" else write_capture()
    drop_colmap(scene)
    (scene.folder / stray).write_text("# PhotoID, X, Y, Z, Omega, Phi, Kappa\n")
    assert_refused(run_command, scene.folder, tmp_path, "a COLMAP model needs cameras, images and points3D")
    WRITERS[name](scene)
    write_ply(scene.folder / "points3D.ply", scene.xyz, scene.rgb)
    assert len(loaded(scene, tmp_path, "cache").views) == 6


@pytest.mark.parametrize("suffix", [".bin", ".txt"])
@pytest.mark.parametrize("start", ["images/", "/home/me/mug/images/", "C:\\mug\\images\\", "../mug/"])
def test_colmap_may_name_images_from_another_folder(write_capture, tmp_path, suffix, start):
    names = [f"{side}/{number}.png" for side in ("left", "right") for number in range(3)]
    scene = write_capture(names=names, suffix=suffix)
    wanted = loaded(scene, tmp_path, "right")
    scene.names = [start + name for name in names]
    write_capture.write_model(scene, scene.folder / "sparse" / "0", suffix)
    assert_same(loaded(scene, tmp_path, "other"), wanted, observations=True)
    (scene.folder / "images" / names[1]).unlink()
    found = loaded(scene, tmp_path, "fewer")
    assert [view.name for view in found.views] == [names[0], *names[2:]] and found.counts["missing"] == 1


def test_images_of_other_folders_are_not_mistaken_for_each_other(write_capture, run_command, tmp_path):
    scene = write_capture(views=4)
    scene.names = ["a/view_000.png", "b/view_000.png", "a/view_001.png", "b/view_001.png"]
    write_capture.write_model(scene, scene.folder / "sparse" / "0", ".bin")
    assert_refused(run_command, scene.folder, tmp_path, "none of the 4 images")


def test_dense_clouds_are_thinned_out(write_capture, tmp_path, monkeypatch):
    monkeypatch.setattr("backend.capture.models.point_cloud._MOST_POINTS", 50)
    scene = write_capture()
    drop_colmap(scene)
    write_transforms(scene)
    found = loaded(scene, tmp_path, "cache")
    assert len(found.points.xyz) == 50 and any("180 points, of which 50" in warning for warning in found.warnings)


@pytest.mark.parametrize("text", [False, True])
def test_points_of_dense_clouds_are_read_in_blocks(tmp_path, monkeypatch, text):
    """All points of a laser scan would not fit into memory."""
    monkeypatch.setattr("backend.capture.models.point_cloud._MOST_POINTS", 50)
    monkeypatch.setattr("backend.shared.formats.ply._BLOCK", 7)
    xyz, warnings = np.arange(480.0).reshape(160, 3), []
    rgb = np.arange(480).reshape(160, 3) // 2
    write_ply(tmp_path / "cloud.ply", xyz, rgb, text)
    found = read_point_cloud(tmp_path / "cloud.ply", warnings)
    rows = np.linspace(0, 159, 50).astype(int)
    assert (found.xyz == xyz[rows]).all() and (found.rgb == rgb[rows]).all()
    assert "160 points, of which 50" in warnings[0]


@pytest.mark.parametrize("kind", ["u2", "f4", "none"])
def test_colors_of_clouds_have_any_type(write_capture, tmp_path, kind):
    scene = write_capture()
    drop_colmap(scene)
    write_transforms(scene, points=None)
    fields = [(axis, "<f8") for axis in "xyz"]
    if kind != "none":
        fields += [(channel, "<" + kind) for channel in ("red", "green", "blue")]
    table = np.zeros(len(scene.xyz), fields)
    for i, axis in enumerate("xyz"):
        table[axis] = scene.xyz[:, i]
    if kind != "none":
        for i, channel in enumerate(("red", "green", "blue")):
            table[channel] = scene.rgb[:, i] * 257.0 if kind == "u2" else scene.rgb[:, i] / 255
    words = {"<f8": "double", "<u2": "ushort", "<f4": "float"}
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    lines += [f"property {words[field]} {name}" for name, field in fields]
    (scene.folder / "points3D.ply").write_bytes("\n".join([*lines, "end_header\n"]).encode() + table.tobytes())
    found = loaded(scene, tmp_path, "cache")
    np.testing.assert_array_equal(found.points.rgb, np.full_like(scene.rgb, 128) if kind == "none" else scene.rgb)


def test_commands_take_captures_of_other_programs(write_capture, run_command, tmp_path):
    scene = write_capture(views=9, size=(64, 48), model="OPENCV", params=[60.0, 60.0, 32, 24, 0.01, 0, 0, 0])
    drop_colmap(scene)
    write_realityscan(scene)
    result = run_command("check", scene.folder, "--json")
    assert result.code == EXIT_DONE and result.events[-1]["check"]["points"] == 180
    out = tmp_path / "out"
    for command in ("import", "plan", "vote"):
        assert run_command(command, scene.folder, "--out", out).code == EXIT_DONE
    assert [entry["id"] for entry in json.loads((out / "objects.json").read_text())["objects"]] == [1, 2, 5]
    result = run_command("train", scene.folder, "--out", out, "--steps", 3, "--offsets", 3)
    assert result.code == EXIT_DONE, result.err
    assert run_command("evaluate", out).code == EXIT_DONE


# Bad input


def changed(key, value):
    return lambda content: content.update({key: value})


def in_frame(key, value):
    return lambda content: content["frames"][1].update({key: value})


def without(*keys):
    return lambda content: [content.pop(key, None) for key in keys]


BAD_TRANSFORMS = {
    "no list": (changed("frames", {"a": 1}), ("frames",)),
    "no frames": (changed("frames", []), ("no image with a pose",)),
    "no path": (in_frame("file_path", 7), ("no file_path in frame 2",)),
    "no matrix": (in_frame("transform_matrix", None), ("4 x 4", "view_001")),
    "ragged matrix": (in_frame("transform_matrix", [[1, 0], [2]]), ("4 x 4", "view_001")),
    "text in matrix": (in_frame("transform_matrix", [["a"] * 4] * 4), ("4 x 4", "view_001")),
    "last row": (in_frame("transform_matrix", np.full((4, 4), 2).tolist()), ("last row", "view_001")),
    "zero matrix": (in_frame("transform_matrix", [[0] * 4] * 3), ("view_001", "pose that is not a number")),
    "flat matrix": (in_frame("transform_matrix", [[1, 0, 0, 0], [0, 1, 0, 0], [0, 1, 0, 0]]), ("view_001", "pose")),
    "sheared": (in_frame("transform_matrix", [[1, 0.5, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]), ("not a rotation",)),
    "mirrored": (in_frame("transform_matrix", [[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]), ("mirrored",)),
    "far": (in_frame("transform_matrix", [[1, 0, 0, 1e300], [0, 1, 0, 0], [0, 0, 1, 0]]), ("view_001", "beyond")),
    "same photo": (in_frame("file_path", "images/view_000.png"), ("two images named view_000.png",)),
    "model": (changed("camera_model", "EQUIRECTANGULAR"), ("EQUIRECTANGULAR", "PINHOLE")),
    "model type": (changed("camera_model", {"a": "\n" * 900}), ("camera_model",)),
    "focal": (changed("fl_x", "90"), ("fl_x", "not a number")),
    "no focal": (without("fl_x", "fl_y"), ("camera_angle_x",)),
    "huge number": (changed("fl_x", 10**400), ("fl_x",)),
    "infinite": (changed("cx", 1e999), ("parameters", "infinite")),
    "size": (changed("w", 10**9), ("size",)),
    "other size": (changed("w", 100), ("view_000.png", "96x72")),
    "zero size": (changed("h", 0), ("impossible size",)),
    "focal of a needle": (changed("fl_x", 1e-300), ("degenerate",)),
    "eighth order": (changed("k4", 1e9), ("lens",)),
    "applied": (changed("applied_transform", [[0] * 4] * 3), ("applied_transform",)),
    "applied text": (changed("applied_transform", "none"), ("applied_transform",)),
    "cloud outside": (changed("ply_file_path", "../points.ply"), ("lies outside",)),
    "cloud at root": (changed("ply_file_path", "/etc/passwd"), ("lies outside",)),
    "cloud on drive": (changed("ply_file_path", "C:\\a.ply"), ("lies outside",)),
    "cloud type": (changed("ply_file_path", [1]), ("ply_file_path",)),
    "cloud is a folder": (changed("ply_file_path", "images"), ("images",)),
    "no photos": (
        lambda content: [f.update(file_path=f"x/{i}.png") for i, f in enumerate(content["frames"])],
        ("none of the 6",),
    ),
}


@pytest.mark.parametrize("what", BAD_TRANSFORMS)
def test_bad_transforms_are_refused(write_capture, run_command, tmp_path, what):
    scene = write_capture()
    drop_colmap(scene)
    edit, words = BAD_TRANSFORMS[what]
    path = write_transforms(scene, edit)
    if what == "infinite":
        path.write_text(path.read_text().replace("Infinity", "1e999"))
    sentence = assert_refused(run_command, scene.folder, tmp_path, *words)
    assert str(scene.folder) in sentence


@pytest.mark.parametrize("data", [b"", b"[]", b"{", b"\xff\xfe{", b'{"frames": [NaN]}', b"[" * 100_000])
def test_transforms_that_are_not_json_are_refused(write_capture, run_command, tmp_path, data):
    scene = write_capture()
    drop_colmap(scene)
    (scene.folder / "transforms.json").write_bytes(data)
    assert_refused(run_command, scene.folder, tmp_path, "transforms.json")


def test_photos_outside_are_never_read(write_capture, run_command, tmp_path):
    """A path out of the capture is taken for the photo in it that has the end of the path, or for a missing one."""
    scene = write_capture(views=4)
    outside = tmp_path / "outside.png"
    (scene.folder / "images" / "view_001.png").rename(outside)
    drop_colmap(scene)
    write_transforms(scene, in_frame("file_path", "../../outside.png"))
    found = loaded(scene, tmp_path, "cache")
    assert [view.name for view in found.views] == ["view_000.png", "view_002.png", "view_003.png"]
    write_transforms(scene, in_frame("file_path", str(outside)))
    assert found.counts["missing"] == 1 == loaded(scene, tmp_path, "again").counts["missing"]


@pytest.mark.parametrize("name", WRITERS)
def test_missing_points_are_asked_for(write_capture, run_command, tmp_path, name):
    scene = write_capture(model="OPENCV", params=EQUAL)
    drop_colmap(scene)
    WRITERS[name](scene)
    words = (str(scene.folder / name), "has no points: export", "PLY", str(scene.folder / "points3D.ply"))
    assert_refused(run_command, scene.folder, tmp_path, *words)
    whole = (scene.folder / name).read_text("utf-8-sig")
    (scene.folder / name).write_text(re.sub(r"view_(?=.*[,<\"])", "photo_", whole))
    (scene.folder / "list.txt").write_text("photo.png\n" * 6)
    assert_refused(run_command, scene.folder, tmp_path, "none of the 6 images")
    WRITERS[name](scene)
    write_ply(scene.folder / "a.ply", scene.xyz, scene.rgb)
    write_ply(scene.folder / "b.ply", scene.xyz, scene.rgb)
    assert_refused(run_command, scene.folder, tmp_path, "a.ply and b.ply", "points3D.ply")
    (scene.folder / "b.ply").unlink()
    assert check_capture(scene.folder)["problems"] == []
    write_ply(scene.folder / "a.ply", scene.xyz + np.array([0, 3000, 0]), scene.rgb)
    assert_refused(run_command, scene.folder, tmp_path, "Only 0% of the points", "a.ply", name, "same coordinates")
    write_ply(scene.folder / "a.ply", scene.xyz[:3], scene.rgb[:3])
    assert_refused(run_command, scene.folder, tmp_path, "a.ply", "only 3 points")


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"v 1 2\n", "three coordinates"),
        (b"v 1 2 3\nv a b c\n", "three coordinates"),
        (b"v 1 2 3\nv 1 2 3 1 1 1\n", "three coordinates"),
        (b"f 1 2 3\n", "only 0 points"),
        (b"v nan 2 3\n" * 9, "only 0 points"),
    ],
)
def test_bad_obj_clouds_are_refused(write_capture, run_command, tmp_path, data, words):
    scene = write_capture()
    drop_colmap(scene)
    write_transforms(scene, points=None)
    (scene.folder / "cloud.obj").write_bytes(data)
    assert_refused(run_command, scene.folder, tmp_path, "cloud.obj", words)


ASCII = (
    "ply\nformat ascii 1.0\nelement vertex {count}\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
)


@pytest.mark.parametrize(
    ("count", "rows", "words"),
    [
        (5, "1 2 3\n" * 4, "only 4 are there"),
        (10**12, "1 2 3\n" * 4, "is truncated"),
        (4, "1 2\n" * 4 + "1 2 3 4 5 6 7 8\n", "not 3 numbers"),
        (4, "1 2 3\n1 b 3\n" * 2, "not 3 numbers"),
        (4, "1 2 3\n1 2 3 4\n" * 2, "not 3 numbers"),
        (4, "inf 2 1e999\n" * 4, "only 0 points"),
    ],
)
def test_bad_ascii_clouds_are_refused(write_capture, run_command, tmp_path, count, rows, words):
    scene = write_capture()
    drop_colmap(scene)
    write_transforms(scene, points=None)
    (scene.folder / "points3D.ply").write_text(ASCII.format(count=count) + rows)
    assert_refused(run_command, scene.folder, tmp_path, "points3D.ply", words)


def edited_lines(*changes):
    """Return a change of a text's lines: (line number, new line or None to end the text before it)."""

    def edit(text: str) -> str:
        lines = text.split("\n")
        for number, line in changes:
            if line is None:
                lines = lines[: number - 1]
            else:
                lines[number - 1] = line
        return "\n".join(lines)

    return edit


BAD_BUNDLER = {
    "version": (edited_lines((1, "# Bundle file v0.2")), ("version 0.2", "0.3")),
    "counts": (edited_lines((2, "6")), ("line 2", "numbers of cameras and points")),
    "negative count": (edited_lines((2, "6 -1")), ("line 2",)),
    "huge count": (edited_lines((2, "6 1e18")), ("truncated",)),
    "fewer cameras": (edited_lines((2, "5 180")), ("list.txt names 6 photos", "5 cameras")),
    "text": (edited_lines((4, "1 0 x")), ("line 4", "camera")),
    "too few numbers": (edited_lines((4, "1 0")), ("line 4",)),
    "end": (edited_lines((40, None)), ("truncated",)),
    "NaN pose": (edited_lines((7, "nan 0 0")), ("view_000.png", "not a number")),
    "zero rotation": (edited_lines((4, "0 0 0"), (5, "0 0 0"), (6, "0 0 0")), ("view_000.png", "not a number")),
    "NaN focal length": (edited_lines((3, "nan 0 0")), ("parameters",)),
    "views": (edited_lines((35, "3 0 1 2 3")), ("line 35", "views")),
    "unknown camera": (edited_lines((35, "1 6 0 1 1")), ("line 35", "0 to 5")),
    "NaN views": (edited_lines((35, "nan")), ("line 35",)),
}


@pytest.mark.parametrize("what", BAD_BUNDLER)
def test_bad_bundler_files_are_refused(write_capture, run_command, tmp_path, what):
    scene = write_capture(model="RADIAL", params=RADIAL)
    drop_colmap(scene)
    path = write_bundler(scene)
    edit, words = BAD_BUNDLER[what]
    path.write_text(edit(path.read_text()))
    assert_refused(run_command, scene.folder, tmp_path, "bundle.out", *words)


def test_bundler_needs_its_list(write_capture, run_command, tmp_path):
    scene = write_capture(model="RADIAL", params=RADIAL)
    drop_colmap(scene)
    write_bundler(scene)
    (scene.folder / "list.txt").write_bytes(b"\xff\xfe\n" * 6)
    assert_refused(run_command, scene.folder, tmp_path, "list.txt", "UTF-8")
    (scene.folder / "list.txt").unlink()
    assert_refused(run_command, scene.folder, tmp_path, "bundle.out has no list of its photos", "list.txt")


BAD_CSV = {
    "columns": (
        lambda text: text.replace("heading,pitch,roll", "a,b,c"),
        ("no column heading, pitch, roll", "Internal"),
    ),
    "row": (edited_lines((3, "view_001.png,1,2")), ("line 3", "16 values")),
    "number": (lambda text: text.replace("view_002.png,", "view_002.png,x"), ("line 4", "numbers")),
    "NaN": (lambda text: re.sub(r"view_002.png,[^,]*", "view_002.png,nan", text), ("view_002.png", "not a number")),
    "infinite angle": (
        lambda text: re.sub(r"(view_002.png(,[^,]*){3}),[^,]*", r"\1,inf", text),
        ("view_002.png", "not a number"),
    ),
    "same photo": (lambda text: text.replace("view_002.png", "view_001.png"), ("two images",)),
    "focal": (
        lambda text: re.sub(r"(view_002.png(,[^,]*){6}),[^,]*", r"\1,inf", text),
        ("parameters that are not numbers",),
    ),
    "quote": (lambda text: text + '"' + "a" * 200_000 + ",", ("CSV",)),
    "no photo": (lambda text: text.replace("view_", "photo_"), ("none of the 6 images",)),
}


@pytest.mark.parametrize("what", BAD_CSV)
def test_bad_csv_files_are_refused(write_capture, run_command, tmp_path, what):
    scene = write_capture(model="OPENCV", params=EQUAL)
    drop_colmap(scene)
    path = write_realityscan(scene)
    edit, words = BAD_CSV[what]
    path.write_text(edit(path.read_text("utf-8-sig")))
    assert_refused(run_command, scene.folder, tmp_path, "cameras.csv", *words)
    path.write_bytes(path.read_bytes().replace(b"view_", b"vi\xe9w_"))
    if what != "no photo":
        assert_refused(run_command, scene.folder, tmp_path, "cameras.csv", "UTF-8")


def test_camera_without_focal_length_is_refused(write_capture):
    scene = write_capture(views=4, model="OPENCV", params=[90.0, 90.0, 47.0, 36.5, 0.0, 0.0, 0.0, 0.0])
    drop_colmap(scene)
    path = write_realityscan(scene)
    path.write_text(re.sub(r"(view_002.png(,[^,]*){6}),[^,]*", r"\1,0", path.read_text("utf-8-sig")))
    with pytest.raises(InputError, match="a focal length of 0"):
        read_capture_model(scene.folder)


BOMB = (
    '<!DOCTYPE document [<!ENTITY a "aaaaaaaaaa">'
    + "".join(f'<!ENTITY {chr(98 + i)} "{f"&{chr(97 + i)};" * 10}">' for i in range(9))
    + "]>"
)


def first_pose(text, start):
    """Insert text at the start of the first camera's pose."""
    return re.sub(r'(label="view_000"><transform>)', rf"\g<1>{start}", text)


BAD_XML = {
    "bomb": (
        lambda text: text.replace("<document", BOMB + "<document").replace('label="lens"', 'label="&j;"'),
        ("DTD",),
    ),
    "external entity": (
        lambda text: text.replace("<document", '<!DOCTYPE d [<!ENTITY a SYSTEM "file:///etc/passwd">]><document'),
        ("DTD",),
    ),
    "cut": (lambda text: text[: len(text) // 2], ("XML",)),
    "no cameras": (lambda text: text.replace("cameras>", "others>"), ("no chunk with cameras",)),
    "no poses": (lambda text: re.sub(r"<transform>[^<]*</transform>", "", text), ("no image with a pose", "Metashape")),
    "short pose": (lambda text: first_pose(text, "1 "), ("16 numbers", "view_000")),
    "text in pose": (lambda text: first_pose(text, "x"), ("16 numbers", "view_000")),
    "NaN pose": (lambda text: first_pose(text, "nan "), ("16 numbers", "view_000")),
    "infinite pose": (
        lambda text: re.sub(r'(label="view_000"><transform>)\S+', r"\1inf", text),
        ("view_000", "not a number"),
    ),
    "NaN chunk": (lambda text: re.sub(r"<scale>[^<]*", "<scale>nan", text), ("chunk", "not a number")),
    "zero scale": (lambda text: re.sub(r"<scale>[^<]*", "<scale>0", text), ("not a number",)),
    "no sensor": (lambda text: text.replace('<sensor id="3"', '<sensor id="4"'), ("sensor",)),
    "no calibration": (lambda text: re.sub(r"<calibration.*</calibration>", "", text), ("no calibration",)),
    "no size": (lambda text: text.replace('width="96"', 'width="wide"'), ("no resolution",)),
    "huge size": (lambda text: text.replace('width="96"', 'width="99999999999"'), ("impossible size",)),
    "no focal length": (lambda text: text.replace("<f>90.0", "<f>0"), ("no focal length",)),
    "spherical": (lambda text: text.replace('"frame"', '"spherical"'), ("spherical", "fisheye")),
    "equisolid": (lambda text: text.replace('"frame"', '"equisolid_fisheye"'), ("equisolid", "must be an equidistant")),
    "P3": (lambda text: text.replace("<b1>", "<p3>0.1</p3><b1>"), ("P3",)),
    "same photo": (lambda text: text.replace("view_001", "view_000"), ("two images",)),
}  # fmt: skip


@pytest.mark.parametrize("what", BAD_XML)
def test_bad_xml_files_are_refused(write_capture, run_command, tmp_path, what):
    scene = write_capture(model="OPENCV", params=EQUAL)
    drop_colmap(scene)
    path = write_metashape(scene)
    write_ply(scene.folder / "cloud.ply", scene.xyz, scene.rgb)
    edit, words = BAD_XML[what]
    path.write_text(edit(path.read_text()))
    assert_refused(run_command, scene.folder, tmp_path, "cameras.xml", *words)


def test_dtd_in_another_encoding_is_refused(write_capture, run_command, tmp_path):
    scene = write_capture(model="OPENCV", params=EQUAL)
    drop_colmap(scene)
    path = write_metashape(scene)
    text = path.read_text().replace("<document", BOMB + "<document").replace("UTF-8", "UTF-16")
    path.write_bytes(b"<document><chunk>" + text.encode("utf-16"))
    assert_refused(run_command, scene.folder, tmp_path, "cameras.xml")


def test_skew_is_reported(write_capture, tmp_path):
    scene = write_capture(model="OPENCV", params=EQUAL)
    drop_colmap(scene)
    path = write_metashape(scene)
    write_ply(scene.folder / "cloud.ply", scene.xyz, scene.rgb)
    path.write_text(path.read_text().replace("<b1>", "<b2>5</b2><b1>"))
    assert any("skew" in warning and "2.0" in warning for warning in loaded(scene, tmp_path, "cache").warnings)


def test_two_files_of_a_kind_are_refused(write_capture, run_command, tmp_path):
    scene = write_capture(model="OPENCV", params=EQUAL)
    drop_colmap(scene)
    write_realityscan(scene, "a.csv")
    write_realityscan(scene, "b.csv")
    (scene.folder / "prices.csv").write_text("item,price\nmug,3\n")
    assert_refused(run_command, scene.folder, tmp_path, "a.csv and b.csv", "leave only one")
    (scene.folder / "b.csv").unlink()
    assert check_capture(scene.folder)["problems"] == []


@pytest.mark.skipif(os.name != "posix", reason="Windows has no such files")
@pytest.mark.parametrize("name", [*WRITERS, "list.txt", "points3D.ply"])
@pytest.mark.parametrize("kind", ["pipe", "device", "folder"])
def test_special_files_are_refused(write_capture, run_command, tmp_path, name, kind):
    scene = write_capture(model="OPENCV", params=EQUAL)
    drop_colmap(scene)
    written = WRITERS["bundle.out" if name == "list.txt" else "transforms.json" if name == "points3D.ply" else name](
        scene
    )
    path = scene.folder / name
    path.unlink(missing_ok=True)
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    else:
        path.mkdir()
    words = (str(scene.folder),) if kind == "folder" and path == written else (name,)
    assert_refused(run_command, scene.folder, tmp_path, *words)


@pytest.mark.parametrize("name", WRITERS)
def test_damaged_files_raise_only_input_errors(write_capture, name):
    scene = write_capture(views=3, points=20, model="OPENCV", params=EQUAL)
    drop_colmap(scene)
    path = write_bundler(scene) if name == "bundle.out" else WRITERS[name](scene)
    if name != "bundle.out":
        write_ply(scene.folder / "points3D.ply", scene.xyz, scene.rgb)
    whole, rng, refusals = path.read_bytes(), np.random.default_rng(0), 0
    for trial in range(150):
        data = bytearray(whole)
        if trial % 2:
            data = data[: rng.integers(len(data))]
        for _ in range(trial % 5):
            if len(data):
                data[rng.integers(len(data))] = rng.integers(256)
        path.write_bytes(data)
        message = None
        try:
            read_capture_model(scene.folder)
        except InputError as error:
            message = str(error)
        if message is not None:
            refusals += 1
            assert message.endswith(".") and "\n" not in message
    assert refusals > 50
    path.write_bytes(whole)
    read_capture_model(scene.folder)


@pytest.mark.parametrize("within", ["", "images", "robot"])
def test_photos_alone_are_told_what_they_lack(write_capture, tmp_path, run_command, within):
    scene = write_capture()
    photos = tmp_path / "photos"
    (photos / within).mkdir(parents=True)
    for path in (scene.folder / "images").iterdir():
        (photos / within / path.name).write_bytes(path.read_bytes())
    result = run_command("import", photos, "--out", tmp_path / "out")
    assert result.code == EXIT_BAD_INPUT and "6 photos, but not where they were taken" in result.err


@pytest.mark.parametrize("name", ["images", "masks"])
def test_folder_of_photos_names_the_capture_above(write_capture, tmp_path, run_command, name):
    scene = write_capture()
    folder = scene.folder / name
    (folder / "left").mkdir(parents=True, exist_ok=True)
    result = run_command("import", folder, "--out", tmp_path / "out")
    assert result.code == EXIT_BAD_INPUT and f"choose the folder above, {scene.folder}." in result.err
    assert not (tmp_path / "out").exists()
