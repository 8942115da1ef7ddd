"""The CUDA kernels in numba's simulator.

The simulator must be enabled before numba is imported, so each test runs other test files in a separate process.
"""

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
        [HERE / "simulated_cuda.py", HERE / "test_raster.py", HERE / "test_raster_properties.py"],
        pytest.param([HERE / "test_raster_stiff.py", "-k", "near_plane or needle or overflow"], marks=pytest.mark.long),
        pytest.param([HERE / "test_raster_stiff.py", "-k", "not gradcheck"], marks=pytest.mark.slow),
    ],
    ids=["random scenes", "some stiff scenes", "stiff scenes"],
)
def test_kernels_in_simulator(words):
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-p", "no:xdist", "--durations=5", *words],
        cwd=ROOT, env=os.environ | {"NUMBA_ENABLE_CUDASIM": "1"}, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert " passed" in done.stdout


def test_cpu_renderer_works_without_numba_cuda():
    """numba-cuda may be missing or fail on import."""
    script = """
import sys
sys.modules["numba.cuda"] = None
from tests.backend.test_raster import as_float32, camera, mapped, random_scene, rasterize
scene = {k: v.requires_grad_(k != "ids") for k, v in as_float32(random_scene(0)).items()}
rendered = rasterize(**scene, camera=camera())
rendered.color.sum().backward()
mapped(rendered)
print(type(rendered.frame).__module__)
"""
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True)
    assert (done.returncode, done.stdout.strip()) == (0, "backend.raster.cpu.renderer"), done.stderr
