"""objects.json: the objects from the votes, the user's edits, and nested merges."""

from __future__ import annotations

import json

import numpy as np
import pytest

from backend.shared.color.recolor import Recolor
from backend.shared.errors import InputError
from backend.shared.reconstruction.meshes import MeshEntry, outdate_meshes, read_meshes, write_meshes
from backend.shared.reconstruction.objects import (
    SceneObject,
    edit_objects,
    forget_vanished,
    is_singular,
    members_of,
    merged,
    read_objects,
    shown_as,
    write_objects,
)

MUG = {"id": 1, "name": "mug", "color": [10, 20, 30], "points": 812}
BOX = {"id": 2**32 - 1, "name": "box", "color": [40, 50, 60], "points": 7}


@pytest.fixture
def path(tmp_path):
    """Path of an objects.json that lists the box before the mug."""
    write_objects(tmp_path / "objects.json", [BOX, MUG])
    return tmp_path / "objects.json"


def test_objects_match_votes(path):
    assert read_objects(path) == [
        SceneObject(1, "mug", (10, 20, 30), 812),
        SceneObject(2**32 - 1, "box", (40, 50, 60), 7),
    ]


def test_edits_are_applied_and_survive_new_votes(path):
    edit_objects(path, {1: dict(name="cup", color=(255, 0, 0))})
    edit_objects(path, {1: dict(merged_into=2**32 - 1, left_out=True)})
    edited = SceneObject(1, "cup", (255, 0, 0), 812, 2**32 - 1, True)
    assert read_objects(path)[0] == edited
    edit_objects(path, {1: {}, 2**32 - 1: {"name": None}, 77: {"left_out": False}})
    write_objects(path, [{**MUG, "name": "mug again", "points": 3}])
    assert read_objects(path) == [SceneObject(1, "cup", (255, 0, 0), 3, 2**32 - 1, True)]
    write_objects(path, [BOX])
    assert read_objects(path) == [SceneObject(2**32 - 1, "box", (40, 50, 60), 7)]
    write_objects(path, [MUG])
    assert read_objects(path) == [edited], "edits are kept while their object is missing"


def test_edits_of_vanished_objects_are_forgotten(path):
    edit_objects(path, {1: {"name": "cup"}, 9: {"separated": True, "name": "part", "color": [1, 2, 3]}})
    write_objects(path, [BOX])
    forget_vanished(path)
    write_objects(path, [BOX, MUG])
    assert [(entry.id, entry.name) for entry in read_objects(path)] == [(1, "mug"), (9, "part"), (2**32 - 1, "box")]
    forget_vanished(path.with_name("missing.json"))


def test_edits_can_be_reverted(path):
    edit_objects(path, {1: dict(name="cup", left_out=True)})
    edit_objects(path, {1: dict(name=None)})
    assert read_objects(path)[0] == SceneObject(1, "mug", (10, 20, 30), 812, None, True)
    edit_objects(path, {1: dict(left_out=None)})
    assert json.loads(path.read_text())["edits"] == {}


MOVED = ((1.0, 0.0, 0.0, 2.0), (0.0, 0.0, -1.0, 0.0), (0.0, 1.0, 0.0, 0.5), (0.0, 0.0, 0.0, 1.0))


def test_recolor_transform_and_copies_are_stored(path):
    edit_objects(path, {1: dict(removed=True, recolor=Recolor(hue=0.2).stored(), transform=MOVED, copies=[MOVED])})
    mug = read_objects(path)[0]
    assert (mug.removed, mug.recolor, mug.transform, mug.copies) == (True, Recolor(hue=0.2), MOVED, (MOVED,))
    edit_objects(path, {1: dict(floaters=True, fill=True)})
    assert read_objects(path)[0].floaters and read_objects(path)[0].fill
    edit_objects(path, {1: dict.fromkeys(("removed", "floaters", "fill", "recolor", "transform", "copies"))})
    assert read_objects(path)[0] == SceneObject(1, "mug", (10, 20, 30), 812)


@pytest.mark.parametrize("edit", [
    {"recolor": 3}, {"recolor": {"hue": "red"}}, {"transform": [[1, 0], [0, 1]]},
    {"copies": [1]}, {"transform": [*MOVED[:3], [0, 0, 1, 1]]},
])  # fmt: skip
def test_invalid_edits_are_reported(path, edit):
    edit_objects(path, {1: edit})
    with pytest.raises(InputError, match=r"objects\.json"):
        read_objects(path)


def test_objects_scaled_to_nothing_keep_the_file_usable(path):
    flat = [[0.0] * 4, *map(list, MOVED[1:])]
    before = path.read_text()
    for edit in ({"transform": flat}, {"copies": [MOVED, flat]}):
        with pytest.raises(InputError, match="scaled to nothing"):
            edit_objects(path, {1: edit})
    assert path.read_text() == before
    # Earlier versions have written them.
    path.write_text(json.dumps({**json.loads(before), "edits": {"1": {"transform": flat, "copies": [MOVED, flat]}}}))
    mug = read_objects(path)[0]
    assert mug.transform is None and mug.copies == (MOVED,)


