"""Models of any program: COLMAP's, transforms.json, Bundler's, Metashape's and RealityScan's, all read as `Model`."""

from .photos import Photos, none_found, photo_files, photos_folder
from .reader import read_capture_model
from .visibility import with_observations

__all__ = ["Photos", "none_found", "photo_files", "photos_folder", "read_capture_model", "with_observations"]
