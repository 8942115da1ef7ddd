"""Texturing of a surface: UV unwrapping, texels, and baking of the photos."""
