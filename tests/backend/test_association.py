"""One ID for each object in all photos, from segments that are numbered in each photo."""

import json
import shutil

import numpy as np
import pytest
from PIL import Image
from scipy import sparse

from backend.capture import load_capture
from backend.capture.files import read_mask
from backend.labels.association import LEAST, Seen, _merged, associate, consistency, object_mask
from backend.labels.regions import merge_regions, merge_tree, stable_regions
from backend.labels.renumbering import renumber_masks
from backend.shared.errors import EXIT_DONE

from .command_result import assert_rejected


def symmetric(entries, count):
    rows, columns, values = zip(*[(*pair, value) for pair, value in entries.items()], strict=True)
    half = sparse.coo_array((values, (rows, columns)), shape=(count, count)).tocsr()
    return (half + half.T).tocsr()


def partition(regions):
    return {frozenset(np.flatnonzero(regions == number).tolist()) for number in np.unique(regions)}


def test_regions_are_merged_by_the_mean_of_their_borders():
    shared = symmetric({(0, 1): 9.0, (1, 2): 6.0, (0, 2): 0.0, (3, 4): 1.0}, 5)
    total = symmetric({(0, 1): 10.0, (1, 2): 10.0, (0, 2): 10.0, (3, 4): 10.0}, 5)
    assert partition(merge_regions(shared, total, 0.5)) == {frozenset({0, 1}), *(frozenset({i}) for i in (2, 3, 4))}
    assert partition(merge_regions(shared, total, 0.25)) == {frozenset({0, 1, 2}), frozenset({3}), frozenset({4})}


def test_stable_regions_are_those_that_last_longest():
    """Two pairs of parts, each of which merges early, a bridge between the pairs, and a speck."""
    pairs = {(0, 1): 0.8, (2, 3): 0.7, (1, 2): 0.1, (3, 4): 0.05, (4, 5): 0.04}
    tree = merge_tree(symmetric(pairs, 6), symmetric(dict.fromkeys(pairs, 1.0), 6), 1e-3)
    sizes = np.array([5.0, 5.0, 6.0, 4.0, 0.1, 7.0])
    found = stable_regions(tree, sizes, 1.0, 0.04)
    assert partition(found[:4]) == {frozenset({0, 1}), frozenset({2, 3})} and (found[4:] == -1).all()
    assert stable_regions(tree, sizes, 1.0, 1e-3).tolist() == [0] * 6, "the whole lasts longest"
    assert stable_regions(tree, sizes, 12.0, 0.04).tolist() == [0] * 6, "the pairs are too small"


def greedy(shared, total, least):
    """The same by definition, on dense arrays."""
    groups = [[i] for i in range(len(shared))]
    while True:
        best, pair = least, None
        for i in range(len(groups)):
            for j in range(i):
                down = total[np.ix_(groups[i], groups[j])].sum()
                ratio = shared[np.ix_(groups[i], groups[j])].sum() / down if down else 0.0
                if ratio > best:
                    best, pair = ratio, (i, j)
        if pair is None:
            return {frozenset(group) for group in groups}
        groups[pair[1]] += groups.pop(pair[0])


@pytest.mark.parametrize("count", [12, 40, 90])
@pytest.mark.long
def test_merging_agrees_with_its_definition(count):
    rng = np.random.default_rng(count)
    total = np.where(rng.random((count, count)) < 8 / count, rng.uniform(1, 5, (count, count)), 0.0)
    total = np.triu(total, 1) + np.triu(total, 1).T
    shared = total * (lambda part: np.triu(part, 1) + np.triu(part, 1).T)(rng.random((count, count)))
    for least in (0.3, 0.5, 0.7):
        found = merge_regions(sparse.csr_array(shared), sparse.csr_array(total), least)
        assert partition(found) == greedy(shared, total, least)


def test_segments_are_merged_as_by_all_pairs():
    """Also where most pairs share no points, and where segments of one photo are merged by way of others."""
    rng = np.random.default_rng(0)
    photos, each, points = 12, 5, 120
    of_photo = np.repeat(np.arange(photos), each)
    visible = rng.random((photos, points)) < 0.6
    members = np.zeros((photos * each, points))
    for photo in range(photos):
        part = np.arange(points) * 4 // points + (rng.random(points) < 0.2)
        for segment in range(each):
            members[photo * each + segment] = visible[photo] & (part == segment)
    together, inside = members @ members.T, members @ visible.T
    either = inside[:, of_photo] + inside[:, of_photo].T - together
    for full in (together, either):
        np.fill_diagonal(full, 0)
    own = of_photo[:, None] == np.arange(photos)
    found = _merged(*(sparse.csr_array(a.astype(float)) for a in (together, inside, own)))
    assert partition(found) == greedy(together, either, LEAST) and 3 < found.max() + 1 < photos * each


