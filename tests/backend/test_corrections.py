"""Correction of masks that contradict the votes of the other views."""

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from backend.capture import load_capture
from backend.labels import correct_masks, vote
from backend.labels.corrections import IGNORED
from backend.shared.errors import EXIT_DONE

from .conftest import SPHERES

FIRST, SECOND, THIRD = (sphere[0] for sphere in SPHERES)


@pytest.fixture
def scene(write_capture):
    """24 views of three spheres with many points."""
    return write_capture(views=24, size=(96, 72))


def mask_path(scene, index):
    view = sorted(scene.folder.rglob("masks/*.png"))[index]
    assert view.is_file()
    return view


def rewrite(path, change):
    mask = np.asarray(Image.open(path)).copy()
    exact = mask.copy()
    change(mask)
    Image.fromarray(mask).save(path)
    return exact


def exchange(mask):
    first, second = mask == FIRST, mask == SECOND
    mask[first], mask[second] = SECOND, FIRST


def loaded(scene, tmp_path, name="cache"):
    capture = load_capture(scene.folder, tmp_path / name)
    return capture, vote(capture).ids


def test_exact_masks_are_unchanged(scene, tmp_path):
    capture, ids = loaded(scene, tmp_path)
    same, regions = correct_masks(capture, ids, ignore_gaps=False)
    assert same is capture and regions == 0


def test_exchanged_ids_are_exchanged_back(scene, tmp_path):
    index = load_capture(scene.folder, tmp_path / "cache").train_indices[3]
    exact = rewrite(mask_path(scene, index), exchange)
    capture, ids = loaded(scene, tmp_path, "again")
    corrected, regions = correct_masks(capture, ids, ignore_gaps=False)
    assert regions == 2
    found = corrected.mask(index)
    assert (capture.mask(index) != exact).sum() > 100, "the capture itself keeps the mask of the file"
    assert ((found != exact) & (found != IGNORED)).sum() <= 0.02 * (exact > 0).sum()
    assert (found == IGNORED).sum() <= 0.1 * (exact > 0).sum()
    half = corrected.mask(index, 2)
    assert np.array_equal(half, found[1::2, 1::2])
    for other in capture.train_indices:
        if other != index:
            assert np.array_equal(corrected.mask(other), capture.mask(other))


def test_objects_of_a_mask_are_found_at_once(scene, tmp_path, monkeypatch):
    index = load_capture(scene.folder, tmp_path / "cache").train_indices[3]
    rewrite(mask_path(scene, index), exchange)
    capture, ids = loaded(scene, tmp_path, "again")
    whole, find = [], ndimage.find_objects

    def counting(labels, *args):
        whole.append(labels.shape == capture.mask(index).shape)
        return find(labels, *args)

    monkeypatch.setattr(ndimage, "find_objects", counting)
    assert correct_masks(capture, ids, ignore_gaps=False)[1] == 2
    assert sum(whole) == 1


@pytest.mark.parametrize("memory_mb", [2000, 0])
def test_masks_of_all_sizes_are_corrected_once(scene, tmp_path, memory_mb):
    """Also where the cache has no room for them."""
    capture = load_capture(scene.folder, tmp_path / "cache", memory_mb)
    calls = []

    def correct(index, mask):
        calls.append(index)
        return np.where(mask == FIRST, IGNORED, 70_000)

    corrected = capture.with_corrected_masks(frozenset({3}), correct)
    whole, half = corrected.mask(3), corrected.mask(3, 2)
    assert calls == [3] and whole.dtype == half.dtype == np.int64
    assert np.array_equal(whole, np.where(capture.mask(3) == FIRST, IGNORED, 70_000))
    assert np.array_equal(half, whole[1::2, 1::2])


def test_flooded_background_is_ignored(scene, tmp_path):
    """The second sphere is background; in one mask it has, with the rest, the ID of the third."""
    index = load_capture(scene.folder, tmp_path / "cache").train_indices[2]

    def flood(mask):
        third, background = mask == THIRD, (mask == 0) | (mask == SECOND)
        mask[background], mask[third] = THIRD, 0

    for each in range(24):
        rewrite(mask_path(scene, each), flood if each == index else lambda mask: mask.__setitem__(mask == SECOND, 0))
    capture, ids = loaded(scene, tmp_path, "again")
    corrected, regions = correct_masks(capture, ids, ignore_gaps=False)
    flooded = capture.mask(index) == THIRD
    assert regions >= 1 and (corrected.mask(index)[flooded] == IGNORED).mean() > 0.9


def test_held_out_views_are_not_corrected(scene, tmp_path):
    index = load_capture(scene.folder, tmp_path / "cache").test_indices[0]
    rewrite(mask_path(scene, index), lambda mask: mask.__setitem__(mask == FIRST, SECOND))
    capture, ids = loaded(scene, tmp_path, "again")
    assert correct_masks(capture, ids, ignore_gaps=False)[1] == 0


