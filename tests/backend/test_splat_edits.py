"""Edits of single splats: the file, hostile contents, and their effect on export, film and fills."""

from __future__ import annotations

import json

import numpy as np
import OpenEXR
import pytest

from backend.commands.objects.film import frame_path
from backend.export import read_splats, write_splats
from backend.model.splats import Splats
from backend.shared.errors import EXIT_DONE, InputError
from backend.shared.formats.ply import read_vertices, write_vertices
from backend.shared.reconstruction.edits.splat_edits import (
    SplatEdits,
    digest_of,
    inside_box,
    read_splat_edits,
    write_splat_edits,
)
from backend.shared.reconstruction.fill import fill_path
from backend.shared.reconstruction.folder import Reconstruction
from backend.shared.reconstruction.objects import edit_objects, read_objects, write_objects
from backend.shared.reconstruction.shot import Frame, Sample, Shot, write_shot
from backend.shared.splats.keys import NO_KEY, splat_keys

from .command_result import assert_rejected

HUGE = 2**32 - 1
IDS = np.resize([0, 1, 2, HUGE], 200)
KNOWN_KEY = 0xF1CB2CB3AF67E735
"""Of the position (1, -2, 0.5) and the color (0.25, 0, -1)."""
BOX = ((0.4, 0.1, 0.0, 1.0), (0.0, 0.5, 0.0, 2.0), (0.0, 0.0, 0.6, 3.0), (0.0, 0.0, 0.0, 1.0))


def some_splats() -> Splats:
    rng = np.random.default_rng(0)
    count = len(IDS)
    return Splats(
        means=rng.normal((1, 2, 3), 0.5, (count, 3)).astype(np.float32),
        quats=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        scales=np.full((count, 3), 0.05),
        opacities=np.full(count, 0.9),
        sh=rng.normal(size=(count, 1, 3)).astype(np.float32) * 0.2,
        object_ids=IDS,
    )


@pytest.fixture
def folder(tmp_path) -> Reconstruction:
    """A reconstruction with splats of three objects and of none."""
    made = Reconstruction(tmp_path / "made").create()
    write_splats(made.splats, some_splats())
    names = {1: "mug", 2: "can", HUGE: "box"}
    write_objects(made.objects, [{"id": i, "name": n, "color": [1, 2, 3], "points": 9} for i, n in names.items()])
    return made


def keys_of(splats: Splats) -> np.ndarray:
    return splat_keys(splats.means, splats.sh[:, 0])


def exported(run_command, folder, tmp_path, *words):
    result = run_command("export", folder.folder, "--out", tmp_path / "out.ply", "--json", *words)
    assert result.code == EXIT_DONE, result
    return read_splats(tmp_path / "out.ply")[0], result.messages("warning")


# --- keys and the file -----------------------------------------------------------------------------------------------


def test_keys_are_of_bits_and_of_any_precision_and_order():
    splats = some_splats()
    keys = keys_of(splats)
    assert len(np.unique(keys)) == len(splats) and NO_KEY not in keys
    assert np.array_equal(splat_keys(splats.means.astype(np.float64), splats.sh[:, 0].astype(np.float64)), keys)
    assert np.array_equal(keys_of(splats.select(np.arange(len(splats))[::-1])), keys[::-1])
    moved = splats.means.copy()
    moved[3, 1] = np.nextafter(moved[3, 1], np.float32(9))
    assert np.flatnonzero(splat_keys(moved, splats.sh[:, 0]) != keys).tolist() == [3]
    # Files outlive versions of the program, so the hash must not change.
    assert splat_keys([[1.0, -2.0, 0.5]], [[0.25, 0.0, -1.0]])[0] == KNOWN_KEY


