"""ObjectGS compute backend: captures, votes, splat training and evaluation, without Blender."""

import os
import sys

# Two OpenMP pools live in this process, torch's and numba's. Threads of one that spin while they wait would take the
# cores from the other, so they sleep instead; this must be set before either library loads.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

__version__ = "0.1.0"


def lacking(error: ModuleNotFoundError) -> str:
    """The sentence for a Python that does not have the backend's packages."""
    return (
        f"The Python {sys.executable} lacks the package {error.name}, which the compute backend needs; "
        "set up the backend, or choose a Python that has its packages."
    )
