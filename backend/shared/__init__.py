"""Modules used by both the backend and the Blender add-on; they import only the standard library and NumPy."""
