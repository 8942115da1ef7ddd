"""Reader of Bundler files (version 0.3), which Bundler, COLMAP, RealityScan, Metashape and others write.

Cameras look along -z with y up, pixels are measured from the image's center with y up, and the photos are in a list of
their own, one a line, in the cameras' order.
"""

from __future__ import annotations

import re
from array import array
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from ...shared.errors import InputError
from ...shared.formats.regular_file import read_regular
from ..colmap import Model, RawPoints
from .draft import FLIP, Draft
from .lens import Lens, radial

_SIGNATURE = b"# Bundle file v"
_VERSION = b"0.3"
_LINES_OF_CAMERA, _LINES_OF_POINT = 5, 3


def recognizes(head: bytes) -> bool:
    """Return whether a file that starts with these bytes is a Bundler file of any version."""
    return head.lstrip(b"\xef\xbb\xbf").startswith(_SIGNATURE)


def read(file: Path) -> Model:
    """Read a Bundler file and its list of photos.

    Args:
        file: The file. Its list is NAME.list.txt, NAME.txt, list.txt, or the only other file whose name has "list".

    Returns:
        The model with the file's points and their observations; without points, those of a point cloud beside it.

    Raises:
        InputError: A file is missing or damaged; the message names it.
    """
    draft = Draft(file)
    try:
        lines = _Lines(read_regular(file), draft)
    except OSError as error:
        raise InputError(f"{file} cannot be read ({error.strerror}); check the file.") from error
    version = lines.next("the version").removeprefix(b"\xef\xbb\xbf")[len(_SIGNATURE) :].strip()
    if version != _VERSION:
        raise draft.refusal(f"has the version {version[:20].decode('ascii', 'replace')}, expected 0.3")
    cameras, points = lines.counts()
    names = _read_list(draft)
    if len(names[1]) != cameras:
        raise InputError(
            f"{names[0]} names {len(names[1])} photos, but {file} has {cameras} cameras; export both again together."
        )
    poses = [lines.numbers(_LINES_OF_CAMERA, (3, 3, 3, 3, 3), "5 lines of a camera") for _ in range(cameras)]
    # One NumPy array for each line would take most of the time.
    xyz, rgb, views = array("d"), array("d"), _Views(cameras)
    for _ in range(points):
        xyz.extend(lines.row(3, "the position of a point"))
        rgb.extend(lines.row(3, "the color of a point"))
        views.add(lines.row(None, "the views of a point"), lines)
    unposed = 0
    for number, (name, row) in enumerate(zip(names[1], poses, strict=True)):
        if not row[0] and not row[3:12].any():
            unposed += 1
            continue
        world_to_camera = np.eye(4)
        world_to_camera[:3, :3], world_to_camera[:3, 3] = row[3:12].reshape(3, 3), row[12:]
        draft.add(
            name,
            partial(_lens, row[:3]),
            _inverse(FLIP @ world_to_camera),
            observed=partial(views.of, number) if points else None,
        )
    if unposed:
        draft.warnings.append(f"{unposed} of {cameras} photos in {names[0]} have no pose in {file} and are left out.")
    if points:
        colors = np.clip(np.nan_to_num(np.array(rgb)), 0, 255).astype(np.uint8)
        of_points = np.array(xyz).reshape(-1, 3), colors.reshape(-1, 3)
        return draft.finish(RawPoints(np.arange(points), *of_points, np.full(points, -1.0)))
    return draft.finish_with_point_cloud()


def _lens(row: np.ndarray, width: int, height: int) -> Lens:
    return radial(float(row[0]), width / 2, height / 2, float(row[1]), float(row[2]))


def _inverse(world_to_camera: np.ndarray) -> np.ndarray:
    """Return the camera-to-world matrix; NaN, which is refused later, if there is none."""
    try:
        return np.linalg.inv(world_to_camera)
    except np.linalg.LinAlgError:
        return np.full((4, 4), np.nan)


