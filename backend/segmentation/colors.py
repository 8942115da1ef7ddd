"""Photos as networks expect them: scaled, and with normalized colors."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from PIL import Image

from ..shared.errors import InputError
from ..shared.formats.json_file import parse_json

_FILE = "preprocessor_config.json"


class Colors(NamedTuple):
    """The mean and the standard deviation (3,) float32 of the colors that a network expects, from 0 to 1."""

    mean: np.ndarray
    deviation: np.ndarray


IMAGENET = Colors(np.array([0.485, 0.456, 0.406], np.float32), np.array([0.229, 0.224, 0.225], np.float32))
HALVES = Colors(np.full(3, 0.5, np.float32), np.full(3, 0.5, np.float32))


def read_colors(folder: Path, usual: Colors = IMAGENET) -> Colors:
    """Read the colors of a checkpoint.

    Args:
        folder: the folder of the checkpoint.
        usual: those of checkpoints that do not say.

    Raises:
        InputError: They are not valid.
    """
    path = folder / _FILE
    if not path.is_file():
        return usual
    try:
        content: Any = parse_json(path.read_bytes())
        mean, deviation = content.get("image_mean", usual.mean), content.get("image_std", usual.deviation)
        found = Colors(np.array(mean, np.float32), np.array(deviation, np.float32))
    except (OSError, ValueError, AttributeError, TypeError) as error:
        raise _invalid(path) from error
    if any(values.shape != (3,) or not np.isfinite(values).all() for values in found) or (found.deviation <= 0).any():
        raise _invalid(path)
    return found


def scaled_pixels(image: np.ndarray, size: tuple[int, int], colors: Colors) -> torch.Tensor:
    """Return a photo (H, W, 3) uint8 as (3, h, w) float32 of a size (w, h), with normalized colors."""
    scaled = np.array(Image.fromarray(image).resize(size, Image.Resampling.BILINEAR), np.float32)
    return torch.from_numpy((scaled / 255 - colors.mean) / colors.deviation).permute(2, 0, 1)


def _invalid(path: Path) -> InputError:
    return InputError(f"{path} has no valid image_mean and image_std; copy the checkpoint again.")
