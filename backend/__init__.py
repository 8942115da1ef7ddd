"""ObjectGS compute backend: captures, votes, splat training and evaluation, without Blender."""

import os
import sys

# Threads that wait for the next kernel should respond at once. On Linux, GNU's OpenMP lets them spin briefly, which
# makes a training step a sixth faster. Elsewhere torch and numba use different libraries, whose threads spin longer and
# block each other's cores, so there they sleep. The libraries read this once, when they are loaded.
if sys.platform != "linux":
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
# The wheels of torch and pycolmap for macOS contain a copy of OpenMP each. The second one that starts would end the
# process; both may start, since only one of them computes with several threads (see backend/sfm/worker.py).
if sys.platform == "darwin":
    os.environ.setdefault("KMP_DUPLICATE_LIB_OK", "TRUE")
