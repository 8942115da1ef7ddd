"""The GPU kernels: emulated on the CPU, compiled for GPUs, and launched through the driver's interface.

The tests of the CPU renderer run again, in processes of their own, in which a GPU is emulated.
"""

import ctypes
import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from backend.gpu import driver
from backend.gpu.kernel import SOURCE, source_of
from backend.raster.gpu.kernels import constants, raster_kernel

from .conftest import EMULATES, NO_EMULATOR

ROOT = Path(__file__).parents[2]
HERE = Path("tests") / "backend"
SURFACE = {"DEPTHS": True, "MEDIAN": False, "SURFACE": True, "NORMALS": True, "MOMENTS": True}
PLAIN = dict.fromkeys(SURFACE, False)
OF_ROWS = [{"COLUMNS": 10, "ROW": 16}, {"COLUMNS": 19, "ROW": 32}]
OF_ANCHORS = {"OFFSETS": 10, "FEATURES": 32, "LOG_EXTENT_MAX": 20.0, "RAW_OPACITY_MIN": 0.004}
OF_IMAGES = {"WINDOW": "{0.1f, 0.1f, 0.1f, 0.1f, 0.1f, 0.1f, 0.1f, 0.1f, 0.1f, 0.05f, 0.05f}", "FLOOR": 0.01}
OF_ADAM = {"BETA1": 0.9, "BETA2": 0.999, "EPSILON": 1e-15, "LARGEST_GRADIENT": 1e19}
VARIANTS = [
    *[("project", {"FLAT": flat, "COEFFICIENTS": count}) for flat in (False, True) for count in (1, 16)],
    ("write_keys", {}), ("order_equals", {}), ("count_intersections", {}),
    *[(name, {"TILE_ID": kind}) for name in ("write_intersections", "find_tiles") for kind in ("short", "int")],
    *[("rank_ids", {"FLAT": flat}) for flat in (False, True)],
    *[(name, {"FLAT": False, "LABELS": True, **PLAIN, **OF_ROWS[0]}) for name in ("blend", "blend_backward")],
    *[(name, {"FLAT": True, "LABELS": True, **SURFACE, **OF_ROWS[1]}) for name in ("blend", "blend_backward")],
    ("project_backward", {"FLAT": False, "NORMALS": False, "COEFFICIENTS": 1, **OF_ROWS[0]}),
    ("project_backward", {"FLAT": True, "NORMALS": True, "COEFFICIENTS": 16, **OF_ROWS[1]}),
    ("find_in_view", OF_ANCHORS), ("place_in_view", {}), ("add_statistics", {}),
    ("generate", {**OF_ANCHORS, "COEFFICIENTS": 4}),
    ("generate_backward", {**OF_ANCHORS, "COEFFICIENTS": 4, "THREADS_OF_GENERATE": 128}),
    *[(name, {"SSIM": has_ssim, **OF_IMAGES}) for name in ("image_loss", "image_loss_total", "image_loss_backward")
      for has_ssim in (False, True)],
    *[(name, {"FLAT": True}) for name in ("volume", "volume_backward")], ("volume_mean", {}), ("totals", {}),
    ("normal_loss", {"SOLID": 0.5, "GRAZING": 0.1}), ("normal_loss_backward", {}),
    ("step_rows", {**OF_ADAM, "ROWS_PER_BLOCK": 4}), ("step_tensors", {**OF_ADAM, "BLOCKS_PER_TENSOR": 8}),
    ("check_tensors", {"LARGEST_GRADIENT": 1e19}), ("find_usable", {}), ("load_target", {"LABEL": "signed char"}),
]  # fmt: skip


def text_of(name, variant):
    """Return the source text of a kernel."""
    of_raster = (SOURCE / "raster" / f"{name}.cu").exists()
    return source_of(name, {**(constants() if of_raster else {}), **variant})


@pytest.mark.skipif(not EMULATES, reason=NO_EMULATOR)
@pytest.mark.parametrize(
    "files",
    [["emulated_gpu.py", "test_raster.py"], ["test_raster_properties.py"], ["test_raster_stiff.py"]],
    ids=["random scenes", "properties", "stiff scenes"],
)
def test_emulated_kernels(files):
    """The tests of the CPU renderer, with the GPU renderer."""
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-p", "no:xdist", "--durations=5",
         *(HERE / file for file in files)],
        cwd=ROOT, env=os.environ | {"OBJECTGS_EMULATE_GPU": "1"}, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert " passed" in done.stdout


def test_every_kernel_is_compiled():
    assert {name for name, _ in VARIANTS} == {path.stem for path in SOURCE.rglob("*.cu")}


