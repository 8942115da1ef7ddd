"""The commands `edit`, `export` and `import-splats`."""

from __future__ import annotations

import gzip
import json
import shutil
import struct
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from plyfile import PlyData
from pxr import Usd, UsdGeom, UsdVol
from scipy.spatial.transform import Rotation

from backend.commands.cameras import read_upright, write_splat_cameras
from backend.editing import apply_edits, transformed
from backend.editing.placement import middle_of
from backend.export import coarser_splats, read_splats, write_gltf, write_splat, write_splats, write_spz, write_usd
from backend.model.splats import Splats
from backend.raster import Camera, rasterize
from backend.shared.color import srgb
from backend.shared.errors import EXIT_DONE, InputError
from backend.shared.formats.json_file import write_json
from backend.shared.formats.ply import read_vertices
from backend.shared.formats.splat_ply import read_description
from backend.shared.reconstruction.fill import fill_path
from backend.shared.reconstruction.folder import Reconstruction
from backend.shared.reconstruction.objects import edit_objects, read_objects, write_objects
from backend.shared.reconstruction.record import ExportRecord, TrainingRecord, VotesRecord, read_record, update_record
from backend.shared.splats.spherical_harmonics import C0

from .command_result import assert_rejected

NAMES = {1: "mug", 2: "Blue box", 3: "box", 7: "can"}
UPRIGHT = Rotation.from_euler("xyz", [0.3, 0.8, -0.5]).as_matrix()


