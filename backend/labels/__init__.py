"""Votes of the ID masks on each point of the cloud, and the labelled point cloud on disk."""

from .points import LabelledPoints, read_points, write_points
from .voting import Votes, vote

__all__ = ["LabelledPoints", "Votes", "read_points", "vote", "write_points"]
