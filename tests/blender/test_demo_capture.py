# SPDX-License-Identifier: GPL-3.0-or-later
"""The demo capture: consistent files, and equal bytes for equal settings."""

import json
import shutil
import struct
import subprocess
import sys
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

from objectgs.backend.shared.errors import Cancelled, InputError
from objectgs.backend.shared.formats import atomic
from objectgs.objectgs_addon.demo import capture as demo_capture
from objectgs.objectgs_addon.demo import mask_noise

ROOT = Path(__file__).resolve().parents[2]
TINY = demo_capture.Settings(objects=7, views=4, width=64, height=48, samples=2)
SMALL = demo_capture.Settings(objects=7, views=12, width=160, height=120, samples=2)


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    """4 views of 64x48."""
    return demo_capture.make(tmp_path_factory.mktemp("demo") / "tiny", TINY)


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """12 views of 160x120: enough for tracks."""
    return demo_capture.make(tmp_path_factory.mktemp("demo") / "small", SMALL)


def read_png(path):
    """Decode the capture's PNGs: 8-bit or 16-bit gray and RGB, with the filters "none" and "up"."""
    data = path.read_bytes()
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    at, body, width, height, depth, color = 8, b"", 0, 0, 0, 0
    while at < len(data):
        size, kind = struct.unpack_from(">I4s", data, at)
        chunk = data[at + 8 : at + 8 + size]
        assert zlib.crc32(kind + chunk) == struct.unpack_from(">I", data, at + 8 + size)[0]
        if kind == b"IHDR":
            width, height, depth, color = struct.unpack_from(">IIBB", chunk)
        elif kind == b"IDAT":
            body += chunk
        at += 12 + size
    lines = np.frombuffer(zlib.decompress(body), np.uint8).reshape(height, -1)
    rows = lines[:, 1:].copy()
    for i in range(1, height):
        if lines[i, 0] == 2:
            rows[i] += rows[i - 1]
    if color == 2:
        return rows.reshape(height, width, 3)
    return rows if depth == 8 else rows.view(">u2").astype(np.uint16)


def read_model(folder):
    """Read a binary COLMAP model.

    Returns:
        ((w, h), (fx, fy, cx, cy)), images {id: (name, R, t, xy, point ids)}, points {id: (xyz, rgb, error, track)}.
    """
    data = (folder / "cameras.bin").read_bytes()
    count, _, model, width, height = struct.unpack_from("<QiiQQ", data)
    assert (count, model) == (1, 1)
    camera = (width, height), struct.unpack_from("<4d", data, 32)
    assert len(data) == 64

    data = (folder / "images.bin").read_bytes()
    (count,), at, images = struct.unpack_from("<Q", data), 8, {}
    for _ in range(count):
        number, w, x, y, z, *t, cam = struct.unpack_from("<i7di", data, at)
        assert cam == 1
        at += 64
        end = data.index(b"\0", at)
        name, at = data[at:end].decode(), end + 1
        (n,) = struct.unpack_from("<Q", data, at)
        table = np.frombuffer(data, np.dtype([("xy", "<f8", 2), ("id", "<i8")]), n, at + 8)
        at += 8 + 24 * n
        rotation = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        images[number] = (name, rotation, np.array(t), table["xy"], table["id"])
    assert at == len(data)

    data = (folder / "points3D.bin").read_bytes()
    (count,), at, points = struct.unpack_from("<Q", data), 8, {}
    for _ in range(count):
        number, x, y, z, r, g, b, error, n = struct.unpack_from("<Q3d3BdQ", data, at)
        track = np.frombuffer(data, "<i4", 2 * n, at + 51).reshape(-1, 2)
        at += 51 + 8 * n
        points[number] = (np.array([x, y, z]), (r, g, b), error, track)
    assert at == len(data)
    return camera, images, points


def read_ply(path):
    head, body = path.read_bytes().split(b"end_header\n", 1)
    words = head.split()
    n, f = int(words[words.index(b"vertex") + 1]), int(words[words.index(b"face") + 1])
    faces = np.frombuffer(body, np.dtype([("n", "u1"), ("v", "<i4", 3)]), f, 12 * n)
    assert len(body) == 12 * n + 13 * f and (faces["n"] == 3).all()
    return np.frombuffer(body, "<f4", 3 * n).reshape(-1, 3), faces["v"]