def some_splats(n=60, degree=2, seed=0):
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(n, 4))
    return Splats(
        means=rng.normal((1, 2, 3), 0.5, (n, 3)).astype(np.float32),
        quats=(quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        scales=np.exp(rng.normal(-3, 0.7, (n, 3))),
        opacities=rng.uniform(0.02, 0.98, n),
        sh=np.clip(rng.normal(size=(n, (degree + 1) ** 2, 3)) * 0.3, -0.9, 0.9).astype(np.float32),
        object_ids=np.resize([0, 1, 2, 3, 7], n),
    )


@pytest.fixture
def folder(tmp_path):
    """A reconstruction with splats of four objects, whose capture space is not upright."""
    made = Reconstruction(tmp_path / "made").create()
    write_splats(made.splats, some_splats())
    write_objects(made.objects, [{"id": i, "name": name, "color": [1, 2, 3], "points": 9} for i, name in NAMES.items()])
    stands = {"rotation": UPRIGHT.tolist(), "translation": [0, 0, 1]}
    write_json(made.cameras, {"capture": None, "origin": [1, 2, 3], "upright": stands, "cameras": []})
    return made


def edited(folder, object_id):
    return next(entry for entry in read_objects(folder.objects) if entry.id == object_id)


# --- edit ------------------------------------------------------------------------------------------------------------


def test_objects_are_removed_and_restored_by_name_or_id(run_command, folder):
    result = run_command("edit", folder.folder, "--remove", "MUG", "blue", "7", "--floaters", "--json")
    assert result.code == EXIT_DONE and result.events[-1]["edited"] == 3
    assert [entry.removed and entry.floaters for entry in read_objects(folder.objects)] == [True, True, False, True]
    status = result.messages("status")[-1]
    assert "1 mug: removed with floaters\n" in status and "3 box: as captured\n" in status
    filled = run_command("edit", folder.folder, "--remove", "mug", "--fill").out
    assert "1 mug: removed, its hole not filled, since there is no flat surface around it" in filled
    run_command("edit", folder.folder, "--remove", "mug")
    assert edited(folder, 1).fill, "the hole stays filled"
    run_command("edit", folder.folder, "--restore", "mug", "box")
    assert [entry.removed for entry in read_objects(folder.objects)] == [False, True, False, True]
    assert json.loads(folder.objects.read_text())["edits"].keys() == {"2", "7"}


def test_fills_are_cached_per_edit_state(run_command, folder):
    """One file per state of edits and splats; undoing an edit reuses the earlier file, and old files are removed."""
    rng = np.random.default_rng(0)
    ground = np.column_stack([rng.uniform(-1, 1, (9000, 2)), np.zeros(9000)])
    ground = ground[np.abs(ground).max(1) > 0.15]
    obj = rng.uniform((-0.15, -0.15, 0), (0.15, 0.15, 0.3), (900, 3))
    splats = some_splats(len(ground) + len(obj))
    splats.means = np.concatenate([ground, obj]).astype(np.float32)
    splats.scales, splats.opacities[:] = np.tile([0.02, 0.02, 0.001], (len(splats), 1)), 0.9
    splats.quats[:], splats.object_ids = (1, 0, 0, 0), np.repeat([2, 1], [len(ground), len(obj)])
    write_splats(folder.splats, splats)

    def path():
        return fill_path(folder, read_objects(folder.objects))

    run_command("edit", folder.folder, "--remove", "mug")
    assert path() is None and not folder.cache.exists(), "no fill is requested"
    result = run_command("edit", folder.folder, "--remove", "mug", "--fill", "--json")
    first, table = path(), read_vertices(path())
    count = int(table["unobserved"].sum())
    assert count > 50 and result.events[-1]["new_splats"] == count and set(table["fills"].tolist()) == {1}
    assert f"1 mug: removed, its hole filled with {count} new splats" in result.messages("status")[-1]
    wanted = apply_edits(read_splats(folder.splats)[0], read_objects(folder.objects))
    put = read_splats(first)[0]
    assert np.array_equal(put.select(put.unobserved).means, wanted.select(wanted.unobserved).means)
    written = first.stat().st_mtime_ns
    run_command("edit", folder.folder, "--remove", "can")
    assert path() != first and path().is_file()
    run_command("edit", folder.folder, "--restore", "can")
    assert path() == first and first.stat().st_mtime_ns == written
    run_command("edit", folder.folder, "--restore", "mug")
    moved = run_command("edit", folder.folder, "--move", "mug:x=1", "--fill").out
    assert path() != first and f"1 mug: its hole filled with {count} new splats, moved" in moved
    run_command("edit", folder.folder, "--remove", "mug")
    run_command("edit", folder.folder, "--restore", "mug")
    assert edited(folder, 1).fill and not edited(folder, 1).removed, "the hole of a moved object stays filled"
    run_command("edit", folder.folder, "--remove", "mug")
    for i in range(12):
        (folder.cache / f"fill-{i}.ply").touch()
    write_splats(folder.splats, splats.select(np.arange(len(splats)) > 0))
    assert path() != first
    run_command("edit", folder.folder)
    assert path().is_file() and len(list(folder.cache.glob("fill-*.ply"))) == 8


def test_edit_without_options_lists_edits(run_command, folder):
    before = folder.objects.read_bytes()
    result = run_command("edit", folder.folder)
    assert result.code == EXIT_DONE and "7 can: as captured" in result.out and folder.objects.read_bytes() == before


def test_folders_that_cannot_be_written_to_are_refused_at_the_start(run_command, folder, tmp_path, monkeypatch):
    """Listing edits still works."""
    write, place = Path.write_bytes, tmp_path / "out"
    place.mkdir()
    update_record(folder)

    def write_bytes(path, data):
        if path.parent in (folder.folder, place):
            raise OSError(30, "Read-only file system", str(path))
        return write(path, data)

    def refuse(*_):
        raise AssertionError("it has begun")

    monkeypatch.setattr(Path, "write_bytes", write_bytes)
    for name in ("edit", "export"):
        monkeypatch.setattr(f"backend.commands.objects.{name}.read_splats", refuse)
    monkeypatch.setattr("backend.shared.reconstruction.objects.locked", refuse)
    listed = run_command("edit", folder.folder)
    assert listed.code == EXIT_DONE and "7 can: as captured" in listed.out
    refused = {
        folder.folder: [("edit", folder.folder, "--move", "can:x=1"), ("evaluate", folder.folder),
                        ("report", folder.folder), ("render", folder.folder), ("mesh", folder.folder),
                        ("propose", folder.folder)],
        place: [("export", folder.folder, "--out", place / "a.ply"),
                ("export", folder.folder, "--out", place / "new", "--per-object"),
                ("propose", folder.folder, "--strokes", place / "a.json")],
    }  # fmt: skip
    for at, commands in refused.items():
        for words in commands:
            result = run_command(*words)
            assert f"The folder {at} cannot be written to (Read-only file system); " in result.err, words


def test_recolor_middle_is_mean_luma(run_command, folder):
    splats = read_splats(folder.splats)[0]
    own = splats.select(splats.object_ids == 7)
    result = run_command(
        "edit", folder.folder, "--recolor", "can:hue=0.3, saturation=0.5", "mug:replace=#ff0080,tint=#00ff00"
    )
    assert "can: recolored hue=0.3 saturation=0.5\n" in result.out, "and no middle, which is no option"
    can, mug = edited(folder, 7).recolor, edited(folder, 1).recolor
    assert (can.hue, can.saturation, mug.amount, mug.tint) == (0.3, 0.5, 1.0, (0, 1, 0))
    assert mug.replace == pytest.approx((1, 0, 128 / 255))
    luma = np.clip(0.5 + C0 * own.sh[:, 0], 0, 1) @ [0.299, 0.587, 0.114]
    assert can.middle == pytest.approx((luma * own.opacities).sum() / own.opacities.sum())
    run_command("edit", folder.folder, "--recolor", "can:value=1")
    assert edited(folder, 7).recolor is None


def test_moves_use_blender_axes_and_object_center(run_command, folder):
    splats = read_splats(folder.splats)[0]
    middle = middle_of(splats.select(splats.object_ids == 7))
    run_command("edit", folder.folder, "--move", "can:x=0.5,z=-1,rz=90,scale=2", "--duplicate", "can:y=1", "can:y=2")
    can = edited(folder, 7)
    matrix = np.array(can.transform)
    # Blender shows upright coordinates.
    shift = UPRIGHT @ ((matrix @ [*middle, 1])[:3] - middle)
    np.testing.assert_allclose(shift, (0.5, 0, -1), atol=1e-9)
    np.testing.assert_allclose(UPRIGHT @ matrix[:3, :3] @ UPRIGHT.T, [[0, -2, 0], [2, 0, 0], [0, 0, 2]], atol=1e-9)
    np.testing.assert_allclose(np.array(can.copies)[:, :3, 3] @ UPRIGHT.T, [[0, 1, 0], [0, 2, 0]], atol=1e-9)
    assert "moved, scaled by 2, 2 copies" in run_command("edit", folder.folder, "--duplicate", "mug:x=1").out
    run_command("edit", folder.folder, "--duplicate", "can:y=3")
    assert len(edited(folder, 7).copies) == 3
    run_command("edit", folder.folder, "--reset", "can")
    assert edited(folder, 7).transform is None and edited(folder, 1).copies
    edit_objects(folder.objects, {1: {"name": "cup"}})
    run_command("edit", folder.folder, "--reset", "ALL")
    assert json.loads(folder.objects.read_text())["edits"] == {"1": {"name": "cup"}}


def test_edit_of_merged_object_applies_to_target(run_command, folder):
    edit_objects(folder.objects, {1: {"merged_into": 7}})
    run_command("edit", folder.folder, "--remove", "mug")
    assert edited(folder, 7).removed and not edited(folder, 1).removed


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--remove", "jug"], ["has no object jug", "1 mug, 2 Blue box, 3 box, 7 can"]),
        (["--remove", "mug", "b"], ["b may be several objects", "2 Blue box, 3 box"]),
        (["--move", "9:x=1"], ["has no object 9"]),
        (["--recolor", "can:hue=2"], ["hue=2", "between -0.5 and 0.5"]),
        (["--recolor", "can:tint=red"], ["tint=red", "#ff8800"]),
        (["--recolor", "can"], ["OBJECT:KEY=VALUE"]),
        (["--move", "can:up=1"], ["unknown 'up'", "x, y, z"]),
        (["--move", "can:scale=0"], ["scale=0"]),
        (["--move", "can:x=nan"], ["x=nan"]),
        (["--floaters"], ["--remove"]),
        (["--restore", "mug", "--fill"], ["--remove or --move"]),
    ],
)
def test_invalid_edits_are_rejected_without_writing(run_command, folder, words, expected):
    before = folder.objects.read_bytes()
    assert_rejected(run_command("edit", folder.folder, *words), *expected)
    assert folder.objects.read_bytes() == before