def test_edits_survive_the_file(folder):
    keys = keys_of(some_splats())
    edits = SplatEdits().delete(keys[[5, 3]]).assign(keys[[3, 9]], HUGE)
    write_splat_edits(folder, SplatEdits(edits.rows, BOX))
    read = read_splat_edits(folder)
    assert np.array_equal(read.rows, edits.rows) and read.crop == BOX
    assert (read.deleted, read.assigned) == (2, 2)
    assert digest_of(read) == digest_of(SplatEdits(edits.rows, BOX)) != digest_of(edits)
    other = SplatEdits(crop=BOX).assign(keys[[9, 3]], HUGE).delete(keys[[3]]).delete(keys[[5]])
    before = folder.splat_edits.read_bytes()
    write_splat_edits(folder, other)
    assert folder.splat_edits.read_bytes() == before, "equal edits make equal files"
    assert read.restore().deleted == 0 and len(read.restore().rows) == 2, "the assignment of a deleted splat is kept"
    write_splat_edits(folder, SplatEdits())
    assert not folder.splat_edits.exists() and not read_splat_edits(folder)


def test_later_edits_replace_and_extend():
    keys, ids = keys_of(some_splats()), IDS
    edits = SplatEdits().assign(keys[:10], 2).assign(keys[5:15], 0).delete(keys[14:16])
    applied = edits.apply(keys, ids, some_splats().means)
    assert applied.object_ids[:5].tolist() == [2] * 5 and not applied.object_ids[5:15].any()
    assert np.array_equal(applied.object_ids[15:], ids[15:]) and applied.missing == 0
    assert np.flatnonzero(~applied.kept).tolist() == [14, 15]
    assert edits.apply(keys[4:12], ids[4:12], some_splats().means[4:12]).missing == 8
    assert edits.apply(keys[:0], ids[:0], np.zeros((0, 3))).missing == 16


def test_inside_box_follows_the_map():
    rng = np.random.default_rng(1)
    local = rng.uniform(-1.5, 1.5, (500, 3))
    points = local @ np.array(BOX)[:3, :3].T + np.array(BOX)[:3, 3]
    assert np.array_equal(inside_box(points, BOX), (np.abs(local) <= 1).all(1))


def rows(count=1, **values) -> np.ndarray:
    table = np.zeros(count, SplatEdits().rows.dtype)
    table["key_low"] = np.arange(count)
    for name, value in values.items():
        table[name] = value
    return table


def hostile(kind: str, folder: Reconstruction) -> None:
    path = folder.splat_edits
    if kind == "not a PLY":
        path.write_bytes(b"PK\x03\x04" * 20)
    elif kind == "splats":
        write_splats(path, some_splats())
    elif kind == "truncated":
        write_vertices(path, rows(5))
        path.write_bytes(path.read_bytes()[:-3])
    elif kind == "huge count":
        write_vertices(path, rows(1))
        path.write_bytes(path.read_bytes().replace(b"vertex 1", b"vertex 99999999999"))
    elif kind == "floats":
        write_vertices(path, rows(3).astype([(name, "f4") for name in rows().dtype.names]))
    elif kind == "signed":
        write_vertices(path, rows(3).astype([(name, "i4") for name in rows().dtype.names]))
    elif kind == "too large":
        table = rows(3).astype([(name, "u4") for name in rows().dtype.names])
        table["deleted"] = 256
        write_vertices(path, table)
    elif kind == "twice":
        write_vertices(path, rows(3, key_low=7))
    elif kind == "folder":
        path.mkdir()
    else:
        write_vertices(path, rows(1), [f"crop {kind}"])


@pytest.mark.parametrize(
    "kind",
    [
        "not a PLY", "splats", "truncated", "huge count", "floats", "signed", "too large", "twice", "folder",
        "1 2 3", "nan " * 16, "0 " * 16, " ".join(["1"] * 17), "x " * 16, "1e999 " * 16,
    ],
)  # fmt: skip
def test_hostile_files_are_refused_by_one_sentence(run_command, folder, tmp_path, kind):
    hostile(kind, folder)
    with pytest.raises(InputError) as caught:
        read_splat_edits(folder)
    assert str(folder.splat_edits) in str(caught.value) and "\n" not in str(caught.value)
    assert_rejected(run_command("export", folder.folder, "--out", tmp_path / "out.ply"), str(folder.splat_edits))
    assert not (tmp_path / "out.ply").exists()


