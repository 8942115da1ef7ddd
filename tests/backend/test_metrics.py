"""Metrics against slow implementations of their definitions, and against values computed by hand."""

from __future__ import annotations

import math
import sys
import time

import numpy as np
import pytest
import torch

from backend.evaluation import IdScores, ImageScores, evaluate, psnr, ssim
from backend.evaluation.lpips import PACKAGE, WEIGHTS, load_lpips
from backend.evaluation.metrics import AloneScores, boundaries, boundary_distance, color_corrected, compacted
from backend.shared.events import Reporter


def slow_ssim(a, b):
    """Compute SSIM with an explicit sum over the 11 x 11 window at each pixel and zero padding."""
    h, w, channels = a.shape
    window = np.array([[math.exp(-(i * i + j * j) / (2 * 1.5**2)) for j in range(-5, 6)] for i in range(-5, 6)])
    window /= window.sum()
    total = 0.0
    for c in range(channels):
        x, y = np.pad(a[..., c], 5), np.pad(b[..., c], 5)
        for i in range(h):
            for j in range(w):
                p, q = x[i : i + 11, j : j + 11], y[i : i + 11, j : j + 11]
                mp, mq = (window * p).sum(), (window * q).sum()
                vp, vq = (window * p * p).sum() - mp**2, (window * q * q).sum() - mq**2
                cov = (window * p * q).sum() - mp * mq
                total += ((2 * mp * mq + 1e-4) * (2 * cov + 9e-4)) / ((mp**2 + mq**2 + 1e-4) * (vp + vq + 9e-4))
    return total / (h * w * channels)


def slow_band(mask, distance):
    """Return a mask minus its erosion by 3 x 3, repeated `distance` times, with zero padding."""
    eroded = np.pad(mask, 1)
    for _ in range(distance):
        before = np.pad(eroded, 1)
        eroded = np.ones_like(eroded)
        for dy in range(3):
            for dx in range(3):
                eroded &= before[dy : dy + eroded.shape[0], dx : dx + eroded.shape[1]]
    return mask & ~eroded[1:-1, 1:-1]


def slow_scores(views, zero_is_class=False):
    """Compute the scores with a loop over all IDs and views on full-size masks."""
    ids = sorted({int(i) for _, truth in views for i in np.unique(truth)} - (set() if zero_is_class else {0}))
    iou, iou_all, biou, dice = {}, {}, {}, {}
    right = labeled = 0
    for predicted, truth in views:
        counted = np.ones(truth.shape, bool) if zero_is_class else truth != 0
        right += int(((predicted == truth) & counted).sum())
        labeled += int(counted.sum())
    for i in ids:
        same = either = both = band_same = band_either = either_anywhere = 0
        for predicted, truth in views:
            counted = np.ones(truth.shape, bool) if zero_is_class else truth != 0
            p, t = (predicted == i) & counted, (truth == i) & counted
            same += int((p & t).sum())
            either += int((p | t).sum())
            either_anywhere += int(((predicted == i) | t).sum())
            both += int(p.sum() + t.sum())
            d = boundary_distance(*truth.shape)
            bp, bt = slow_band(p, d), slow_band(t, d)
            band_same += int((bp & bt).sum())
            band_either += int((bp | bt).sum())
        iou[i], biou[i], dice[i] = same / either, band_same / band_either, 2 * same / both
        iou_all[i] = same / either_anywhere
    return {
        "miou": np.mean(list(iou.values())),
        "miou_all": np.mean(list(iou_all.values())),
        "mbiou": np.mean(list(biou.values())),
        "dice": np.mean(list(dice.values())),
        "accuracy": right / labeled,
        "objects": iou,
    }


def scores(*views, **options):
    out = IdScores(**options)
    for predicted, truth in views:
        out.add(predicted, truth)
    return out.result()


