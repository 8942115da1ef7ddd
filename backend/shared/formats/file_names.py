"""File names for names that users chose, valid on Windows, macOS and Linux."""

from __future__ import annotations

import re
import unicodedata
import zlib
from collections.abc import Hashable, Mapping
from typing import TypeVar

Key = TypeVar("Key", bound=Hashable)

LONGEST = 100
"""Largest size of a stem in bytes of UTF-8; file systems allow 255, of which suffixes need some."""

_RESERVED = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?$", re.IGNORECASE)
"""Names of devices on Windows, with any suffix."""


def file_stem(name: str, fallback: str = "object") -> str:
    """Return a name without characters, lengths and words that a file system may refuse.

    Args:
        name: any text.
        fallback: the stem for names of which nothing is left.

    Returns:
        At most LONGEST bytes of letters, digits, "_", "." and "-", neither beginning nor ending with "." or "_".
    """
    text = unicodedata.normalize("NFC", name).encode("utf-8", "replace").decode()
    stem = re.sub(r"[^\w.-]+", "_", text).strip("._")
    stem = stem.encode()[:LONGEST].decode(errors="ignore").strip("._") or fallback
    return f"{stem}-file" if _RESERVED.match(stem) else stem


def legible(name: str) -> str:
    """Return a name as text; bytes that are not UTF-8, which Linux allows in names, become question marks."""
    return name.encode(errors="replace").decode()


def distinct_stems(names: Mapping[Key, str], fallback: str = "object") -> dict[Key, str]:
    """Return stems that differ in more than upper and lower case.

    A stem that several names share is followed by "_" and the key, for all of these names but the first.

    Args:
        names: key, such as an object ID, -> name.
        fallback: as in `file_stem`.

    Returns:
        key -> stem, for the keys in the order of `names`.
    """
    stems = {key: file_stem(name, fallback) for key, name in names.items()}
    first: dict[str, Key] = {}
    for key, stem in stems.items():
        first.setdefault(_folded(stem), key)
    taken = set(first)
    for key, stem in stems.items():
        if first[_folded(stem)] == key:
            continue
        tried = f"{stem}_{key}"
        number = 1
        while _folded(tried) in taken:
            number += 1
            tried = f"{stem}_{key}_{number}"
        taken.add(_folded(tried))
        stems[key] = tried
    return stems


def hashed_stem(name: str) -> str:
    """Return a stem that depends on `name` alone and differs from those of other names.

    It is the name itself if that is a valid stem in lower case, else the stem with a hash of the name.
    """
    stem = file_stem(name)
    is_plain = stem == name == _folded(name)
    return name if is_plain else f"{stem}-{zlib.crc32(name.encode('utf-8', 'replace')):08x}"


def _folded(stem: str) -> str:
    """Return what file systems that ignore case and normalization compare."""
    return unicodedata.normalize("NFKD", stem).casefold()
