"""checkpoint/: the names of its files, and how far the training has come, which the header of each of them says.

A file is safetensors: 8 bytes with the header's length, the header as JSON, the tensors. The header's metadata holds
the training's state as a string of JSON: `format`, `progress`, `settings` and more, which `backend.training` knows.
"""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from pathlib import Path

CURRENT = "model.safetensors"
PREVIOUS = "previous.safetensors"
FORMAT = 1
"""The version of a checkpoint's tensors and state."""
LONGEST_HEADER = 1 << 26
"""Bytes; a longer header is none."""


@dataclass(frozen=True)
class CheckpointHeader:
    """How far a training has come: steps, and seconds of training."""

    steps: int
    seconds: float


def read_header(folder: Path) -> CheckpointHeader | None:
    """The newest checkpoint's header, without its tensors.

    Args:
        folder: `checkpoint` of a reconstruction folder.

    Returns:
        None where there is no checkpoint, or its header cannot be read.
    """
    try:
        with (folder / CURRENT).open("rb") as file:
            (length,) = struct.unpack("<Q", file.read(8))
            header = json.loads(file.read(min(length, LONGEST_HEADER)))
        progress = json.loads(header["__metadata__"]["state"])["progress"]
        return CheckpointHeader(int(progress["step"]), float(progress["seconds"]))
    except (OSError, ValueError, KeyError, TypeError, struct.error, RecursionError):
        return None