def test_the_file_belongs_to_the_reconstruction(run_command, folder):
    write_splat_edits(folder, SplatEdits(crop=BOX))
    assert_rejected(run_command("export", folder.folder, "--out", folder.splat_edits), "belongs to the reconstruction")


# --- what they do ----------------------------------------------------------------------------------------------------


def test_export_deletes_assigns_and_crops(run_command, folder, tmp_path):
    splats = read_splats(folder.splats)[0]
    keys = keys_of(splats)
    mug = np.flatnonzero(splats.object_ids == 1)
    edits = SplatEdits().delete(keys[mug[:10]]).assign(keys[mug[10:20]], 2)
    write_splat_edits(folder, edits)
    out, warnings = exported(run_command, folder, tmp_path)
    assert not warnings
    wanted = np.ones(len(splats), bool)
    wanted[mug[:10]] = False
    assert np.array_equal(out.means, splats.means[wanted])
    ids = splats.object_ids.copy()
    ids[mug[10:20]] = 2
    assert np.array_equal(out.object_ids, ids[wanted])
    edit_objects(folder.objects, {2: {"removed": True}})
    out, _ = exported(run_command, folder, tmp_path)
    assert np.array_equal(out.object_ids, ids[wanted & (ids != 2)]), "assigned splats follow the edits of the object"
    edit_objects(folder.objects, {2: {"removed": None}, 1: {"transform": [[1, 0, 0, 9], *np.eye(4)[1:].tolist()]}})
    write_splat_edits(folder, SplatEdits(edits.rows, BOX))
    out, _ = exported(run_command, folder, tmp_path, "--objects", "1")
    inside = wanted & inside_box(splats.means, BOX) & (ids == 1)
    assert 0 < inside.sum() < (wanted & (ids == 1)).sum()
    np.testing.assert_allclose(out.means, splats.means[inside] + (9, 0, 0), rtol=1e-6)
    told = run_command("edit", folder.folder).out
    assert "single splats: 10 deleted, 10 assigned, cropped to a box" in told


def test_edits_after_further_training_are_reported_and_kept_but_the_crop_works(run_command, folder, tmp_path):
    splats = read_splats(folder.splats)[0]
    write_splat_edits(folder, SplatEdits(crop=BOX).delete(keys_of(splats)[:30]))
    before = folder.splat_edits.read_bytes()
    splats.means[10:] += np.float32(0.001)
    write_splats(folder.splats, splats)
    out, (warning,) = exported(run_command, folder, tmp_path)
    assert "20 of 30 edits" in warning and str(folder.splat_edits) in warning and warning.endswith(".")
    assert folder.splat_edits.read_bytes() == before
    wanted = inside_box(splats.means, BOX) & (np.arange(len(splats)) >= 10)
    assert np.array_equal(out.means, splats.means[wanted])


def test_nothing_left_is_an_error(run_command, folder, tmp_path):
    away = np.array(BOX)
    away[:3, 3] += 100
    write_splat_edits(folder, SplatEdits(crop=tuple(map(tuple, away.tolist()))))
    assert_rejected(run_command("export", folder.folder, "--out", tmp_path / "x.ply"), "No splats", "cropped")


