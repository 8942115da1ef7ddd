"""Which frames of a video become photos: evenly spaced in how far the picture moves, and the sharpest near each place.

A clock would take many frames of where the camera stands and few of where it hurries.
"""

from __future__ import annotations

import numpy as np

SPACING = 0.08
"""Motion between chosen frames, relative to the longer side of the picture, unless their number is given."""
FEWEST, MOST = 40, 150
"""Numbers of frames between which that spacing is kept."""

ANALYZED = 192
"""Longer side in pixels of the pictures whose motion is measured."""
_BLOCK = 48
"""Side of the blocks that move on their own, as parallax moves them."""
_NEW_REFERENCE = 0.02
"""Motion from which on a frame becomes the one that the next are compared with."""
_FLAT = 2.0
"""Standard deviation in gray levels below which a block shows no motion."""
_CERTAIN = 0.12
"""Least height of the peak of a correlation; pictures that have nothing in common reach 0.1."""
_QUANTILE = 75
"""Percentile of the blocks' motion that counts, since an object may turn before a background at rest."""
_AT_EDGE = 0.5
"""What sharpness counts at the edges of a slot, compared to its middle, so that frames are also evenly spaced."""


class MotionTracker:
    """Measures how far the picture has moved since the first frame, frame by frame."""

    def __init__(self) -> None:
        self._reference: np.ndarray | None = None
        self._position = 0.0

    def add(self, gray: np.ndarray) -> float:
        """Return the length of the path, relative to the picture's longer side, up to a frame.

        Args:
            gray: (h, w) gray levels, scaled so that the longer side is about ANALYZED pixels.
        """
        spectra = _spectra(gray)
        if self._reference is None:
            self._reference = spectra
            return 0.0
        moved = displacement(self._reference, spectra) / max(gray.shape)
        if moved >= _NEW_REFERENCE:
            self._position += moved
            self._reference = spectra
            return self._position
        return self._position + moved


def displacement(first: np.ndarray, second: np.ndarray) -> float:
    """Return how many pixels the blocks of two pictures have moved, from their `_spectra`.

    Phase correlation (Kuglin and Hines 1975). Where it is uncertain in most blocks, the picture has moved further than
    can be measured, and the longest motion that can be is returned.
    """
    textured = np.isfinite(first[:, 0, 0]) & np.isfinite(second[:, 0, 0])
    if not textured.any():
        return 0.0
    cross = first[textured] * second[textured].conj()
    peaks = np.fft.irfft2(cross / np.maximum(np.abs(cross), 1e-9), (_BLOCK, _BLOCK)).reshape(-1, _BLOCK * _BLOCK)
    best = peaks.argmax(1)
    moved = np.stack(np.divmod(best, _BLOCK), 1)
    moved = np.where(moved > _BLOCK // 2, moved - _BLOCK, moved)
    certain = peaks.max(1) > _CERTAIN
    if certain.sum() * 2 < len(best):
        return _BLOCK / 2
    return float(np.percentile(np.hypot(*moved[certain].T), _QUANTILE))


def sharpness(gray: np.ndarray) -> float:
    """Return the mean squared gradient of a picture (h, w) of gray levels."""
    values = gray.astype(np.float32)
    return float((np.diff(values, axis=0) ** 2).mean() + (np.diff(values, axis=1) ** 2).mean())


def choose_frames(positions: np.ndarray, sharp: np.ndarray, count: int | None = None) -> np.ndarray:
    """Choose frames of a video.

    Args:
        positions: (n,) from `MotionTracker.add`.
        sharp: (n,) from `sharpness`.
        count: wanted number; None: by the motion.

    Returns:
        Indices of at most `count` frames, in order.
    """
    positions = np.maximum.accumulate(positions)
    total = positions[-1]
    if count is None:
        count = int(np.clip(round(total / SPACING), FEWEST, MOST))
    if len(positions) <= count:
        return np.arange(len(positions))
    if total <= 0:
        return np.unique(np.linspace(0, len(positions) - 1, count).round().astype(int))
    place = positions / total * count
    slots = np.minimum(place.astype(int), count - 1)
    value = sharp * (1 - 2 * (1 - _AT_EDGE) * np.abs(place - slots - 0.5))
    members = (np.flatnonzero(slots == slot) for slot in np.unique(slots))
    return np.array([frames[value[frames].argmax()] for frames in members])


def _spectra(gray: np.ndarray) -> np.ndarray:
    """Return the spectra (n, _BLOCK, _BLOCK // 2 + 1) of the blocks of a picture, NaN for those without texture."""
    rows, columns = (max(size // _BLOCK, 1) for size in gray.shape)
    padded = np.zeros((max(gray.shape[0], _BLOCK), max(gray.shape[1], _BLOCK)), np.float32)
    padded[: gray.shape[0], : gray.shape[1]] = gray
    top, left = (padded.shape[0] - rows * _BLOCK) // 2, (padded.shape[1] - columns * _BLOCK) // 2
    inner = padded[top : top + rows * _BLOCK, left : left + columns * _BLOCK]
    blocks = inner.reshape(rows, _BLOCK, columns, _BLOCK).swapaxes(1, 2).reshape(-1, _BLOCK, _BLOCK)
    window = np.outer(np.hanning(_BLOCK), np.hanning(_BLOCK)).astype(np.float32)
    spectra = np.fft.rfft2((blocks - blocks.mean((1, 2), keepdims=True)) * window)
    spectra[blocks.std((1, 2)) < _FLAT] = np.nan
    return spectra