def look(points, image, camera):
    """Project world points to pixels (N, 2) and depths (N,) of an image."""
    _, rotation, translation, _, _ = image
    fx, fy, cx, cy = camera[1]
    x, y, z = (points @ rotation.T + translation).T
    return np.stack([fx * x / z + cx, fy * y / z + cy], 1), z


def truth(capture, name):
    return read_png(capture / "truth/masks" / name), np.load(capture / "truth/depth" / (name[:-4] + ".npy"))


def test_capture_has_expected_files_and_ids(tiny):
    labels = json.loads((tiny / "labels.json").read_text())
    assert len(labels) == TINY.objects + 2 and set(labels.values()) >= {"mug", "table", "backdrop"}
    names = [f"{i:04d}.png" for i in range(4)]
    found = set()
    for name in names:
        image = read_png(tiny / "images" / name)
        ids, depth = truth(tiny, name)
        assert image.shape == (48, 64, 3) and 40 < image.mean() < 200
        assert ids.min() >= 1 and depth.dtype == np.float32 and depth.min() > 0.3 and depth.max() < 6
        assert np.array_equal(ids, read_png(tiny / "masks" / name))
        found |= set(np.unique(ids).tolist())
    assert found == {int(key) for key in labels}
    assert not list(tiny.parent.glob("*.part")) and not list(tiny.parent.glob(".*"))
    assert all(demo_capture._is_written(path.relative_to(tiny)) for path in tiny.rglob("*") if path.is_file())


def test_masks_and_depth_match_meshes(small):
    camera, images, _ = read_model(small / "sparse/0")
    (width, height), intrinsics = camera
    assert intrinsics[2:] == (80.0, 60.0)
    objects = json.loads((small / "truth/objects.json").read_text())["objects"]
    for entry in objects:
        vertices, faces = read_ply(small / "truth" / entry["mesh"])
        assert np.allclose(vertices.min(0), entry["bounding_box"]["min"], atol=1e-5)
        spots = vertices[faces].mean(1)
        front = same = 0
        for image in images.values():
            ids, depth = truth(small, image[0])
            pixel, z = look(spots, image, camera)
            inside = (pixel > 0).all(1) & (pixel < [width, height]).all(1) & (z > 0)
            col, row = pixel[inside].astype(int).T
            visible = np.abs(depth[row, col] - z[inside]) < 0.004
            front += visible.sum()
            same += (ids[row, col][visible] == entry["id"]).sum()
        assert front > 30, entry["name"]
        assert same > 0.93 * front, entry["name"]


def test_points_match_depth_and_tracks(small):
    camera, images, points = read_model(small / "sparse/0")
    hidden = np.load(small / "truth/points.npz")
    outlier, label = hidden["outlier"], hidden["object_id"]
    assert len(points) == len(outlier) > 300
    assert 0.005 < outlier.mean() < 0.07
    errors, away, ids_agree = [], [], []
    for number, (xyz, _, error, track) in points.items():
        assert len(track) >= 3 and len(set(track[:, 0])) == len(track)
        rest = []
        for image_id, index in track:
            _, _, _, xy, point_ids = images[image_id]
            assert point_ids[index] == number
            pixel, _ = look(xyz[None], images[image_id], camera)
            rest.append(np.linalg.norm(pixel[0] - xy[index]))
        assert error == pytest.approx(np.mean(rest), abs=1e-6)
        if not outlier[number - 1]:
            errors.append(error)
    for image in images.values():
        ids, depth = truth(small, image[0])
        mine = np.unique(image[4][image[4] > 0])
        mine = mine[~outlier[mine - 1]]
        pixel, z = look(np.array([points[i][0] for i in mine]), image, camera)
        col, row = np.clip(pixel, 0, [159, 119]).astype(int).T
        away += np.abs(depth[row, col] - z)[label[mine - 1] <= SMALL.objects + 1].tolist()
        ids_agree += (ids[row, col] == label[mine - 1]).tolist()
    assert 0.3 < np.mean(errors) < 0.75  # noise of 0.5 pixels on both axes, reduced by the fit of the points
    assert np.median(away) < 0.01
    assert np.mean(ids_agree) > 0.9


