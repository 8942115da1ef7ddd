"""`import-splats`: a reconstruction of splats that another program trained, so that they can be shown and edited."""

from __future__ import annotations

import argparse
from contextlib import ExitStack

import numpy as np

from ..capture import Capture, Points
from ..export import read_splats, write_splats
from ..labels import Votes
from ..labels import vote as vote_points
from ..labels.points import write_points
from ..model.splats import Splats
from ..objects import write_objects
from ..palette import object_colours
from ..protocol import InputError, Reconstruction, Reporter
from ..stopping import StoppingReporter
from .cameras import write_no_cameras
from .folder import described, open_reconstruction, removed_if_refused
from .lock import locked
from .record import record
from .votes import object_name

_SEEN = 0.5
"""Share of the splats that must lie in some view of the capture, or they are hardly in its coordinates."""


def import_splats(options: argparse.Namespace, reporter: StoppingReporter) -> None:
    """Write splats.ply, objects.json, cameras.json and points.ply from the PLY."""
    folder = Reconstruction(options.out)
    if folder.checkpoint.exists():
        raise InputError(f"{folder.folder} holds a training already; choose another --out.")
    reporter.status(f"Reading {options.ply.name}")
    splats, warnings = read_splats(options.ply)
    if len(splats) == 0:
        raise InputError(f"{options.ply} holds no splats.")
    for sentence in warnings:
        reporter.warning(sentence)
    names: dict[int, str] = {}
    with removed_if_refused(folder), ExitStack() as opened:
        if options.capture is None:
            folder.create()
            opened.enter_context(locked(folder.folder))
            write_no_cameras(folder, splats.means)
            write_points(folder.points, _no_points(), _no_votes(0))
        else:
            _, capture = opened.enter_context(open_reconstruction(options, reporter))
            names = {i: object_name(capture, i) for i in capture.object_ids.tolist()}
            votes = _no_votes(len(capture.points.xyz))
            if capture.has_masks:
                splats.object_ids = _votes(capture, splats, reporter)
                votes = vote_points(capture)
            else:
                reporter.warning(f"{capture.folder / 'masks'} does not exist, so splats keep the objects of the file.")
            write_points(folder.points, capture.points, votes)
            record(folder, capture=described(capture, options.max_size))
        for sentence in write_splats(folder.splats, splats):
            reporter.warning(sentence)
        found, counts = np.unique(splats.object_ids[splats.object_ids > 0], return_counts=True)
        colours = object_colours(found)
        objects = [
            {"id": i, "name": names.get(i, f"object {i}"), "colour": list(colours[i]), "points": n}
            for i, n in zip(found.tolist(), counts.tolist())
        ]
        write_objects(folder.objects, objects)
        record(folder, imported={"file": str(options.ply.resolve()), "splats": len(splats)})
    reporter.done(splats=len(splats), objects=len(objects), reconstruction=str(folder.folder))


def _votes(capture: Capture, splats: Splats, reporter: Reporter) -> np.ndarray:
    """The object of each splat (N,) by the capture's masks; InputError where the splats do not lie in its views."""
    votes = vote_points(capture, reporter=reporter, places=splats.means)
    seen = float((votes.visible > 0).mean())
    if seen < _SEEN:
        raise InputError(
            f"Only {seen:.0%} of the splats lie in the views of {capture.folder}; they must be in its coordinates."
        )
    return votes.ids


def _no_points() -> Points:
    return Points(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0, np.float32), np.zeros(0, np.int64))


def _no_votes(count: int) -> Votes:
    return Votes(np.zeros(count, np.int64), np.zeros(count, np.float32), {}, np.zeros(count, np.int32))
