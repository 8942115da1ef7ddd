# SPDX-License-Identifier: GPL-3.0-or-later
"""How far a reconstruction folder is, read from its files alone (no torch, no backend)."""

import json
import struct
from dataclasses import dataclass
from pathlib import Path

from ..backend.protocol import Reconstruction

LONGEST_HEADER = 1 << 26


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
    checkpoint = paths.checkpoint / "model.safetensors"
    listed = paths.meshes / "meshes.json"
    stamp = tuple(_modified(path) for path in (
        paths.folder, paths.cameras, paths.objects, paths.splats, checkpoint, listed))
    before = _known.get(paths.folder)
    if before is not None and before[0] == stamp:
        return before[1]
    steps, seconds = _progress(checkpoint)
    made = _mesh_steps(listed)
    capture, pixels = _views(paths.cameras)
    state = FolderState(
        exists=stamp[0] is not None, imported=stamp[1] is not None and paths.points.exists(),
        voted=stamp[2] is not None, steps=steps, seconds=seconds, trained=stamp[3] is not None,
        capture=capture, pixels=pixels, meshes=len(made), stale_meshes=sum(at != steps for at in made))
    _known[paths.folder] = (stamp, state)
    return state


def _modified(path: Path) -> int | None:
    try:
        return path.stat().st_mtime_ns
    except OSError:
        return None


def _views(cameras: Path) -> tuple[Path | None, float]:
    """The capture's folder, and how many pixels its views have on average."""
    try:
        content = json.loads(cameras.read_text(encoding="utf-8"))
        sizes = [entry["width"] * entry["height"] for entry in content.get("cameras", ())]
        return Path(content["capture"]), sum(sizes) / max(len(sizes), 1)
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None, 0.0


def _mesh_steps(listed: Path) -> list:
    """The steps of the training that each mesh was made at."""
    try:
        meshes = json.loads(listed.read_text(encoding="utf-8"))["meshes"].values()
        return [entry.get("trained_steps") for entry in meshes if "file" in entry]
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return []


def _progress(checkpoint: Path) -> tuple[int, float]:
    """Steps and seconds from the header of a safetensors file: a length of 8 bytes, then JSON."""
    try:
        with open(checkpoint, "rb") as file:
            (length,) = struct.unpack("<Q", file.read(8))
            header = json.loads(file.read(min(length, LONGEST_HEADER)))
        progress = json.loads(header["__metadata__"]["state"])["progress"]
        return int(progress["step"]), float(progress["seconds"])
    except (OSError, ValueError, KeyError, TypeError, struct.error):
        return 0, 0.0
