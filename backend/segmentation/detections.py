"""From words to boxes: the prompt of a Grounding DINO (Liu et al. 2023), and the objects that its answers show."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

LEAST_BOX, LEAST_TEXT = 0.3, 0.25
"""Least probability of any word of a box, and least one of a word of its name."""

_SAME = 0.7
"""Of boxes with a larger IoU, the best one is kept, whatever their names."""
_MOST = 100
"""Most objects of a photo."""


class Detection(NamedTuple):
    """An object in a photo.

    Attributes:
        box: (4,) left, top, right and bottom in pixels.
        name: the name that fits it best.
        score: how certain it is, from 0 to 1.
    """

    box: np.ndarray
    name: str
    score: float


def prompt_of(names: Sequence[str]) -> tuple[str, list[tuple[int, int]]]:
    """Return the prompt for names, and where each of them begins and ends in it.

    The network takes periods and question marks for ends of phrases, so names are without.
    """
    prompt, places = "", []
    for name in names:
        words = " ".join(re.sub(r"[.?]", " ", name.lower()).split())
        places.append((len(prompt), len(prompt) + len(words)))
        prompt += f"{words} . "
    return prompt.rstrip(), places


def detections(
    probabilities: np.ndarray,
    boxes: np.ndarray,
    tokens: Sequence[np.ndarray],
    names: Sequence[str],
    size: tuple[int, int],
) -> list[Detection]:
    """Return the objects that a network has found in a photo.

    A box gets the name whose tokens are most probable on average: names share words, as "red cup" and "blue cup" do,
    and the most probable token may be such a word.

    Args:
        probabilities: (q, t) of each box and token of the prompt.
        boxes: (q, 4) center x and y, width and height, relative to the photo.
        tokens: the indices of the tokens of each name.
        names: the names.
        size: width and height of the photo in pixels.

    Returns:
        The objects, the most certain first.
    """
    most = np.stack([probabilities[:, own].max(1) for own in tokens], 1)
    means = np.stack([probabilities[:, own].mean(1) for own in tokens], 1)
    named = np.where(most >= LEAST_TEXT, means, -1.0).argmax(1)
    scores = most.max(1)
    corners = np.concatenate([boxes[:, :2] - boxes[:, 2:] / 2, boxes[:, :2] + boxes[:, 2:] / 2], 1)
    corners = np.clip(corners, 0, 1) * np.tile(size, 2)
    good = np.flatnonzero((scores >= LEAST_BOX) & (corners[:, 2:] > corners[:, :2]).all(1))
    best = good[np.argsort(-scores[good], kind="stable")]
    kept: list[int] = []
    for index in best.tolist():
        if len(kept) < _MOST and not (_overlaps(corners[index], corners[kept]) > _SAME).any():
            kept.append(index)
    return [Detection(corners[index], names[named[index]], float(scores[index])) for index in kept]


def _overlaps(box: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """Return the IoU of a box (4,) with others (n, 4)."""
    common = np.clip(np.minimum(box[2:], boxes[:, 2:]) - np.maximum(box[:2], boxes[:, :2]), 0, None).prod(1)
    return common / ((box[2:] - box[:2]).prod() + (boxes[:, 2:] - boxes[:, :2]).prod(1) - common)
