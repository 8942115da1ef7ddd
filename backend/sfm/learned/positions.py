"""Places that pairs of photos show in common, in a file of SQLite that each matched pair is added to at once.

They are kept beside COLMAP's database, since features, which pairs share, follow from those of all pairs.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager
from functools import lru_cache
from pathlib import Path

import numpy as np

from ...capture.files import read_image
from ..database import POSITIONS
from .photos import scaled_gray

Match = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Returns what two gray images (h, w) uint8 show in common: (m, 5) float32, x and y in pixels in the first and in the
second, with the center of the first pixel at (0.5, 0.5), and the certainty."""

_COLUMNS = 5
_KEPT = 64
"""Number of photos that are kept in memory while pairs are matched."""


@contextmanager
def opened(path: Path) -> Iterator[sqlite3.Connection]:
    """Open a file of matched places, which is made if it does not exist."""
    with closing(sqlite3.connect(path, timeout=30.0)) as stored:
        stored.execute(
            f"CREATE TABLE IF NOT EXISTS {POSITIONS} (first TEXT, second TEXT, data BLOB, PRIMARY KEY (first, second))"
        )
        stored.execute(f"CREATE INDEX IF NOT EXISTS of_second ON {POSITIONS} (second)")
        yield stored


def match_photos(path: Path, images: Path, pairs: Iterable[tuple[str, str]], match: Match, multiple: int) -> None:
    """Match pairs of photos, one after another, unless they are in the file.

    Args:
        path: the file, as of `opened`.
        images: folder of the photos.
        pairs: names of the photos.
        match: matches two photos, scaled as by `scaled_gray`.
        multiple: number of pixels of which the sides of scaled photos are multiples.

    Raises:
        InputError: A photo cannot be read.
    """

    @lru_cache(_KEPT)
    def scaled(name: str) -> tuple[np.ndarray, np.ndarray]:
        photo = read_image(images / name)
        gray = scaled_gray(photo, multiple)
        return gray, np.divide(photo.size, gray.shape[::-1])

    with opened(path) as stored:
        for first, second in sorted((min(pair), max(pair)) for pair in pairs):
            if stored.execute(f"SELECT 1 FROM {POSITIONS} WHERE first = ? AND second = ?", (first, second)).fetchone():
                continue
            (one, to_first), (other, to_second) = scaled(first), scaled(second)
            found = match(one, other) * [*to_first, *to_second, 1.0]
            with stored:
                data = found.astype(np.float32).tobytes()
                stored.execute(f"INSERT INTO {POSITIONS} VALUES (?, ?, ?)", (first, second, data))


def listed(stored: sqlite3.Connection) -> list[tuple[str, str]]:
    """Return the names of the pairs in an opened file, each sorted."""
    return stored.execute(f"SELECT first, second FROM {POSITIONS} ORDER BY first, second").fetchall()


def of_pair(stored: sqlite3.Connection, first: str, second: str) -> np.ndarray:
    """Return what a listed pair shows in common, (m, 5) as of `Match`, but in pixels of the photos themselves."""
    query = f"SELECT data FROM {POSITIONS} WHERE first = ? AND second = ?"
    return _as_rows(stored.execute(query, (first, second)).fetchone()[0])


def of_photo(stored: sqlite3.Connection, name: str) -> np.ndarray:
    """Return the places in a photo that any pair shows in common: (n, 3), x, y in its pixels, and the certainty."""
    found = [np.zeros((0, 3), np.float32)]
    for column, query in ((0, "first"), (2, "second")):
        rows = stored.execute(f"SELECT data FROM {POSITIONS} WHERE {query} = ? ORDER BY first, second", (name,))
        found += [_as_rows(data)[:, [column, column + 1, 4]] for (data,) in rows]
    return np.concatenate(found)


def name_of(network: str) -> str:
    """Return the name of the file for a checkpoint with this fingerprint."""
    return f"learned-{network}-positions.db"


def _as_rows(data: bytes) -> np.ndarray:
    return np.frombuffer(data, np.float32).reshape(-1, _COLUMNS)
