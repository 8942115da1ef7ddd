# SPDX-License-Identifier: GPL-3.0-or-later
"""What the viewport draws of scenes with many splats: their levels of detail, order and marks."""

import gc
import threading
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("bpy")

from objectgs.backend.shared.splats.levels import BLOCK, build_levels
from objectgs.backend.shared.splats.picking import View
from objectgs.objectgs_addon.drawing import detail, entries
from objectgs.objectgs_addon.drawing.entries import DrawnObject, entries_of
from objectgs.objectgs_addon.drawing.shaders import INDEX_OFFSET, SELECTED
from objectgs.objectgs_addon.drawing.splat_arrays import Labels, SplatArrays

COUNT = 20 * BLOCK + 10


def splats(seed: int = 0, count: int = COUNT) -> SplatArrays:
    rng = np.random.default_rng(seed)
    return SplatArrays(
        rng.uniform(-1, 1, (count, 3)).astype(np.float32),
        np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        np.full((count, 3), 0.01, np.float32),
        np.full(count, 0.5, np.float32),
        rng.normal(size=(count, 4, 3)).astype(np.float32),
    )


def drawn(arrays: SplatArrays, levels=None, **words) -> DrawnObject:
    return DrawnObject(arrays, np.eye(4), np.eye(3, 4), (0.0, 0.0, 0.0, 0.0), levels=levels, **words)


def view(distance: float) -> View:
    matrix = np.eye(4)
    matrix[2, 3] = distance
    return View(matrix, 300.0, 300.0, 160.0, 120.0, 320, 240)


def levels_of(arrays: SplatArrays):
    return build_levels(arrays.means, arrays.quats, arrays.scales, arrays.opacities, arrays.harmonics)


def indices(table: np.ndarray) -> np.ndarray:
    return table[:, 0].astype(np.int64) + INDEX_OFFSET


@pytest.fixture
def many(monkeypatch):
    """Scenes of a few thousand splats count as large."""
    monkeypatch.setattr(detail, "MOST", 2000)
    monkeypatch.setattr(entries, "MOST", 2000)
    yield
    detail.unregister()


def wait(objs):
    for future in list(detail._built.values()):
        future.result(30)
    assert not detail.is_building()
    return detail.with_levels(objs)


def test_small_scenes_draw_all_splats():
    objs = [drawn(splats()), drawn(splats(1, 50))]
    assert detail.with_levels(objs) == objs and not detail.is_building() and not len(detail._built)
    table = entries_of(objs, {id(objs[0].splats): 0, id(objs[1].splats): COUNT}).update(objs, view(5.0))
    assert sorted(indices(table).tolist()) == list(range(COUNT + 50))
    depth = np.concatenate([obj.splats.means[:, 2] for obj in objs])[indices(table)] + 5.0
    assert (np.diff(depth) < 3e-4 * depth[1:]).all()
    assert np.array_equal(table[:, 1], indices(table) >= COUNT)


def test_splats_before_the_near_plane_come_back_when_it_does():
    objs = [drawn(splats())]
    entries = entries_of(objs, {id(objs[0].splats): 0})
    assert len(entries.update(objs, view(5.0))) == COUNT and entries.update(objs, view(5.0)) is None
    some = entries.update(objs, replace(view(5.0), near=5.0))
    assert 0 < len(some) < COUNT and len(entries.update(objs, view(5.0))) == COUNT


def test_indices_are_exact_beyond_the_integers_of_float32():
    arrays = splats(0, 3)
    obj = drawn(arrays)
    for start in (2**23 + 1, 2**24 + 1, 2**25 - 3):
        table = entries_of([obj], {id(arrays): start}).update([obj], view(5.0))
        assert table.dtype == np.float32 and sorted(indices(table).tolist()) == [start, start + 1, start + 2]


def test_levels_are_built_once_and_dropped_with_the_splats(many):
    objs = [drawn(splats()), drawn(splats(1, 50))]
    assert all(obj.levels is None for obj in detail.with_levels(objs))
    first = wait(objs)
    assert first[0].levels is not None and first[1].levels is None
    assert detail.with_levels(objs)[0].levels is first[0].levels
    del objs, first
    gc.collect()
    assert not len(detail._built)


