"""Kernels for GPUs in a dialect of C++ (`source/`), compiled at run time for CUDA, HIP or an emulator."""
