"""Assigns points their objects by votes of the ID masks, and stores the labeled points."""

from .points import LabeledPoints, read_points, write_points
from .voting import Votes, vote

__all__ = ["LabeledPoints", "Votes", "read_points", "vote", "write_points"]
