"""Kernels are compiled once for a machine; later processes start from numba's cache."""

import os
import re
import shutil
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from numba.core.caching import IndexDataCacheFile

from backend.raster import compile_kernels, kernel
from backend.raster.kernel import digest_of_code, locked

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
                rendered = rasterize(
                    **leaves, camera=cam, labels=labels, want_depth=wanted, want_median=wanted, want_normals=flat,
                    want_distortion=flat, primitive=primitive,
                )
                (rendered.color.sum() + (rendered.normals.sum() if flat else 0)).backward()
                object_map(rendered)
from backend.raster.cpu import binning, blending, blending_backward, ids, projection
for variants, kernels in (
    (1, (binning.depth_order, binning.bin_splats)),
    (2, (projection.project, projection.project_backward, blending.blend, blending_backward.blend_backward,
         ids.most_probable)),
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


def test_compile_kernels_reports_progress():
    seen = []
    assert compile_kernels(progress=lambda done, total: seen.append((done, total))) > 0
    assert seen == [(i, len(seen) - 1) for i in range(len(seen))]


@pytest.mark.long
def test_second_process_uses_cached_kernels():
    """Every call finds its kernel in the cache."""
    compile_kernels()
    run(DRAW)


@pytest.mark.skipif(os.name == "nt", reason="the user's cache folder is determined differently")
@pytest.mark.slow
def test_read_only_installation_uses_user_cache(tmp_path):
    """If the installation cannot be written to, the cache is in the user's cache folder."""
    copy_backend(tmp_path)
    for folder in ("raster", "raster/cpu"):
        (tmp_path / "backend" / folder / "__pycache__").write_text("blocks the cache folder for any user")
    script = """
import sys, numpy as np
sys.path.insert(0, sys.argv[1])
from backend.raster.cpu.binning import depth_order
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


@pytest.mark.slow
def test_change_of_any_package_file_invalidates_cache(tmp_path):
    """A constant of one file is compiled into kernels of other files."""
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
    constants = tmp_path / "backend" / "shared" / "splats" / "blending.py"
    constants.write_text(constants.read_text().replace("TAN_MARGIN = 0.3", "TAN_MARGIN = 0.5"))
    assert [limit(), limit()] == [[2.5, 0], [2.5, 1]]


def test_variants_that_are_saved_at_the_same_time_are_all_kept(tmp_path, monkeypatch):
    """Each has a file of its own, although all are saved after the index was read without any."""

    def read_slowly(self):
        found = IndexDataCacheFile._load_index(self)
        time.sleep(0.1)
        return found

    kind = locked(IndexDataCacheFile)
    monkeypatch.setattr(kind, "_load_index", read_slowly)
    files = [kind(str(tmp_path), "kernel", "stamp") for _ in range(4)]
    with ThreadPoolExecutor(len(files)) as pool:
        list(pool.map(lambda number: files[number].save(number, f"code {number}"), range(len(files))))
    assert [files[0].load(number) for number in range(len(files))] == [f"code {number}" for number in range(len(files))]


def test_variants_are_saved_where_files_cannot_be_locked(tmp_path, monkeypatch):
    def refused(*_, **_options):
        raise NotImplementedError

    monkeypatch.setattr(kernel, "FileLock", refused)
    file = locked(IndexDataCacheFile)(str(tmp_path), "kernel", "stamp")
    file.save(1, "code")
    assert file.load(1) == "code"


@pytest.mark.slow
def test_model_kernels_depend_only_on_lower_layers(tmp_path):
    copy_backend(tmp_path)
    script = """
import numpy as np
from backend.model.generate_on_cpu import _head_output
layer = np.zeros((1, 1, 33, 16), np.float32)
_head_output(np.zeros(32, np.float32), 0, layer, 0, np.zeros(16, np.float32))
print(sum(_head_output.stats.cache_hits.values()))
"""

    def hits():
        done = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return int(done.stdout)

    assert [hits(), hits()] == [0, 1]
    for changed, expected in (("training/settings.py", 1), ("raster/camera.py", 0), ("model/heads.py", 0)):
        path = tmp_path / "backend" / changed
        path.write_text(path.read_text() + "CHANGED = 1\n")
        assert hits() == expected, changed


@pytest.mark.parametrize(
    ("old", "new", "changes"),
    [
        ("@kernel()\ndef sh_basis", "# A comment.\n\n\n@kernel()\ndef sh_basis", False),
        ('"""Real spherical harmonics of', '"""Real harmonics of', False),
        ("    gx = gy = gz = 0.0\n", "    # A comment.\n    gx = gy = gz = 0.0\n", False),
        (
            "def sh_gradient(x, y, z, count, g):\n",
            'def sh_gradient(x, y, z, count, g):\n    """A docstring."""\n',
            False,
        ),
        ("if count > 9:", "if count > 8:", True),
        ("_C2 = (C2, -C2", "_C2 = (C2, C2", True),
        ("out[1] = -C1 * y", "out[1] = -C1 / y", True),
        ("out[2] = C1 * z", "out[2] = C1 * x", True),
    ],
)
def test_digest_ignores_comments_and_docstrings(old, new, changes):
    path = ROOT / "backend" / "raster" / "spherical_harmonics.py"
    text = path.read_text()
    without_docstring = re.sub(r'(def sh_gradient\(.*\n) +""".*"""\n', r"\1", text)
    assert old in without_docstring

    def digest(source):
        return digest_of_code(compile(source, path, "exec"))

    assert digest(without_docstring) == digest(text)
    assert (digest(without_docstring.replace(old, new)) != digest(text)) == changes


@pytest.mark.parametrize("place", ["{}\n", "class A:\n    {}\n    b = 1\n", "def f():\n    {}\n    return 1\n"])
def test_digest_excludes_all_docstrings(place):
    def digest(text):
        return digest_of_code(compile(place.format(repr(text)), "a.py", "exec"))

    assert digest("one docstring") == digest("another docstring")
    assert digest_of_code(compile("a = 'one'", "a.py", "exec")) != digest_of_code(compile("a = 'two'", "a.py", "exec"))
