"""EfficientLoFTR: matches of two photos without a search for features.

The networks are those of transformers. What follows them has no weights and is done here, as the paper describes it:
Wang et al., "Efficient LoFTR: Semi-Dense Local Feature Matching with Sparse-Like Speed", 2024. In transformers 5.24 the
matches of the two photos are listed in different orders, and all positions are at the same corner of their cells.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from .checkpoint import load_network

MULTIPLE = 32
"""Number of pixels of which the sides of photos are multiples: cells of 8 pixels, of which attention takes 4 as one."""
MOST_MATCHES = 4096
"""Most matches of two photos."""


class EfficientLoFTR:
    """An EfficientLoFTR, of a folder with a checkpoint of transformers.

    Args:
        folder: with config.json and weights, *.safetensors or *.bin.

    Raises:
        InputError: The folder lacks a file, is of another architecture, or its weights do not fit its config.json; or
            transformers is not installed.
    """

    def __init__(self, folder: Path) -> None:
        self._network = load_network(folder)
        self._config = self._network.config

    @torch.inference_mode()
    def match(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """Return what two photos show at the same places.

        Args:
            first: gray image (h, w) uint8, with multiples of 32 as sides.
            second: another, whose size may differ.

        Returns:
            (m, 5) float32, m <= `MOST_MATCHES`, the most certain first: x and y in pixels in the first photo, the same
            in the second, with the center of the first pixel at (0.5, 0.5), and the certainty.
        """
        photos = first, second
        height, width = np.maximum(first.shape, second.shape)
        pixels = torch.zeros(1, 2, 1, height, width)
        for number, gray in enumerate(photos):
            pixels[0, number, 0, : gray.shape[0], : gray.shape[1]] = torch.tensor(gray) / 255
        coarse, *finer = self._network.efficientloftr(pixels).feature_maps
        coarse = coarse / coarse.shape[2] ** 0.5
        columns = coarse.shape[4]
        side = width // columns
        # Cells beyond the smaller photo are left out, since networks do not know where it ends.
        cells = [_cells_of(gray.shape[0] // side, gray.shape[1] // side, columns) for gray in photos]
        border = self._config.coarse_matching_border_removal
        inner = [_is_inner(gray.shape[0] // side, gray.shape[1] // side, border) for gray in photos]
        features = coarse[0].flatten(2).mT
        *matches, certainty = self._mutual(features[0, cells[0]], features[1, cells[1]], *inner)
        matched = [each[row] for each, row in zip(cells, matches, strict=True)]
        windows, larger = self._network.refinement_layer(coarse, finer)
        within = self._within_cells(windows[0, matched[0]], larger[0, matched[1]])
        corners = [side * torch.stack([each % columns, each // columns], 1) for each in matched]
        places = [corner + place for corner, place in zip(corners, within, strict=True)]
        return torch.cat([*places, certainty[:, None]], 1).numpy()

    def _mutual(
        self, first: torch.Tensor, second: torch.Tensor, inner: torch.Tensor, inner_of_second: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return the rows of the cells (n, d) and (m, d) that are each other's most similar, and how certain that is.

        The certainty is the product of the softmax over either photo's cells. Only inner cells are returned.
        """
        scores = first @ second.T / self._config.coarse_matching_temperature
        if not self._config.coarse_matching_skip_softmax:
            over_first, over_second = scores.logsumexp(0, keepdim=True), scores.logsumexp(1, keepdim=True)
            scores = scores.mul_(2).sub_(over_first).sub_(over_second).exp_()
        best, of_second = scores.max(1)
        kept = (scores.argmax(0)[of_second] == torch.arange(len(best))) & inner & inner_of_second[of_second]
        of_first = torch.nonzero(kept & (best > self._config.coarse_matching_threshold))[:, 0]
        of_first = of_first[best[of_first].argsort(descending=True, stable=True)][:MOST_MATCHES]
        return of_first, of_second[of_first], best[of_first]

    def _within_cells(self, first: torch.Tensor, second: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the places (m, 2) of matches relative to the corners of their cells, in pixels.

        Args:
            first: (m, s * s, d) features of the pixels of the cells in the first photo.
            second: (m, (s + 2) * (s + 2), d), the same in the second, and of a pixel around them.
        """
        side, last = self._config.fine_kernel_size, self._config.fine_matching_slice_dim
        wide = side + 2
        likeness = first[..., :-last] @ second[..., :-last].mT / first.shape[-1]
        likeness = likeness.softmax(1) * likeness.softmax(2)
        likeness = likeness.unflatten(2, (wide, wide))[..., 1:-1, 1:-1].flatten(1)
        best = likeness.argmax(1)
        of_first, of_second = best // side**2, best % side**2
        # Weights are trained with places from 3.5 pixels before the corner of a cell to 3.5 after it, and with 3 x 3
        # pixels around that which is one up and left of the best; beyond the border are those of the opposite side.
        steps = torch.tensor([-1, 0, 1])
        down, right = steps.repeat_interleave(3), steps.repeat(3)
        around = (of_second // side)[:, None] + down, (of_second % side)[:, None] + right
        each = torch.arange(len(best))
        near = second[each[:, None], around[0] % wide * wide + around[1] % wide, -last:]
        likeness = (near @ first[each, of_first, -last:, None])[..., 0] / last**0.5
        weights = (likeness / self._config.fine_matching_regress_temperature).softmax(1)
        moved = weights @ torch.stack([right, down], 1).float()
        in_first, in_second = (
            torch.stack([pixel % side, pixel // side], 1) + 1 - side / 2 for pixel in (of_first, of_second)
        )
        return in_first, in_second + moved


def _cells_of(rows: int, columns: int, all_columns: int) -> torch.Tensor:
    """Return the indices of the cells of a photo, in a grid that may have more columns."""
    return (torch.arange(rows)[:, None] * all_columns + torch.arange(columns)).flatten()


def _is_inner(rows: int, columns: int, border: int) -> torch.Tensor:
    """Return which cells of a photo are away from its border, by so many cells."""
    inner = torch.zeros(rows, columns, dtype=torch.bool)
    inner[border : rows - border, border : columns - border] = True
    return inner.flatten()
