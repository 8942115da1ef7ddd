"""Labeled points: the capture's points with the objects of a vote."""

from __future__ import annotations

from pathlib import Path

from ..capture import Points
from ..shared.formats import points_ply
from ..shared.formats.points_ply import LabeledPoints
from .voting import Votes


def write_points(path: Path, points: Points, votes: Votes) -> None:
    """Write labeled points, atomically.

    Args:
        path: The PLY file.
        points: M points.
        votes: Their labels.
    """
    labeled = LabeledPoints(points.xyz, points.rgb, votes.ids, votes.margins, votes.visible)
    points_ply.write_points(path, labeled)
