"""Segmentation of photos by prompts: SAM (Kirillov et al. 2023), SAM 2 (Ravi et al. 2024), EdgeTAM (Zhou et al. 2025).

The networks are those of a folder with a checkpoint of the package transformers. Its own preparation of photos needs
torchvision, so it is done here: SAM's input is the photo scaled to its longer side and padded at the right and bottom,
and that of the others is the photo scaled to a square.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch.nn.functional import interpolate

from ..networks.checkpoint_folder import CONFIG, digest_of, load_network, read_config
from ..shared.errors import InputError
from .colors import read_colors, scaled_pixels
from .selection import distinct, grid_points, is_segment

NAME = "SAM, SAM 2.1 or EdgeTAM"
LONGEST_SIDE = 1024
"""Longer side in pixels of the photos that are segmented, which is that of the models' inputs."""

_CLASSES = {"sam": "Sam", "sam2": "Sam2", "sam2_video": "Sam2", "edgetam": "EdgeTam", "edgetam_video": "EdgeTam"}
"""Types of checkpoints, and the beginning of the names of their classes; those for videos contain the image's model."""
_BATCH = 4
"""Number of prompts at once; each takes some 130 MB, and more of them are not faster on a CPU."""


class Encoded(NamedTuple):
    """A photo that is ready for prompts.

    Attributes:
        features: those of the model.
        size: width and height of the photo in pixels.
        content: width and height of the photo in the model's input, in pixels of the input.
    """

    features: Any
    size: tuple[int, int]
    content: tuple[int, int]