def blobs(rng, height, width, ids):
    """Return a label image of a few patches, so that masks have an interior."""
    centers = rng.random((len(ids), 2)) * (height, width)
    y, x = np.mgrid[:height, :width]
    nearest = ((y[..., None] - centers[:, 0]) ** 2 + (x[..., None] - centers[:, 1]) ** 2).argmin(-1)
    return np.asarray(ids)[nearest]


def test_psnr_matches_manual_values():
    a = np.zeros((4, 5, 3))
    assert psnr(a, a + 0.1) == pytest.approx(20.0)
    assert psnr(a, a + 0.01) == pytest.approx(40.0)
    assert psnr(a, a) == pytest.approx(150.0), "finite, so that means are"
    one_pixel = a.copy()
    one_pixel[0, 0] = 1.0
    assert psnr(a, one_pixel) == pytest.approx(10 * math.log10(20))


def test_metrics_accept_uint8_images():
    rng = np.random.default_rng(0)
    a, b = rng.integers(0, 256, (2, 7, 6, 3), dtype=np.uint8)
    assert psnr(a, b) == pytest.approx(psnr(a / 255.0, b / 255.0))
    assert ssim(a, b) == pytest.approx(ssim(a / 255.0, b / 255.0))


def test_ssim_matches_definition():
    rng = np.random.default_rng(1)
    a = rng.random((17, 14, 3))
    b = np.clip(a + 0.2 * rng.normal(size=a.shape), 0, 1)
    assert ssim(a, b) == pytest.approx(slow_ssim(a, b), abs=1e-10)
    assert ssim(a[:3, :2], b[:3, :2]) == pytest.approx(slow_ssim(a[:3, :2], b[:3, :2]), abs=1e-10)
    assert ssim(a, a) == pytest.approx(1.0)


def test_images_of_different_sizes_are_rejected():
    with pytest.raises(ValueError, match="one size"):
        psnr(np.zeros((4, 4, 3)), np.zeros((4, 5, 3)))
    with pytest.raises(ValueError, match="one size"):
        IdScores().add(np.zeros((4, 4), int), np.zeros((4, 5), int))


def test_fractional_ids_are_rejected():
    with pytest.raises(ValueError, match="integer"):
        IdScores().add(np.zeros((4, 4)), np.zeros((4, 4), int))


