"""Scores of the paper's tables that the program itself does not compute: of prompts, and of instances in 3D."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from backend.evaluation.metrics import boundaries, boundary_distance

NEAR = 0.02
"""Distance in meters up to which a point counts as found."""


class Results(NamedTuple):
    """What a trained reconstruction gives to the protocols.

    Attributes:
        ids: function that returns the rendered object IDs (h, w) of a held-out view, by its name.
        quality: means over the held-out views by metric, as from `backend.evaluation.evaluate`.
        points: "anchors" and "splats" -> object ID -> positions (n, 3) in the world.
    """

    ids: Callable[[str], NDArray]
    quality: Mapping[str, float | None]
    points: Mapping[str, Mapping[int, NDArray]]


def binary_iou(predicted: NDArray, truth: NDArray) -> float:
    """Return the IoU of two masks (h, w) bool over the whole image; 1 if both are empty."""
    union = np.count_nonzero(predicted | truth)
    return np.count_nonzero(predicted & truth) / union if union else 1.0


def binary_boundary_iou(predicted: NDArray, truth: NDArray) -> float:
    """Return the boundary IoU of two masks (h, w) bool over the whole image; 1 if both are empty.

    The boundary of a mask are its pixels up to 2% of the image's diagonal from its border (Cheng et al. 2021).
    """
    distance = boundary_distance(*truth.shape)
    return binary_iou(predicted & boundaries(predicted, distance), truth & boundaries(truth, distance))


def associated(ids: NDArray, mask: NDArray) -> int | None:
    """Return the object in the IDs (h, w) that has the largest IoU with a mask (h, w) bool; None if none overlaps."""
    found = np.unique(ids[mask & (ids > 0)]).tolist()
    return max(found, key=lambda i: binary_iou(ids == i, mask), default=None)


class PromptScore(NamedTuple):
    """The scores of one prompt in one view; is_first: whether its object was chosen in this view."""

    prompt: str
    view: str
    object_id: int | None
    is_first: bool
    iou: float
    biou: float


def score_prompts(ids_of: Callable[[str], NDArray], truth: Mapping[str, Mapping[str, NDArray]]) -> list[PromptScore]:
    """Score prompts in the views that show them.

    A prompt is associated with the object that has the largest IoU with its mask in the first view that shows it.

    Args:
        ids_of: Function that returns the rendered object IDs (h, w) of a view.
        truth: View name -> prompt -> mask (h, w) bool, with the first view first.

    Returns:
        A score for each view and prompt of it.
    """
    object_of: dict[str, int | None] = {}
    scores = []
    for view, masks in truth.items():
        ids = ids_of(view)
        for prompt, mask in masks.items():
            is_first = prompt not in object_of
            if is_first:
                object_of[prompt] = associated(ids, mask)
            predicted = np.zeros_like(mask) if object_of[prompt] is None else ids == object_of[prompt]
            iou, biou = binary_iou(predicted, mask), binary_boundary_iou(predicted, mask)
            scores.append(PromptScore(prompt, view, object_of[prompt], is_first, iou, biou))
    return scores


def mean(values: Iterable[float]) -> float | None:
    """Return the mean; None if there are no values."""
    found = list(values)
    return math.fsum(found) / len(found) if found else None


def mean_over_prompts(scores: Iterable[PromptScore], key: str) -> float | None:
    """Return the mean over the prompts of the mean over each prompt's views; None without scores."""
    of_prompt: dict[str, list[float]] = {}
    for score in scores:
        of_prompt.setdefault(score.prompt, []).append(getattr(score, key))
    return mean(math.fsum(values) / len(values) for values in of_prompt.values())


def prompt_rows(scores: Iterable[PromptScore]) -> list[dict[str, Any]]:
    """Return a row for each prompt: prompt, id, views, and iou and biou as means over its views."""
    of_prompt: dict[str, list[PromptScore]] = {}
    for score in scores:
        of_prompt.setdefault(score.prompt, []).append(score)
    return [
        {
            "prompt": prompt, "id": found[0].object_id, "views": len(found),
            "iou": mean(score.iou for score in found), "biou": mean(score.biou for score in found),
        }
        for prompt, found in of_prompt.items()
    ]  # fmt: skip


def percent(value: float | None) -> float | None:
    """Return a fraction in percent; None stays None."""
    return None if value is None else 100 * value


def score_instances(found: Mapping[int, NDArray], truth: Mapping[int, NDArray]) -> dict[str, float | int | None]:
    """Compare the points of objects with those of the true objects of the same IDs.

    Precision is the fraction of an object's points that lie within NEAR of a true one, recall the fraction of its true
    points that lie within NEAR of one of its points, F1 their harmonic mean, and the Chamfer distance the mean of the
    mean distances in both directions.

    Args:
        found: Object ID -> points (n, 3) in meters; an object without points has no entry, or an empty one.
        truth: Object ID -> true points (m, 3) in meters, m > 0.

    Returns:
        chamfer in meters, precision, recall and f1, as means over the true objects, and `missing`, the number of
        these without points: their precision, recall and F1 are 0, and they have no Chamfer distance. None without
        any.
    """
    rows, chamfers = [], []
    for i, true in truth.items():
        points = found.get(i)
        if points is None or not len(points):
            rows.append((0.0, 0.0, 0.0))
            continue
        to_truth = cKDTree(true).query(points)[0]
        to_points = cKDTree(points).query(true)[0]
        precision, recall = float((to_truth <= NEAR).mean()), float((to_points <= NEAR).mean())
        both = precision + recall
        rows.append((precision, recall, 2 * precision * recall / both if both else 0.0))
        chamfers.append((float(to_truth.mean()) + float(to_points.mean())) / 2)
    columns = {key: mean(row[k] for row in rows) for k, key in enumerate(("precision", "recall", "f1"))}
    return {"chamfer": mean(chamfers), **columns, "missing": len(rows) - len(chamfers)}
