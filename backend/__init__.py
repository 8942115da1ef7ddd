"""ObjectGS compute backend: captures, votes, splat training and evaluation, without Blender."""

import os

# Two OpenMP pools live in this process, torch's and numba's. Threads of one that spin while they wait would take the
# cores from the other, so they sleep instead; this must be set before either library loads.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

__version__ = "0.1.0"
