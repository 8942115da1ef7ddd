"""`vote`: assigns each 3D point its object, as `train` does if necessary."""

from __future__ import annotations

import argparse

from ...shared.stopping import StoppingReporter
from ..folder import READ, open_reconstruction
from ..planning import change_objects, write_default_plan
from ..votes import VOTE, cast_votes


def vote(options: argparse.Namespace, reporter: StoppingReporter) -> None:
    """Write points.ply, objects.json and plan.json."""
    reporter.expect({READ: ("Preparing", 5.0), VOTE: ("Voting", 5.0), "plan": ("Planning", 5.0)})
    with open_reconstruction(options, reporter) as (output, capture):
        folder = output.folder
        if not capture.has_masks:
            reporter.warning(f"{capture.folder / 'masks'} does not exist, so no point belongs to an object.")
        cast_votes(folder, capture, options, reporter)
        reporter.begin("plan", "Planning the training")
        change_objects(folder, capture, options)
        output.accept()
        write_default_plan(folder, capture, options.max_size, reporter)
    reporter.done(points=str(folder.points), objects=str(folder.objects))
