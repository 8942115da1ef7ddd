"""Point clouds beside the cameras of other programs: PLY or OBJ files with or without colors."""

from __future__ import annotations

import os
from pathlib import Path, PureWindowsPath

import numpy as np

from ...shared.errors import InputError
from ...shared.formats.ply import read_chosen_vertices
from ...shared.formats.regular_file import read_regular
from ..colmap import Model, RawPoints, export_again

USUAL_NAMES = ("points3D.ply", "sparse_pc.ply")
SUFFIXES = (".ply", ".obj")

_MOST_POINTS = 2_000_000
"""Dense clouds are thinned out to this number of points, which is more than a training starts from."""
_CHECKED = 2000
_MARGIN = 1.2
"""Factor by which views are widened, as distorted images show more than their focal length says."""
_COLORS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
_GRAY = 128


def find_point_cloud(file: Path, named: str | None, program: str, export: str) -> Path:
    """Find the point cloud that belongs to a file with cameras.

    Args:
        file: The file with the cameras.
        named: A path relative to the file, if the file names its point cloud.
        program: The program that wrote the file, for messages.
        export: What to export if there is none, for messages.

    Returns:
        The named file, points3D.ply, sparse_pc.ply, or the only PLY or OBJ file beside the cameras.

    Raises:
        InputError: There is none, or several that may be meant.
    """
    folder = file.parent
    if named is not None:
        parts = PureWindowsPath(named)
        path = folder.joinpath(*parts.parts) if not parts.anchor else Path(named)
        if parts.anchor or ".." in parts.parts or "\0" in named:
            raise InputError(
                f"{file} names the point cloud {' '.join(named.split())[:200]}, which lies outside {folder}; put it "
                "there and correct its path."
            )
        if os.path.exists(path):  # noqa: PTH110 - Path.exists raises for names that are too long
            return path
    for name in USUAL_NAMES:
        if (folder / name).exists():
            return folder / name
    try:
        found = sorted(
            path
            for path in folder.iterdir()
            if path.suffix.lower() in SUFFIXES and not path.name.startswith(".") and path.is_file()
        )
    except OSError as error:
        raise InputError(f"{folder} cannot be read ({error.strerror}); check it.") from error
    if len(found) > 1:
        raise InputError(
            f"{folder} contains the point clouds {found[0].name} and {found[1].name}; name the one that belongs to "
            f"{file.name} {USUAL_NAMES[0]}."
        )
    if not found:
        raise InputError(
            f"{file} has no points: export {export} from {program} as PLY, in the coordinates of the cameras, to "
            f"{folder / USUAL_NAMES[0]}."
        )
    return found[0]


def read_point_cloud(path: Path, warnings: list[str]) -> RawPoints:
    """Read the points of a PLY or OBJ file.

    Args:
        path: The file. Colors are 8- or 16-bit integers, or floats up to 1; without colors, points are gray.
        warnings: Receives a warning if points of a dense cloud are left out.

    Returns:
        The points, numbered from 0; reprojection errors are unknown.

    Raises:
        InputError: The file is damaged or has no coordinates.
    """
    count, xyz, rgb = _read_obj(path) if path.suffix.lower() == ".obj" else _read_ply(path)
    if len(xyz) < count:
        warnings.append(f"{path} has {count:,} points, of which {len(xyz):,} are used.")
    return RawPoints(np.arange(len(xyz)), xyz, rgb, np.full(len(xyz), -1.0))


def _used(count: int) -> np.ndarray:
    """Return which of the points of a file are used, evenly distributed over it."""
    return np.linspace(0, count - 1, min(count, _MOST_POINTS)).astype(np.int64)


def _read_ply(path: Path) -> tuple[int, np.ndarray, np.ndarray]:
    """Return the number of points in the file, and positions and colors of those that are used."""
    count, table = read_chosen_vertices(path, _used)
    names = table.dtype.names or ()
    if not {"x", "y", "z"} <= set(names):
        raise InputError(f"{path} has no coordinates x, y and z; {export_again('the program that wrote it')}.")
    xyz = np.stack([table[axis].astype(np.float64) for axis in "xyz"], 1)
    channels = next((group for group in _COLORS if set(group) <= set(names)), None)
    if channels is None:
        return count, xyz, np.full((len(xyz), 3), _GRAY, np.uint8)
    return count, xyz, _as_bytes(np.stack([table[channel] for channel in channels], 1))


def _read_obj(path: Path) -> tuple[int, np.ndarray, np.ndarray]:
    """Return the same as `_read_ply`, of the vertices of a mesh."""
    try:
        lines = [line[2:] for line in read_regular(path).split(b"\n") if line.startswith((b"v ", b"v\t"))]
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}); check the file.") from error
    rows = [lines[number].split() for number in _used(len(lines)).tolist()]
    columns = {len(row) for row in rows}
    try:
        if len(columns) > 1 or columns - {3, 4, 6, 7}:
            raise ValueError
        values = np.array(rows, np.float64).reshape(len(rows), -1) if rows else np.zeros((0, 3))
    except ValueError as error:
        raise InputError(
            f"{path} has a vertex that is not three coordinates with or without a color; save it as PLY."
        ) from error
    if values.shape[1] < 6:
        return len(lines), values[:, :3], np.full((len(values), 3), _GRAY, np.uint8)
    return len(lines), values[:, :3], _as_bytes(values[:, -3:])


def _as_bytes(colors: np.ndarray) -> np.ndarray:
    """Return colors (n, 3) of any type as uint8."""
    if colors.dtype == np.uint8:
        return colors
    if colors.dtype.kind in "iu" and colors.dtype.itemsize > 1:
        return np.clip(colors >> 8 if colors.size and colors.max() > 255 else colors, 0, 255).astype(np.uint8)
    colors = np.nan_to_num(colors.astype(np.float64))
    scale = 255.0 if colors.size and colors.max() <= 1.0 else 1.0
    return np.clip(np.rint(colors * scale), 0, 255).astype(np.uint8)


def seen_in(model: Model) -> tuple[float, float]:
    """Return the fraction of a model's points inside at least one view, and their mean number of views.

    A sample of the points is projected without distortion into views that are widened a little.
    """
    xyz = model.xyz[:: max(1, len(model.xyz) // _CHECKED)]
    views = np.zeros(len(xyz))
    for image in model.images:
        camera = model.cameras[image.camera_id]
        x, y, z = (xyz @ image.viewmat[:3, :3].T + image.viewmat[:3, 3]).T
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            u, v = x / z * camera.params[0], y / z * camera.params[0]
            near = (np.abs(u) <= _MARGIN * camera.width / 2) & (np.abs(v) <= _MARGIN * camera.height / 2)
        views += (z > 0) & near
    return float((views > 0).mean()), float(views.mean())