def test_film_draws_edited_splats_and_draws_again_after_edits(run_command, folder, tmp_path):
    splats = read_splats(folder.splats)[0]
    viewmat = np.eye(4)
    viewmat[:3, 3] = -1, -2, 0
    sample = Sample(1.0, viewmat, np.array([[40.0, 0, 24], [0, 40.0, 18], [0, 0, 1]]), (0.01, 100.0))
    write_shot(tmp_path / "shot.json", Shot(48, 36, [Frame(1, (1.0, 1.0), [sample])]))

    def draw(name, place):
        result = run_command(
            "film", place.folder, "--shot", tmp_path / "shot.json", "--out", tmp_path / name, "--device", "cpu"
        )
        assert result.code == EXIT_DONE, result
        with OpenEXR.File(str(frame_path(tmp_path / name, 1)), separate_channels=True) as file:
            return {channel: values.pixels for channel, values in file.channels().items()}

    before = draw("film", folder)
    mug = np.flatnonzero(splats.object_ids == 1)
    write_splat_edits(folder, SplatEdits().delete(keys_of(splats)[mug[:40]]).assign(keys_of(splats)[mug[40:]], 2))
    after = draw("film", folder)
    assert not np.array_equal(after["A"], before["A"]), "an existing frame of other edits is drawn again"
    other = Reconstruction(tmp_path / "other").create()
    kept = np.setdiff1d(np.arange(len(splats)), mug[:40])
    splats.object_ids[mug[40:]] = 2
    write_splats(other.splats, splats.select(kept))
    other.objects.write_bytes(folder.objects.read_bytes())
    wanted = draw("same", other)
    assert after.keys() == wanted.keys()
    for name, values in after.items():
        assert np.array_equal(values, wanted[name]), name


def test_fills_depend_on_the_edits(folder):
    edit_objects(folder.objects, {1: {"removed": True, "fill": True}})
    before = fill_path(folder, read_objects(folder.objects))
    write_splat_edits(folder, SplatEdits().delete(keys_of(some_splats())[:3]))
    edited = fill_path(folder, read_objects(folder.objects))
    assert before != edited
    write_splat_edits(folder, SplatEdits())
    assert fill_path(folder, read_objects(folder.objects)) == before


def test_fill_is_of_edited_splats(run_command, folder):
    """The hole of an object that is reached only because its splats were assigned to it."""
    rng = np.random.default_rng(0)
    ground = np.column_stack([rng.uniform(-1, 1, (9000, 2)), np.zeros(9000)])
    ground = ground[np.abs(ground).max(1) > 0.15]
    obj = rng.uniform((-0.15, -0.15, 0), (0.15, 0.15, 0.3), (900, 3))
    means = np.concatenate([ground, obj]).astype(np.float32)
    count = len(means)
    splats = Splats(
        means,
        np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        np.tile([0.02, 0.02, 0.001], (count, 1)),
        np.full(count, 0.9),
        rng.normal(size=(count, 1, 3)).astype(np.float32) * 0.1,
        np.repeat([2, HUGE], [len(ground), len(obj)]),
    )
    write_splats(folder.splats, splats)
    assert "its hole not filled" in run_command("edit", folder.folder, "--remove", "mug", "--fill").out
    write_splat_edits(folder, SplatEdits().assign(keys_of(splats)[splats.object_ids == HUGE], 1))
    run_command("edit", folder.folder)
    assert read_vertices(fill_path(folder, read_objects(folder.objects)))["unobserved"].sum() > 50


def test_separated_objects_are_listed_and_kept_by_votes(folder):
    edit_objects(folder.objects, {5: {"separated": True, "name": "handle", "color": [9, 8, 7]}})
    handle = next(entry for entry in read_objects(folder.objects) if entry.id == 5)
    assert (handle.name, handle.color, handle.points, handle.separated) == ("handle", (9, 8, 7), 0, True)
    write_objects(folder.objects, [{"id": 1, "name": "mug", "color": [1, 2, 3], "points": 9}])
    assert [(entry.id, entry.separated) for entry in read_objects(folder.objects)] == [(1, False), (5, True)]
    write_objects(folder.objects, [{"id": 5, "name": "dog", "color": [1, 2, 3], "points": 9}])
    dog = read_objects(folder.objects)
    assert [(entry.id, entry.name, entry.color, entry.separated) for entry in dog] == [(5, "dog", (1, 2, 3), False)]
    assert json.loads(folder.objects.read_text())["edits"] == {}


@pytest.mark.parametrize("key", ["x", "-1", str(2**32), "1.5"])
def test_invalid_separated_objects_are_reported(folder, key):
    content = json.loads(folder.objects.read_text())
    content["edits"] = {key: {"separated": True}}
    folder.objects.write_text(json.dumps(content))
    with pytest.raises(InputError, match=r"objects\.json is not a valid list"):
        read_objects(folder.objects)
