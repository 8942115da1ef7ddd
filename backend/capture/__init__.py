"""Captures: images, ID masks and COLMAP models, loaded as undistorted pinhole views."""

from .capture import Capture, Keypoints, Points, View
from .prepare import load_capture
from .survey import check_capture
from .upright import Upright, compute_upright

__all__ = ["Capture", "Keypoints", "Points", "Upright", "View", "check_capture", "compute_upright", "load_capture"]