def all_kernels():
    """Return the text of all variants, each in a namespace of its own."""
    texts = []
    for number, (name, variant) in enumerate(VARIANTS):
        lines = text_of(name, variant).splitlines()
        macros = [line.split()[1].partition("(")[0] for line in lines if line.startswith("#define ")]
        text = "\n".join(lines).replace(f" {name}(", f" {name}_{number}(")
        texts.append(f"namespace kernel_{number} {{\n{text}\n}}\n" + "".join(f"#undef {macro}\n" for macro in macros))
    return "".join(texts)


@pytest.mark.skipif(not shutil.which("hipcc"), reason="needs AMD's compiler")
@pytest.mark.parametrize("architecture", ["gfx1030", "gfx90a"])
@pytest.mark.long
def test_kernels_compile_for_amd_gpus(architecture, tmp_path):
    source = tmp_path / "kernels.hip"
    source.write_text("#include <hip/hip_runtime.h>\n" + all_kernels())
    done = subprocess.run(
        ["hipcc", "--genco", f"--offload-arch={architecture}", "-std=c++17", "-o", tmp_path / "kernels.co", source],
        env=os.environ | {"HIP_PLATFORM": "amd", "HIP_CLANG_PATH": "/usr/bin"}, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr


@pytest.mark.skipif(not shutil.which("nvcc"), reason="needs NVIDIA's compiler")
@pytest.mark.parametrize("architecture", ["sm_75", "sm_90"])
def test_kernels_compile_for_nvidia_gpus(architecture, tmp_path):
    source = tmp_path / "kernels.cu"
    source.write_text(all_kernels())
    options = ["-cubin", f"-arch={architecture}", "--resource-usage", "-o", tmp_path / "kernels.cubin"]
    done = subprocess.run(["nvcc", *options, source], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    usage = done.stdout + done.stderr
    assert usage.count("bytes spill stores") >= len(VARIANTS)
    # What does not fit into registers would be kept in memory.
    assert usage.count(" 0 bytes spill stores, 0 bytes spill loads") == usage.count("bytes spill stores"), usage


class Machine:
    """Stands for NVRTC and the driver: keeps what is compiled and launched, and can fail."""

    def __init__(self, status=0):
        self.compiled, self.launched, self.status = [], [], status
        self.synchronized = self.needed = 0

    def synchronize(self):
        self.synchronized += 1

    def nvrtcCreateProgram(self, program, source, name, *_):
        program._obj.value = 7
        self.compiled.append((name.decode(), source.decode()))
        return 0

    def nvrtcCompileProgram(self, program, count, options):
        self.options = [options[i].decode() for i in range(count)]
        return self.status

    def nvrtcGetProgramLogSize(self, program, size):
        size._obj.value = len(b"line 7 is wrong") + 1

    def nvrtcGetProgramLog(self, program, log):
        log.value = b"line 7 is wrong"

    def nvrtcGetCUBINSize(self, program, size):
        size._obj.value = 4

    def nvrtcGetCUBIN(self, program, binary):
        binary.raw = b"code"

    def nvrtcDestroyProgram(self, program):
        return 0

    def cuModuleLoadData(self, module, binary):
        return 0 if binary == b"code" else 200

    def cuModuleGetFunction(self, function, module, name):
        function._obj.value = 9
        self.name = name.decode()
        return 0

    def cuGetErrorString(self, status, text):
        text._obj.value = b"out of memory"

    def cuLaunchKernel(self, function, *words):
        *sizes, shared, stream, pointers, extra = words
        values = [ctypes.cast(p, ctypes.POINTER(ctypes.c_uint64))[0] for p in pointers]
        self.launched.append((sizes, shared, stream.value, values, extra))
        return 201 if self.synchronized < self.needed else self.status


@pytest.fixture
def machine(monkeypatch, tmp_path):
    made = Machine()
    stream = SimpleNamespace(cuda_stream=1234, synchronize=made.synchronize)
    monkeypatch.setattr(driver.libraries, "_get_gpu_runtime_library", lambda: made)
    monkeypatch.setattr(driver.libraries, "_get_gpu_rtc_library", lambda: made)
    monkeypatch.setattr(torch.cuda, "init", lambda: None)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda: stream)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda: (8, 9))
    monkeypatch.setattr(driver.numba.config, "CACHE_DIR", str(tmp_path / "cache"))
    driver._compiler.cache_clear()
    raster_kernel.cache_clear()
    yield made
    driver._compiler.cache_clear()
    raster_kernel.cache_clear()


def write_keys():
    return raster_kernel("write_keys")


