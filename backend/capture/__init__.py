"""COLMAP model, images and masks -> one Capture of undistorted pinhole views with ID maps."""

from .capture import Capture, Keypoints, Points, View, check_capture, load_capture
from .upright import Upright, stand_up

__all__ = ["Capture", "Keypoints", "Points", "Upright", "View", "check_capture", "load_capture", "stand_up"]
