"""checkpoint/: names of its files, and the training progress in their headers.

The files are safetensors: 8 bytes with the header's length, the header as JSON, and the tensors. The header's metadata
contains the training state as a JSON string with `format`, `progress`, `settings` and other fields that
`backend.training` defines.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

from ..formats.json_file import parse_json
from ..formats.regular_file import open_regular

CURRENT = "model.safetensors"
PREVIOUS = "previous.safetensors"
FORMAT = 1
"""Version of a checkpoint's tensors and state."""
LONGEST_HEADER = 1 << 26
"""Maximum header length in bytes; longer headers are invalid."""
LENGTH_BYTES = 8
"""Number of bytes of the header's length."""


@dataclass(frozen=True)
class CheckpointHeader:
    """Progress of a training in steps and seconds, and its latest metrics on held-out views.

    Attributes:
        steps, seconds: progress.
        quality: those of psnr, miou and miou_all that were measured.
        zero_is_background: whether pixels without a label show the background, see `report.lead_miou`.
    """

    steps: int
    seconds: float
    quality: Mapping[str, float] = field(default_factory=dict)
    zero_is_background: bool = False


def stored_header(file: BinaryIO) -> tuple[dict[str, Any], int]:
    """Return the header of an open checkpoint, and the position of the first tensor; raise ValueError if it is damaged.

    The header maps the names of tensors to their `dtype`, `shape` and `data_offsets`, and `__metadata__` to a mapping
    with the `state`.
    """
    length = int.from_bytes(file.read(LENGTH_BYTES), "little")
    if length > LONGEST_HEADER:
        raise ValueError("the header is too long")
    header = parse_json(file.read(length))
    if not isinstance(header, dict):
        raise ValueError("the header is no object")
    return header, LENGTH_BYTES + length


def read_header(folder: Path) -> CheckpointHeader | None:
    """Read the header of the newest checkpoint, without its tensors.

    Args:
        folder: The `checkpoint` folder of a reconstruction.

    Returns:
        The header, or None if there is no checkpoint or its header cannot be read.
    """
    try:
        with open_regular(folder / CURRENT) as file:
            header, _ = stored_header(file)
        state = parse_json(header["__metadata__"]["state"])
        progress = state["progress"]
        steps, seconds = int(progress["step"]), float(progress["seconds"])
        return CheckpointHeader(steps, seconds, _latest(progress), state.get("supervise_background") is True)
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _latest(progress: Mapping[str, Any]) -> dict[str, float]:
    """Return the finite metrics of the last entry of the training curve that has any."""
    curve = progress.get("curve")
    entries = [entry for entry in curve if isinstance(entry, dict)] if isinstance(curve, list) else []
    last = next((entry for entry in reversed(entries) if isinstance(entry.get("psnr"), float)), {})
    found = {name: last.get(name) for name in ("psnr", "miou", "miou_all")}
    return {name: value for name, value in found.items() if isinstance(value, float) and math.isfinite(value)}
