"""Metrics of renders, object IDs and objects alone: PSNR, SSIM, IoU, boundary IoU, Dice and pixel accuracy."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

_SMALLEST_ERROR = 1e-15
"""Least mean squared error that a PSNR is computed from."""

BOUNDARY_FRACTION = 0.02
"""Width of the boundary band of mBIoU, as a fraction of the image diagonal."""


def _as_float(image: NDArray) -> NDArray[np.float64]:
    if image.dtype == np.uint8:
        return image.astype(np.float64) / 255.0
    return image.astype(np.float64)


def _pair(a: NDArray, b: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    if a.shape != b.shape or a.ndim != 3:
        raise ValueError(f"two images (h, w, channels) of one size were expected, not {a.shape} and {b.shape}")
    return _as_float(a), _as_float(b)


def psnr(a: NDArray, b: NDArray) -> float:
    """Compute the peak signal-to-noise ratio of two images, -10 log10(mean((a - b)^2)).

    Args:
        a, b: Images of the same shape (h, w, 3), float in [0, 1] or uint8.

    Returns:
        The ratio in dB; at most 150, for equal images, so that means over images stay finite.

    Raises:
        ValueError: If the shapes differ.
    """
    a, b = _pair(a, b)
    error = float(np.mean((a - b) ** 2))
    return -10.0 * math.log10(max(error, _SMALLEST_ERROR))


def color_corrected(render: NDArray, photo: NDArray) -> NDArray[np.float64]:
    """Fit the colors of a render to a photo, as exposure and white balance of an unseen photo are unknown.

    The affine map of colors c' = A c + b with the least squared error over all pixels.

    Args:
        render, photo: Images of the same shape (h, w, 3), float in [0, 1] or uint8.

    Returns:
        The mapped render (h, w, 3), clipped to [0, 1].

    Raises:
        ValueError: If the shapes differ.
    """
    render, photo = _pair(render, photo)
    colors = render.reshape(-1, 3)
    terms = np.column_stack([colors, np.ones(len(colors))])
    # The normal equations suffice: four terms of order 1. lstsq gives the smallest map where a render has one color.
    fitted = np.linalg.lstsq(terms.T @ terms, terms.T @ photo.reshape(-1, 3), rcond=1e-10)[0]
    return np.clip((terms @ fitted).reshape(render.shape), 0.0, 1.0)


def ssim(a: NDArray, b: NDArray) -> float:
    """Compute the structural similarity of two images (Wang et al. 2004), as in papers on Gaussian splatting.

    Gaussian window of 11 x 11 pixels with sigma 1.5, C1 = 0.01^2, C2 = 0.03^2, zero padding.

    Args:
        a, b: Images of the same shape (h, w, 3), float in [0, 1] or uint8.

    Returns:
        The mean over all pixels and channels; 1 if the images are equal.

    Raises:
        ValueError: If the shapes differ.
    """
    a, b = _pair(a, b)
    offsets = np.arange(-5, 6)
    window = np.exp(-(offsets**2) / (2 * 1.5**2))
    window /= window.sum()

    def blur(image: NDArray) -> NDArray:
        rows = ndimage.correlate1d(image, window, axis=0, mode="constant")
        return ndimage.correlate1d(rows, window, axis=1, mode="constant")

    mean_a, mean_b = blur(a), blur(b)
    var_a = blur(a * a) - mean_a**2
    var_b = blur(b * b) - mean_b**2
    covariance = blur(a * b) - mean_a * mean_b
    c1, c2 = 0.01**2, 0.03**2
    numerator = (2 * mean_a * mean_b + c1) * (2 * covariance + c2)
    return float(np.mean(numerator / ((mean_a**2 + mean_b**2 + c1) * (var_a + var_b + c2))))


def boundary_distance(height: int, width: int) -> int:
    """Return the width in pixels of the boundary band of an image: 2% of its diagonal, at least 1."""
    return max(1, round(BOUNDARY_FRACTION * math.hypot(height, width)))


def compacted(labels: NDArray) -> tuple[NDArray, NDArray[np.int64]]:
    """Return the values that occur in an integer array, ascending, and the index of each element's value among them.

    As `np.unique`, but without sorting where the values are close together.
    """
    if labels.size == 0:
        return np.zeros(0, np.int64), np.zeros(labels.shape, np.int64)
    lowest, highest = int(labels.min()), int(labels.max())
    if highest - lowest > labels.size:
        values, index = np.unique(labels, return_inverse=True)
        return values, index.reshape(labels.shape)
    shifted = labels.astype(np.int64) - lowest
    occurs = np.zeros(highest - lowest + 1, bool)
    occurs[shifted] = True
    return np.flatnonzero(occurs) + lowest, (np.cumsum(occurs) - 1)[shifted]


def boundaries(labels: NDArray, distance: int) -> NDArray[np.bool_]:
    """Find the pixels in the boundary band of their label's mask, (h, w) bool (Cheng et al. 2021).

    The band of a mask is the mask minus its erosion by a square of 2 `distance` + 1 pixels. Pixels beyond the image
    border are outside every mask, so masks have a band there, too. A pixel is in the band of its mask if and only if
    the square around it contains another label or the border. Therefore a minimum and a maximum filter find the bands
    of all masks at once.
    """
    size = 2 * distance + 1
    compact = compacted(labels)[1].astype(np.int32)
    lowest = ndimage.minimum_filter(compact, size, mode="constant", cval=-1)
    highest = ndimage.maximum_filter(compact, size, mode="constant", cval=-1)
    return lowest != highest


class IdScores:
    """Accumulator of the agreement of predicted and true object IDs over views.

    For each object, intersections and unions are summed over the pixels of all views before the division; its IoU is
    |P and T| / |P or T|, with the pixels P that are predicted as the object and its true pixels T. miou, miou_all,
    mbiou and dice are the means over the objects that occur in the ground truth. A predicted ID that does not occur
    there has no score of its own, but its pixels count as misses of the true objects.

    Pixels with the true ID 0 are unlabeled. If 0 means background, a prediction of an object there is wrong; if 0 is a
    gap in the masks, it may be right. `miou_all` takes P over all pixels, so that an object that spreads over unlabeled
    pixels loses by it; it is the one to compare where 0 means background. `miou` and the other scores ignore unlabeled
    pixels. With `zero_is_class`, 0 is an object like the others, nothing is ignored, and both are equal. For the
    boundary IoU, predictions on ignored pixels are replaced by "unlabeled" before the bands are computed. accuracy is
    the fraction of the labeled pixels with the correct ID.
    """

    _COLUMNS = (
        "intersection", "predicted", "truth", "band_intersection", "band_predicted", "band_truth", "predicted_anywhere",
    )  # fmt: skip

    def __init__(self, zero_is_class: bool = False) -> None:
        self.zero_is_class = zero_is_class
        self._ids = np.zeros(0, np.int64)
        self._sums = np.zeros((0, len(self._COLUMNS)), np.int64)

    def add(self, predicted: NDArray, truth: NDArray) -> None:
        """Add one view; `predicted` and `truth` are integer IDs (h, w)."""
        if predicted.shape != truth.shape or predicted.ndim != 2:
            raise ValueError(f"two ID images (h, w) of one size were expected, not {predicted.shape} and {truth.shape}")
        if predicted.dtype.kind not in "iub" or truth.dtype.kind not in "iub":
            raise ValueError(f"integer IDs were expected, not {predicted.dtype} and {truth.dtype}")
        both = np.stack([predicted.astype(np.int64), truth.astype(np.int64)])
        ids, compact = compacted(both)
        found, true = compact
        if self.zero_is_class:
            counted = np.ones(truth.shape, bool)
        else:
            counted = both[1] != 0
            found = np.where(counted, found, -1)
            true = np.where(counted, true, -1)
        distance = boundary_distance(*truth.shape)
        found_band = counted & boundaries(found, distance)
        true_band = counted & boundaries(true, distance)
        right = counted & (found == true)

        def count(labels: NDArray, where: NDArray) -> NDArray:
            return np.bincount(labels[where], minlength=len(ids))

        columns = [
            count(true, right),
            count(found, counted),
            count(true, counted),
            count(true, right & found_band & true_band),
            count(found, found_band),
            count(true, true_band),
            count(compact[0], np.ones_like(counted)),
        ]
        self._add_sums(ids, np.stack(columns, axis=1))

    def merge(self, other: IdScores) -> None:
        """Add the views that `other` has accumulated."""
        if other.zero_is_class != self.zero_is_class:
            raise ValueError("scores with and without 0 as a class cannot be added up")
        self._add_sums(other._ids, other._sums)

    def _add_sums(self, ids: NDArray, sums: NDArray) -> None:
        merged = np.union1d(self._ids, ids)
        total = np.zeros((len(merged), sums.shape[1]), np.int64)
        total[np.searchsorted(merged, self._ids)] = self._sums
        total[np.searchsorted(merged, ids)] += sums
        self._ids, self._sums = merged, total

    def table(self) -> list[dict[str, Any]]:
        """Return a row for each true object, by ID: id, iou, iou_all, biou, dice, pixels (true ones in all views)."""
        rows = []
        for i, sums in zip(self._ids.tolist(), self._sums.tolist()):
            same, predicted, truth, band_same, band_predicted, band_truth, anywhere = sums
            if truth == 0:
                continue
            rows.append(
                {
                    "id": i,
                    "iou": same / (predicted + truth - same),
                    "iou_all": same / (anywhere + truth - same),
                    "biou": band_same / (band_predicted + band_truth - band_same),
                    "dice": 2 * same / (predicted + truth),
                    "pixels": truth,
                }
            )
        return rows

    def result(self) -> dict[str, Any]:
        """Return miou, miou_all, mbiou, dice and accuracy, 0 .. 1, None if no pixel was labeled, and objects {ID: IoU},
        whose IoUs are those of miou."""
        rows = self.table()
        labeled = sum(row["pixels"] for row in rows)
        right = int(self._sums[:, 0].sum())

        def mean(key: str) -> float | None:
            return math.fsum(row[key] for row in rows) / len(rows) if rows else None

        return {
            "miou": mean("iou"),
            "miou_all": mean("iou_all"),
            "mbiou": mean("biou"),
            "dice": mean("dice"),
            "accuracy": right / labeled if labeled else None,
            "objects": {row["id"]: row["iou"] for row in rows},
        }


class AloneScores:
    """Accumulator of the agreement of objects that are rendered alone with their masks, where 0 means background.

    A render of the whole scene does not show the parts of an object that other splats hide, but moving the object does.
    The IoU alone of an object is |P and T| / |T or (P and B)|, with the pixels P where it is opaque if rendered alone,
    its true pixels T and the background B, summed over the views. Pixels of other objects do not count, since these may
    hide it.
    """

    _OPAQUE = 0.5

    def __init__(self) -> None:
        self._sums: dict[int, NDArray[np.int64]] = {}

    def add(self, object_id: int, alpha: NDArray, truth: NDArray) -> None:
        """Add the render of an object in one view: its alpha (h, w), and the integer IDs (h, w) of all objects."""
        if alpha.shape != truth.shape or alpha.ndim != 2:
            raise ValueError(f"two images (h, w) of one size were expected, not {alpha.shape} and {truth.shape}")
        shown, true = alpha > self._OPAQUE, truth == object_id
        found = np.array([np.sum(shown & true), np.sum(true) + np.sum(shown & (truth == 0))])
        self._sums[object_id] = self._sums.get(object_id, 0) + found

    def result(self) -> dict[int, float]:
        """Return the IoU alone, 0 .. 1, of each object that is rendered or true on any counted pixel."""
        return {object_id: int(same) / int(union) for object_id, (same, union) in self._sums.items() if union}


class ImageScores:
    """Accumulator of the mean scores over views: psnr, psnr_corrected (both in dB) and ssim."""

    def __init__(self) -> None:
        self._views: list[dict[str, float]] = []

    def add(self, render: NDArray, truth: NDArray) -> dict[str, float]:
        """Add one view (h, w, 3) and return its scores; the render is clipped to [0, 1].

        psnr_corrected is the PSNR after `color_corrected`.
        """
        render = np.clip(_as_float(render), 0.0, 1.0)
        corrected = color_corrected(np.nan_to_num(render), truth)
        scores = {
            "psnr": psnr(render, truth),
            "psnr_corrected": psnr(corrected, truth),
            "ssim": ssim(render, truth),
        }
        self._views.append(scores)
        return scores

    def result(self) -> dict[str, float | None]:
        """Return the means; None if there was no view."""
        names = ("psnr", "psnr_corrected", "ssim")
        return {name: float(np.mean([v[name] for v in self._views])) if self._views else None for name in names}