@pytest.mark.parametrize("judged_every", [1, 3])
def test_object_without_points_keeps_its_masks(scene, tmp_path, write_capture, judged_every):
    """Points behind an object that has none of its own must not take over its pixels, however few views have enough."""
    keep = scene.point_objects != FIRST
    kept = np.cumsum(keep) - 1
    behind = kept[scene.point_objects == SECOND]
    capture = load_capture(scene.folder, tmp_path / "cache")
    for i, seen in enumerate(scene.seen):
        mine = keep[seen] & (scene.point_objects[seen] != SECOND)
        rows, columns = np.nonzero(capture.mask(i) == FIRST)
        count = min(30 if i % judged_every == 0 else 5, len(rows), len(behind))
        # Wrong observations of another object's points all over the object.
        scene.seen[i] = np.concatenate([kept[seen[mine]], behind[:count]])
        scene.pixels[i] = np.concatenate([scene.pixels[i][mine], np.stack([columns, rows], 1)[:count] + 0.5])
    scene.xyz, scene.rgb, scene.point_objects = scene.xyz[keep], scene.rgb[keep], scene.point_objects[keep]
    write_capture.write_model(scene, scene.folder / "sparse/0", ".bin")
    capture = load_capture(scene.folder, tmp_path / "again")
    corrected, _ = correct_masks(capture, scene.point_objects, ignore_gaps=False)
    for index in capture.train_indices:
        own = capture.mask(index) == FIRST
        assert (corrected.mask(index)[own] == FIRST).all()


def test_training_reports_corrections_and_resumes_the_same(scene, tmp_path, run_command):
    rewrite(mask_path(scene, 7), exchange)
    out = tmp_path / "out"
    words = ("train", scene.folder, "--out", out, "--json")
    first = run_command(*words, "--steps", 20)
    assert first.code == EXIT_DONE and any("contradict" in event.get("message", "") for event in first.events)
    again = run_command(*words, "--steps", 30)
    assert again.code == EXIT_DONE and any("contradict" in event.get("message", "") for event in again.events)


def test_gaps_are_ignored_and_background_is_not(write_capture, tmp_path):
    """One mask lacks a sphere, and a line is cut out of the others; the rest of the photo shows no object."""
    scene = write_capture(views=24, size=(96, 72), points=600)
    index = load_capture(scene.folder, tmp_path / "cache").train_indices[3]
    exact = rewrite(mask_path(scene, index), lambda mask: mask.__setitem__(mask == SECOND, 0))
    largest = np.unique(exact[exact != SECOND], return_counts=True)
    kept = largest[0][1:][largest[1][1:].argmax()]
    rows = np.nonzero(exact == kept)[0]
    line = (exact == kept) & (np.arange(exact.shape[0]) == int(np.median(rows)))[:, None]
    rewrite(mask_path(scene, index), lambda mask: mask.__setitem__(line, 0))
    capture, ids = loaded(scene, tmp_path, "again")
    corrected, _ = correct_masks(capture, ids, ignore_gaps=True)
    found = corrected.mask(index)
    assert line.sum() > 10 and (found[line] == IGNORED).mean() > 0.8
    background = exact == 0
    assert (found[background] == 0).mean() > 0.85
    assert (correct_masks(capture, ids, ignore_gaps=False)[0].mask(index) != IGNORED).all()
    assert (found[exact == SECOND] == IGNORED).mean() > 0.9


def test_objects_that_are_left_out_are_background_and_gaps_beside_others_are_not(scene, tmp_path):
    """Of the first sphere's mask in one view, a line beside the second is missing; in another the two are exchanged."""
    before = load_capture(scene.folder, tmp_path / "cache")
    beside = {i: ndimage.binary_dilation((m := before.mask(i)) == FIRST) & (m == SECOND) for i in before.train_indices}
    cut = max(beside, key=lambda index: beside[index].sum())
    swapped = next(index for index in beside if index != cut)
    rewrite(mask_path(scene, cut), lambda mask: mask.__setitem__(beside[cut], 0))
    rewrite(mask_path(scene, swapped), exchange)
    capture, ids = loaded(scene, tmp_path, "again")
    corrected, _ = correct_masks(capture.edited({}, [SECOND, THIRD]), ids, ignore_gaps=True)
    assert beside[cut].sum() > 10 and (corrected.mask(cut)[beside[cut]] == IGNORED).mean() > 0.8
    for index in capture.train_indices:
        exact, found = before.mask(index), corrected.mask(index)
        assert (found[np.isin(exact, (SECOND, THIRD)) & ~beside[index]] == 0).mean() > 0.9
        assert (found[exact == FIRST] == FIRST).mean() > 0.9
        assert (found[exact == 0] == 0).mean() > 0.9