def seen(points, segments):
    points, segments = np.array(points), np.array(segments)
    at = np.stack([points % 10, points // 10], 1)
    return Seen(points, at, segments, np.ones(len(points), bool), int(segments.max(initial=0)))


def test_segments_that_show_the_same_points_are_one_object():
    points = np.arange(60)
    true = points // 20  # 0 is no object
    photos = [
        seen(points, np.choose(true, (0, 1, 2))),
        seen(points, np.choose(true, (0, 2, 1))),
        seen(points[10:], np.choose(true, (0, 1, 2))[10:]),
        # The first object in two parts.
        seen(points, np.where(true == 1, 1 + (points % 20 < 8), 3 * (true == 2))),
    ]
    found = associate(photos, 60)
    one, other = found.points[20], found.points[40]
    assert sorted((one, other)) == [1, 2]
    assert (found.points == np.choose(true, (0, one, other))).all()
    assert found.objects[1].tolist() == [0, other, one] and found.objects[3].tolist() == [0, one, one, other]
    assert (found.agreement == 1.0).all()


def test_object_of_a_single_photo_is_dropped_and_empty_input_has_no_objects():
    alone = associate([seen([1, 2, 3], [1, 1, 1]), seen([7, 8], [0, 0])], 10)
    assert alone.objects[0].tolist() == [0, 0] and not alone.points.any()
    nothing = associate([], 5)
    assert nothing.objects == [] and nothing.points.tolist() == [0] * 5


def test_consistency_tells_ids_of_objects_from_numbers_in_each_photo():
    photos = [seen(np.arange(30), np.ones(30, int)) for _ in range(4)]
    ids = np.arange(30) // 10 + 1
    assert consistency([ids] * 4, photos) == 1.0
    assert consistency([ids, ids % 3 + 1, (ids + 1) % 3 + 1, ids], photos) == pytest.approx(0.5)
    assert consistency([ids * 0] * 4, photos) == 1.0


def test_segment_of_two_objects_is_divided_and_points_at_its_border_do_not_count():
    segments = np.zeros((60, 120), np.int64)
    segments[10:50, 10:110] = 1
    grid = np.stack(np.meshgrid(np.arange(14, 108, 6), np.arange(14, 48, 6)), -1).reshape(-1, 2)
    objects = np.where(grid[:, 0] < 60, 1, 2)
    photo = Seen(np.arange(len(grid)), grid, np.ones(len(grid), np.int64), np.ones(len(grid), bool), 1)
    mask = object_mask(segments, photo, np.array([0, 1]), objects)
    assert (mask[segments == 0] == 0).all()
    assert (mask[12:48, 12:55] == 1).all() and (mask[12:48, 66:108] == 2).all()
    # Many points of the other object along the border do not divide it.
    edge = np.stack([np.arange(10, 110), np.full(100, 10)], 1)
    xy = np.concatenate([edge, grid])
    photo = Seen(np.arange(len(xy)), xy, np.ones(len(xy), np.int64), np.ones(len(xy), bool), 1)
    objects = np.repeat([2, 1], [len(edge), len(grid)])
    assert (object_mask(segments, photo, np.array([0, 1]), objects)[segments == 1] == 1).all()


def shuffled(scene, folder, missing=None):
    """Replace a capture's masks by those with other numbers in each photo, without the object `missing`."""
    rng = np.random.default_rng(0)
    for name, ids in zip(scene.names, scene.ids, strict=True):
        present = np.unique(ids[(ids > 0) & (ids != missing)])
        number = np.zeros(ids.max() + 1, np.uint8)
        number[present] = rng.permutation(len(present)) + 1
        path = folder / "masks" / name
        Image.fromarray(number[ids]).save(path)


def test_ids_of_each_photo_become_those_of_objects(write_capture, tmp_path, run_command):
    scene = write_capture(views=12, points=200)
    folder = scene.folder
    (folder / "labels.json").unlink()
    shuffled(scene, folder)
    given = {path.name: path.read_bytes() for path in (folder / "masks").iterdir()}
    done = run_command("masks", folder, folder / "masks", "--json")
    assert done.code == EXIT_DONE and any("agree between photos" in each for each in done.messages("warning"))
    assert {path.name: path.read_bytes() for path in (folder / "masks-given").iterdir()} == given
    pairs = set()
    for name, ids in zip(scene.names, scene.ids, strict=True):
        found = read_mask(folder / "masks" / f"{name}.png")
        assert (found > 0).sum() >= 0.98 * (ids > 0).sum()
        for object_id in np.unique(ids[ids > 0]).tolist():
            values, counts = np.unique(found[ids == object_id], return_counts=True)
            if counts.sum() > 20:
                assert counts.max() >= 0.9 * counts.sum()
                pairs.add((object_id, int(values[counts.argmax()])))
    assert len(pairs) == 3 == len({found for _, found in pairs}), pairs
    assert set(json.loads((folder / "labels.json").read_text())) == {"1", "2", "3"}
    assert_rejected(run_command("masks", folder, folder / "masks"), "was made of other masks")
    again = run_command("masks", folder, folder / "masks-given", "--objects", "given", "--json")
    assert again.code == EXIT_DONE and again.events[-1]["result"]["found"] is False


def test_objects_keep_their_ids_when_masks_are_made_anew(write_capture, tmp_path, run_command):
    """The second time one object is missing, and the third time it is there again, and another one is not."""
    scene = write_capture(views=12, points=200)
    folder = scene.folder
    shutil.rmtree(folder / "masks")

    def found_without(missing):
        given = tmp_path / f"without-{missing}"
        (given / "masks").mkdir(parents=True)
        shuffled(scene, given, missing)
        assert run_command("masks", folder, given / "masks", "--objects", "find").code == EXIT_DONE
        found = {}
        for name, ids in zip(scene.names, scene.ids, strict=True):
            mask = read_mask(folder / "masks" / f"{name}.png")
            for object_id in np.unique(ids[ids > 0]).tolist():
                found.setdefault(object_id, []).extend(mask[ids == object_id].tolist())
        return {object_id: int(np.bincount(shown).argmax()) for object_id, shown in found.items()}

    first = found_without(None)
    assert sorted(first.values()) == [1, 2, 3]
    gone = next(object_id for object_id, number in first.items() if number == 1)
    assert found_without(gone) == {**first, gone: 0}
    third = found_without(next(object_id for object_id, number in first.items() if number == 3))
    assert third[gone] == 4, "an ID of an object that was gone is not used again, since edits may be stored for it"
    assert {third[object_id] for object_id, number in first.items() if number == 2} == {2}


@pytest.mark.parametrize("how", ["find", "given"])
def test_new_objects_get_none_of_the_ids_of_strokes(write_capture, tmp_path, run_command, how):
    """Masks of strokes have no masks.json."""
    scene = write_capture(views=12, points=200)
    folder, masks = scene.folder, scene.folder / "masks"
    (folder / "labels.json").write_text('{"1": "ball", "7": "gone"}')
    (masks / "strokes.json").write_text("{}")
    other = int(max(np.unique(scene.ids[0])))
    given = tmp_path / "given"
    for name, ids in zip(scene.names, scene.ids, strict=True):
        stem = name.rpartition(".")[0]
        for path in masks.glob(f"{stem}.*"):
            path.unlink()
        Image.fromarray((ids == 1).astype(np.uint8)).save(masks / f"{stem}.png")
        for label, object_id in (("ball", 1), ("new", other)):
            (given / label).mkdir(parents=True, exist_ok=True)
            Image.fromarray(255 * (ids == object_id).astype(np.uint8)).save(given / label / f"{stem}.png")
    done = run_command("masks", folder, given, "--objects", how)
    assert done.code == EXIT_DONE, done.err
    assert json.loads((folder / "labels.json").read_text()) == {"1": "ball", "8": "new"}
    assert json.loads((masks / "masks.json").read_text())["largest_id"] == 8


def test_regions_get_the_id_that_most_of_their_objects_regions_have(write_capture, tmp_path):
    """IDs are exchanged in seven of eighteen photos; a region without points keeps its ID, unless it has no say."""
    scene = write_capture(views=18, size=(96, 72))
    capture = load_capture(scene.folder, tmp_path / "cache")
    exchanged = np.array([0, 2, 5, 3, 4, 1])
    given = {index: exchanged[ids] if index % 5 in (1, 3) else ids for index, ids in enumerate(scene.ids)}
    given[0] = given[0].copy()
    given[0][:2, :2] = 9
    others = {index: given.pop(index) for index in (6, 11)}
    others = {index: np.where(mask > 0, mask + 10, 0) for index, mask in others.items()}
    others[6][:2, :2] = 9
    found = renumber_masks(capture, given, others, 0.9)
    assert found.agreement < 0.8
    for index, mask in found.others.items():
        assert (mask == scene.ids[index])[scene.ids[index] > 0].mean() > 0.95 and (mask[:2, :2] == 0).all()
    right = {index: (mask == scene.ids[index])[scene.ids[index] > 0].mean() for index, mask in found.masks.items()}
    assert min(right.values()) > 0.95, right
    assert (found.masks[0][:2, :2] == 9).all() and (found.masks[1][scene.ids[1] == 0] == 0).all()


def test_masks_that_agree_are_kept(write_capture, tmp_path):
    scene = write_capture(views=9, size=(64, 48))
    capture = load_capture(scene.folder, tmp_path / "cache")
    found = renumber_masks(capture, dict(enumerate(scene.ids)), {}, 0.9)
    assert found.agreement > 0.9
    assert all(np.array_equal(found.masks[index], ids) for index, ids in enumerate(scene.ids))
