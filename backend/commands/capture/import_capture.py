"""`import`: prepares a capture's cameras and points for display, before the vote and training."""

from __future__ import annotations

import argparse

import numpy as np

from ...labels import Votes
from ...labels.points import write_points
from ...planning.agreement import measure_agreement
from ...planning.decisions import planned_capture
from ...shared.reconstruction.objects import write_objects
from ...shared.reconstruction.record import read_record, update_record
from ...shared.stopping import StoppingReporter
from ..folder import READ, capture_record, open_reconstruction
from ..planning import write_default_plan
from ..votes import votes_are_current


def import_capture(options: argparse.Namespace, reporter: StoppingReporter) -> None:
    """Undistort the images; write cameras.json, points.ply, plan.json and the capture's entry in objectgs.json.

    Points keep the objects of an earlier vote on this capture; without a vote they belong to no object.
    """
    reporter.expect({READ: ("Preparing", 10.0), "plan": ("Planning", 5.0)})
    with open_reconstruction(options, reporter) as (output, capture):
        folder = output.folder
        reporter.begin("plan", "Planning the training")
        output.accept()
        update_record(folder, capture=capture_record(capture, options.max_size))
        voted = read_record(folder).votes
        cast = voted and (options.max_size, voted.strategy, voted.seed or 0)
        if not cast or not votes_are_current(folder, capture, *cast):
            count = len(capture.points.xyz)
            none = Votes(np.zeros(count, np.int64), np.zeros(count, np.float32), {}, np.zeros(count, np.int32))
            # The record is cleared first, so that points without a vote are never taken for the result of one.
            update_record(folder, votes=None)
            write_points(folder.points, capture.points, none)
            if folder.objects.exists():
                write_objects(folder.objects, [])
        plan = write_default_plan(folder, capture, options.max_size, reporter)
        agreement = measure_agreement(planned_capture(capture, plan), reporter.check)
        update_record(folder, capture=capture_record(capture, options.max_size, agreement))
    reporter.done(
        cameras=str(folder.cameras), points=str(folder.points), views=len(capture.views), masks=capture.has_masks
    )
