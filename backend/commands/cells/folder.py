"""The folder cells/ of a reconstruction.

cells.json               the division, see `backend.training.cells.division`
coarse/                  the checkpoint that was divided
0/, 1/, ...              one folder a cell: checkpoint/, and part.json, which tells how far its training is
seams/                   the same of the seams between the cells
"""

from __future__ import annotations

import argparse
import hashlib
from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch

from ...capture import Capture
from ...model.anchors import Anchors
from ...raster import Camera, devices
from ...shared.errors import InputError
from ...shared.formats.json_file import parse_json, read_json, write_json
from ...shared.formats.regular_file import open_regular
from ...shared.formats.typed import typed
from ...shared.reconstruction.checkpoint import CURRENT, stored_header
from ...shared.reconstruction.folder import Reconstruction
from ...shared.reconstruction.lock import FolderInUse, locked
from ...shared.reconstruction.record import TrainingRecord
from ...shared.stopping import StoppingReporter
from ...training.budget import TrainingProgress
from ...training.cells.division import NO_CELL, Division, read_division
from ...training.cells.parts import MERGED_OF, Checkpoint
from ...training.scene import Scene
from ...training.state import Keep, read_result
from ..folder import open_trained, require_reconstruction, with_corrected_masks

CHECKPOINT = "checkpoint"
"""Name of the folder of a part's checkpoints in that of the part."""

RECORD = "part.json"


