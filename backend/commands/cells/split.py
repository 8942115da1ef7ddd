"""`split`: divide a trained reconstruction into cells that are trained one by one, in any order and on any machine."""

from __future__ import annotations

import argparse
import shutil

import numpy as np

from ...shared.errors import InputError
from ...shared.formats.atomic import atomic_path, make_folder
from ...shared.reconstruction.checkpoint import CURRENT
from ...shared.reconstruction.folder import Reconstruction
from ...shared.reconstruction.lock import locked
from ...shared.stopping import StoppingReporter
from ...training.cells.division import Division, divide, read_division, write_division
from ...training.cells.visibility import first_unseen, shares, with_views
from ..folder import READ, open_trained, require_reconstruction
from ..stages import stage
from .folder import CellFolders, cells_of, digest_of, require_unchanged

_VIEWS = "views"


def split(options: argparse.Namespace, reporter: StoppingReporter) -> None:
    """Write cells/ with the division and a copy of the checkpoint."""
    reporter.expect({READ: ("Preparing", 5.0), _VIEWS: ("Choosing views", 20.0)})
    folder = Reconstruction(options.folder)
    require_reconstruction(folder)
    folders = CellFolders(folder.cells)
    with locked(folder.folder), stage(folder, "split"):
        trained = open_trained(options, reporter)
        scene, model, views = trained.scene, trained.model, trained.capture.views
        if folders.division.exists() and not options.restart:
            division = read_division(folders.division)
            _require_same(division, options)
            require_unchanged(folder, division, folders)
            reporter.status("The model is already divided like that; use --restart to discard its cells.")
            reporter.done(cells=options.cells, folder=str(folders.folder))
            return
        with folders.locked():
            pass  # A cell in training is a reason to refuse at once, too.
        if not trained.is_latest:
            raise InputError(
                f"{folder.checkpoint / CURRENT} is missing or damaged; continue the training with `train`."
            )
        positions = model.anchors.positions.cpu().numpy()
        near = scene.before_surroundings(model.anchors.positions).cpu().numpy()
        if near.sum() < options.cells:
            raise InputError(
                f"The model has {near.sum()} anchors, too few for {options.cells} cells; use fewer --cells."
            )
        cells = tuple(divide(positions[near].astype(np.float64), options.cells, options.overlap))
        division = Division("", options.overlap, cells)
        reporter.begin(_VIEWS, f"Choosing the views of {options.cells} cells")
        training = trained.capture.train_indices
        found = []
        measured = shares(model, division, cells_of(division, scene, positions), map(scene.camera, training))
        for done, of_view in enumerate(measured, 1):
            found.append(of_view)
            reporter.progress(done, len(training), what="views")
        division = with_views(division, [views[index].name for index in training], np.array(found))
        unseen = first_unseen(division.cells)
        if unseen is not None:
            raise InputError(f"No view shows cell {unseen}; use fewer --cells.")
        if folders.folder.exists():
            with folders.locked():
                # First, so that a stop in between leaves no division without its parts, and that no cell is begun.
                folders.division.unlink(missing_ok=True)
            shutil.rmtree(folders.folder)
        make_folder(folders.coarse)
        with atomic_path(folders.coarse / CURRENT) as part:
            shutil.copyfile(folder.checkpoint / CURRENT, part)
        # Last, since it makes the folder one of cells.
        write_division(
            folders.division, Division(digest_of(folders.coarse), options.overlap, division.cells, division.seam_views)
        )
    for number, cell in enumerate(division.cells):
        reporter.status(f"Cell {number}: {cell.anchors:,} anchors, {len(cell.views)} views")
    reporter.done(cells=len(division.cells), folder=str(folders.folder), seam_views=len(division.seam_views))


def _require_same(division: Division, options: argparse.Namespace) -> None:
    """Raise InputError if a model was divided otherwise before."""
    cells, overlap = len(division.cells), division.overlap
    if (cells, overlap) != (options.cells, options.overlap):
        raise InputError(
            f"{options.folder} is already divided into {cells} cells with an overlap of {overlap:g}; use --restart to "
            "discard them."
        )