def test_same_seed_gives_identical_files(tiny, tmp_path):
    again = demo_capture.make(tmp_path / "again", TINY)
    files = sorted(p.relative_to(tiny) for p in tiny.rglob("*") if p.is_file())
    assert files == sorted(p.relative_to(again) for p in again.rglob("*") if p.is_file())
    for file in files:
        assert (tiny / file).read_bytes() == (again / file).read_bytes(), file


def test_mask_noise_grows_with_level():
    ids = np.ones((60, 80), np.uint16)
    ids[20:40, 20:60] = 2
    ids[30:50, 50:70] = 3
    assert np.array_equal(mask_noise.disturb(ids, 0, np.random.default_rng(0)), ids)
    low, middle, high = (
        np.mean([mask_noise.disturb(ids, x, np.random.default_rng(i)) != ids for i in range(20)]) for x in (0.1, 0.5, 1)
    )
    assert 0 < low < middle < high < 0.5


def run(*arguments):
    command = [sys.executable, ROOT / "headless.py", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=300)


@pytest.mark.long
def test_demo_command_reports_existing_and_foreign_files(tiny, tmp_path):
    same = run("demo", str(tiny), "--objects=7", "--views=4", "--width=64", "--height=48", "--samples=2")
    assert same.returncode == 0 and "already" in same.stdout
    other = run("demo", str(tiny), "--objects=8")
    assert other.returncode == 2 and "--overwrite" in other.stderr and "Traceback" not in other.stderr
    (tmp_path / "mine.txt").write_text("keep")
    full = run("demo", str(tmp_path))
    assert full.returncode == 2 and full.stderr.count("\n") == 1
    assert [p.name for p in tmp_path.iterdir()] == ["mine.txt"]
    assert run("demo", str(tmp_path / "x"), "--views=1").returncode == 2


def test_stopping_leaves_no_files(tmp_path):
    with pytest.raises(Cancelled):
        demo_capture.make(tmp_path / "x", TINY, stopped=lambda: True)
    assert not list(tmp_path.iterdir())
    assert "ObjectGS demo" not in bpy.data.scenes


def test_foreign_files_are_kept(tiny, tmp_path, monkeypatch):
    for name in ("demo.part", "demo.old"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "thesis.odt").write_text("not yours")
    monkeypatch.setattr(demo_capture, "_fill", lambda part, *_: shutil.copytree(tiny, part, dirs_exist_ok=True))
    out = demo_capture.make(tmp_path / "demo", TINY)
    other = replace(TINY, seed=5)
    demo_capture.make(out, other, overwrite=True)
    (out / "images" / "holiday.jpg").write_text("not yours")
    with pytest.raises(InputError, match=r"holiday\.jpg is not part of the demo capture"):
        demo_capture.make(out, other, overwrite=True)
    assert (out / "images" / "holiday.jpg").read_text() == "not yours"
    assert all((tmp_path / name / "thesis.odt").read_text() == "not yours" for name in ("demo.part", "demo.old"))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["demo", "demo.old", "demo.part"]


def test_renders_are_kept_while_another_program_reads_them(tiny, tmp_path, monkeypatch):
    """On Windows, a folder cannot be renamed while a virus scanner has one of its files open."""
    refused, rename = set(), Path.replace

    def busy(self, target):
        if self not in refused:
            refused.add(self)
            raise PermissionError(13, "in use")
        return rename(self, target)

    monkeypatch.setattr(demo_capture, "_fill", lambda part, *_: shutil.copytree(tiny, part, dirs_exist_ok=True))
    monkeypatch.setattr(Path, "replace", busy)
    monkeypatch.setattr(atomic, "_PATIENCE", 1.0)
    for settings in (TINY, replace(TINY, seed=5)):
        out = demo_capture.make(tmp_path / "demo", settings, overwrite=True)
    assert len(refused) == 3 and [path.name for path in tmp_path.iterdir()] == ["demo"]
    assert (out / "truth" / "objects.json").is_file()
