"""Metrics against slow implementations of their definitions, and against values computed by hand."""

from __future__ import annotations

import math
import time

import numpy as np
import pytest

from backend.evaluation import IdScores, ImageScores, evaluate, psnr, ssim
from backend.evaluation.metrics import boundaries, boundary_distance
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
    iou, biou, dice = {}, {}, {}
    right = labeled = 0
    for predicted, truth in views:
        counted = np.ones(truth.shape, bool) if zero_is_class else truth != 0
        right += int(((predicted == truth) & counted).sum())
        labeled += int(counted.sum())
    for i in ids:
        same = either = both = band_same = band_either = 0
        for predicted, truth in views:
            counted = np.ones(truth.shape, bool) if zero_is_class else truth != 0
            p, t = (predicted == i) & counted, (truth == i) & counted
            same += int((p & t).sum())
            either += int((p | t).sum())
            both += int(p.sum() + t.sum())
            d = boundary_distance(*truth.shape)
            bp, bt = slow_band(p, d), slow_band(t, d)
            band_same += int((bp & bt).sum())
            band_either += int((bp | bt).sum())
        iou[i], biou[i], dice[i] = same / either, band_same / band_either, 2 * same / both
    return {
        "miou": np.mean(list(iou.values())),
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
    assert psnr(a, a) == math.inf
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
    for name in ("miou", "mbiou", "dice", "accuracy"):
        assert fast[name] == pytest.approx(slow[name], abs=1e-12), name
    assert fast["objects"] == pytest.approx(slow["objects"])


def test_equal_ids_score_one():
    truth = blobs(np.random.default_rng(5), 30, 40, [1, 2, 3])
    assert scores((truth, truth)) == {
        "miou": 1.0,
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


def test_image_border_counts_as_mask_boundary():
    band = boundaries(np.ones((7, 9), int), 2)
    expected = np.ones((7, 9), bool)
    expected[2:-2, 2:-2] = False
    assert (band == expected).all()


def test_boundary_distance_is_two_percent_of_the_diagonal():
    assert boundary_distance(480, 640) == 16
    assert boundary_distance(240, 320) == 8
    assert boundary_distance(1, 1) == 1


def test_unlabeled_pixels_are_ignored():
    rng = np.random.default_rng(6)
    truth = blobs(rng, 40, 50, [0, 1, 2, 3])
    predicted = np.roll(truth, 2, 1)
    expected = scores((predicted, truth))
    for _ in range(3):
        predicted[truth == 0] = rng.integers(0, 9, int((truth == 0).sum()))
        assert scores((predicted, truth)) == expected
    y, x = np.argwhere((truth == 1) & (predicted == 1))[0]
    predicted[y, x] = 2
    assert scores((predicted, truth)) != expected


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
    assert result == {"miou": None, "mbiou": None, "dice": None, "accuracy": None, "objects": {}}
    assert ImageScores().result() == {"psnr": None, "ssim": None}


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
    assert ImageScores().add(np.full((12, 12, 3), 1.5), truth)[0] == math.inf


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


def test_evaluate_without_masks_has_no_id_scores():
    capture = _Capture([np.zeros((12, 16, 3), np.uint8)], [None])
    result = evaluate(capture, lambda i: (np.full((12, 16, 3), 0.1), np.zeros((12, 16), int)), [0])
    assert result["quality"]["psnr"] == pytest.approx(20.0)
    assert [result["quality"][name] for name in ("miou", "mbiou", "dice", "accuracy")] == [None] * 4
    assert result["objects"] == []
    assert result["views"][0]["miou"] is None


def test_evaluate_warns_of_nan_in_render():
    class RecordingReporter(Reporter):
        warnings: list[str] = []

        def warning(self, message):
            self.warnings.append(message)

    reporter = RecordingReporter()
    capture = _Capture([np.zeros((12, 16, 3), np.uint8)], [None])
    evaluate(capture, lambda i: (np.full((12, 16, 3), np.nan), np.zeros((12, 16), int)), [0], reporter)
    assert reporter.warnings == ["The render of 0.png contains NaN or Inf."]
