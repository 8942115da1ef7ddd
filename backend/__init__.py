"""ObjectGS compute backend: captures, votes, splat training and evaluation, without Blender."""

import os
import sys

# A thread that waits for the next kernel should be there at once: on Linux, where GNU's OpenMP lets it spin a moment, a
# training step takes a sixth less time. Elsewhere torch's and numba's threads come from libraries that spin for longer
# and would take the cores from each other, so there they sleep. It is read once, when these load.
if sys.platform != "linux":
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

__version__ = "0.1.0"


def lacking(error: ModuleNotFoundError) -> str:
    """The sentence for a Python that does not have the backend's packages."""
    return (
        f"The Python {sys.executable} lacks the package {error.name}, which the compute backend needs; "
        "set up the backend, or choose a Python that has its packages."
    )
