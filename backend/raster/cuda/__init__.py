"""The CUDA renderer, in numba-cuda."""