class CellFolders:
    """Paths in the folder cells/."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.division = folder / "cells.json"
        self.coarse = folder / "coarse"
        self.seams = folder / "seams"

    def cell(self, number: int) -> Path:
        """Return the folder of a cell's checkpoint, counted from 0."""
        return self.folder / str(number)

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Hold the locks of all cells that were begun; raises FolderInUse if one is being trained."""
        names = [path.name for path in self.folder.iterdir() if path.is_dir()] if self.folder.exists() else []
        with ExitStack() as held:
            for number in sorted(int(name) for name in names if name.isdecimal()):
                try:
                    held.enter_context(locked(self.cell(number)))
                except FolderInUse as error:
                    raise FolderInUse(f"Cell {number} is being trained: {error}") from error
            yield


@dataclass(frozen=True)
class Divided:
    """An opened reconstruction that is divided into cells, without its coarse model, which may be large.

    Attributes:
        folder: the reconstruction.
        capture: its capture with corrected masks, as for the training of the coarse model.
        scene: the capture for trainings.
        progress, training: of the training of the coarse model.
        device: where parts are trained.
        folders: the folders of the cells.
        division: the cells.
        key: hash of cells.json, to which the records of its parts refer.
    """

    folder: Reconstruction
    capture: Capture
    scene: Scene
    progress: TrainingProgress
    training: TrainingRecord
    device: torch.device
    folders: CellFolders
    division: Division
    key: str

    def read_coarse(self, keep: Callable[[Anchors, np.ndarray], np.ndarray]) -> tuple[Checkpoint, np.ndarray]:
        """Read what parts are made of.

        Args:
            keep: returns which of a block of anchors, whose cells (n,) are given, are kept, (n,) bool.

        Returns:
            The checkpoint of the coarse model with the anchors that are kept, and their cells.
        """
        coarse = read_part(self.folders.coarse, lambda block: keep(block, self._cells_of(block.positions.numpy())))
        return coarse, self._cells_of(coarse[0]["anchors.positions"])

    def _cells_of(self, positions: np.ndarray) -> np.ndarray:
        return cells_of(self.division, self.scene, positions)

    def cameras(self, names: Collection[str]) -> list[Camera]:
        """Return the cameras of the named views, in scene units."""
        wanted = set(names)
        return [self.scene.camera(i) for i, view in enumerate(self.capture.views) if view.name in wanted]

    def restricted(self, names: Collection[str]) -> Capture:
        """Return the capture with only the named views to train on."""
        wanted = set(names)
        return self.capture.excluding_from_training({v.name for v in self.capture.views if v.name not in wanted})

    def require_current(self) -> None:
        """Raise InputError if the model has been divided anew."""
        if not self.folders.division.exists() or _digest(self.folders.division) != self.key:
            raise InputError(f"{self.folder.folder} was divided anew in the meantime; run the same command again.")


def open_divided(options: argparse.Namespace, reporter: StoppingReporter, cell: int | None = None) -> Divided:
    """Open a reconstruction that `split` has divided.

    Args:
        options: as for `open_trained`.
        reporter: receives status and warnings.
        cell: a cell that is to be trained by this process, which then writes to the folder of the cell alone.

    Raises:
        InputError: as `open_trained`, or it is not divided, or has no such cell.
    """
    folder = Reconstruction(options.folder)
    require_reconstruction(folder)
    folders = CellFolders(folder.cells)
    division = read_division(folders.division)
    key = _digest(folders.division)
    if cell is not None and cell >= len(division.cells):
        raise InputError(f"There is no cell {cell}: {folders.division} has {len(division.cells)}, from 0 on.")
    if not (folders.coarse / CURRENT).exists() or digest_of(folders.coarse) != division.checkpoint:
        raise InputError(
            f"{folders.coarse / CURRENT} is missing, damaged or of another division; use `split --restart` to divide "
            "the model anew."
        )
    trained = open_trained(options, reporter, folders.coarse, None if cell is None else folders.cell(cell))
    return Divided(
        folder, with_corrected_masks(trained, reporter), trained.scene, trained.progress, trained.training,
        trained.model.device, folders, division, key,
    )  # fmt: skip


def cells_of(division: Division, scene: Scene, positions: np.ndarray) -> np.ndarray:
    """Return the cell of each of the positions (N, 3) in scene units, which for distant surroundings is none."""
    near = devices.host(scene.before_surroundings(torch.from_numpy(positions)))
    return np.where(near, division.cells_of(positions), NO_CELL)


def read_part(folder: Path, keep: Keep | None = None, fixed: bool = True) -> Checkpoint:
    """Return the model in a folder of cells/, as in its checkpoint; keep, fixed: as in `read_result`.

    Raises:
        InputError: it is missing or damaged.
    """
    try:
        tensors, state, warning = read_result(folder, keep, fixed)
    except InputError as error:
        raise _damaged(folder) from error
    if warning:
        # An older one is not what its record describes.
        raise _damaged(folder)
    return tensors, state


def _damaged(folder: Path) -> InputError:
    return InputError(f"{folder / CURRENT} is missing or damaged; run `train-cell` for this cell again.")


def require_unchanged(folder: Reconstruction, division: Division, folders: CellFolders) -> None:
    """Raise InputError if a reconstruction's model is neither the divided one nor merged of its cells."""
    try:
        # Without the tensors, which may take much of the memory.
        with open_regular(folder.checkpoint / CURRENT) as file:
            merged_of = parse_json(stored_header(file)[0]["__metadata__"]["state"]).get(MERGED_OF)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{folder.checkpoint / CURRENT} is missing or damaged; train again.") from error
    if merged_of != _digest(folders.division) and digest_of(folder.checkpoint) != division.checkpoint:
        raise InputError(
            f"The model in {folder.folder} was changed after it was divided; use `split --restart` to divide it anew."
        )


def digest_of(folder: Path) -> str:
    """Return a hash of the checkpoint in a folder of cells/; raise InputError if it is missing."""
    if not (folder / CURRENT).is_file():
        raise _damaged(folder)
    return _digest(folder / CURRENT)


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()[:16]


@dataclass(frozen=True)
class PartRecord:
    """part.json: what a part was made of, and how far it is.

    made_of: hashes of cells.json and of the checkpoints that its training began with. complete: whether that is
    complete, of `steps` that took `seconds`, with so many `anchors` in the core of the cell.
    """

    made_of: tuple[str, ...]
    complete: bool = False
    steps: int = 0
    seconds: float = 0.0
    anchors: int = 0


def write_part_record(folder: Path, record: PartRecord) -> None:
    """Write part.json of a folder of cells/."""
    write_json(folder / RECORD, {**asdict(record), "made_of": list(record.made_of)})


def read_part_record(folder: Path) -> PartRecord | None:
    """Read part.json of a folder of cells/; None if there is none.

    Raises:
        InputError: the file is damaged.
    """
    path = folder / RECORD
    if not path.exists():
        return None
    try:
        found = typed(PartRecord, read_json(path))
        return PartRecord(**{**found, "made_of": tuple(found["made_of"])})
    except (KeyError, TypeError) as error:
        raise InputError(f"{path} is damaged; run `train-cell` with --restart for this cell.") from error
