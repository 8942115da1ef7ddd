"""`import`: a capture's cameras and points, ready to be shown, before anything is voted on or trained."""

from __future__ import annotations

import argparse

import numpy as np

from ..labels import Votes
from ..labels.points import write_points
from ..objects import write_objects
from ..stopping import StoppingReporter
from .folder import described, open_reconstruction
from .plan import keep_plan
from .record import record, recorded
from .votes import votes_are_current


def import_capture(options: argparse.Namespace, reporter: StoppingReporter) -> None:
    """Undistort the images; leave cameras.json, points.ply, plan.json and the capture's entry in objectgs.json.

    Points keep the objects of a vote on this capture; where there is none, they belong to no object.
    """
    with open_reconstruction(options, reporter) as (folder, capture):
        record(folder, capture=described(capture, options.max_size))
        voted = recorded(folder).get("votes")
        cast = voted and (options.max_size, voted["strategy"], voted["seed"])
        if not cast or not votes_are_current(folder, capture, *cast):
            count = len(capture.points.xyz)
            none = Votes(np.zeros(count, np.int64), np.zeros(count, np.float32), {}, np.zeros(count, np.int32))
            # First forgotten, then overwritten: points without a vote must never pass for voted ones.
            record(folder, votes=None)
            write_points(folder.points, capture.points, none)
            if folder.objects.exists():
                write_objects(folder.objects, [])
        keep_plan(folder, capture, options.max_size)
    reporter.done(
        cameras=str(folder.cameras), points=str(folder.points), views=len(capture.views), masks=capture.has_masks
    )
