"""Votes on the objects of points, stored in points.ply and objects.json, and the test whether they are current."""

from __future__ import annotations

import argparse
import hashlib

from ..capture import Capture
from ..labels import vote as vote_points
from ..labels.points import write_points
from ..shared.color.palette import object_colors
from ..shared.errors import InputError
from ..shared.events import Reporter
from ..shared.formats.points_ply import read_points
from ..shared.reconstruction.folder import Reconstruction
from ..shared.reconstruction.objects import default_name, write_objects
from ..shared.reconstruction.record import VotesRecord, read_record, update_record
from .folder import digest
from .stages import stage

VOTE = "vote"
"""Name of a vote among the parts of a command."""


def cast_votes(folder: Reconstruction, capture: Capture, options: argparse.Namespace, reporter: Reporter) -> None:
    """Vote on the objects of the capture's points; writes points.ply and objects.json."""
    reporter.begin(VOTE, "Voting on the objects of the points" if capture.has_masks else "Writing the points")
    with stage(folder, "vote"):
        votes = vote_points(capture, options.strategy, options.seed, reporter=reporter)
        colors = object_colors(votes.counts)
        objects = [
            {"id": i, "name": object_name(capture, i), "color": list(colors[i]), "points": n}
            for i, n in sorted(votes.counts.items())
            if i
        ]
        write_points(folder.points, capture.points, votes)
        write_objects(folder.objects, objects)
    update_record(folder, votes=votes_key(capture, options.max_size, options.strategy, options.seed))
    for entry in objects:
        reporter.status(f"object {entry['id']} {entry['name']}: {entry['points']:,} points")


def votes_are_current(folder: Reconstruction, capture: Capture, max_size: int, strategy: str, seed: int) -> bool:
    """Return whether points.ply is complete and contains the result of the same vote.

    Args:
        folder: The reconstruction.
        capture: Its capture, whose masks may have been modified since.
        max_size: Longest side of the images that voted, in pixels.
        strategy: As in `labels.vote`.
        seed: For the strategy probability; others do not depend on it.

    Returns:
        Whether a vote with these inputs would give the points in points.ply; False if the file is damaged.

    Raises:
        InputError: objectgs.json is invalid.
    """
    if not folder.points.exists() or not folder.objects.exists():
        return False
    if read_record(folder).votes != votes_key(capture, max_size, strategy, seed):
        return False
    try:
        return len(read_points(folder.points).ids) == len(capture.points.xyz)
    except InputError:
        return False


def votes_key(capture: Capture, max_size: int, strategy: str, seed: int) -> VotesRecord:
    """Return the inputs of a vote for objectgs.json; they change if a mask file is modified."""
    masks = hashlib.sha256()
    for view in capture.views:
        if view.mask_file is not None:
            status = view.mask_file.stat()
            masks.update(f"{view.name}\0{status.st_size}\0{status.st_mtime_ns}\0".encode())
    return VotesRecord(
        strategy,
        seed if strategy == "probability" else None,
        max_size,
        digest(capture),
        masks.hexdigest()[:16] if capture.has_masks else None,
    )


def object_name(capture: Capture, object_id: int) -> str:
    """Return the name of an object in the capture, or its default name."""
    return capture.names.get(object_id, default_name(object_id))