class _Lines:
    """The lines of a Bundler file that are not empty, one after the other."""

    def __init__(self, data: bytes, draft: Draft) -> None:
        self._lines: Iterator[tuple[int, bytes]] = (
            (number, line) for number, line in enumerate(data.split(b"\n"), 1) if line.strip()
        )
        self._size, self._draft, self._number = data.count(b"\n") + 1, draft, 0

    def malformed(self, expected: str) -> InputError:
        """Return the error for the line read last."""
        return self._draft.refusal(f"is malformed or truncated at line {self._number}: expected {expected}")

    def next(self, expected: str) -> bytes:
        """Return the next line."""
        self._number, line = next(self._lines, (self._number + 1, b""))
        if not line:
            raise self.malformed(expected)
        return line.strip()

    def row(self, count: int | None, expected: str) -> list[float]:
        """Return the `count` numbers of the next line; any number of them for None."""
        try:
            values = list(map(float, self.next(expected).split()))
        except ValueError as error:
            raise self.malformed(expected) from error
        if count is not None and len(values) != count:
            raise self.malformed(expected)
        return values

    def numbers(self, lines: int, counts: tuple[int, ...], expected: str) -> np.ndarray:
        """Return the numbers of several lines as one array."""
        return np.concatenate([self.row(counts[line], expected) for line in range(lines)])

    def counts(self) -> tuple[int, int]:
        """Return the numbers of cameras and points, which the file must be long enough for."""
        expected = "the numbers of cameras and points"
        row = np.array(self.row(2, expected))
        if not ((row >= 0) & (row == np.floor(row)) & np.isfinite(row)).all():
            raise self.malformed(expected)
        if row @ [_LINES_OF_CAMERA, _LINES_OF_POINT] > self._size:
            raise self._draft.refusal(f"is truncated: it declares {row[0]:.0f} cameras and {row[1]:.0f} points")
        return int(row[0]), int(row[1])


class _Views:
    """The observations of the points, by camera."""

    def __init__(self, cameras: int) -> None:
        self._cameras = cameras
        self._rows = array("d")
        self._counts: list[int] = []
        self._sorted: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None

    def add(self, row: list[float], lines: _Lines) -> None:
        """Add the next point's list of views: their number, then camera, key, x and y for each."""
        if not row or len(row) != 1 + 4 * row[0]:
            raise lines.malformed("the number of views of a point, and 4 numbers for each")
        if not all(0 <= camera < self._cameras for camera in row[1::4]):
            raise lines.malformed(f"views with cameras from 0 to {self._cameras - 1}")
        self._rows.extend(row[1:])
        self._counts.append(len(row) // 4)

    def of(self, camera: int, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the pixels (n, 2) and points (n,) that a camera observed."""
        if self._sorted is None:
            rows = np.array(self._rows).reshape(-1, 4)
            points = np.repeat(np.arange(len(self._counts)), self._counts)
            cameras = rows[:, 0].astype(np.int64)
            order = np.argsort(cameras, kind="stable")
            starts = np.searchsorted(cameras[order], np.arange(self._cameras + 1))
            self._sorted = rows[order, 2:], points[order], starts
        xy, points, starts = self._sorted
        mine = slice(starts[camera], starts[camera + 1])
        return xy[mine] * [1.0, -1.0] + [width / 2, height / 2], points[mine]


def _read_list(draft: Draft) -> tuple[Path, list[str]]:
    """Return the file that lists the photos, and the photos in their order."""
    file = draft.file
    stems = {file.stem, file.name, re.sub(r"[._-]?bundle.*", "", file.stem, flags=re.IGNORECASE)} - {""}
    usual = [f"{stem}{end}" for stem in sorted(stems) for end in (".list.txt", "_list.txt", "-list.txt", ".txt")]
    path = next((file.with_name(name) for name in (*usual, "list.txt") if file.with_name(name).exists()), None)
    if path is None:
        others = [other for other in sorted(file.parent.glob("*.txt")) if "list" in other.name.lower()]
        if len(others) != 1:
            raise InputError(
                f"{file} has no list of its photos: export it, too, as {file.with_name('list.txt')}, with the path of "
                "one photo a line."
            )
        path = others[0]
    try:
        text = read_regular(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not text in UTF-8; save it as UTF-8.") from error
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}); check the file.") from error
    # A photo may be followed by 0 and its focal length.
    names = [re.sub(r"\s+0\s+[-+.\deE]+$", "", line.strip()) for line in text.splitlines()]
    return path, [name for name in names if name]
