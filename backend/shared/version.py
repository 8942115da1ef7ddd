"""The version of extension and backend."""

__version__ = "0.1.0"
