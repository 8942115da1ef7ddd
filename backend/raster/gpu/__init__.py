"""The GPU renderer; its kernels are in `backend/gpu/source/raster`."""
