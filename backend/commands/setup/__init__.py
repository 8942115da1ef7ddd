"""The machine: the command doctor, compilation of kernels, threads and memory."""
