"""A training's state on disk: safetensors, written beside and renamed, the one before kept."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from ..protocol import InputError

CURRENT = "model.safetensors"
PREVIOUS = "previous.safetensors"
FORMAT = 1


def save_checkpoint(folder: Path, tensors: dict[str, np.ndarray], state: dict[str, Any]) -> None:
    """Write `tensors` and the JSON-able `state`. At every moment one whole checkpoint lies in `folder`.

    Raises InputError that names the file when the disk refuses; what was there before still loads.
    """
    folder.mkdir(parents=True, exist_ok=True)
    data = save(
        {name: np.ascontiguousarray(value) for name, value in tensors.items()},
        metadata={"state": json.dumps({"format": FORMAT, **state})},
    )
    part = folder / (CURRENT + ".part")
    try:
        with open(part, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        if (folder / CURRENT).exists():
            os.replace(folder / CURRENT, folder / PREVIOUS)
        os.replace(part, folder / CURRENT)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise InputError(
            f"The checkpoint {folder / CURRENT} could not be written ({error.strerror}); free some space and run "
            "the same command again, it goes on from the checkpoint before."
        ) from error


def has_checkpoint(folder: Path) -> bool:
    """Whether there are files to go on from, whole or not."""
    return any((folder / name).exists() for name in (CURRENT, PREVIOUS))


def load_checkpoint(folder: Path) -> tuple[dict[str, np.ndarray], dict[str, Any], str | None] | None:
    """Tensors, state and a warning (None if all is well) of the newest checkpoint that is whole; None if there is none.

    Raises InputError when there are files but none can be read.
    """
    broken = None
    for name in (CURRENT, PREVIOUS):
        path = folder / name
        if not path.exists():
            continue
        try:
            with safe_open(path, framework="numpy") as file:
                tensors = {key: file.get_tensor(key) for key in file.keys()}
                state = json.loads(file.metadata()["state"])
        except (SafetensorError, OSError, ValueError, KeyError, TypeError):
            broken = path
            continue
        if state.get("format") != FORMAT:
            raise InputError(f"{path} was written by another version of ObjectGS; train again with --restart.")
        warning = None
        if broken is not None:
            warning = f"{broken} is cut short or damaged; going on from the checkpoint before it ({path.name})."
        elif name == PREVIOUS:
            warning = f"{folder / CURRENT} is missing; going on from the checkpoint before it ({path.name})."
        return tensors, state, warning
    if broken is not None:
        raise InputError(f"{broken} is cut short or damaged and there is no older one; train again with --restart.")
    return None