@pytest.mark.parametrize("zero_is_class", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_id_scores_match_definitions(seed, zero_is_class):
    rng = np.random.default_rng(seed)
    ids = [0, 1, 2, 7, 70_000, 2**32 - 1]
    views = []
    for height, width in ((40, 61), (33, 33), (61, 90)):
        truth = blobs(rng, height, width, ids)
        predicted = np.roll(truth, (2, -3), (0, 1))
        noisy = rng.random(truth.shape) < 0.03
        predicted[noisy] = rng.choice([*ids, 12345], int(noisy.sum()))
        views.append((predicted, truth))
    fast, slow = scores(*views, zero_is_class=zero_is_class), slow_scores(views, zero_is_class)
    for name in ("miou", "miou_all", "mbiou", "dice", "accuracy"):
        assert fast[name] == pytest.approx(slow[name], abs=1e-12), name
    assert fast["objects"] == pytest.approx(slow["objects"])


def test_equal_ids_score_one():
    truth = blobs(np.random.default_rng(5), 30, 40, [1, 2, 3])
    assert scores((truth, truth)) == {
        "miou": 1.0,
        "miou_all": 1.0,
        "mbiou": 1.0,
        "dice": 1.0,
        "accuracy": 1.0,
        "objects": {1: 1.0, 2: 1.0, 3: 1.0},
    }


def test_scores_of_shifted_square():
    truth = np.ones((20, 20), int)
    truth[5:15, 5:15] = 2
    predicted = np.ones((20, 20), int)
    predicted[5:15, 7:17] = 2
    result = scores((predicted, truth))
    assert boundary_distance(20, 20) == 1
    assert result["objects"][2] == pytest.approx(80 / 120)
    assert result["objects"][1] == pytest.approx(280 / 320)
    assert result["dice"] == pytest.approx((160 / 200 + 560 / 600) / 2)
    assert result["accuracy"] == pytest.approx(360 / 400)


def test_boundary_iou_of_shifted_square():
    truth = np.zeros((20, 20), int)
    truth[5:15, 5:15] = 2
    predicted = np.zeros((20, 20), int)
    predicted[5:15, 7:17] = 2
    result = IdScores(zero_is_class=True)
    result.add(predicted, truth)
    row = next(row for row in result.table() if row["id"] == 2)
    # Two frames of 36 pixels: their top and bottom rows share 2 x 8; columns 7 and 14 are inside the other square.
    assert row["biou"] == pytest.approx(16 / (36 + 36 - 16))


@pytest.mark.parametrize(
    "labels",
    [[[3, -1], [3, 7]], [[0, 2**40], [5, 0]], [[True, False]], np.zeros((0, 2), int), np.full((2, 2), 255, np.uint8)],
)
def test_labels_are_compacted_as_by_unique(labels):
    labels = np.array(labels)
    values, index = np.unique(labels, return_inverse=True)
    found, where = compacted(labels)
    assert np.array_equal(found, values) and np.array_equal(where, index.reshape(labels.shape))


def test_image_border_counts_as_mask_boundary():
    band = boundaries(np.ones((7, 9), int), 2)
    expected = np.ones((7, 9), bool)
    expected[2:-2, 2:-2] = False
    assert (band == expected).all()


def test_boundary_distance_is_two_percent_of_the_diagonal():
    assert boundary_distance(480, 640) == 16
    assert boundary_distance(240, 320) == 8
    assert boundary_distance(1, 1) == 1


FOUR_OBJECTS = np.array([
    [1, 1, 1, 1, 0, 0, 0, 0],
    [1, 1, 1, 1, 0, 0, 0, 0],
    [2, 2, 2, 2, 0, 0, 0, 0],
    [2, 2, 2, 2, 0, 0, 0, 0],
])  # fmt: skip


def test_object_on_unlabeled_pixels_lowers_miou_all():
    spread = FOUR_OBJECTS.copy()
    spread[:2, 4:6] = 1  # 4 pixels of object 1 on the background
    spread[3, 4:] = 9  # an object that the truth does not have
    result = scores((spread, FOUR_OBJECTS))
    assert result["miou"] == result["accuracy"] == 1.0 and result["objects"] == {1: 1.0, 2: 1.0}
    assert result["miou_all"] == pytest.approx((8 / 12 + 8 / 8) / 2)


def test_object_predicted_only_on_unlabeled_pixels_has_no_overlap():
    predicted = np.where(FOUR_OBJECTS == 2, 0, FOUR_OBJECTS)
    predicted[:, 6] = 2
    found = IdScores()
    found.add(predicted, FOUR_OBJECTS)
    assert [(row["iou"], row["iou_all"]) for row in found.table()] == [(1.0, 1.0), (0.0, 0.0)]
    assert found.result()["miou_all"] == 0.5


def test_false_pixels_in_view_without_the_object_count():
    empty = np.zeros_like(FOUR_OBJECTS)
    elsewhere = empty.copy()
    elsewhere[0, :4] = 2
    result = scores((FOUR_OBJECTS, FOUR_OBJECTS), (elsewhere, empty))
    assert result["miou"] == 1.0 and result["miou_all"] == pytest.approx((1 + 8 / 12) / 2)


def test_miou_all_equals_miou_if_zero_is_an_object():
    predicted = FOUR_OBJECTS.copy()
    predicted[:2, 4:6] = 1
    result = scores((predicted, FOUR_OBJECTS), zero_is_class=True)
    assert result["miou_all"] == result["miou"] == pytest.approx((12 / 16 + 8 / 12 + 1) / 3)


def test_miou_all_ranks_spreading_objects_last():
    """miou prefers a map that covers slightly more of each object by spreading over the background."""
    truth = np.zeros((40, 60), int)
    truth[10:30, 5:25], truth[10:30, 35:55] = 1, 2
    tight = truth.copy()
    tight[10, 5:25] = 0  # one row of 20 is missed
    spread = np.where(truth == 0, np.where(np.arange(60) < 30, 1, 2), truth)
    spread[10, 5:10] = 0
    of_tight, of_spread = scores((tight, truth)), scores((spread, truth))
    assert of_spread["miou"] > of_tight["miou"], "the ranking of miou is inverted"
    assert of_spread["miou_all"] < of_tight["miou_all"]
    assert of_tight["miou_all"] == of_tight["miou"] == pytest.approx((380 / 400 + 1) / 2)
    assert of_spread["miou_all"] == pytest.approx((395 / 1200 + 400 / 1200) / 2)
    same = scores((np.where(truth == 0, 1, truth), truth))
    assert same["miou"] == scores((truth, truth))["miou"] and same["miou_all"] < 1


def test_unlabeled_pixels_are_ignored():
    rng = np.random.default_rng(6)
    truth = blobs(rng, 40, 50, [0, 1, 2, 3])
    predicted = np.roll(truth, 2, 1)

    def on_labeled():
        return {name: value for name, value in scores((predicted, truth)).items() if name != "miou_all"}

    expected = on_labeled()
    for _ in range(3):
        predicted[truth == 0] = rng.integers(0, 9, int((truth == 0).sum()))
        assert on_labeled() == expected
    y, x = np.argwhere((truth == 1) & (predicted == 1))[0]
    predicted[y, x] = 2
    assert on_labeled() != expected


def test_missing_prediction_on_labeled_pixels_is_an_error():
    truth = np.full((10, 10), 4)
    predicted = truth.copy()
    predicted[:, :5] = 0
    result = scores((predicted, truth))
    assert result["miou"] == result["accuracy"] == 0.5
    assert result["objects"] == {4: 0.5}


def test_views_are_summed_before_dividing():
    small, large = np.full((2, 5), 3), np.full((9, 10), 3)
    result = scores((np.zeros_like(small), small), (large, large))
    assert result["miou"] == pytest.approx(90 / 100)


def test_id_absent_from_truth_is_not_averaged():
    truth = np.full((10, 10), 4)
    predicted = truth.copy()
    predicted[0] = 99
    assert scores((predicted, truth))["objects"] == {4: 0.9}


def test_ids_equal_in_16_bits_are_distinguished():
    truth = np.full((6, 6), 65_536 + 7, np.uint32)
    assert scores((np.full((6, 6), 7), truth))["miou"] == 0.0


def test_scores_without_labels_are_none():
    result = scores((np.ones((5, 5), int), np.zeros((5, 5), int)))
    assert result == {"miou": None, "miou_all": None, "mbiou": None, "dice": None, "accuracy": None, "objects": {}}
    assert ImageScores().result() == {"psnr": None, "psnr_corrected": None, "ssim": None}


def test_color_correction_removes_exposure_and_white_balance_only():
    rng = np.random.default_rng(0)
    photo = rng.uniform(0.1, 0.6, (24, 32, 3))
    darker = photo * [0.6, 0.7, 0.8] + 0.02
    assert psnr(darker, photo) < 20 < 100 < psnr(color_corrected(darker, photo), photo)
    noise = rng.normal(0, 0.05, photo.shape)
    before = psnr(np.clip(photo + noise, 0, 1), photo)
    assert before - 0.1 < psnr(color_corrected(np.clip(photo + noise, 0, 1), photo), photo) < before + 1
    flat = np.full_like(photo, 0.5)
    np.testing.assert_allclose(color_corrected(flat, photo), np.broadcast_to(photo.mean((0, 1)), photo.shape))
    scores = ImageScores().add(darker, photo)
    assert scores["psnr_corrected"] > 100 and scores["psnr"] == psnr(darker, photo)


def test_many_objects_are_scored_quickly():
    rng = np.random.default_rng(7)
    many = rng.permutation(10_000).repeat(32)[: 400 * 800].reshape(400, 800) + 1
    few = many % 3 + 1

    def seconds(truth):
        result = IdScores()
        start = time.perf_counter()
        result.add(np.roll(truth, 3, 1), truth)
        return time.perf_counter() - start, result.result()

    few_seconds = min(seconds(few)[0] for _ in range(3))
    many_seconds, result = min((seconds(many) for _ in range(3)), key=lambda pair: pair[0])
    assert len(result["objects"]) == 10_000
    assert many_seconds < 5 * few_seconds + 1.0


def test_renders_are_clipped_before_comparison():
    truth = np.full((12, 12, 3), 255, np.uint8)
    assert ImageScores().add(np.full((12, 12, 3), 1.5), truth)["psnr"] == pytest.approx(150.0)


class _View:
    def __init__(self, name):
        self.name = name


class _Capture:
    names = {1: "cup"}

    def __init__(self, images, masks):
        self.images, self.masks = images, masks
        self.views = [_View(f"{i}.png") for i in range(len(images))]

    def image(self, i):
        return self.images[i]

    def mask(self, i):
        return self.masks[i]


def test_evaluate_uses_only_chosen_views():
    images = [np.full((12, 16, 3), 255 * i, np.uint8) for i in (0, 1)]
    masks = [np.full((12, 16), 1), np.full((12, 16), 70_000)]
    found = [np.full((12, 16), 5), np.full((12, 16), 70_000)]
    result = evaluate(_Capture(images, masks), lambda i: (np.full((12, 16, 3), 0.9, np.float32), found[i]), [1])
    assert result["quality"]["psnr"] == pytest.approx(20.0, abs=1e-4)
    assert result["quality"]["miou"] == 1.0
    assert result["quality"]["lpips"] is None
    assert [(entry["id"], entry["name"], entry["iou"]) for entry in result["objects"]] == [(70_000, "70000", 1.0)]
    assert [view["name"] for view in result["views"]] == ["1.png"]


def test_evaluate_scores_each_view_by_itself():
    images = [np.zeros((4, 8, 3), np.uint8)] * 2
    spread = FOUR_OBJECTS.copy()
    spread[:2, 4:6] = 1
    capture = _Capture(images, [FOUR_OBJECTS, FOUR_OBJECTS])
    found = [FOUR_OBJECTS, spread]
    result = evaluate(capture, lambda i: (np.full((4, 8, 3), 0.1), found[i]), [0, 1])
    assert [view["miou"] for view in result["views"]] == [1.0, 1.0]
    assert [view["miou_all"] for view in result["views"]] == pytest.approx([1.0, (8 / 12 + 1) / 2])
    assert result["quality"]["miou_all"] == pytest.approx((16 / 20 + 1) / 2), "unions over all views, not their mean"
    assert [entry["iou_all"] for entry in result["objects"]] == [16 / 20, 1.0]


def test_iou_alone_by_hand():
    """Object 1 is hidden behind object 2 and reaches over the background; a view without it counts, too."""
    truth = np.array([[1, 1, 2, 2, 0, 0, 0, 0]])
    alone = AloneScores()
    alone.add(1, np.array([[0.9, 0.4, 0.9, 0.9, 0.9, 0.51, 0.5, 0.0]]), truth)
    alone.add(1, np.array([[0.0, 0.0, 0.0, 0.9]]), np.array([[2, 2, 2, 0]]))
    alone.add(2, np.array([[0.0, 0.9, 0.9, 0.9, 0.0, 0.0, 0.0, 0.0]]), truth)
    alone.add(3, np.zeros((1, 8)), truth)
    assert alone.result() == {1: 1 / 5, 2: 1.0}
    with pytest.raises(ValueError, match="one size"):
        alone.add(1, np.zeros((2, 8)), truth)


@pytest.mark.parametrize(("background", "is_class"), [(True, False), (False, False), (True, True)])
def test_evaluate_measures_objects_alone_where_zero_is_background(background, is_class):
    masks = [np.array([[1, 1, 0, 0], [2, 2, 2, 2]])] * 2
    capture = _Capture([np.zeros((2, 4, 3), np.uint8)] * 2, masks)

    def alone(index):
        yield 1, np.array([[1.0, 1.0, float(index), 0.0], [0.0, 0.0, 0.0, 0.0]])
        yield 2, np.array([[0.0, 0.0, 0.0, 0.0], [1.0, 1.0, 0.0, 0.0]])

    result = evaluate(capture, lambda i: (np.zeros((2, 4, 3)), masks[i]), [0, 1], None, is_class, background, alone)
    of_objects = {entry["id"]: entry["iou_alone"] for entry in result["objects"]}
    if background and not is_class:
        assert of_objects == {1: 4 / 5, 2: 0.5} and result["quality"]["miou_alone"] == pytest.approx(0.65)
    else:
        assert set(of_objects.values()) == {None} and result["quality"]["miou_alone"] is None


def test_evaluate_without_masks_has_no_id_scores():
    capture = _Capture([np.zeros((12, 16, 3), np.uint8)], [None])
    result = evaluate(capture, lambda i: (np.full((12, 16, 3), 0.1), np.zeros((12, 16), int)), [0])
    assert result["quality"]["psnr"] == pytest.approx(20.0)
    assert [result["quality"][name] for name in ("miou", "miou_all", "mbiou", "dice", "accuracy")] == [None] * 5
    assert result["objects"] == []
    assert result["views"][0]["miou"] is None and result["views"][0]["miou_all"] is None


def test_evaluate_warns_of_nan_in_render():
    class RecordingReporter(Reporter):
        warnings: list[str] = []

        def warning(self, message):
            self.warnings.append(message)

    reporter = RecordingReporter()
    capture = _Capture([np.zeros((12, 16, 3), np.uint8)], [None])
    evaluate(capture, lambda i: (np.full((12, 16, 3), np.nan), np.zeros((12, 16), int)), [0], reporter)
    assert reporter.warnings == ["The render of 0.png contains NaN or Inf."]


FAKE_LPIPS = """
import torch

class LPIPS:
    def __init__(self, net, verbose):
        assert net == "vgg" and not verbose

    def __call__(self, a, b):
        assert a.shape == b.shape == (1, 3, 12, 16) and a.dtype == torch.float32
        assert not torch.is_grad_enabled() and min(a.min(), b.min()) >= -1 and max(a.max(), b.max()) <= 1
        return (a - b).abs().mean().reshape(1, 1, 1, 1)
"""


@pytest.fixture
def fake_lpips(tmp_path, monkeypatch):
    """A package lpips whose distance is the mean difference, without weights; returns the folder of these."""
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "lpips.py").write_text(FAKE_LPIPS)
    monkeypatch.syspath_prepend(tmp_path / "site")
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path / "hub"))
    monkeypatch.delitem(sys.modules, PACKAGE, raising=False)
    yield tmp_path / "hub" / "checkpoints"
    sys.modules.pop(PACKAGE, None)


def test_lpips_is_the_mean_over_the_views(fake_lpips):
    fake_lpips.mkdir(parents=True)
    (fake_lpips / WEIGHTS).write_bytes(b"")
    images = [np.full((12, 16, 3), value, np.uint8) for value in (0, 255)]
    capture = _Capture(images, [None, None])
    quality = evaluate(capture, lambda i: (np.full((12, 16, 3), (0.25, 1.5)[i]), np.zeros((12, 16), int)), [0, 1])[
        "quality"
    ]
    assert quality["lpips"] == pytest.approx((0.5 + 0.0) / 2), "from -1 to 1, and clipped"


def test_lpips_without_weights_is_none_and_loads_nothing(fake_lpips):
    assert load_lpips() is None and PACKAGE not in sys.modules


def test_lpips_without_its_package_is_none(monkeypatch):
    monkeypatch.setitem(sys.modules, PACKAGE, None)
    assert load_lpips() is None
