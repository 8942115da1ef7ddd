"""Film frames as multilayer OpenEXR files: lossless, written atomically, with a digest of their source."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from ..shared.formats.atomic import atomic_path
from ..shared.formats.regular_file import open_regular

DIGEST = "objectgs/digest"
_MAGIC = bytes.fromhex("762f3101")
_LINES_A_CHUNK = 16
"""Lines in a chunk of the compression that `write` uses."""


def write(path: Path, channels: Mapping[str, NDArray], header: Mapping[str, Any], digest: str) -> None:
    """Write an EXR file atomically; several processes may write the same file.

    Args:
        path: The file to write.
        channels: Channel name -> (H, W) float16, float32 or uint32.
        header: Additional attributes of the header.
        digest: The digest of the frame's source, which `digest_of` returns.

    Raises:
        OSError: If the file cannot be written.
    """
    entries = {**header, DIGEST: digest, "compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    planes = {name: np.ascontiguousarray(plane) for name, plane in channels.items()}
    with atomic_path(path) as part:
        try:
            OpenEXR.File(entries, planes).write(str(part))
        except RuntimeError as error:
            # Its message is of several sentences and contains the path of the temporary file.
            raise OSError(0, "OpenEXR cannot write it; is the disk full?") from error


def digest_of(path: Path) -> str | None:
    """Return the digest in a complete file of `write`; None if the file is truncated, missing or of another program."""
    try:
        with open_regular(path) as file:
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


def _attributes(file: BinaryIO) -> Iterator[tuple[str, bytes]]:
    """Iterate over the names and values of the attributes in a header."""

    def text() -> str:
        letters = bytearray()
        while (letter := file.read(1)) not in (b"\0", b""):
            letters += letter
        return letters.decode()

    while name := text():
        text()
        (length,) = struct.unpack("<i", file.read(4))
        yield name, file.read(length)
