"""checkpoint/: names of its files, and the training progress in their headers.

The files are safetensors: 8 bytes with the header's length, the header as JSON, and the tensors. The header's metadata
contains the training state as a JSON string with `format`, `progress`, `settings` and other fields that
`backend.training` defines.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

from ..formats.json_file import parse_json
from ..formats.regular_file import open_regular

CURRENT = "model.safetensors"
PREVIOUS = "previous.safetensors"
FORMAT = 1
"""Version of a checkpoint's tensors and state."""
LONGEST_HEADER = 1 << 26
"""Maximum header length in bytes; longer headers are invalid."""


@dataclass(frozen=True)
class CheckpointHeader:
    """Progress of a training in steps and seconds."""

    steps: int
    seconds: float


def read_header(folder: Path) -> CheckpointHeader | None:
    """Read the header of the newest checkpoint, without its tensors.

    Args:
        folder: The `checkpoint` folder of a reconstruction.

    Returns:
        The header, or None if there is no checkpoint or its header cannot be read.
    """
    try:
        with open_regular(folder / CURRENT) as file:
            (length,) = struct.unpack("<Q", file.read(8))
            header = parse_json(file.read(min(length, LONGEST_HEADER)))
        progress = parse_json(header["__metadata__"]["state"])["progress"]
        return CheckpointHeader(int(progress["step"]), float(progress["seconds"]))
    except (OSError, ValueError, KeyError, TypeError, struct.error):
        return None
