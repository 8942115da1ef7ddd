"""COLMAP's database of features and matches: what it holds so far, read while another process writes it."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path, PurePath

import numpy as np

from ..shared.errors import InputError
from ..shared.formats.atomic import write_atomic

NAME, ON_OBJECTS = "database.db", "objects.db"
"""Databases in sfm/ with features everywhere, and on objects alone."""
POSITIONS = "positions"
"""Table with a row for each pair of photos, in the files of `learned.positions`."""
FEWEST_INLIERS = 15
"""Number of matches in agreement from which on COLMAP takes two photos to show the same."""

_IN_LISTS = {" ": "\ue020", "#": "\ue023"}
"""Characters for private use that names in COLMAP's lists of pairs have for spaces, and for what begins a comment."""
_UNDEFINED = -1
"""COLMAP's type of descriptors that it does not know."""
_MOST_IMAGES = 2**31 - 1
"""COLMAP's pair ID is this times the smaller image ID, plus the larger one."""


def _uri(path: PurePath) -> str:
    """Return the URI of an absolute path; SQLite refuses the usual form for shared folders of other computers."""
    uri = path.as_uri()
    return uri if uri.startswith("file:///") else uri.replace("file://", "file:////", 1)


@contextmanager
def _reading(path: Path) -> Iterator[sqlite3.Connection]:
    try:
        with closing(sqlite3.connect(f"{_uri(path.resolve())}?mode=ro", uri=True, timeout=30.0)) as connection:
            yield connection
    except sqlite3.Error as error:
        raise InputError(f"{path} cannot be read ({error}); delete it and run the same command again.") from error


def name_of(on_objects: bool, network: str = "") -> str:
    """Return the name of a database: of features on objects alone, or everywhere; of a network's by its fingerprint."""
    name = ON_OBJECTS if on_objects else NAME
    return f"learned-{network}-{name}" if network else name


def remove_all(work: Path) -> None:
    """Remove all databases of a capture's folder sfm/, since what they hold is of other photos or cameras."""
    for path in work.glob("*.db*"):
        path.unlink(missing_ok=True)


def remove_on_objects(work: Path) -> None:
    """Remove the databases of features on objects, since the masks are others."""
    for path in work.glob(f"*{ON_OBJECTS}*"):
        path.unlink(missing_ok=True)


def write_pairs(path: Path, pairs: Iterable[tuple[str, str]]) -> None:
    """Write pairs of names as one of COLMAP's lists; the database needs `listed_names` for it."""
    table = str.maketrans(_IN_LISTS)
    lines = (" ".join(name.translate(table) for name in pair) + "\n" for pair in pairs)
    write_atomic(path, "".join(lines).encode())


def read_pairs(path: Path) -> list[tuple[str, str]]:
    """Read a list that `write_pairs` has written."""
    table = str.maketrans({new: old for old, new in _IN_LISTS.items()})
    lines = path.read_text(encoding="utf-8").split("\n")[:-1]
    split = (line.split(" ") for line in lines)
    return [(first.translate(table), second.translate(table)) for first, second in split]


@contextmanager
def listed_names(path: Path) -> Iterator[None]:
    """Give the photos in the database the names that are in lists; call `restore_names` first if this was killed."""
    _rename(path, _IN_LISTS)
    try:
        yield
    finally:
        restore_names(path)


def restore_names(path: Path) -> None:
    """Give the photos in the database their own names, if it exists."""
    if path.exists():
        _rename(path, {new: old for old, new in _IN_LISTS.items()})


def _rename(path: Path, instead: Mapping[str, str]) -> None:
    with closing(sqlite3.connect(path, timeout=30.0)) as database, database:
        for old, new in instead.items():
            database.execute("UPDATE images SET name = replace(name, ?, ?) WHERE instr(name, ?)", (old, new, old))


