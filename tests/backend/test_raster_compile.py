"""Kernels are compiled once for a machine; later processes start from numba's cache."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from backend.raster import compile_kernels

ROOT = Path(__file__).parents[2]

DRAW = """
import time
started = time.perf_counter()
import torch
imported = time.perf_counter()
import tests.backend.test_raster as scenes
from backend.raster import compile_kernels, object_map, rasterize
compile_kernels()
cam = scenes.camera()
for coefficients in (1, 4, 9, 16):
    scene = scenes.as_float32(scenes.random_scene(0, coefficients=coefficients))
    for labels in (None, torch.zeros(2 * cam.height, cam.width, dtype=torch.int64)[::2]):
        for wanted in (False, True):
            for primitive in ("3d", "2d"):
                leaves = {k: v.requires_grad_(k != "ids") for k, v in scene.items()}
                flat = wanted and primitive == "2d"
                picture = rasterize(
                    **leaves, camera=cam, labels=labels, want_depth=wanted, want_median=wanted, want_normals=flat,
                    want_distortion=flat, primitive=primitive,
                )
                (picture.color.sum() + (picture.normals.sum() if flat else 0)).backward()
                object_map(picture)
from backend.raster import cpu, cpu_bin, cpu_ids, cpu_project, cpu_tiles
for variants, kernels in (
    (1, (cpu_bin.depth_order, cpu_bin.bin_splats)),
    (2, (cpu_project.project, cpu_project.project_backward, cpu_tiles.blend, cpu_tiles.blend_backward,
         cpu_ids.most_probable)),
):
    for kernel in kernels:
        assert len(kernel.signatures) == variants, (kernel, kernel.signatures)
        assert not kernel.stats.cache_misses, kernel
print(time.perf_counter() - started, imported - started)
"""


def run(script, **environment):
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=ROOT, env=os.environ | environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return [float(word) for word in done.stdout.split()]


def copy_backend(place):
    shutil.copytree(ROOT / "backend", place / "backend", ignore=shutil.ignore_patterns("__pycache__"))


def test_progress_is_reported():
    seen = []
    assert compile_kernels(progress=lambda done, total: seen.append((done, total))) > 0
    assert seen == [(i, len(seen) - 1) for i in range(len(seen))]


def test_second_process_compiles_nothing():
    """Every way in which training and rendering call the kernels finds them in the cache, as `compile_kernels` has left
    them there: no kernel has more variants than that made, and none is compiled."""
    compile_kernels()
    run(DRAW)


@pytest.mark.skipif(os.name == "nt", reason="the user's cache folder is found another way")
def test_read_only_installation(tmp_path):
    """Where nothing can be written beside the kernels, the cache goes to the user's own folder."""
    copy_backend(tmp_path)
    (tmp_path / "backend" / "raster" / "__pycache__").write_text("in the way of a cache, whoever runs the test")
    script = """
import sys, numpy as np
sys.path.insert(0, sys.argv[1])
from backend.raster.cpu_bin import depth_order
depth_order(np.ones((1, 12), np.float32), np.zeros(1, np.int32))
print(sum(depth_order.stats.cache_hits.values()))
"""
    environment = {k: v for k, v in os.environ.items() if k not in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")}
    for hits in ("0", "1"):
        done = subprocess.run(
            [sys.executable, "-B", "-c", script, str(tmp_path)],
            env=environment | {"HOME": str(tmp_path / "home")}, capture_output=True, text=True,
        )  # fmt: skip
        assert (done.returncode, done.stdout.strip()) == (0, hits), done.stderr
    assert list((tmp_path / "home").rglob("*.nbi"))


def test_cache_is_renewed_when_any_file_of_the_package_changes(tmp_path):
    """A guard is a constant inside kernels of other files."""
    copy_backend(tmp_path)
    script = """
import sys, numpy as np
sys.path.insert(0, sys.argv[1])
from backend.raster.splats import tangent_limits
print(tangent_limits(1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 2.0, 2.0)[1], sum(tangent_limits.stats.cache_hits.values()))
"""

    def limit():
        done = subprocess.run([sys.executable, "-c", script, str(tmp_path)], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return [float(word) for word in done.stdout.split()]

    assert [limit(), limit()] == [[2.3, 0], [2.3, 1]]
    guards = tmp_path / "backend" / "blending.py"
    guards.write_text(guards.read_text().replace("TAN_MARGIN = 0.3", "TAN_MARGIN = 0.5"))
    assert [limit(), limit()] == [[2.5, 0], [2.5, 1]]


@pytest.mark.parametrize(
    ("changed", "renewed"), [("raster/camera.py", True), ("model/heads.py", True), ("training/settings.py", False)]
)
def test_a_models_kernels_are_renewed_with_what_lies_below_them(tmp_path, changed, renewed):
    copy_backend(tmp_path)
    script = """
import numpy as np
from backend.model.generate_on_cpu import _say
layer = np.zeros((1, 1, 33, 16), np.float32)
_say(np.zeros(32, np.float32), 0, layer, 0, np.zeros(16, np.float32))
print(sum(_say.stats.cache_hits.values()))
"""

    def hits():
        done = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return int(done.stdout)

    assert [hits(), hits()] == [0, 1]
    path = tmp_path / "backend" / changed
    path.write_text(path.read_text() + "# changed\n")
    assert hits() == (0 if renewed else 1)
