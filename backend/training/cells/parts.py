"""Checkpoints of the parts of a model: of a cell, of the seams, and of all cells merged.

A part begins with the anchors around it that its views show, which stay fixed. All parts share heads, background, voxel
size and table of objects, so that their anchors can be put together again without loss.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import torch

from ...model.anchors import Anchors
from ...model.object_model import anchors_in_view
from ...model.splats import gathered_columns
from ...raster import Camera
from ..budget import TrainingProgress
from ..settings import Settings
from ..state import Keep
from ..step import frustum
from .division import NO_CELL, Division
from .region import Bounds, Region, inside

Checkpoint = tuple[dict[str, np.ndarray], dict[str, Any]]
"""Tensors and state of a checkpoint, as `read_result` returns them."""

NOWHERE: Bounds = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
"""Bounds in which no anchors are added."""

MERGED_OF = "merged_of"
"""Entry of the state of a merged checkpoint with the hash of the division."""

_OF_ANCHORS = ("positions", "rows", "ids")


def anchors_of(checkpoint: Checkpoint) -> dict[str, np.ndarray]:
    """Return the anchors of a checkpoint: positions, rows and ids."""
    return {name: checkpoint[0][f"anchors.{name}"] for name in _OF_ANCHORS}


def without_anchors(coarse: Checkpoint) -> Checkpoint:
    """Return what the parts of a model share, for `begin_seams` and `merged`."""
    return {name: value for name, value in coarse[0].items() if not name.startswith("anchors.")}, coarse[1]


def shown(anchors: Anchors, cameras: Iterable[Camera]) -> np.ndarray:
    """Return which of the anchors, on the CPU, any of the cameras shows: (N,) bool."""
    found = np.zeros(len(anchors), np.bool_)
    for camera in cameras:
        found[anchors_in_view(anchors, *frustum(camera)).numpy()] = True
    return found


def begin_part(
    shared: Checkpoint, anchors: dict[str, np.ndarray], trained: np.ndarray, bounds: Bounds, seed: Sequence[int]
) -> Checkpoint:  # fmt: skip
    """Return the checkpoint from which a part of a model is trained.

    Args:
        shared: checkpoint of the coarse model, of whose anchors nothing is used.
        anchors: anchors, as from `anchors_of`.
        trained: (n,) bool, those of the part; the others stay fixed.
        bounds: where anchors may be added.
        seed: of the random numbers.
    """
    tensors, state = shared
    settings = Settings(**state["settings"])
    order = np.concatenate([np.flatnonzero(~trained), np.flatnonzero(trained)])
    fixed = len(order) - int(trained.sum())
    made = _untrained(tensors, {name: anchors[name][order] for name in _OF_ANCHORS}, fixed, settings)
    rng = np.random.default_rng([settings.seed, *seed])
    return made, {
        **state, "rng": rng.bit_generator.state, "progress": {**TrainingProgress().__dict__},
        "region": Region(fixed, bounds).as_dict(),
    }  # fmt: skip


def trained_in(division: Division, number: int, positions: np.ndarray, cell_of: np.ndarray) -> np.ndarray:
    """Return which anchors of the coarse model at `positions` (N, 3), in the cells (N,), a cell trains: (N,) bool."""
    return inside(positions, division.cells[number].bounds) & (cell_of != NO_CELL)


def begin_cell(coarse: Checkpoint, division: Division, number: int, cell_of: np.ndarray) -> Checkpoint:
    """Return the checkpoint from which a cell is trained.

    Args:
        coarse: checkpoint of the coarse model, with the anchors that the cell trains or that its views show.
        division, number: the cells, and which of them.
        cell_of: (n,) the cell of each of these anchors.
    """
    anchors = anchors_of(coarse)
    trained = trained_in(division, number, anchors["positions"], cell_of)
    return begin_part(coarse, anchors, trained, division.cells[number].bounds, (number,))


def in_core(division: Division, number: int) -> Keep:
    """Return what chooses, of the anchors that a cell has trained, those that the merged model has."""
    return lambda anchors: inside(anchors.positions.numpy(), division.cells[number].core)


def near_seams(division: Division, cameras: Sequence[Camera]) -> Keep:
    """Return what chooses the anchors that are on seams or in view of the cameras, which are those that show seams."""
    return lambda anchors: division.on_seams(anchors.positions.numpy()) | shown(anchors, cameras)


def begin_seams(
    shared: Checkpoint,
    division: Division,
    of_none: dict[str, np.ndarray],
    cells: Iterable[dict[str, np.ndarray]],
    most: int,
    cameras: Sequence[Camera],
) -> Checkpoint:
    """Return the checkpoint from which the seams of trained cells are trained; no anchors are added.

    Args:
        shared: checkpoint of the coarse model, of whose anchors nothing is used.
        division: the cells.
        of_none: anchors of the coarse model that belong to no cell, as from `anchors_of`.
        cells: the anchors of each cell that are `in_core` and `near_seams`, read one after another.
        most: upper bound of the number of anchors.
        cameras: the training views that show seams, in scene units.
    """
    settings, voxel = Settings(**shared[1]["settings"]), float(shared[1]["voxel"])
    every = Anchors(settings.layout, voxel, *(torch.from_numpy(of_none[name]) for name in _OF_ANCHORS))
    near = shown(every, cameras)
    around = {name: values[near] for name, values in of_none.items()}
    anchors = gathered_columns(itertools.chain([around], cells), most)
    trained = _on_seams(division, anchors, int(near.sum()))
    return begin_part(shared, anchors, trained, NOWHERE, (len(division.cells),))


def merged(
    shared: Checkpoint,
    division: Division,
    of_none: dict[str, np.ndarray],
    cells: Iterable[dict[str, np.ndarray]],
    most: int,
    seams: Checkpoint,
    progress: TrainingProgress,
    key: str,
) -> Checkpoint:
    """Return the checkpoint of the whole model, after the training of the seams.

    Args:
        shared, division, of_none, most: as for `begin_seams`.
        cells: the anchors of each cell that are `in_core`, read one after another.
        seams: checkpoint of the trained seams, without fixed anchors.
        progress: of the whole training.
        key: hash of the division, which the state keeps until the model is trained further.
    """
    tensors, state = shared
    trained, anchors = anchors_of(seams), gathered_columns(itertools.chain([of_none], cells), most)
    of_seams = _on_seams(division, anchors, len(of_none["ids"]))
    if int(of_seams.sum()) == len(trained["ids"]):
        anchors["rows"][of_seams] = trained["rows"]
    else:
        # Anchors whose parameters were not finite have been removed.
        anchors = {name: np.concatenate([anchors[name][~of_seams], trained[name]]) for name in _OF_ANCHORS}
    made = _untrained(tensors, anchors, 0, Settings(**state["settings"]))
    return made, {**state, "progress": {**progress.__dict__}, MERGED_OF: key}


def _untrained(
    shared: dict[str, np.ndarray], anchors: dict[str, np.ndarray], fixed: int, settings: Settings
) -> dict[str, np.ndarray]:
    """Return the tensors of a checkpoint with these anchors, of which no training has begun.

    shared: tensors of the coarse model, whose heads, background and colors they have.
    """
    count, k, columns = len(anchors["ids"]), settings.offsets, settings.layout.columns
    made = {f"anchors.{name}": values for name, values in anchors.items()}
    # Zeros take no memory before they are written to.
    made |= {f"adam.{name}": np.zeros((count - fixed, columns), np.float32) for name in ("exp_avg", "exp_avg_sq")}
    made |= {
        "growth.gradient": np.zeros(count * k, np.float32), "growth.visits": np.zeros(count * k, np.int32),
        "growth.opacity": np.zeros(count, np.float32), "growth.views": np.zeros(count, np.int32),
    }  # fmt: skip
    made |= {name: value for name, value in shared.items() if name.startswith(("heads.", "colors."))}
    return {**made, "object_ids": shared["object_ids"], "background": shared["background"]}


def _on_seams(division: Division, anchors: dict[str, np.ndarray], surroundings: int) -> np.ndarray:
    found = division.on_seams(anchors["positions"])
    found[:surroundings] = False
    return found