def count_features(path: Path) -> int:
    """Return the number of photos whose features are known; 0 if the database does not exist yet."""
    return _count(path, "SELECT COUNT(*) FROM descriptors")


def count_pairs(path: Path) -> int:
    """Return the number of pairs of photos that were matched and verified; 0 if the database does not exist yet."""
    return _count(path, "SELECT COUNT(*) FROM two_view_geometries")


def count_positions(path: Path) -> int:
    """Return the number of pairs of photos in a file of matched places; 0 if it does not exist yet."""
    return _count(path, f"SELECT COUNT(*) FROM {POSITIONS}")


def _count(path: Path, query: str) -> int:
    if not path.exists():
        return 0
    try:
        with _reading(path) as database:
            return int(database.execute(query).fetchone()[0])
    except InputError:
        return 0  # The tables are being made.


def image_ids(path: Path) -> dict[str, int]:
    """Map the names of the photos in the database to their IDs."""
    with _reading(path) as database:
        return {name: int(number) for number, name in database.execute("SELECT image_id, name FROM images")}


def camera_of(path: Path, names: Iterable[str]) -> int:
    """Return the ID of the camera of the first of some photos that is in the database, or -1.

    After a stop, COLMAP would give the photos of a group that are left a camera of their own.
    """
    with _reading(path) as database:
        cameras = dict(database.execute("SELECT name, camera_id FROM images"))
    return next((int(cameras[name]) for name in names if name in cameras), -1)


def feature_counts(path: Path) -> dict[int, int]:
    """Map the IDs of photos to their numbers of features."""
    with _reading(path) as database:
        return {int(number): int(rows) for number, rows in database.execute("SELECT image_id, rows FROM keypoints")}


def largest_features(path: Path, image_id: int, most: int) -> np.ndarray:
    """Return the descriptors (n, d) of the photo's features with the largest scales, n <= `most`.

    Large features are seen from afar and nearby, so a few of them tell whether two photos show the same. Features of
    networks have no scale; those that were written first are returned, which are the most certain. Descriptors are
    uint8, or float32 if their type is UNDEFINED.
    """
    with _reading(path) as database:
        points = database.execute("SELECT rows, cols, data FROM keypoints WHERE image_id = ?", (image_id,)).fetchone()
        found = database.execute(
            "SELECT rows, cols, data, type FROM descriptors WHERE image_id = ?", (image_id,)
        ).fetchone()
    if not points or not found or not found[0]:
        return np.zeros((0, 128), np.uint8)
    shapes = np.frombuffer(points[2], np.float32).reshape(points[0], points[1])
    # An affine shape (a11, a12, a21, a22), or scale and orientation.
    if points[1] >= 6:
        size = np.abs(shapes[:, 2] * shapes[:, 5] - shapes[:, 3] * shapes[:, 4])
    else:
        size = shapes[:, 2] if points[1] > 2 else np.zeros(len(shapes))
    kind = np.float32 if found[3] == _UNDEFINED else np.uint8
    rows = np.frombuffer(found[2], kind).reshape(found[0], -1)
    return rows[np.argsort(-size, kind="stable")[:most]]


def verified_pairs(path: Path, names: Iterable[str]) -> list[tuple[int, int, int, int]]:
    """Return (first image ID, second image ID, COLMAP's configuration, number of inliers) of the verified pairs.

    Args:
        path: the database, which also keeps photos that are not used any more.
        names: the photos whose pairs are wanted.
    """
    ids = image_ids(path)
    wanted = {ids[name] for name in names if name in ids}
    with _reading(path) as database:
        rows = database.execute(
            "SELECT pair_id, config, rows FROM two_view_geometries WHERE rows >= ?", (FEWEST_INLIERS,)
        ).fetchall()
    pairs = [(*divmod(int(pair), _MOST_IMAGES), int(config), int(count)) for pair, config, count in rows]
    return [pair for pair in pairs if wanted.issuperset(pair[:2])]
