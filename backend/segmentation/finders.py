"""What finds the segments of photos: a segmenter alone, or by names together with a detector, or a SAM 3."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch

from ..networks.checkpoint_folder import digest_of
from . import detector as detectors
from . import sam3
from .detector import Detector
from .photo_segments import Find, Finder
from .sam3 import Sam3
from .segmenter import LONGEST_SIDE, Segmenter, fingerprint, kind_of
from .selection import distinct

_NO_POINTS = np.zeros((0, 2)), np.zeros(0)


def everything(folder: Path, option: str) -> Finder:
    """Return what finds all segments of photos.

    Args:
        folder: with a checkpoint of a segmenter.
        option: the argument of the command that names the folder, for errors.

    Raises:
        InputError: As of `fingerprint`; loading raises it as `Segmenter` does.
    """

    def load(device: torch.device) -> Find:
        segmenter = Segmenter(folder, option, device)
        return lambda image, progress: [(mask, "") for mask in segmenter.everything(image, progress)]

    what = f"segments by a model of the type {kind_of(folder, option)}"
    return Finder(what, fingerprint(folder, option), LONGEST_SIDE, load)


def boxed(folder: Path, option: str, detector: Path, names: Sequence[str]) -> Finder:
    """Return what segments the boxes of what names name.

    Args:
        folder: with a checkpoint of a segmenter.
        option: the argument of the command that names the folder, for errors.
        detector: folder with a checkpoint of a detector.
        names: of objects.

    Raises:
        InputError: As of `fingerprint`; loading raises it as `Segmenter` and `Detector` do.
    """

    def load(device: torch.device) -> Find:
        detect, segmenter = Detector(detector, names, device), Segmenter(folder, option, device)

        def find(image: np.ndarray, progress: Callable[[int, int], object]) -> list[tuple[np.ndarray, str]]:
            found = detect.find(image)
            progress(1, 2)
            if not found:
                return []
            encoded = segmenter.encode(image)
            progress(2, 2)
            masks = np.stack([segmenter.segment(encoded, *_NO_POINTS, each.box)[0] for each in found])
            # Boxes of one object may differ by what they contain beside it.
            return [(masks[i], found[i].name) for i in distinct(masks, np.array([each.score for each in found]))]

        return find

    what = f"segments of {', '.join(names)} by models of the types grounding-dino and {kind_of(folder, option)}"
    key = f"{fingerprint(folder, option)}-{detectors.fingerprint(detector)}-{_digest(names)}"
    return Finder(what, key, detectors.LONGEST_SIDE, load)


def by_words(folder: Path, option: str, names: Sequence[str]) -> Finder:
    """Return what segments what names name.

    Args:
        folder: with a checkpoint of SAM 3.
        option: the argument of the command that names the folder, for errors.
        names: of objects.

    Raises:
        InputError: A file of the folder cannot be read; loading raises it as `Sam3` does.
    """
    what = f"segments of {', '.join(names)} by a model of the type sam3"
    key = f"{digest_of(folder)}-{_digest(names)}"
    return Finder(what, key, sam3.LONGEST_SIDE, lambda device: Sam3(folder, names, option, device).find)


def _digest(names: Sequence[str]) -> str:
    """Return 8 hexadecimal digits that identify names."""
    return hashlib.sha256("\n".join(names).encode()).hexdigest()[:8]
