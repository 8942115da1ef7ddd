"""Models of any program: COLMAP's, transforms.json, Bundler's, Metashape's and RealityScan's, all read as `Model`."""

from .photos import none_found, photos_folder
from .reader import read_capture_model

__all__ = ["none_found", "photos_folder", "read_capture_model"]