def test_what_is_flat_within_single_precision_is_scaled_to_nothing():
    turn = np.linalg.qr(np.array([[1.0, 2.0, 3.0], [0.0, 1.0, 4.0], [5.0, 6.0, 0.0]]))[0]
    for size, expected in ((0.0, True), (1e-4, False)):
        for scale in (1e-3, 1.0, 1e3):
            found = np.eye(4)
            found[:3, :3] = (scale * turn @ np.diag([size, 1.0, 1.0]) @ turn.T).astype(np.float32)
            assert is_singular(found) == expected


def test_only_editable_fields_are_changed(path):
    before = path.read_text()
    with pytest.raises(ValueError, match="points"):
        edit_objects(path, {1: dict(points=3)})
    assert path.read_text() == before
    content = json.loads(before)
    path.write_text(json.dumps({**content, "edits": {"1": {"points": 3, "id": 9, "later": 1}}}))
    assert read_objects(path)[0] == SceneObject(1, "mug", (10, 20, 30), 812)


@pytest.mark.parametrize(
    ("into", "shown"),
    [
        ({}, {1: 1, 2: 2, 3: 3}),
        ({1: 2, 2: 3}, {1: 3, 2: 3, 3: 3}),
        ({1: 1}, {1: 1, 2: 2, 3: 3}),
        ({1: 9}, {1: 1, 2: 2, 3: 3}),
        ({1: 0}, {1: 1, 2: 2, 3: 3}),
    ],
)
def test_chained_merges_are_resolved(into, shown):
    assert merged([SceneObject(i, "", (0, 0, 0), 1, into.get(i)) for i in (1, 2, 3)]) == shown


def test_circular_merges_terminate():
    circle = merged([SceneObject(i, "", (0, 0, 0), 1, i % 3 + 1) for i in (1, 2, 3)])
    assert set(circle) == {1, 2, 3} and set(circle.values()) <= {1, 2, 3}


def test_what_is_left_out_is_not_shown_nor_what_is_merged_into_it():
    objects = [
        SceneObject(1, "", (0, 0, 0), 1, merged_into=2),
        SceneObject(2, "", (0, 0, 0), 1, merged_into=3),
        SceneObject(3, "", (0, 0, 0), 1),
        SceneObject(4, "", (0, 0, 0), 1, merged_into=5),
        SceneObject(5, "", (0, 0, 0), 1, left_out=True),
        SceneObject(6, "", (0, 0, 0), 1, merged_into=3, left_out=True),
    ]
    assert shown_as(objects) == {1: 3, 2: 3, 3: 3, 4: None, 5: None, 6: None}
    assert members_of(objects, 3) == [1, 2, 3, 6] and members_of(objects, 5) == [4, 5] and members_of(objects, 1) == []


@pytest.mark.parametrize(
    "text",
    ["", "{", "[]", "{}", '{"objects": 3}', '{"objects": [{"id": 1}]}', '{"objects": [], "edits": []}',
     '{"objects": [], "edits": {"1": 2}}',
     '{"objects": [{"id": 1, "name": "a", "color": [1, 2], "points": 1}]}',
     '{"objects": [{"id": 1, "name": "a", "color": [1, 2, 3], "points": 1}], "edits": {"1": {"merged_into": "x"}}}'],
)  # fmt: skip
def test_invalid_files_are_reported_in_one_sentence(tmp_path, text):
    path = tmp_path / "objects.json"
    path.write_text(text)
    with pytest.raises(InputError, match=r"objects\.json") as caught:
        read_objects(path)
    assert "\n" not in str(caught.value) and path.read_text() == text


def test_missing_file_is_reported(tmp_path):
    with pytest.raises(InputError, match=r"objects\.json does not exist"):
        read_objects(tmp_path / "objects.json")


def test_meshes_of_vanished_objects_are_deleted(tmp_path):
    entries = {
        "1": MeshEntry("1", "mug", (1, 2), 100, file="1.ply", texture="1.png"),
        "3": MeshEntry("3", "box", (3,), 100, file="3.ply", texture="3.png"),
        "0": MeshEntry("0", "rest", (0,), 100, file="0.ply"),
        "scene": MeshEntry("scene", "all", None, 100, file="scene.ply"),
    }
    for name in ("1.ply", "1.png", "3.ply", "3.png", "0.ply", "scene.ply"):
        (tmp_path / name).write_bytes(b"")
    write_meshes(tmp_path, entries, 100)
    outdate_meshes(tmp_path, {1, 4})
    kept = read_meshes(tmp_path)
    assert set(kept) == {"1", "0", "scene"} and all(entry.trained_steps is None for entry in kept.values())
    assert {path.name for path in tmp_path.iterdir()} == {"1.ply", "1.png", "0.ply", "scene.ply", "meshes.json"}
