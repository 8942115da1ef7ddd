"""The CUDA kernels in numba's simulator, which a process chooses before it imports numba: each test runs other test
files in a process of its own and shows what that says."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
HERE = Path("tests") / "backend"


@pytest.mark.parametrize(
    "words",
    [
        [HERE / "simulated_cuda.py", HERE / "test_raster.py"],
        [HERE / "test_raster_stiff.py", "-k", "not 2d and not disc"],
        [HERE / "test_raster_stiff.py", "-k", "2d or disc"],
    ],
    ids=["random scenes", "stiff scenes", "stiff scenes of discs"],
)
def test_simulated(words):
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-p", "no:xdist", "--durations=5", *words],
        cwd=ROOT, env=os.environ | {"NUMBA_ENABLE_CUDASIM": "1"}, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert " passed" in done.stdout
