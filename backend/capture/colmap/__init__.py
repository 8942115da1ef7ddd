"""COLMAP models: cameras, posed images and points, read from text or binary files; validation of all models."""

from .model import CAMERA_MODELS, COLMAP, Camera, Image, Model, RawImage, RawPoints, export_again
from .reader import find_model, has_model, read_cameras, read_model
from .validate import validate

__all__ = [
    "CAMERA_MODELS", "COLMAP", "Camera", "Image", "Model", "RawImage", "RawPoints", "export_again", "find_model",
    "has_model", "read_cameras", "read_model", "validate",
]  # fmt: skip
