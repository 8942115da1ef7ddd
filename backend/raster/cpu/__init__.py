"""The CPU renderer, in numba."""