class Segmenter:
    """A model that segments photos, of a folder with a checkpoint of transformers.

    Args:
        folder: with config.json and weights, *.safetensors or *.bin.
        option: the argument of the command that names the folder, for errors.
        device: where the model runs.

    Raises:
        InputError: The folder lacks a file, is of another architecture, or its weights do not fit its config.json; or
            a package is not installed.
    """

    def __init__(self, folder: Path, option: str = "--segmenter", device: torch.device | str = "cpu") -> None:
        kind = kind_of(folder, option)
        name = _CLASSES[kind]
        self._is_padded = kind == "sam"
        self._device = torch.device(device)
        self._network: Any = load_network(folder, f"{name}Model", f"{name}Config", option).to(self._device)
        self._colors = read_colors(folder)
        self._side = int(self._network.config.prompt_encoder_config.image_size)

    @torch.inference_mode()
    def encode(self, image: np.ndarray) -> Encoded:
        """Prepare a photo (H, W, 3) uint8 for prompts, which takes most of the time."""
        height, width = image.shape[:2]
        content = (self._side, self._side)
        if self._is_padded:
            scale = self._side / max(width, height)
            content = max(round(scale * width), 1), max(round(scale * height), 1)
        pixels = torch.zeros(1, 3, self._side, self._side)
        pixels[0, :, : content[1], : content[0]] = scaled_pixels(image, content, self._colors)
        features = self._network.get_image_embeddings(pixels.to(self._device))
        return Encoded(features, (width, height), content)

    @torch.inference_mode()
    def segment(
        self, encoded: Encoded, points: np.ndarray, labels: np.ndarray, box: np.ndarray | None = None
    ) -> tuple[np.ndarray, float]:
        """Segment what points and a box mark.

        Args:
            encoded: the photo.
            points: (n, 2) x and y in pixels, with the center of the first pixel at (0.5, 0.5); may be empty with a box.
            labels: (n,) 1 for points on the object, 0 for points that are not on it.
            box: (4,) left, top, right and bottom of the object in pixels, or None.

        Returns:
            The mask (H, W) bool, and the IoU with the true one that the model predicts.
        """
        # A single point may mean a part or the whole, for which the model has an answer each.
        is_ambiguous = len(points) == 1 and box is None
        logits, scores = self._predict(
            encoded, np.asarray(points, float)[None], np.asarray(labels)[None], None if box is None else box[None],
            is_ambiguous,
        )  # fmt: skip
        best = int(scores[0].argmax())
        return self._masks(encoded, logits[0, best : best + 1])[0], float(scores[0, best])

    @torch.inference_mode()
    def everything(
        self, image: np.ndarray, progress: Callable[[int, int], object] = lambda _done, _total: None
    ) -> list[np.ndarray]:
        """Find the segments of a photo by prompts all over it.

        Args:
            image: (H, W, 3) uint8.
            progress: receives the number of finished steps, and of all.

        Returns:
            Masks (H, W) bool, large to small; they may overlap, as parts do with the whole.
        """
        encoded = self.encode(image)
        points = grid_points(encoded.size)
        steps = 1 + -(-len(points) // _BATCH)
        progress(1, steps)
        candidates, qualities = [], []
        for step, first in enumerate(range(0, len(points), _BATCH), 2):
            batch = points[first : first + _BATCH, None]
            logits, scores = self._predict(encoded, batch, np.ones(batch.shape[:2], int), None, True)
            logits, scores = logits.flatten(0, 1), scores.flatten()
            kept = is_segment(self._cropped(encoded, logits), scores)
            candidates.append(logits[kept].half().cpu())
            qualities.append(scores[kept].cpu())
            progress(step, steps)
        logits, scores = torch.cat(candidates), torch.cat(qualities)
        chosen = distinct((self._cropped(encoded, logits) > 0).numpy(), scores.numpy())
        return [self._masks(encoded, logits[index : index + 1].float())[0] for index in chosen]

    def _predict(
        self, encoded: Encoded, points: np.ndarray, labels: np.ndarray, boxes: np.ndarray | None, several: bool
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the logits (p, m, h, w) and predicted IoUs (p, m) of masks for p prompts.

        Args:
            encoded: the photo.
            points, labels: (p, n, 2) in pixels and (p, n).
            boxes: (p, 4) in pixels, or None.
            several: whether there are three masks for each prompt instead of one.
        """
        scale = np.divide(encoded.content, encoded.size)
        given: dict[str, Any] = {}
        # The model adds half a pixel, which is in the points already.
        if points.shape[1]:
            given["input_points"] = torch.from_numpy((points * scale - 0.5).astype(np.float32))[None].to(self._device)
            given["input_labels"] = torch.from_numpy(labels.astype(np.int32))[None].to(self._device)
        if boxes is not None:
            corners = np.asarray(boxes, float).reshape(-1, 2, 2) * scale - 0.5
            given["input_boxes"] = torch.from_numpy(corners.reshape(1, -1, 4).astype(np.float32)).to(self._device)
        found = self._network(image_embeddings=encoded.features, multimask_output=several, **given)
        return found.pred_masks[0], found.iou_scores[0]

    def _cropped(self, encoded: Encoded, logits: torch.Tensor) -> torch.Tensor:
        """Return logits (n, h, w) without the padding of the input."""
        width, height = (
            -(-side * pixels // self._side)
            for side, pixels in zip(encoded.content, (logits.shape[2], logits.shape[1]), strict=True)
        )
        return logits[:, :height, :width]

    def _masks(self, encoded: Encoded, logits: torch.Tensor) -> np.ndarray:
        """Return the masks (n, H, W) bool of logits (n, h, w), in the photo's pixels."""
        width, height = encoded.content
        if (width, height) != (self._side, self._side):
            size = (self._side, self._side)
            logits = interpolate(logits[None], size, mode="bilinear", align_corners=False)[0, :, :height, :width]
        scaled = interpolate(logits[None], encoded.size[::-1], mode="bilinear", align_corners=False)[0]
        return (scaled > 0).cpu().numpy()


def kind_of(folder: Path, option: str) -> str:
    """Return the type of the model in a folder, such as "sam2"; raises InputError if it has none that is known."""
    kind = str(read_config(folder, NAME, option)["model_type"])
    if kind not in _CLASSES:
        raise InputError(
            f"{folder / CONFIG} is of a model of the type {kind}; choose a checkpoint of {NAME} as {option}."
        )
    return kind


def fingerprint(folder: Path, option: str = "--segmenter") -> str:
    """Return 8 hexadecimal digits that identify the checkpoint in a folder; raises InputError if there is none."""
    kind_of(folder, option)
    return digest_of(folder)