def test_an_edit_of_one_object_keeps_the_levels_of_the_others(many, monkeypatch):
    objs = [drawn(splats()), drawn(splats(1))]
    assert all(obj.levels is not None for obj in (detail.with_levels(objs), wait(objs))[1])
    may_build = threading.Event()
    monkeypatch.setattr(detail, "build_levels", lambda *args: may_build.wait(30) and build_levels(*args))
    objs[1] = drawn(splats(2))
    first, second = detail.with_levels(objs)
    assert first.levels is not None and second.levels is None and detail.is_building()
    may_build.set()
    assert all(obj.levels is not None for obj in wait(objs))


def test_new_levels_are_drawn_once_all_are_built(many, monkeypatch):
    may_build = threading.Event()

    def build(means, *args):
        assert len(means) == COUNT or may_build.wait(30)
        return build_levels(means, *args)

    monkeypatch.setattr(detail, "build_levels", build)
    objs = [drawn(splats()), drawn(splats(1, COUNT + 1))]
    detail.with_levels(objs)
    detail._built[objs[0].splats].result(30)
    assert all(obj.levels is None for obj in detail.with_levels(objs))
    may_build.set()
    assert all(obj.levels is not None for obj in wait(objs))


def test_building_stops_when_the_splats_are_dropped(many, monkeypatch):
    begun, stopped = threading.Event(), threading.Event()

    def build(*arrays_and_stop):
        begun.set()
        while not arrays_and_stop[-1]():
            pass
        stopped.set()
        raise detail.Stopped

    monkeypatch.setattr(detail, "build_levels", build)
    objs = [drawn(splats())]
    detail.with_levels(objs)
    assert begun.wait(30) and detail.is_building()
    del objs
    gc.collect()
    assert stopped.wait(30)


def test_what_cannot_be_built_is_drawn_without_levels(many, monkeypatch, capsys):
    def build(*_):
        raise MemoryError("too much")

    monkeypatch.setattr(detail, "build_levels", build)
    objs = [drawn(splats())]
    detail.with_levels(objs)
    assert wait(objs)[0].levels is None and "too much" in capsys.readouterr().out


def test_entries_follow_the_view(many):
    arrays, other = splats(), splats(1, 50)
    levels = levels_of(arrays)
    objs = [drawn(arrays, levels), drawn(other)]
    starts = {id(arrays): 0, id(other): COUNT, id(levels.merged): COUNT + 50}
    found = entries_of(objs, starts)
    means = np.concatenate([arrays.means, other.means, levels.merged.means])
    counts = []
    for distance in (3.0, 30.0, 300.0):
        table = found.update(objs, view(distance))
        depth = means[indices(table)][:, 2] + distance
        assert (np.diff(depth) < 3e-4 * depth[1:]).all()
        assert np.array_equal(table[:, 1] == 1.0, (indices(table) >= COUNT) & (indices(table) < COUNT + 50))
        counts.append(len(table))
        assert found.update(objs, view(distance)) is None
    assert counts == sorted(counts, reverse=True) and counts[-1] == 20 + 10 + 50
    assert counts[0] <= 2000 + 50
    assert found.holds(objs) and not found.holds(objs[:1]) and not found.holds([drawn(arrays), objs[1]])


def test_selected_and_labeled_splats_are_drawn_one_by_one(many):
    arrays = splats()
    levels = levels_of(arrays)
    starts = {id(arrays): 0, id(levels.merged): COUNT}
    selected = np.zeros(COUNT, bool)
    selected[levels.order[3]] = True
    of_splats = np.zeros(COUNT, np.int64)
    of_splats[levels.order[BLOCK : 2 * BLOCK]] = 2
    labels = Labels(of_splats, np.zeros((2, 3)))
    plain = drawn(arrays, levels, labels=Labels(np.zeros(COUNT, np.int64), np.zeros((2, 3))))
    found = entries_of([plain], starts)
    assert (found.update([plain], view(300.0))[:, 1] == 0.0).all()
    marked = drawn(arrays, levels, selected=selected, labels=labels)
    table = found.update([marked], view(300.0))
    assert indices(table)[table[:, 1] == SELECTED].tolist() == [levels.order[3]]
    assert set(levels.order[:BLOCK].tolist()) <= set(indices(table).tolist())
    assert (indices(table) >= COUNT).sum() == 19 and (table[:, 1] == 2.0).sum() == 1
    whole = drawn(arrays, None, selected=selected, labels=labels)
    table = entries_of([whole], starts).update([whole], view(300.0))
    assert len(table) == COUNT and (table[:, 1] == 2.0).sum() == BLOCK
    assert indices(table)[table[:, 1] % 1 == SELECTED].tolist() == [levels.order[3]]
