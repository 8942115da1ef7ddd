# SPDX-License-Identifier: GPL-3.0-or-later
"""Floaters of an object: which splats they are, and the edit that hides them in exports and films."""

import json

import numpy as np
import pytest

from backend.editing import apply_edits
from backend.export import write_splats
from backend.model.splats import Splats
from backend.shared.reconstruction.fill import fill_path
from backend.shared.reconstruction.folder import Reconstruction
from backend.shared.reconstruction.objects import SceneObject, read_objects
from backend.shared.splats.floaters import FEWEST, far, floating

FAR, GROUP = 5, 6


def shape(seed=0, n=600):
    """Return the centers (n + FAR + GROUP, 3) of a box's surface, of splats far from it, and of a group beside it."""
    rng = np.random.default_rng(seed)
    box = rng.uniform(-1, 1, (n, 3))
    side = rng.integers(3, size=n)
    box[np.arange(n), side] = np.sign(box[np.arange(n), side])
    strays = rng.normal(size=(FAR, 3))
    strays *= rng.uniform(20, 60, (FAR, 1)) / np.linalg.norm(strays, axis=1, keepdims=True)
    return np.concatenate([box, strays, (2.5, 0, 0) + 0.05 * rng.normal(size=(GROUP, 3))])


def splats_of(means, ids):
    count = len(means)
    rng = np.random.default_rng(1)
    return Splats(
        means.astype(np.float32),
        np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        np.full((count, 3), 0.1, np.float32),
        np.full(count, 0.9, np.float32),
        rng.normal(size=(count, 4, 3)).astype(np.float32),
        np.asarray(ids, np.int64),
    )


def scene_object(object_id, **edits):
    return SceneObject(object_id, f"object {object_id}", (1, 2, 3), 1, **edits)


def test_floaters_are_far_splats_and_small_groups():
    means = shape()
    expected = np.arange(len(means)) >= len(means) - FAR - GROUP
    assert np.array_equal(floating(means), expected)
    assert far(means).sum() == FAR and not floating(means[~expected]).any()
    bounds = np.ptp(means[~floating(means)], axis=0)
    assert np.ptp(means, axis=0).max() > 20 and bounds.max() == pytest.approx(2.0, rel=0.01)


def test_floaters_do_not_depend_on_order_unit_or_origin():
    means = shape(3)
    expected = floating(means)
    order = np.random.default_rng(0).permutation(len(means))
    assert np.array_equal(floating(means[order]), expected[order])
    assert np.array_equal(floating(1e-3 * means), expected)
    assert np.array_equal(floating(means + np.array([1000.0, -2000.0, 500.0])), expected)


def test_larger_parts_are_no_floaters():
    """A lid that lies beside its pot belongs to the object."""
    rng = np.random.default_rng(2)
    lid = rng.uniform((3, 0, 0), (3.6, 0.6, 0.05), (60, 3))
    assert floating(np.concatenate([shape(), lid])).sum() == FAR + GROUP


@pytest.mark.parametrize("count", [0, 1, FEWEST - 1, 100])
def test_few_or_coincident_splats_have_no_floaters(count):
    assert not floating(np.ones((count, 3))).any() and not far(np.ones((count, 3))).any()


def test_cleaned_objects_lose_their_floaters_alone():
    means = np.concatenate([shape(0), shape(1) + 5.0])
    splats = splats_of(means, np.repeat([1, 2], len(shape())))
    cleaned = apply_edits(splats, [scene_object(1, cleaned=True), scene_object(2)])
    keep = ~(floating(splats.means[: len(shape())]))
    expected = splats.select(np.concatenate([np.flatnonzero(keep), np.arange(len(shape()), len(splats))]))
    assert len(cleaned) == len(splats) - FAR - GROUP
    for name in ("means", "sh", "object_ids"):
        assert np.array_equal(getattr(cleaned, name), getattr(expected, name))


def test_floaters_of_merged_objects_and_duplicates():
    """Merged objects are cleaned as one, so that a small part of its own is no floater beside the other one."""
    means = np.concatenate([shape(), shape()[:GROUP] * 0.1 + (0, 0, 1.1)])
    splats = splats_of(means, np.repeat([1, 2], [len(shape()), GROUP]))
    move = ((1, 0, 0, 9), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1))
    objects = [scene_object(1, cleaned=True, copies=(move,)), scene_object(2, merged_into=1)]
    edited = apply_edits(splats, objects)
    assert len(edited) == 2 * (len(splats) - FAR - GROUP)
    assert np.abs(edited.means[:, 1:]).max() < 2.0


def test_edit_command_cleans_and_restores(run_command, tmp_path):
    folder = Reconstruction(tmp_path)
    means = np.concatenate([shape(0), shape(1)])
    write_splats(folder.splats, splats_of(means, np.repeat([1, 2], len(shape()))))
    objects = [{"id": i, "name": name, "color": [1, 2, 3], "points": 1} for i, name in ((1, "pot"), (2, "mug"))]
    folder.objects.write_text(json.dumps({"objects": objects, "edits": {}}))

    def cleaned():
        return [entry.id for entry in read_objects(folder.objects) if entry.cleaned]

    assert "1 pot: floaters hidden" in run_command("edit", tmp_path, "--clean-floaters", "pot").out
    assert cleaned() == [1]
    out = tmp_path.parent / "out.ply"
    run_command("export", tmp_path, "--out", out, "--objects", "pot")
    assert f"element vertex {len(shape()) - FAR - GROUP}\n".encode() in out.read_bytes()
    run_command("edit", tmp_path, "--clean-floaters", "ALL")
    assert cleaned() == [1, 2]
    run_command("edit", tmp_path, "--restore-floaters", "mug")
    assert cleaned() == [1]
    run_command("edit", tmp_path, "--reset", "all")
    assert cleaned() == [] and json.loads(folder.objects.read_text())["edits"] == {}


def test_fills_of_cleaned_objects_are_separate(tmp_path):
    """Splats that floaters hide change which splats fill a hole; other fills stay valid."""
    folder = Reconstruction(tmp_path)
    write_splats(folder.splats, splats_of(shape(), np.ones(len(shape()))))
    removed = scene_object(1, removed=True, fill=True)
    before = fill_path(folder, [removed, scene_object(2)])
    assert fill_path(folder, [removed, scene_object(2, cleaned=True)]) != before
