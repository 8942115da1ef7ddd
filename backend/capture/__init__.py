"""Captures: images, ID masks and models of cameras and points, loaded as undistorted pinhole views."""

from .capture import Capture, Keypoints, Points, View, default_split
from .prepare import load_capture
from .sharpness import BLURRED, measure_contrasts
from .survey import check_capture
from .upright import Upright, compute_upright

__all__ = [
    "BLURRED",
    "Capture",
    "Keypoints",
    "Points",
    "Upright",
    "View",
    "check_capture",
    "compute_upright",
    "default_split",
    "load_capture",
    "measure_contrasts",
]
