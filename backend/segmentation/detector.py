"""Boxes of what words name in photos, by a Grounding DINO (Liu et al. 2023) of a folder with its checkpoint.

The package's own preparation of photos needs torchvision, so it is done here: the photo is scaled to a shorter side of
800 pixels, or to a longer one of 1333 if that is less.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..networks.checkpoint_folder import CONFIG, digest_of, load_network, read_config, read_tokenizer
from ..shared.errors import InputError
from .colors import read_colors, scaled_pixels
from .detections import Detection, detections, prompt_of

LONGEST_SIDE = 1333
"""Longer side in pixels of photos that are not larger than the network's input."""

_SHORTEST_SIDE = 800
_NAME, _KIND, _OPTION = "Grounding DINO", "grounding-dino", "--detector"
_VOCABULARIES = ("tokenizer.json", "vocab.txt")
"""Files of tokenizers, of which one is enough."""


class Detector:
    """A model that finds what words name, of a folder with a checkpoint of transformers.

    Args:
        folder: with config.json, weights (*.safetensors or *.bin) and tokenizer.json or vocab.txt.
        names: what to find.
        device: where the model runs.

    Raises:
        InputError: The folder lacks a file, is of another architecture, or its weights do not fit its config.json; or
            the names are too many, or contain no words; or a package is not installed.
    """

    def __init__(self, folder: Path, names: Sequence[str], device: torch.device | str = "cpu") -> None:
        _require_kind(folder)
        tokenizer = read_tokenizer(folder, _NAME, _OPTION, _VOCABULARIES)
        self._device = torch.device(device)
        self._network: Any = load_network(folder, "GroundingDinoForObjectDetection", "GroundingDinoConfig", _OPTION).to(
            self._device
        )
        self._colors = read_colors(folder)
        self._names = names
        prompt, places = prompt_of(names)
        encoded = tokenizer(prompt, return_offsets_mapping=True)
        self._words = torch.tensor([encoded["input_ids"]], device=self._device)
        starts, ends = np.array(encoded["offset_mapping"]).T
        self._tokens = [np.flatnonzero((starts >= first) & (ends <= last) & (ends > starts)) for first, last in places]
        most = int(self._network.config.max_text_len)
        if self._words.shape[1] > most:
            raise InputError(
                f"The names of --text are {self._words.shape[1]} words and parts of words, and the model in {folder} "
                f"reads {most}; name fewer objects."
            )
        if unread := [name for name, own in zip(names, self._tokens, strict=True) if not len(own)]:
            raise InputError(f"The model in {folder} reads no word in {unread[0]!r} of --text; choose another name.")

    @torch.inference_mode()
    def find(self, image: np.ndarray) -> list[Detection]:
        """Find the named objects in a photo (H, W, 3) uint8; return them, the most certain first."""
        height, width = image.shape[:2]
        pixels = scaled_pixels(image, input_size((width, height)), self._colors)[None].to(self._device)
        found = self._network(
            pixel_values=pixels,
            pixel_mask=torch.ones(pixels.shape[0], *pixels.shape[2:], dtype=torch.int64, device=self._device),
            input_ids=self._words,
        )
        return detections(
            found.logits[0].sigmoid().cpu().numpy(),
            found.pred_boxes[0].cpu().numpy(),
            self._tokens,
            self._names,
            (width, height),
        )


def fingerprint(folder: Path) -> str:
    """Return 8 hexadecimal digits that identify the checkpoint in a folder; raises InputError if there is none."""
    _require_kind(folder)
    return digest_of(folder)


def _require_kind(folder: Path) -> None:
    """Raise InputError if a folder has no checkpoint of a detector."""
    kind = read_config(folder, _NAME, _OPTION)["model_type"]
    if kind != _KIND:
        raise InputError(
            f"{folder / CONFIG} is of a model of the type {kind}; choose a checkpoint of {_NAME} as {_OPTION}."
        )


def input_size(size: tuple[int, int]) -> tuple[int, int]:
    """Return width and height in pixels of the network's input for a photo of a size (width, height)."""
    scale = min(_SHORTEST_SIDE / min(size), LONGEST_SIDE / max(size))
    width, height = (max(round(scale * side), 1) for side in size)
    return width, height