def test_object_without_splats_cannot_be_moved(run_command, folder):
    splats = some_splats()
    write_splats(folder.splats, splats.select(splats.object_ids != 7))
    assert_rejected(run_command("edit", folder.folder, "--remove", "mug", "--move", "can:x=1"), "no splats of can")
    assert not edited(folder, 1).removed
    assert_rejected(run_command("edit", folder.folder.parent), "objects.json does not exist")


# --- export ----------------------------------------------------------------------------------------------------------


def test_export_applies_edits_and_is_readable_ply(run_command, folder, tmp_path):
    run_command("edit", folder.folder, "--remove", "mug", "--recolor", "can:hue=0.2", "--move", "blue:x=1")
    result = run_command("export", folder.folder, "--out", tmp_path / "all.ply", "--json")
    assert result.code == EXIT_DONE and result.events[-1]["splats"] == 48
    wanted = apply_edits(read_splats(folder.splats)[0], read_objects(folder.objects))
    vertex = PlyData.read(str(tmp_path / "all.ply"))["vertex"]
    names = [f"f_rest_{i}" for i in range(24)]
    assert [p.name for p in vertex.properties] == [
        *["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"], *names, "opacity",
        *["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3", "object_id"],
    ]  # fmt: skip
    assert vertex["object_id"].tolist() == wanted.object_ids.tolist() and 1 not in wanted.object_ids
    np.testing.assert_array_equal(np.stack([vertex[c] for c in "xyz"], 1), wanted.means)
    rest = np.stack([vertex[name] for name in names], 1).reshape(-1, 3, 8).transpose(0, 2, 1)
    np.testing.assert_array_equal(rest, wanted.sh[:, 1:])


def test_export_without_edits_equals_splats_ply(run_command, folder, tmp_path):
    run_command("export", folder.folder, "--out", tmp_path / "all.ply")
    exported, own = (path.read_bytes().split(b"element vertex") for path in (tmp_path / "all.ply", folder.splats))
    assert exported[1] == own[1], "apart from comments"
    run_command("export", folder.folder, "--out", tmp_path / "plain.ply", "--no-ids", "--sh-degree", "1")
    names = read_vertices(tmp_path / "plain.ply").dtype.names
    assert names[-1] == "rot_3" and "f_rest_8" in names and "f_rest_9" not in names


def test_export_refuses_unknown_suffixes(run_command, folder, tmp_path):
    result = run_command("export", folder.folder, "--out", tmp_path / "all.sog")
    assert_rejected(result, "all.sog", "written as .ply, .spz, .splat, .glb or .usdc")
    assert not (tmp_path / "all.sog").exists()
    assert run_command("export", folder.folder, "--out", tmp_path / "all.v2", "--format", "spz").code == EXIT_DONE
    assert run_command("export", folder.folder, "--out", tmp_path / "parts.v2", "--per-object").code == EXIT_DONE
    assert run_command("export", folder.folder, "--out", tmp_path / "all").code == EXIT_DONE
    assert len(read_splats(tmp_path / "all")[0]) == 60
    assert run_command("export", folder.folder, "--out", tmp_path / "all.usd").code == EXIT_DONE
    assert len(read_usd(tmp_path / "all.usd")) == 5


def test_export_per_object_names_files_of_earlier_exports(run_command, folder, tmp_path):
    options = ["export", folder.folder, "--out", tmp_path / "parts", "--per-object"]
    assert "also contains" not in run_command(*options).err
    (tmp_path / "parts" / "notes.txt").touch()
    edit_objects(folder.objects, {1: {"name": "cup"}})
    result = run_command(*options)
    assert "parts also contains mug.ply, which" in " ".join(result.err.split())
    assert (tmp_path / "parts" / "mug.ply").exists() and (tmp_path / "parts" / "cup.ply").exists()


def test_export_per_object_writes_one_file_each(run_command, folder, tmp_path):
    edit_objects(folder.objects, {3: {"name": "../BLUE box"}, 1: {"merged_into": 7}})
    run_command("export", folder.folder, "--out", tmp_path / "parts", "--per-object")
    assert {path.name for path in (tmp_path / "parts").iterdir()} == {
        "background.ply", "Blue_box.ply", "BLUE_box_3.ply", "can.ply",
    }  # fmt: skip
    assert len(read_splats(tmp_path / "parts" / "can.ply")[0]) == 24
    run_command(
        "export", folder.folder, "--out", tmp_path / "one", "--per-object", "--objects", "can", "--format", "splat"
    )
    assert [path.name for path in (tmp_path / "one").iterdir()] == ["can.splat"]


def test_export_names_chosen_objects_without_splats(run_command, folder, tmp_path):
    edit_objects(folder.objects, {3: {"merged_into": 7}})
    run_command("edit", folder.folder, "--remove", "mug")
    chosen = ["--objects", "mug", "can", "3", "1"]
    result = run_command("export", folder.folder, "--out", tmp_path / "all.ply", "--json", *chosen)
    assert result.code == EXIT_DONE and result.events[-1]["splats"] == 24
    (warning,) = result.messages("warning")
    assert warning.startswith("No splats of mug are left to export, since")


def test_export_writes_coarser_levels(run_command, folder, tmp_path):
    write_splats(folder.splats, some_splats(5 * (1024 + 10)))
    result = run_command("export", folder.folder, "--out", tmp_path / "all.ply", "--levels", "2", "--json")
    assert result.code == EXIT_DONE and result.events[-1]["files"] == 3
    versions = [read_splats(tmp_path / name)[0] for name in ("all.ply", "all-1.ply", "all-2.ply")]
    for object_id in (0, 1, 2, 3, 7):
        parts = [version.select(version.object_ids == object_id) for version in versions]
        assert [len(part) for part in parts] == [1024 + 10, 256 + 10, 64 + 10]
        centers = [part.means.mean(0) for part in parts]
        np.testing.assert_allclose(centers, [centers[0]] * 3, atol=0.15)
    assert all((version.opacities > 0.0).all() and (version.opacities < 1.0).all() for version in versions)
    run_command("export", folder.folder, "--out", tmp_path / "parts", "--per-object", "--levels", "1")
    assert len(read_splats(tmp_path / "parts" / "can.ply")[0]) == 1024 + 10
    assert len(read_splats(tmp_path / "parts-1" / "can.ply")[0]) == 256 + 10


