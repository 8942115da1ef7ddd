"""COLMAP model, images and masks -> one Capture of undistorted pinhole views with ID maps."""

from .capture import Capture, Keypoints, Points, View, check_capture, load_capture

__all__ = ["Capture", "Keypoints", "Points", "View", "check_capture", "load_capture"]
