"""LPIPS, the perceptual distance of images (Zhang et al. 2018), if its package and its weights are on this computer."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

PACKAGE = "lpips"
BACKBONE = "vgg"
"""The network of papers on Gaussian splatting."""

WEIGHTS = "vgg16-397923af.pth"
"""File of the backbone's weights in the folder `checkpoints` of torch's hub cache."""


def load_lpips() -> Callable[[NDArray, NDArray], float] | None:
    """Load the network of LPIPS; nothing is downloaded.

    Returns:
        A function that returns the distance of two images (h, w, 3), float in [0, 1] or uint8, 0 if they are equal;
        None if the package or the weights of its backbone are missing.
    """
    if find_spec(PACKAGE) is None:
        return None
    import torch

    if not (Path(torch.hub.get_dir()) / "checkpoints" / WEIGHTS).is_file():
        return None
    network = importlib.import_module(PACKAGE).LPIPS(net=BACKBONE, verbose=False)

    def prepared(image: NDArray) -> torch.Tensor:
        """Return an image as (1, 3, h, w), from -1 to 1."""
        pixels = image.astype(np.float32) / (255 if image.dtype == np.uint8 else 1)
        return torch.from_numpy(np.ascontiguousarray(pixels.clip(0, 1).transpose(2, 0, 1)[None])) * 2 - 1

    def distance(a: NDArray, b: NDArray) -> float:
        with torch.no_grad():
            return float(network(prepared(a), prepared(b)))

    return distance
