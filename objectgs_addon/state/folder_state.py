# SPDX-License-Identifier: GPL-3.0-or-later
"""How far a reconstruction folder is, read from its files alone (no torch, no backend)."""

from dataclasses import dataclass
from pathlib import Path

from ...backend.shared.errors import InputError
from ...backend.shared.reconstruction.cameras import read_cameras
from ...backend.shared.reconstruction.checkpoint import CURRENT, CheckpointHeader, read_header
from ...backend.shared.reconstruction.folder import Reconstruction
from ...backend.shared.reconstruction.meshes import NAME as MESHES
from ...backend.shared.reconstruction.meshes import read_meshes


@dataclass(frozen=True)
class FolderState:
    """exists: the folder is there; imported: cameras and points are; voted: objects are; steps, seconds: of the
    checkpoint's training (0: none); trained: splats are there; capture: where the photos are, or None; pixels: of a
    view, on average; meshes: how many there are; stale_meshes: those of another state of the training."""

    exists: bool
    imported: bool
    voted: bool
    steps: int
    seconds: float
    trained: bool
    capture: Path | None
    pixels: float
    meshes: int
    stale_meshes: int


_known: dict[Path, tuple[tuple, FolderState]] = {}


def folder_state(folder: Path) -> FolderState:
    """What is in `folder`; cheap enough to be asked while a panel is drawn."""
    paths = Reconstruction(folder)
    checkpoint = paths.checkpoint / CURRENT
    listed = paths.meshes / MESHES
    stamp = tuple(
        _modified(path) for path in (paths.folder, paths.cameras, paths.objects, paths.splats, checkpoint, listed)
    )
    before = _known.get(paths.folder)
    if before is not None and before[0] == stamp:
        return before[1]
    header = read_header(paths.checkpoint) or CheckpointHeader(0, 0.0)
    made = _mesh_steps(paths.meshes)
    capture, pixels = _views(paths.folder)
    state = FolderState(
        exists=stamp[0] is not None,
        imported=stamp[1] is not None and paths.points.exists(),
        voted=stamp[2] is not None,
        steps=header.steps,
        seconds=header.seconds,
        trained=stamp[3] is not None,
        capture=capture,
        pixels=pixels,
        meshes=len(made),
        stale_meshes=sum(at != header.steps for at in made),
    )
    _known[paths.folder] = (stamp, state)
    return state


def _modified(path: Path) -> int | None:
    try:
        return path.stat().st_mtime_ns
    except OSError:
        return None


def _views(folder: Path) -> tuple[Path | None, float]:
    """The capture's folder, and how many pixels its views have on average."""
    try:
        cameras = read_cameras(folder)
    except InputError:
        return None, 0.0
    sizes = [view.width * view.height for view in cameras.views]
    return cameras.capture, sum(sizes) / max(len(sizes), 1)


def _mesh_steps(folder: Path) -> list[int | None]:
    """The steps of the training that each mesh was made at."""
    try:
        return [entry.trained_steps for entry in read_meshes(folder).values() if entry.file]
    except InputError:
        return []
