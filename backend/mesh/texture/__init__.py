"""Texturing of a surface: UVs, texels, and their colors from the photos."""
