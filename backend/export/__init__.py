"""Files that other programs read."""

from .ply import read_splats, write_splats

__all__ = ["read_splats", "write_splats"]
