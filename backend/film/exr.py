"""Film frames as multilayer OpenEXR files: lossless, whole or not there, with what they were made of in the header."""

from __future__ import annotations

import os
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from ..protocol import atomic_path

DIGEST = "objectgs/digest"
_MAGIC = bytes.fromhex("762f3101")
_LINES_A_CHUNK = 16
"""Of the compression that `write` uses."""


def write(path: Path, channels: Mapping[str, NDArray], header: Mapping[str, Any], digest: str) -> None:
    """Write channels (H, W) by name (float16, float32 or uint32) to `path`, under another name until it is whole.

    Several processes may write the same file: the last one stays. An OSError names `path`.
    """
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    entries = {**header, DIGEST: digest, "compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    planes = {name: np.ascontiguousarray(plane) for name, plane in channels.items()}
    with atomic_path(path, part):
        part.write_bytes(b"")  # OpenEXR says badly why a file cannot be written.
        try:
            OpenEXR.File(entries, planes).write(str(part))
        except RuntimeError as error:
            raise OSError(0, str(error)) from error


def digest_of(path: Path) -> str | None:
    """The digest of a file that `write` made and that is whole; None where it is cut short, another or not there."""
    try:
        with open(path, "rb") as file:
            size = os.fstat(file.fileno()).st_size
            if file.read(4) != _MAGIC:
                return None
            file.read(4)
            found = {name: value for name, value in _attributes(file)}
            _, top, _, bottom = struct.unpack("<4i", found["dataWindow"])
            chunks = -(-(bottom - top + 1) // _LINES_A_CHUNK)
            table = struct.unpack(f"<{chunks}Q", file.read(8 * chunks))
            file.seek(max(table))
            _, length = struct.unpack("<2i", file.read(8))
            whole = min(table) > 0 and max(table) + 8 + length == size
            return found[DIGEST].decode() if whole else None
    except (OSError, KeyError, ValueError, struct.error):
        return None


def _attributes(file):
    """Name and content of each attribute of a header, up to its end."""

    def text() -> str:
        letters = bytearray()
        while (letter := file.read(1)) not in (b"\0", b""):
            letters += letter
        return letters.decode()

    while name := text():
        text()
        (length,) = struct.unpack("<i", file.read(4))
        yield name, file.read(length)
