"""A training's state on disk: safetensors, written to a temporary file and renamed; the previous one is kept."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from ..shared.errors import InputError
from ..shared.reconstruction.checkpoint import CURRENT, FORMAT, PREVIOUS


def save_checkpoint(folder: Path, tensors: dict[str, np.ndarray], state: dict[str, Any]) -> None:
    """Write a checkpoint. At every moment `folder` holds a whole one, once the first is written.

    Args:
        folder: created if necessary.
        tensors: by name.
        state: JSON-serializable.

    Raises:
        InputError: the file cannot be written; the previous checkpoint still loads.
    """
    folder.mkdir(parents=True, exist_ok=True)
    data = save(
        {name: np.ascontiguousarray(value) for name, value in tensors.items()},
        metadata={"state": json.dumps({"format": FORMAT, **state})},
    )
    part = folder / (CURRENT + ".part")
    try:
        with part.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        if (folder / CURRENT).exists():
            (folder / CURRENT).replace(folder / PREVIOUS)
        part.replace(folder / CURRENT)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise InputError(
            f"The checkpoint {folder / CURRENT} could not be written ({error.strerror}); free some space and run "
            "the same command again to continue from the previous checkpoint."
        ) from error


def has_checkpoint(folder: Path) -> bool:
    """Whether `folder` holds files of a checkpoint, whole or damaged."""
    return any((folder / name).exists() for name in (CURRENT, PREVIOUS))


def load_checkpoint(folder: Path) -> tuple[dict[str, np.ndarray], dict[str, Any], str | None] | None:
    """Read the newest whole checkpoint.

    Returns:
        Its tensors, its state, and a warning or None; None if there is no checkpoint.

    Raises:
        InputError: there are files, but none can be read.
    """
    broken = None
    for name in (CURRENT, PREVIOUS):
        path = folder / name
        if not path.exists():
            continue
        try:
            with safe_open(path, framework="numpy") as file:
                tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 - no dict
                state = json.loads(file.metadata()["state"])
        except (SafetensorError, OSError, ValueError, KeyError, TypeError):
            broken = path
            continue
        if state.get("format") != FORMAT:
            raise InputError(f"{path} was written by another version of ObjectGS; train again with --restart.")
        warning = None
        if broken is not None:
            warning = f"{broken} is cut short or damaged; continuing from the previous checkpoint ({path.name})."
        elif name == PREVIOUS:
            warning = f"{folder / CURRENT} is missing; continuing from the previous checkpoint ({path.name})."
        return tensors, state, warning
    if broken is not None:
        raise InputError(f"{broken} is cut short or damaged, and there is no older one; train again with --restart.")
    return None
