"""The true surfaces of a synthetic capture, and the parts of them that are visible in its views.

truth/objects.json           {"objects": [{"id": 1, "mesh": "meshes/1_mug.ply"}, ...]}
truth/meshes/*.ply           triangles in the capture's frame, with outward faces
truth/depth/<image>.npy      (H, W) float32, along the camera axis
truth/masks/<image>.png      (H, W) object IDs
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from ..capture import Capture
from ..mesh.texture.zbuffer import draw_mesh
from ..raster import Camera
from ..shared.errors import InputError
from ..shared.formats.json_file import read_json
from ..shared.formats.ply import LONGEST_HEADER, read_vertices
from ..shared.formats.regular_file import read_regular, require_regular

VIEWS_TO_COUNT = 2
"""Number of views in which a point of the surface must be visible to count as seen."""
_PIXELS_DEEP = 1.5
"""Largest difference of a point's depth from the depth map, in widths of a pixel at this depth; allows for slanted
surfaces."""
_BYTES_HELD = 400_000_000
_FACES = "property list uchar int vertex_indices"


@dataclass
class TrueMesh:
    """A true surface: vertices (V, 3) float64 in the capture's world, faces (F, 3) int32."""

    vertices: np.ndarray
    faces: np.ndarray


@dataclass
class _View:
    viewmat: np.ndarray
    intrinsics: np.ndarray
    depth: np.ndarray
    ids: np.ndarray


class Truth:
    """True surfaces by object ID, and the parts of them that are visible in the views `indices` of `capture`."""

    def __init__(self, meshes: dict[int, TrueMesh], capture: Capture, indices: Sequence[int]) -> None:
        self.meshes = meshes
        self._capture = capture
        self._indices = indices
        self._held: dict[int, _View] = {}
        self._bytes = 0

    def of(self, ids: Collection[int]) -> TrueMesh | None:
        """Return the joined surface of the objects `ids`; None if the truth lacks one of them."""
        if not ids or not all(i in self.meshes for i in ids):
            return None
        parts = [self.meshes[i] for i in ids]
        first = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
        faces = [part.faces + start for part, start in zip(parts, first)]
        return TrueMesh(np.concatenate([part.vertices for part in parts]), np.concatenate(faces))

    def seen(self, points: np.ndarray, normals: np.ndarray, ids: Collection[int]) -> np.ndarray:
        """Find the points of the objects `ids` that are visible in at least `VIEWS_TO_COUNT` views.

        A point is visible in a view if its normal faces the camera and the point's pixel shows one of `ids` at the
        point's depth.

        Args:
            points: (n, 3) in the capture's world.
            normals: (n, 3), outward.
            ids: Object IDs.

        Returns:
            (n,) bool.
        """
        views = map(self._view, self._indices)
        return _seen(points, normals, ((view, np.where(np.isin(view.ids, list(ids)), view.depth, 0)) for view in views))

    def seen_alone(
        self, points: np.ndarray, normals: np.ndarray, vertices: np.ndarray, faces: np.ndarray
    ) -> np.ndarray:
        """Find the visible points of another surface, rendered without the rest of the scene; otherwise as `seen`.

        vertices (V, 3) and faces (F, 3) are the surface.
        """

        def drawn(view: _View) -> np.ndarray:
            fx, fy, cx, cy = view.intrinsics
            height, width = view.depth.shape
            K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float64)
            return draw_mesh(vertices, faces, Camera(view.viewmat, K, width, height))[0]

        return _seen(points, normals, ((view, drawn(view)) for view in map(self._view, self._indices)))

    def _view(self, index: int) -> _View:
        if index in self._held:
            return self._held[index]
        view = _read_view(self._capture, index)
        self._bytes += view.depth.nbytes + view.ids.nbytes
        if self._bytes <= _BYTES_HELD:
            self._held[index] = view
        return view