def test_kernel_is_compiled_once_and_launched_with_its_arguments(machine):
    splats, keys = torch.zeros(3, 12), torch.zeros(3, dtype=torch.int64)
    for _ in range(2):
        write_keys()(5, 128, splats, 3, keys)
    assert machine.launched == [
        ([5, 1, 1, 128, 1, 1], 0, 1234, [splats.data_ptr(), 3, keys.data_ptr()], None),
    ] * 2  # fmt: skip
    assert machine.name == "write_keys" and machine.options[0] == "--gpu-architecture=sm_89"
    ((name, source),) = machine.compiled
    assert name == "write_keys.cu" and "EMULATED 1" not in source and "ucontext" not in source
    # Another process finds the binary in the cache.
    raster_kernel.cache_clear()
    write_keys()(1, 128, splats, 3, keys)
    assert len(machine.compiled) == 1 and len(machine.launched) == 3


def test_damaged_binary_in_cache_is_compiled_again(machine, tmp_path):
    arguments = torch.zeros(3, 12), 3, torch.zeros(3, dtype=torch.int64)
    write_keys()(1, 32, *arguments)
    (kept,) = (tmp_path / "cache").iterdir()
    kept.write_bytes(b"damaged")
    raster_kernel.cache_clear()
    write_keys()(1, 32, *arguments)
    assert len(machine.compiled) == len(machine.launched) == 2 and kept.read_bytes() == b"code"


def test_thread_without_context_gets_one(machine):
    arguments = torch.zeros(3, 12), 3, torch.zeros(3, dtype=torch.int64)
    write_keys()(1, 32, *arguments)
    machine.needed = machine.synchronized + 1
    write_keys()(1, 32, *arguments)
    assert len(machine.launched) == 3 and machine.synchronized == machine.needed


def test_nothing_is_launched_for_no_elements(machine):
    write_keys().for_each(0, torch.zeros(1, 12), 0, torch.zeros(0, dtype=torch.int64))
    assert not machine.launched


@pytest.mark.parametrize(
    "arguments",
    [
        (torch.zeros(3, 12, dtype=torch.float64), 3, torch.zeros(3, dtype=torch.int64)),
        (torch.zeros(12, 3).T, 3, torch.zeros(3, dtype=torch.int64)),
        (torch.zeros(3, 12), 3, torch.zeros(3, dtype=torch.int32)),
        (torch.zeros(3, 12), torch.zeros(1), torch.zeros(3, dtype=torch.int64)),
        (torch.zeros(3, 12), None, torch.zeros(3, dtype=torch.int64)),
        (3, 3, torch.zeros(3, dtype=torch.int64)),
        (torch.zeros(3, 12), 3),
    ],
)
def test_arguments_of_other_types_are_rejected(machine, arguments):
    with pytest.raises(TypeError, match="write_keys"):
        write_keys()(1, 32, *arguments)
    assert not machine.launched


def test_errors_of_compiler_and_driver_are_passed_on(machine):
    arguments = torch.zeros(3, 12), 3, torch.zeros(3, dtype=torch.int64)
    write_keys()(1, 32, *arguments)
    machine.status = 2
    with pytest.raises(RuntimeError, match="CUDA error: out of memory"):
        write_keys()(1, 32, *arguments)
    with pytest.raises(RuntimeError, match="cannot be compiled:\nline 7 is wrong"):
        raster_kernel("order_equals")(1, 32, None, None, None, 3, None)


@pytest.mark.parametrize(("platform", "folder", "names"), [
    ("linux", "nvidia/cu13/lib", ["libnvrtc-builtins.so.13.0", "libnvrtc.so.13"]),
    ("win32", "torch/lib", ["nvrtc-builtins64_130.dll", "nvrtc64_130_0.dll"]),
])  # fmt: skip
def test_the_compiler_finds_its_second_library(machine, monkeypatch, tmp_path, platform, folder, names):
    """It is opened by its name alone when a kernel is compiled."""
    loaded = []
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(torch, "__file__", str(tmp_path / "torch" / "__init__.py"))
    monkeypatch.setattr(driver.sys, "platform", platform)
    monkeypatch.setattr(driver.ctypes, "CDLL", loaded.append)
    (tmp_path / folder).mkdir(parents=True)
    for name in (*names, "libnvrtc-builtins.alt.so.13.0", "nvrtc-builtins64_130.alt.dll"):
        (tmp_path / folder / name).write_bytes(b"")
    driver._compiler()
    assert loaded == [str(tmp_path / folder / name) for name in names]


def test_source_depends_on_constants_and_variant():
    """So that a binary in the cache is of the same constants."""
    flat, round_ = (text_of("blend", {"LABELS": True, **PLAIN, "FLAT": flat}) for flat in (True, False))
    assert "#define FLAT 1\n" in flat and "#define FLAT 0\n" in round_
    assert "#define ALPHA_MAX (0.99)\n" in flat and "U = 0, V = 1" in flat and "#include" not in flat