def test_coarser_splats_far_from_the_origin_keep_their_places():
    splats, place = some_splats(1280), np.array([4e6, 5e6, 100.0])
    far = replace(splats, means=splats.means.astype(np.float64) + place)
    (near,), (moved,) = coarser_splats(splats, 1), coarser_splats(far, 1)
    assert moved.means.dtype == np.float64 and len(moved) == 5 * 64
    np.testing.assert_allclose(moved.means - place, near.means, atol=1e-4)
    assert [len(level) for level in coarser_splats(Splats.empty(2), 2)] == [0, 0]


def test_blender_coordinates_are_upright(run_command, folder, tmp_path):
    run_command("export", folder.folder, "--out", tmp_path / "up.ply", "--coordinates", "blender")
    found, captured = read_splats(tmp_path / "up.ply")[0], read_splats(folder.splats)[0]
    np.testing.assert_allclose(found.means, (captured.means - (1, 2, 3)) @ UPRIGHT.T + (0, 0, 1), atol=1e-6)
    stand = np.eye(4)
    stand[:3, :3] = UPRIGHT
    np.testing.assert_allclose(found.sh, transformed(captured, stand).sh, atol=1e-6)


def test_blender_coordinates_follow_the_empty(run_command, folder, tmp_path):
    world = np.eye(4)
    world[:3, :3], world[:3, 3] = -2.5 * np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0]]), (1e-7, -3e-9, 4)
    numbers = ",".join(map(repr, world.ravel().tolist()))
    options = ("--out", tmp_path / "all.ply", "--coordinates", "blender")
    assert run_command("export", folder.folder, *options, f"--to-world={numbers}").code == 0
    found, captured = read_splats(tmp_path / "all.ply")[0], read_splats(folder.splats)[0]
    expected = (captured.means - (1, 2, 3)) @ world[:3, :3].T + world[:3, 3]
    np.testing.assert_allclose(found.means, expected, atol=1e-5)
    np.testing.assert_allclose(np.sort(found.scales), np.sort(2.5 * captured.scales), rtol=1e-5)
    columns, flat = (",".join(map(repr, each.ravel().tolist())) for each in (world.T, np.diag([0.0, 0, 0, 1])))
    for wrong in ("1,2", numbers + ",0", numbers.replace("4.0", "nan"), columns, flat):
        assert run_command("export", folder.folder, *options, f"--to-world={wrong}").code == 2
    result = run_command("export", folder.folder, *options[:2], f"--to-world={numbers}")
    assert result.code == 2 and "--to-world is for --coordinates blender" in result.err


def test_export_of_fit_warns_with_psnr(run_command, folder, tmp_path):
    training = TrainingRecord({"mode": "view"}, VotesRecord("majority", None, 1600, "0f", None))
    update_record(folder, training=training, export=ExportRecord(splats=9, anchors=3, psnr_of_export=34.62))
    result = run_command("export", folder.folder, "--out", tmp_path / "all.ply", "--json")
    assert any("34.6 dB" in sentence for sentence in result.messages("warning"))


def test_invalid_exports_are_rejected(run_command, folder, tmp_path):
    assert_rejected(run_command("export", folder.folder, "--out", tmp_path), "is a folder")
    (tmp_path / "file").touch()
    assert_rejected(run_command("export", folder.folder, "--out", tmp_path / "file", "--per-object"), "is a file")
    before = set(folder.folder.iterdir())
    result = run_command("export", folder.folder, "--out", folder.folder / "." / "", "--per-object")
    assert_rejected(result, "the reconstruction's own folder")
    assert set(folder.folder.iterdir()) == before
    assert_rejected(
        run_command("export", folder.folder, "--out", tmp_path / "a.ply", "--objects", "jug"), "no object jug"
    )
    run_command("edit", folder.folder, "--remove", "can")
    assert_rejected(run_command("export", folder.folder, "--out", tmp_path / "a.ply", "--objects", "can"), "No splats")
    assert_rejected(run_command("export", tmp_path / "nothing", "--out", tmp_path / "a.ply"), "splats.ply")
    assert not (tmp_path / "a.ply").exists()


def read_spz(path):
    """Decode an SPZ file splat by splat as specified."""
    data = gzip.decompress(path.read_bytes())
    magic, version, count, degree, bits, flags, reserved = struct.unpack_from("<IIIBBBB", data)
    assert (magic, version, flags, reserved) == (0x5053474E, 3, 0, 0)
    rest = (degree + 1) ** 2 - 1
    sizes = [9, 1, 3, 3, 4, 3 * rest]
    starts = [16 + count * sum(sizes[:i]) for i in range(6)]
    assert len(data) == starts[5] + count * sizes[5]
    means, opacities, colors, scales, quats, sh = ([] for _ in range(6))
    for i in range(count):
        at = [data[start + i * size : start + (i + 1) * size] for start, size in zip(starts, sizes)]
        means.append([int.from_bytes(at[0][3 * j : 3 * j + 3], "little", signed=True) / 2**bits for j in range(3)])
        opacities.append(at[1][0] / 255)
        colors.append([(value / 255 - 0.5) / 0.15 for value in at[2]])
        scales.append([np.exp(value / 16 - 10) for value in at[3]])
        (packed,) = struct.unpack("<I", at[4])
        xyzw, largest = np.zeros(4), packed >> 30
        for axis in (3, 2, 1, 0):
            if axis != largest:
                xyzw[axis] = (packed & 511) / 511 / np.sqrt(2) * (-1 if packed & 512 else 1)
                packed >>= 10
        xyzw[largest] = np.sqrt(1 - (xyzw**2).sum())
        quats.append(xyzw[[3, 0, 1, 2]])
        sh.append(np.reshape([(value - 128) / 128 for value in at[5]], (rest, 3)))
    sh = np.concatenate([np.reshape(colors, (count, 1, 3)), np.reshape(sh, (count, rest, 3))], 1)
    return Splats(*map(np.array, (means, quats, scales, opacities)), sh, np.zeros(count, np.int64))


