# SPDX-License-Identifier: GPL-3.0-or-later
"""Progress of a reconstruction folder, read from its files."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from ...backend.shared.errors import InputError
from ...backend.shared.reconstruction.cameras import read_cameras
from ...backend.shared.reconstruction.checkpoint import CURRENT, CheckpointHeader, read_header
from ...backend.shared.reconstruction.folder import Reconstruction
from ...backend.shared.reconstruction.meshes import NAME as MESHES
from ...backend.shared.reconstruction.meshes import MeshEntry, read_meshes, read_waiting
from ...backend.shared.reconstruction.objects import read_objects, shown_as
from ...backend.shared.reconstruction.record import Record, read_record


@dataclass(frozen=True)
class FolderState:
    """Contents of a reconstruction folder.

    Attributes:
        exists: the folder exists.
        imported: cameras and points exist.
        voted: objects.json exists.
        steps: training steps of the checkpoint; 0 without one.
        seconds: training time of the checkpoint; 0 without one.
        trained: splats exist.
        capture: folder of the capture with the photos, or None.
        pixels: average number of pixels per view.
        unfinished: the training was stopped before its end.
        outdated: the training is that of another capture than the present one, for example of other poses.
        agreement: how well the photos agree, in dB, or None.
        meshes: number of meshes.
        stale_meshes: number of meshes of shown objects made at another training step than the checkpoint's.
        stale_scene: the mesh of the whole scene was made at another training step.
        waiting_meshes: number of meshes that a job is to make, or was when it was interrupted.
        quality, zero_is_background: of the checkpoint's header.
    """

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
    unfinished: bool = False
    outdated: bool = False
    agreement: float | None = None
    waiting_meshes: int = 0
    stale_scene: bool = False
    quality: Mapping[str, float] = field(default_factory=dict)
    zero_is_background: bool = False


UNKNOWN = FolderState(
    exists=False,
    imported=False,
    voted=False,
    steps=0,
    seconds=0.0,
    trained=False,
    capture=None,
    pixels=0.0,
    meshes=0,
    stale_meshes=0,
)
"""What is known of a folder that is not read."""

_known: dict[Path, tuple[tuple, FolderState]] = {}


def reconstruction_for(capture: Path, new: Callable[[str, Callable[[Path], bool]], Path]) -> Path:
    """Return a reconstruction folder named after a capture, or after its parent if the capture has a generic name.

    Args:
        capture: the capture's folder.
        new: returns a folder of a name, with a number if it is needed for a condition; `locations.new_reconstruction`.

    Returns:
        The folder, which does not belong to another capture or to something else.
    """
    name = capture.name if capture.name.lower() not in ("capture", "colmap", "data") else capture.parent.name

    def is_free(folder: Path) -> bool:
        return folder_state(folder).capture in (None, capture) and Reconstruction(folder).foreign_file() is None

    return new(name, is_free)


def folder_state(folder: Path) -> FolderState:
    """Return the state of `folder`; the result is cached, so panels can call this while drawing."""
    paths = Reconstruction(folder)
    checkpoint = paths.checkpoint / CURRENT
    listed = paths.meshes / MESHES
    stamp = tuple(
        _modified(path)
        for path in (paths.folder, paths.cameras, paths.objects, paths.splats, checkpoint, listed, paths.settings)
    )
    before = _known.get(paths.folder)
    if before is not None and before[0] == stamp:
        return before[1]
    header = read_header(paths.checkpoint) or CheckpointHeader(0, 0.0)
    made = _meshes(paths.meshes)
    stale = [entry for entry in made if entry.trained_steps != header.steps]
    capture, pixels = _views(paths.folder)
    record = _record(paths)
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
        stale_meshes=len({entry.object_id for entry in stale} & _meshed_objects(paths.objects)),
        unfinished=header.steps > 0 and _is_unfinished(record, header),
        outdated=header.steps > 0 and _is_outdated(record),
        agreement=None if record.capture is None else record.capture.agreement,
        waiting_meshes=len(read_waiting(paths.meshes)),
        stale_scene=any(entry.ids is None for entry in stale),
        quality=header.quality,
        zero_is_background=header.zero_is_background,
    )
    _known[paths.folder] = (stamp, state)
    return state


def _modified(path: Path) -> int | None:
    try:
        return path.stat().st_mtime_ns
    except OSError:
        return None


def _views(folder: Path) -> tuple[Path | None, float]:
    """Return the capture's folder and the average number of pixels per view."""
    try:
        cameras = read_cameras(folder)
    except InputError:
        return None, 0.0
    sizes = [view.width * view.height for view in cameras.views]
    return cameras.capture, sum(sizes) / max(len(sizes), 1)


def _record(paths: Reconstruction) -> Record:
    """Return what is recorded of the folder; nothing if that is invalid."""
    try:
        return read_record(paths)
    except InputError:
        return Record()


def _is_unfinished(record: Record, header: CheckpointHeader) -> bool:
    """Return whether the training was to be longer; one until convergence may have ended at any time."""
    training = record.training
    if training is None or training.preset == "final":
        return False
    return header.steps < (training.steps or 0) or header.seconds < 60 * (training.minutes or 0)


def _is_outdated(record: Record) -> bool:
    """Return whether the capture has changed since the training; images of another size do not tell."""
    capture, training = record.capture, record.training
    if capture is None or training is None or capture.max_size != training.votes.max_size:
        return False
    return capture.digest != training.votes.capture


def _meshes(folder: Path) -> list[MeshEntry]:
    """Return the entries of the meshes that have a file."""
    try:
        return [entry for entry in read_meshes(folder).values() if entry.file]
    except InputError:
        return []


def _meshed_objects(path: Path) -> set[int | None]:
    """Return the IDs of the objects that get a mesh of their own; those that are merged or left out get none."""
    try:
        objects = [entry for entry in read_objects(path) if entry.id]
    except InputError:
        return set()
    separated = {entry.id for entry in objects if entry.separated}
    return {i for i, target in shown_as(objects).items() if target == i and i not in separated}
