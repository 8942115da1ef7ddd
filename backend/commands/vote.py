"""`vote`: each 3D point's object, in points.ply and objects.json; `train` votes in the same way."""

from __future__ import annotations

import argparse

from ..stopping import StoppingReporter
from .folder import open_reconstruction
from .plan import change_objects, keep_plan
from .votes import cast_votes


def vote(options: argparse.Namespace, reporter: StoppingReporter) -> None:
    """Write points.ply, objects.json and plan.json."""
    with open_reconstruction(options, reporter) as (folder, capture):
        if not capture.has_masks:
            reporter.warning(f"{capture.folder / 'masks'} does not exist, so no point belongs to an object.")
        cast_votes(folder, capture, options, reporter)
        change_objects(folder, capture, options)
        keep_plan(folder, capture, options.max_size)
    reporter.done(points=str(folder.points), objects=str(folder.objects))
