"""Segments of what words name in photos, by a SAM 3 (Carion et al. 2025) of a folder with its checkpoint."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.nn.functional import interpolate

from ..networks.checkpoint_folder import load_network, read_config, read_tokenizer
from .colors import HALVES, read_colors, scaled_pixels
from .segmenter import NAME as SEGMENTERS
from .selection import distinct

LONGEST_SIDE = 1024
"""Longer side in pixels of photos that are about as large as the network's input."""

_NAME = "SAM 3"
_KINDS = ("sam3", "sam3_video")
"""Types of checkpoints; that for videos contains the image's model."""
_VOCABULARIES = ("tokenizer.json", "vocab.json")
_LEAST = 0.3
"""Least certainty of an object."""


def is_sam3(folder: Path, option: str) -> bool:
    """Return whether a folder has a checkpoint of SAM 3; raises InputError if it has none of a model."""
    return read_config(folder, f"{SEGMENTERS}, or {_NAME}", option)["model_type"] in _KINDS


class Sam3:
    """A model that segments what words name, of a folder with a checkpoint of transformers.

    Args:
        folder: with config.json, weights (*.safetensors or *.bin) and tokenizer.json or vocab.json, for which `is_sam3`
            is true.
        names: what to find.
        option: the argument of the command that names the folder, for errors.
        device: where the model runs.

    Raises:
        InputError: The folder lacks a file, its weights do not fit its config.json, or a package is not installed.
    """

    def __init__(self, folder: Path, names: Sequence[str], option: str, device: torch.device | str = "cpu") -> None:
        tokenizer = read_tokenizer(folder, _NAME, option, _VOCABULARIES)
        self._device, self._names = torch.device(device), names
        self._network: Any = load_network(folder, "Sam3Model", "Sam3Config", option).to(self._device)
        self._colors = read_colors(folder, HALVES)
        self._side = int(self._network.config.vision_config.image_size)
        words = int(self._network.config.text_config.max_position_embeddings)
        self._words = tokenizer(
            [name.lower() for name in names], padding="max_length", truncation=True, max_length=words,
            return_tensors="pt",
        ).to(self._device)  # fmt: skip

    @torch.inference_mode()
    def find(self, image: np.ndarray, progress: Callable[[int, int], object]) -> list[tuple[np.ndarray, str]]:
        """Find the segments of what the names name.

        Args:
            image: (H, W, 3) uint8.
            progress: receives the number of finished steps, and of all.

        Returns:
            Masks (H, W) bool and their names, large to small.
        """
        pixels = scaled_pixels(image, (self._side, self._side), self._colors)[None].to(self._device)
        features = self._network.get_vision_features(pixels)
        progress(1, 1 + len(self._names))
        masks, scores, names = [np.zeros((0, *image.shape[:2]), bool)], [np.zeros(0)], []
        for number, name in enumerate(self._names):
            own = slice(number, number + 1)
            found = self._network(
                vision_embeds=features,
                input_ids=self._words["input_ids"][own],
                attention_mask=self._words["attention_mask"][own],
            )
            # The words may be of nothing in the photo, whatever fits them best.
            certain = found.pred_logits[0].sigmoid() * found.presence_logits[0].sigmoid()
            good = torch.nonzero(certain >= _LEAST)[:, 0]
            logits = found.pred_masks[:, good]
            if len(good):
                logits = interpolate(logits, image.shape[:2], mode="bilinear", align_corners=False)
                masks.append((logits[0] > 0).cpu().numpy())
                scores.append(certain[good].cpu().numpy())
                names += [name] * len(good)
            progress(2 + number, 1 + len(self._names))
        every = np.concatenate(masks)
        return [(every[index], names[index]) for index in distinct(every, np.concatenate(scores))]
