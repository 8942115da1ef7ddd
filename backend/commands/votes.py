"""Each 3D point's object, in points.ply and objects.json: casting votes, and whether those that are there hold."""

from __future__ import annotations

import argparse
import hashlib
from typing import Any

from ..capture import Capture
from ..labels import vote as vote_points
from ..labels.points import read_points, write_points
from ..objects import write_objects
from ..palette import object_colours
from ..protocol import InputError, Reconstruction, Reporter
from .folder import digest
from .record import record, recorded, stage


def cast_votes(folder: Reconstruction, capture: Capture, options: argparse.Namespace, reporter: Reporter) -> None:
    """Vote on the objects of the capture's points; leaves points.ply and objects.json."""
    with stage(folder, "vote"):
        votes = vote_points(capture, options.strategy, options.seed, reporter=reporter)
        colours = object_colours(votes.counts)
        objects = [
            {"id": i, "name": object_name(capture, i), "colour": list(colours[i]), "points": n}
            for i, n in sorted(votes.counts.items())
            if i
        ]
        write_points(folder.points, capture.points, votes)
        write_objects(folder.objects, objects)
    record(folder, votes=votes_key(capture, options.max_size, options.strategy, options.seed))
    for entry in objects:
        reporter.status(f"object {entry['id']} {entry['name']}: {entry['points']:,} points")


def votes_are_current(folder: Reconstruction, capture: Capture, max_size: int, strategy: str, seed: int) -> bool:
    """Whether points.ply is whole and holds the votes that would be cast again."""
    if not folder.points.exists() or not folder.objects.exists():
        return False
    if recorded(folder).get("votes") != votes_key(capture, max_size, strategy, seed):
        return False
    try:
        return len(read_points(folder.points).ids) == len(capture.points.xyz)
    except InputError:
        return False


def votes_key(capture: Capture, max_size: int, strategy: str, seed: int) -> dict[str, Any]:
    """What the votes depend on; a mask that was edited since counts as another one."""
    masks = hashlib.sha256()
    for view in capture.views:
        if view.mask_file is not None:
            status = view.mask_file.stat()
            masks.update(f"{view.name}\0{status.st_size}\0{status.st_mtime_ns}\0".encode())
    return {
        "strategy": strategy,
        "seed": seed if strategy == "probability" else None,
        "max_size": max_size,
        "capture": digest(capture),
        "masks": masks.hexdigest()[:16] if capture.has_masks else None,
    }


def object_name(capture: Capture, object_id: int) -> str:
    """What an object is called: as in the capture, or by its number."""
    return capture.names.get(object_id, f"object {object_id}" if object_id else "unlabelled")
