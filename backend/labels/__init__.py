"""Assigns points their objects by votes of the ID masks, and stores the labeled points."""

from ..shared.formats.points_ply import LabeledPoints, read_points
from .corrections import correct_masks
from .points import write_points
from .voting import Votes, vote

__all__ = ["LabeledPoints", "Votes", "correct_masks", "read_points", "vote", "write_points"]
