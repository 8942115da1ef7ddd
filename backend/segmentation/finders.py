"""What finds the segments of photos."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from .photo_segments import Finder
from .segmenter import LONGEST_SIDE, Segmenter, fingerprint


def everything(folder: Path, option: str, device: torch.device | str) -> Finder:
    """Return what finds all segments of photos.

    Args:
        folder: with a checkpoint of a segmenter.
        option: the argument of the command that names the folder, for errors.
        device: where the model runs.

    Raises:
        InputError: As of `Segmenter`.
    """
    segmenter = Segmenter(folder, option, device)

    def find(image: np.ndarray, progress: Callable[[int, int], object]) -> list[tuple[np.ndarray, str]]:
        return [(mask, "") for mask in segmenter.everything(image, progress)]

    return Finder(f"segments by a model of the type {segmenter.kind}", fingerprint(folder, option), LONGEST_SIDE, find)
