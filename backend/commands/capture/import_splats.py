"""`import-splats`: makes a reconstruction from splats of another program, for display and editing."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from functools import partial

import numpy as np

from ...capture import Capture, Points
from ...editing import transformed
from ...export import read_foreign_scene, write_splats
from ...labels import Votes
from ...labels import vote as vote_points
from ...labels.points import write_points
from ...labels.voting import find_visible_points
from ...model.splats import concatenate
from ...shared.errors import InputError
from ...shared.events import Reporter
from ...shared.reconstruction.folder import Reconstruction
from ...shared.reconstruction.record import ExportRecord, ImportRecord, read_record, update_record
from ...shared.stopping import StoppingReporter
from ..cameras import write_splat_cameras
from ..folder import READ, capture_record, open_output, read_capture
from ..imported import write_objects_of
from ..votes import VOTE

_LEAST_VISIBLE = 0.5
"""Least fraction of the splats inside a view; with fewer, they are probably not in the capture's coordinates."""
_MOST_CHECKED = 20_000
"""Number of splats, evenly chosen, of which this fraction is measured."""


def import_splats(options: argparse.Namespace, reporter: StoppingReporter) -> None:
    """Write splats.ply, objects.json, cameras.json and points.ply from a file of splats."""
    folder = Reconstruction(options.out)
    if folder.checkpoint.exists():
        raise InputError(f"{folder.folder} already contains a training; choose another --out.")
    parts = {"splats": ("Reading", 5.0), READ: ("Preparing", 5.0), VOTE: ("Voting", 5.0), "write": ("Saving", 5.0)}
    if options.capture is None:
        parts = {"splats": parts["splats"], "write": parts["write"]}
    reporter.expect(parts)
    reporter.begin("splats", f"Reading {options.splats.name}")
    nodes, warnings, description = read_foreign_scene(options.splats)
    placed = [
        node.splats if np.array_equal(node.matrix, np.eye(4)) else transformed(node.splats, node.matrix)
        for node in nodes
    ]
    splats = placed[0] if len(placed) == 1 else concatenate(placed)
    if len(splats) == 0:
        raise InputError(" ".join([f"{options.splats} contains no splats.", *warnings]))
    for sentence in warnings:
        reporter.warning(sentence)
    names: Mapping[int, str] = description.names
    with open_output(options):
        if options.capture is None:
            write_splat_cameras(folder, splats.means, description.up)
            write_points(folder.points, _no_points(), _no_votes(0))
            _forget_capture(folder, reporter)
        else:
            capture = read_capture(folder, options, reporter, partial(_require_visible, centers=splats.means))
            votes = _no_votes(len(capture.points.xyz))
            if capture.has_masks:
                names = capture.names
                reporter.begin(VOTE, "Voting on the objects of the splats")
                splats.object_ids = vote_points(capture, reporter=reporter, positions=splats.means).ids
                votes = vote_points(capture)
            else:
                names = {**capture.names, **names}
                reporter.warning(f"{capture.folder / 'masks'} does not exist, so splats keep the objects of the file.")
            write_points(folder.points, capture.points, votes)
            update_record(folder, capture=capture_record(capture, options.max_size))
        reporter.begin("write", f"Writing {folder.splats.name}")
        for sentence in write_splats(folder.splats, splats):
            reporter.warning(sentence)
        objects = write_objects_of(folder, splats, names)
        export = description.background and ExportRecord(len(splats), 0, background=description.background)
        imported = ImportRecord(str(options.splats.resolve()), len(splats))
        # The checkpoint of an earlier training is gone.
        update_record(folder, imported=imported, export=export, training=None)
    reporter.done(splats=len(splats), objects=objects, reconstruction=str(folder.folder))


def _forget_capture(folder: Reconstruction, reporter: Reporter) -> None:
    """Remove the capture of an earlier import from the record, and the strokes, which are on its photos."""
    recorded = read_record(folder).capture
    if recorded is not None:
        reporter.warning(
            f"{folder.folder} no longer has the capture {recorded.folder}, nor strokes on its photos; to use it, "
            "import the splats again with this capture."
        )
        update_record(folder, capture=None, votes=None)
        folder.strokes.unlink(missing_ok=True)


def _require_visible(capture: Capture, centers: np.ndarray) -> None:
    """Raise InputError if too few splats with centers (N, 3) are in the capture's views."""
    some = np.ascontiguousarray(centers[:: -(-len(centers) // _MOST_CHECKED)].T, np.float64)
    visible = np.zeros(some.shape[1], bool)
    for index in range(len(capture.views)):
        visible[find_visible_points(capture, some, index, None)[0]] = True
    seen = float(visible.mean())
    if seen < _LEAST_VISIBLE:
        raise InputError(
            f"Only {seen:.0%} of the splats lie in the views of {capture.folder}; they must be in its coordinates."
        )


def _no_points() -> Points:
    return Points(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0, np.float32), np.zeros(0, np.int64))


def _no_votes(count: int) -> Votes:
    return Votes(np.zeros(count, np.int64), np.zeros(count, np.float32), {}, np.zeros(count, np.int32))