def assert_close(found, wanted, color):
    turned = Rotation.from_quat(found.quats, scalar_first=True).inv() * Rotation.from_quat(
        wanted.quats, scalar_first=True
    )
    assert turned.magnitude().max() < 0.01
    np.testing.assert_allclose(found.means, wanted.means, atol=1e-5)
    np.testing.assert_allclose(found.scales, wanted.scales, rtol=0.04)
    np.testing.assert_allclose(found.opacities, wanted.opacities, atol=0.002)
    np.testing.assert_allclose(found.sh[:, 0], wanted.sh[:, 0], atol=color)


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_spz_export_is_y_up(run_command, folder, tmp_path, degree):
    write_splats(folder.splats, some_splats(degree=degree))
    run_command("export", folder.folder, "--out", tmp_path / "all.spz")
    found = read_spz(tmp_path / "all.spz")
    wanted = transformed(read_splats(folder.splats)[0], np.diag([1.0, -1, -1, 1]))
    assert_close(found, wanted, 0.02)
    np.testing.assert_allclose(found.sh[:, 1:], wanted.sh[:, 1:], atol=0.004)
    run_command("export", folder.folder, "--out", tmp_path / "again.spz")
    assert (tmp_path / "all.spz").read_bytes() == (tmp_path / "again.spz").read_bytes()
    run_command("export", folder.folder, "--out", tmp_path / "up.spz", "--coordinates", "blender")
    run_command("export", folder.folder, "--out", tmp_path / "up.ply", "--coordinates", "blender")
    upright = read_splats(tmp_path / "up.ply")[0]
    np.testing.assert_allclose(read_spz(tmp_path / "up.spz").means, upright.means[:, [0, 2, 1]] * (1, 1, -1), atol=1e-5)


def test_spz_matches_gsply_reader(tmp_path):
    gsply = pytest.importorskip("gsply")
    splats = some_splats(degree=3)
    write_spz(tmp_path / "a.spz", splats)
    found, mine = gsply.read_spz(tmp_path / "a.spz"), read_spz(tmp_path / "a.spz")
    np.testing.assert_allclose(found.means, mine.means, atol=1e-6)
    np.testing.assert_allclose(np.exp(found.scales), mine.scales, rtol=1e-5)
    np.testing.assert_allclose(found.shN, mine.sh[:, 1:], atol=1e-6)
    np.testing.assert_allclose(found.sh0, mine.sh[:, 0], atol=1e-5)
    np.testing.assert_allclose(np.abs((found.quats * mine.quats).sum(1)), 1, atol=1e-5)


def read_gltf(path):
    """Decode the splats of a GLB, node by node, as specified: object ID -> (name, splats, COLOR_0)."""
    data = path.read_bytes()
    magic, version, length, size, kind = struct.unpack_from("<4sIIII", data)
    assert (magic, version, length, kind) == (b"glTF", 2, len(data), 0x4E4F534A)
    content = json.loads(data[20 : 20 + size])
    binary_size, kind = struct.unpack_from("<II", data, 20 + size)
    binary = data[28 + size :]
    assert kind == 0x004E4942 and binary_size == len(binary) == content["buffers"][0]["byteLength"]
    assert content["extensionsUsed"] == ["KHR_gaussian_splatting"]
    found = {}
    for index in content["scenes"][content["scene"]]["nodes"]:
        node = content["nodes"][index]
        (primitive,) = content["meshes"][node["mesh"]]["primitives"]
        assert primitive["mode"] == 0, "points"
        properties = primitive["extensions"]["KHR_gaussian_splatting"]
        assert properties == {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
        values = {}
        for name, number in primitive["attributes"].items():
            accessor = content["accessors"][number]
            view = content["bufferViews"][accessor["bufferView"]]
            width, kind = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]], accessor["componentType"]
            dtype, one = {5126: (np.dtype("<f4"), 1), 5123: (np.dtype("<u2"), 65535)}[kind]
            assert accessor.get("normalized", False) == (one > 1) and view["byteOffset"] % 4 == 0
            assert view["byteLength"] == accessor["count"] * width * dtype.itemsize
            numbers = np.frombuffer(binary, dtype, accessor["count"] * width, view["byteOffset"])
            values[name] = numbers.reshape(-1, width) / one
        low, high = content["accessors"][primitive["attributes"]["POSITION"]]["min"], values["POSITION"].min(0)
        np.testing.assert_array_equal(np.float32(low), high)
        bands = [
            f"KHR_gaussian_splatting:SH_DEGREE_{degree}_COEF_{n}" for degree in range(4) for n in range(2 * degree + 1)
        ]
        count = len(values["POSITION"])
        splats = Splats(
            values["POSITION"] + np.array(node["translation"]),
            values["KHR_gaussian_splatting:ROTATION"][:, [3, 0, 1, 2]],
            values["KHR_gaussian_splatting:SCALE"],
            values["KHR_gaussian_splatting:OPACITY"][:, 0],
            np.stack([values[band] for band in bands if band in values], 1),
            np.full(count, node["extras"]["object_id"]),
        )
        found[node["extras"]["object_id"]] = node["name"], splats, values["COLOR_0"]
    return found


