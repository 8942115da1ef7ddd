"""The folder of `--matcher`: which networks it has, and loading them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from ...networks import checkpoint_folder
from ...networks.checkpoint_folder import CONFIG, digest_of, not_a_config, read_config
from ...shared.errors import InputError

LIGHTGLUE, LOFTR = "lightglue", "efficientloftr"
"""Types of models that can match photos: of features that SuperPoint finds, and without a search for features."""

_CLASSES = {LIGHTGLUE: "LightGlue", LOFTR: "EfficientLoFTR"}
"""Their names in transformers."""
_NAMES, _OPTION = " or ".join(_CLASSES.values()), "--matcher"


def kind_of(folder: Path) -> str:
    """Return the type of the model in a folder with a checkpoint, `LIGHTGLUE` or `LOFTR`.

    Raises:
        InputError: The folder lacks a file, or is of another model.
    """
    config, path = read_config(folder, _NAMES, _OPTION), folder / CONFIG
    kind = str(config["model_type"])
    if kind not in _CLASSES:
        raise InputError(f"{path} is of a model of the type {kind}; choose a checkpoint of {_NAMES} as {_OPTION}.")
    corners = config.get("keypoint_detector_config") or {}
    if not isinstance(corners, dict):
        raise not_a_config(path, _NAMES)
    detector = corners.get("model_type")
    if kind == LIGHTGLUE and detector not in ("superpoint", None):
        raise InputError(
            f"{path} is of a LightGlue for features of {detector}; choose a checkpoint with those of SuperPoint."
        )
    return kind


def fingerprint(folder: Path) -> str:
    """Return 8 hexadecimal digits that identify the checkpoint in a folder; raises InputError if there is none."""
    kind_of(folder)
    return digest_of(folder)


def load_network(folder: Path, change: Callable[[Any], None] = lambda _config: None) -> Any:
    """Load the networks of a folder with a checkpoint, in float32.

    Args:
        folder: with config.json and weights, *.safetensors or *.bin.
        change: called with the config, which it may change.

    Raises:
        InputError: The folder lacks a file, is of another architecture, or its weights do not fit its config.json; or
            there is not enough memory, or transformers is not installed.
    """
    name = _CLASSES[kind_of(folder)]
    return checkpoint_folder.load_network(folder, f"{name}ForKeypointMatching", f"{name}Config", _OPTION, change)