def _seen(points: np.ndarray, normals: np.ndarray, looks: Iterable[tuple[_View, np.ndarray]]) -> np.ndarray:
    """Find the points visible in at least `VIEWS_TO_COUNT` views; each view has a depth map (H, W), 0 where empty."""
    views = np.zeros(len(points), np.int32)
    for view, depth in looks:
        fx, fy, cx, cy = view.intrinsics
        turn = view.viewmat[:3, :3]
        seen_from = points @ turn.T + view.viewmat[:3, 3]
        height, width = depth.shape
        at = np.flatnonzero(((points + view.viewmat[:3, 3] @ turn) * normals).sum(1) < 0)
        at = at[seen_from[at, 2] > 0]
        x, y, z = seen_from[at].T
        column, row = np.floor(fx * x / z + cx), np.floor(fy * y / z + cy)
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        at, z, column, row = at[inside], z[inside], column[inside].astype(int), row[inside].astype(int)
        deep = depth[row, column]
        views[at[(deep > 0) & (np.abs(deep - z) <= _PIXELS_DEEP * z / fx)]] += 1
    return views >= VIEWS_TO_COUNT


def load_truth(capture: Capture, indices: Sequence[int]) -> Truth | None:
    """Read the true surfaces of a synthetic capture.

    Args:
        capture: The capture.
        indices: The views that determine which parts of the surfaces count as seen.

    Returns:
        The truth, or None if the capture has none.

    Raises:
        InputError: A file of the truth cannot be read.
    """
    listed = capture.folder / "truth" / "objects.json"
    if not listed.exists():
        return None
    content = read_json(listed)
    try:
        files = {int(entry["id"]): capture.folder / "truth" / entry["mesh"] for entry in content["objects"]}
    except (AttributeError, KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{listed} is not a valid list of meshes ({error!r}); make the capture again.") from error
    return Truth({i: _read_mesh(path) for i, path in files.items()}, capture, indices)


def _read_mesh(path: Path) -> TrueMesh:
    table = read_vertices(path)
    vertices = np.stack([table[name] for name in "xyz"], 1).astype(np.float64)
    data = read_regular(path)
    end = data.find(b"end_header\n", 0, LONGEST_HEADER) + len(b"end_header\n")
    lines = data[:end].decode("ascii", "replace").splitlines()
    counts = [int(line.split()[2]) for line in lines if line.startswith("element face ")]
    row = np.dtype([("corners", "u1"), ("vertices", "<i4", 3)])
    start = end + table.nbytes
    if len(counts) != 1 or _FACES not in lines or len(data) != start + counts[0] * row.itemsize:
        raise InputError(f"{path} is not a triangle mesh as the demo writes it; make the capture again.")
    faces = np.frombuffer(data[start:], row)["vertices"]
    if len(faces) and not 0 <= faces.min() <= faces.max() < len(vertices):
        raise InputError(f"{path} has faces with vertices that it does not contain; make the capture again.")
    return TrueMesh(vertices, faces.astype(np.int32))


def _read_view(capture: Capture, index: int) -> _View:
    view = capture.views[index]
    name = Path(view.name)
    depth_file = capture.folder / "truth" / "depth" / name.with_suffix(".npy")
    ids_file = capture.folder / "truth" / "masks" / name.with_suffix(".png")
    try:
        depth = np.load(require_regular(depth_file))
        with Image.open(require_regular(ids_file)) as image:
            ids = np.asarray(image)
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError(f"{depth_file} or {ids_file} cannot be read ({error}); make the capture again.") from error
    if depth.ndim != 2 or ids.shape != depth.shape:
        raise InputError(f"{depth_file} and {ids_file} differ in size; make the capture again.")
    # The truth has the size of the images on disk; the capture's views may be smaller.
    across, down = depth.shape[1] / view.width, depth.shape[0] / view.height
    K = view.K
    intrinsics = np.array([K[0, 0] * across, K[1, 1] * down, K[0, 2] * across, K[1, 2] * down])
    return _View(view.viewmat, intrinsics, depth, ids)