def read_usd(path):
    """Read the splats of a USD file by its schema: object ID -> (display name, splats)."""
    stage = Usd.Stage.Open(str(path))
    assert UsdGeom.GetStageUpAxis(stage) == "Z" and UsdGeom.GetStageMetersPerUnit(stage) == 1
    cache = UsdGeom.XformCache()
    found = {}
    for prim in stage.GetDefaultPrim().GetChildren():
        field = UsdVol.ParticleField3DGaussianSplat(prim)
        assert prim.GetTypeName() == "ParticleField3DGaussianSplat" and field.GetPositionsAttr().IsDefined()
        place = np.array(cache.GetLocalToWorldTransform(prim))
        np.testing.assert_array_equal(place[:3, :3], np.eye(3))
        means = np.array(field.GetPositionsAttr().Get()) + place[3, :3]
        quats = [(quat.GetReal(), *quat.GetImaginary()) for quat in field.GetOrientationsAttr().Get()]
        degree = field.GetRadianceSphericalHarmonicsDegreeAttr().Get()
        sh = np.array(field.GetRadianceSphericalHarmonicsCoefficientsAttr().Get()).reshape(-1, (degree + 1) ** 2, 3)
        object_id = prim.GetAttribute("userProperties:object_id").Get()
        scales = np.array(field.GetScalesAttr().Get())
        low, high = np.array(field.GetExtentAttr().Get()) + place[3, :3]
        assert (low <= means.min(0) - scales.min()).all() and (high >= means.max(0) + scales.min()).all()
        splats = Splats(
            means, np.array(quats), scales, np.array(field.GetOpacitiesAttr().Get()), sh, np.full(len(means), object_id)
        )
        found[object_id] = prim.GetDisplayName(), splats
    return found


@pytest.mark.parametrize("degree", [0, 1, 3])
@pytest.mark.parametrize("coordinates", ["capture", "blender"])
def test_gltf_and_usd_keep_each_object_apart(run_command, folder, tmp_path, degree, coordinates):
    write_splats(folder.splats, some_splats(degree=degree))
    edit_objects(folder.objects, {3: {"name": "Blue box"}})
    run_command("edit", folder.folder, "--move", "can:x=0.5", "--remove", "mug")
    for kind in ("ply", "glb", "usdc"):
        run_command("export", folder.folder, "--out", tmp_path / f"a.{kind}", "--coordinates", coordinates)
    whole = read_splats(tmp_path / "a.ply")[0]
    turned = whole
    if coordinates == "blender":
        turned = transformed(whole, np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]]))
    gltf, usd = read_gltf(tmp_path / "a.glb"), read_usd(tmp_path / "a.usdc")
    names = {0: "Background", 2: "Blue box", 3: "Blue box", 7: "can"}
    assert {i: each[0] for i, each in gltf.items()} == {i: each[0] for i, each in usd.items()} == names
    for every, read in ((turned, gltf), (whole, usd)):
        for object_id, (_, found, *_) in read.items():
            wanted = every.select(every.object_ids == object_id)
            np.testing.assert_allclose(found.means, wanted.means, atol=1e-6)
            np.testing.assert_allclose(np.abs((found.quats * wanted.quats).sum(1)), 1, atol=1e-6)
            np.testing.assert_allclose(found.scales, wanted.scales, rtol=1e-6)
            np.testing.assert_allclose(found.opacities, wanted.opacities, atol=1e-6)
            np.testing.assert_allclose(found.sh, wanted.sh, atol=1e-5)
    for _, found, color in gltf.values():
        linear = srgb.decode(np.clip(0.5 + C0 * found.sh[:, 0], 0, 1))
        np.testing.assert_allclose(color, np.column_stack([linear, found.opacities]), atol=1e-5)


def test_gltf_and_usd_without_ids_are_of_one_part(run_command, folder, tmp_path):
    for kind, read in (("glb", read_gltf), ("usdc", read_usd)):
        run_command("export", folder.folder, "--out", tmp_path / f"all.{kind}", "--no-ids")
        ((name, splats, *_),) = read(tmp_path / f"all.{kind}").values()
        assert name == "all" and len(splats) == 60
    assert sorted(path.name for path in tmp_path.iterdir()) == ["all.glb", "all.usdc", "made"]


def test_gltf_and_usd_are_exact_far_from_the_origin(tmp_path):
    near = some_splats()
    far = replace(near, means=near.means + np.array([4e5, -3e6, 100]))
    for write, read, kind in ((write_gltf, read_gltf, "glb"), (write_usd, read_usd, "usdc")):
        write(tmp_path / f"far.{kind}", far, {0: "ü / 1", 1: "ü / 1", 2: "con", 3: "", 7: "杯"})
        for object_id, (_, found, *_) in read(tmp_path / f"far.{kind}").items():
            wanted = far.select(far.object_ids == object_id)
            assert np.abs(found.means - wanted.means).max() < 1e-6


