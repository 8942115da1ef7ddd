"""The test of a GPU before its first use passes on this one."""

import pytest
import torch

pytest.importorskip("pycolmap")

from backend.commands.setup.self_test import problem_of
from backend.raster import devices

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no GPU")


def test_this_gpu_computes_what_the_cpu_computes(tmp_path):
    assert problem_of(devices.pick("cuda"), tmp_path) == ""
