"""COLMAP models: cameras, posed images and points, read from text or binary files and validated."""

from .model import CAMERA_MODELS, Camera, Image, Model
from .reader import find_model, read_model

__all__ = ["CAMERA_MODELS", "Camera", "Image", "Model", "find_model", "read_model"]