def test_usd_needs_its_package(run_command, folder, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pxr", None)
    result = run_command("export", folder.folder, "--out", tmp_path / "all.usdc")
    assert_rejected(result, "all.usdc", "needs the package usd-core")
    assert not (tmp_path / "all.usdc").exists()


def test_gltf_of_too_many_splats_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("backend.export.gltf._LARGEST", 9000)
    with pytest.raises(InputError, match="more than a glTF file can"):
        write_gltf(tmp_path / "many.glb", some_splats(), dict.fromkeys((0, 1, 2, 3, 7), "part"))
    assert not list(tmp_path.iterdir())


def test_spz_limits_are_reported(tmp_path, monkeypatch):
    splats = some_splats()
    tiny = splats.select(slice(0, 9))
    tiny.means, tiny.scales = tiny.means * 1e-7, tiny.scales * 1e-7
    assert any("scale them up" in warning for warning in write_spz(tmp_path / "tiny.spz", tiny))
    with monkeypatch.context() as patched:
        patched.setattr("backend.export.spz._MOST_SPLATS", 59)
        with pytest.raises(InputError, match="60 splats are more than the 59"):
            write_spz(tmp_path / "many.spz", splats)
    assert not (tmp_path / "many.spz").exists()
    splats.means += 1e6
    (warning,) = write_spz(tmp_path / "far.spz", splats)
    assert "rounds positions" in warning
    assert np.abs(read_spz(tmp_path / "far.spz").means - splats.means).max() < 0.6
    splats.means += 1e8
    with pytest.raises(InputError, match="PLY"):
        write_spz(tmp_path / "farther.spz", splats)
    assert not (tmp_path / "farther.spz").exists()
    splats = some_splats()
    splats.scales[:3] *= 1e-6
    assert "3 of 60" in write_spz(tmp_path / "small.spz", splats)[0]
    assert write_spz(tmp_path / "none.spz", Splats.empty(1)) == []


def test_positions_far_away_are_reported_where_they_are_rounded(tmp_path):
    splats = some_splats(degree=0)
    splats.means = splats.means.astype(np.float64) + 5e6
    (warning,) = write_splat(tmp_path / "a.splat", splats)
    assert "rounds positions to 0.5 units" in warning


def test_splat_file_has_32_bytes_per_splat(tmp_path):
    splats = some_splats(degree=0)
    assert write_splat(tmp_path / "a.splat", splats) == [] and write_splat(tmp_path / "b.splat", some_splats()) != []
    data = (tmp_path / "a.splat").read_bytes()
    assert len(data) == 32 * len(splats)
    rows = [struct.unpack_from("<6f8B", data, 32 * i) for i in range(len(splats))]
    sizes = [row[9] * np.prod(row[3:6]) ** (1 / 3) for row in rows]
    assert all(a > 0.9 * b for a, b in pairwise(sizes))
    first = np.flatnonzero((splats.means == np.float32(rows[0][:3])).all(1))[0]
    color = np.clip((0.5 + C0 * splats.sh[first, 0]) * 255, 0, 255)
    assert rows[0][6:9] == pytest.approx(color, abs=0.51)
    assert rows[0][9] == pytest.approx(255 * splats.opacities[first], abs=0.51)
    assert (np.array(rows[0][10:]) - 128) / 128 == pytest.approx(splats.quats[first], abs=0.009)


# --- import ----------------------------------------------------------------------------------------------------------


def test_import_of_splats_with_ids(run_command, folder, tmp_path):
    made = Reconstruction(tmp_path / "imported")
    result = run_command("import-splats", folder.splats, "--out", made.folder, "--json")
    assert result.code == EXIT_DONE and result.events[-1]["objects"] == 4
    assert made.splats.read_bytes() == folder.splats.read_bytes()
    assert [(entry.id, entry.name, entry.points) for entry in read_objects(made.objects)] == [
        (1, "object 1", 12), (2, "object 2", 12), (3, "object 3", 12), (7, "object 7", 12),
    ]  # fmt: skip
    assert len(read_vertices(made.points)) == 0 and json.loads(made.cameras.read_text())["cameras"] == []
    assert run_command("edit", made.folder, "--move", "7:z=1").code == EXIT_DONE
    assert (
        run_command("export", made.folder, "--out", tmp_path / "again.ply", "--coordinates", "blender").code
        == EXIT_DONE
    )
    assert_rejected(run_command("render", made.folder), "checkpoint")


@pytest.mark.parametrize("coordinates", ["capture", "blender"])
def test_import_of_an_export_stands_and_has_names_and_background(run_command, folder, tmp_path, coordinates):
    objects = [{"id": i, "name": name, "color": [1, 2, 3], "points": 9} for i, name in {**NAMES, 7: 'Käse "7"'}.items()]
    write_objects(folder.objects, objects)
    update_record(folder, export=ExportRecord(splats=60, anchors=6, background=[0.2, 0.55, 0.9]))
    options = ["--out", tmp_path / "all.ply", "--coordinates", coordinates]
    assert run_command("export", folder.folder, *options).code == EXIT_DONE
    made = Reconstruction(tmp_path / "again")
    assert run_command("import-splats", tmp_path / "all.ply", "--out", made.folder).code == EXIT_DONE
    assert [entry.name for entry in read_objects(made.objects)] == [entry["name"] for entry in objects]
    assert read_record(made).export.background == [0.2, 0.55, 0.9]
    up = np.eye(3)[2] if coordinates == "blender" else UPRIGHT[2]
    np.testing.assert_allclose(read_upright(made).rotation[2], up, atol=1e-5)
    assert run_command("export", folder.folder, "--no-ids", *options).code == EXIT_DONE
    assert read_description(tmp_path / "all.ply").names == {}


def test_import_without_a_capture_forgets_that_of_an_earlier_one(run_command, write_capture, folder, tmp_path):
    scene = write_capture(views=4)
    splats = some_splats(n=len(scene.xyz), degree=0)
    splats.means = scene.xyz.astype(np.float32)
    write_splats(tmp_path / "foreign.ply", splats)
    made = Reconstruction(tmp_path / "imported")
    options = ["import-splats", tmp_path / "foreign.ply", "--out", made.folder]
    assert run_command(*options, "--capture", scene.folder).code == EXIT_DONE
    made.strokes.write_text("{}")
    assert run_command(*options, "--capture", scene.folder).code == EXIT_DONE and made.strokes.exists()
    result = run_command(*options)
    assert result.code == EXIT_DONE and f"no longer has the capture {scene.folder}" in " ".join(result.err.split())
    assert read_record(made).capture is None and not made.strokes.exists()
    made.strokes.write_text("{}")
    result = run_command(*options)
    assert result.code == EXIT_DONE and "no longer" not in result.err and made.strokes.exists()


def test_import_assigns_ids_from_masks(run_command, write_capture, tmp_path):
    scene = write_capture(views=9, points=200)
    splats = some_splats(n=len(scene.xyz), degree=0)
    splats.means, splats.object_ids = scene.xyz.astype(np.float32), np.zeros(len(scene.xyz), np.int64)
    write_splats(tmp_path / "foreign.ply", splats, with_ids=False)
    made = Reconstruction(tmp_path / "imported")
    result = run_command("import-splats", tmp_path / "foreign.ply", "--out", made.folder, "--capture", scene.folder)
    assert result.code == EXIT_DONE
    assert (read_splats(made.splats)[0].object_ids == scene.point_objects).mean() > 0.95
    assert [entry.name for entry in read_objects(made.objects)] == ["sphere 1", "sphere 2", "sphere 5"]
    assert len(read_vertices(made.points)) == len(scene.xyz)
    assert len(json.loads(made.cameras.read_text())["cameras"]) == 9
    training = ("train", scene.folder, "--out", made.folder, "--steps", 1, "--offsets", 2)
    before = made.splats.read_bytes()
    assert_rejected(run_command(*training), "was imported from", "foreign.ply", "--restart")
    assert made.splats.read_bytes() == before and not made.checkpoint.exists()
    assert run_command(*training, "--restart").code == EXIT_DONE and made.splats.read_bytes() != before
    assert run_command(*training).code == EXIT_DONE
    importing = ("import-splats", tmp_path / "foreign.ply", "--out", made.folder)
    assert_rejected(run_command(*importing), "already contains a training")
    shutil.rmtree(made.checkpoint)
    assert run_command(*importing, "--capture", scene.folder).code == EXIT_DONE
    assert_rejected(run_command(*training), "was imported from", "foreign.ply", "--restart")


def test_import_without_masks_keeps_ids_of_file(run_command, write_capture, folder, tmp_path):
    scene = write_capture(views=4, masks=False)
    splats = some_splats(n=len(scene.xyz))
    splats.means = scene.xyz.astype(np.float32)
    write_splats(tmp_path / "seen.ply", splats)
    result = run_command("import-splats", tmp_path / "seen.ply", "--out", tmp_path / "made2", "--capture", scene.folder)
    assert result.code == EXIT_DONE and "masks does not exist" in result.err
    assert len(read_objects(tmp_path / "made2" / "objects.json")) == 4
    splats.means += 1000
    write_splats(tmp_path / "far.ply", splats)
    result = run_command("import-splats", tmp_path / "far.ply", "--out", tmp_path / "made3", "--capture", scene.folder)
    assert_rejected(result, "Only 0% of the splats", "coordinates")


def test_failed_import_leaves_no_files(run_command, write_capture, folder, tmp_path):
    scene = write_capture(views=4)
    made = tmp_path / "not" / "there"
    assert_rejected(run_command("import-splats", tmp_path / "none.ply", "--out", made), "none.ply")
    write_splats(tmp_path / "empty.ply", Splats.empty())
    assert_rejected(run_command("import-splats", tmp_path / "empty.ply", "--out", made), "contains no splats")
    assert_rejected(run_command("import-splats", scene.folder / "labels.json", "--out", made), "not a PLY")
    far = some_splats()
    far.means += 1000
    write_splats(tmp_path / "far.ply", far)
    assert_rejected(
        run_command("import-splats", tmp_path / "far.ply", "--out", made, "--capture", scene.folder), "coordinates"
    )
    assert_rejected(run_command("import-splats", folder.splats, "--out", made, "--capture", tmp_path / "gone"), "gone")
    assert not made.parent.exists()
    folder.checkpoint.mkdir()
    assert_rejected(run_command("import-splats", folder.splats, "--out", folder.folder), "already contains a training")


def test_splats_without_cameras_are_oriented_to_ground(tmp_path):
    rng = np.random.default_rng(0)
    ground = np.column_stack([rng.uniform(-1, 1, 3000), rng.normal(0.5, 0.001, 3000), rng.uniform(-1, 1, 3000)])
    above = rng.uniform(-0.2, 0.2, (500, 3))
    folder = Reconstruction(tmp_path)
    write_splat_cameras(folder, np.concatenate([ground, above]))
    upright = json.loads(folder.cameras.read_text())["upright"]
    rotation, translation = np.array(upright["rotation"]), np.array(upright["translation"])
    assert (above @ rotation.T + translation)[:, 2].min() > 0.2
    assert np.abs((ground @ rotation.T + translation)[:, 2]).max() < 0.05


def test_baked_background_looks_like_background(tmp_path, folder, run_command):
    color = [0.2, 0.55, 0.9]
    update_record(folder, export=ExportRecord(splats=60, anchors=6, background=color))
    plain, baked = tmp_path / "plain.ply", tmp_path / "baked.ply"
    assert run_command("export", folder.folder, "--out", plain).code == EXIT_DONE
    assert run_command("export", folder.folder, "--out", baked, "--bake-background").code == EXIT_DONE
    assert b"comment background 0.2000 0.5500 0.9000\n" in plain.read_bytes()[:400]
    assert b"background" not in baked.read_bytes()[:400]
    inside, everything = read_splats(plain)[0], read_splats(baked)[0]
    assert len(everything) > len(inside) and (everything.object_ids[len(inside) :] == 0).all()
    # In every direction, from a camera in front of the scene and from one within it.
    for distance in (6.0, 0.0):
        for turn in Rotation.random(8, random_state=1).as_matrix():
            viewmat = np.eye(4)
            viewmat[:3, :3], viewmat[:3, 3] = turn, -turn @ [1, 2, 3] + [0, 0, distance]
            camera = Camera(viewmat, np.array([[30, 0, 24], [0, 30, 16], [0, 0, 1.0]]), 48, 32)
            shown, alone = _drawn(everything, camera), _drawn(inside, camera)
            wanted = alone.color + (1 - alone.alpha) * torch.tensor(color)[:, None, None]
            assert float((shown.color - wanted).abs().max()) < 0.03


@pytest.mark.parametrize("coordinates", ["capture", "blender"])
def test_baked_background_is_whole_in_coarser_levels(tmp_path, folder, run_command, coordinates):
    write_splats(folder.splats, some_splats(5 * 1034))
    update_record(folder, export=ExportRecord(splats=5 * 1034, anchors=6, background=[0.2, 0.55, 0.9]))
    options = ["--levels", "2", "--bake-background", "--coordinates", coordinates]
    result = run_command("export", folder.folder, "--out", tmp_path / "all.ply", *options, "--json")
    assert result.code == EXIT_DONE and result.events[-1]["splats"] == 5 * 1034 + 1000
    full, *coarser = (read_splats(tmp_path / name)[0] for name in ("all.ply", "all-1.ply", "all-2.ply"))
    sphere = full.select(slice(-1000, None))
    for level, version in enumerate(coarser, 1):
        assert len(version) == 5 * (1024 // 4**level + 10) + 1000
        assert np.array_equal(version.means[-1000:], sphere.means)


def _drawn(splats, camera):
    values = (splats.means, splats.quats, splats.scales, splats.opacities, splats.sh)
    tensors = [torch.from_numpy(np.ascontiguousarray(value, np.float32)) for value in values]
    return rasterize(*tensors, torch.zeros(len(splats), dtype=torch.int32), camera)


def test_background_that_is_not_known_is_not_baked(tmp_path, folder, run_command):
    result = run_command("export", folder.folder, "--out", tmp_path / "out.ply", "--bake-background")
    assert_rejected(result, "objectgs.json", "background")
    assert not (tmp_path / "out.ply").exists()
