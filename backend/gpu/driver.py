"""Compilation of kernels for a GPU by NVRTC, or HIPRTC on AMD's, and their launch; both come with torch.

torch finds the libraries, and gives those of AMD the names of NVIDIA's functions. Compiled kernels are kept in numba's
cache folder, which only this user can write.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import torch
from torch.cuda import _utils as libraries

from ..shared.formats.atomic import write_atomic

_NO_CONTEXT = 201
"""Status of the driver in a thread that has no context of the GPU yet."""


def load(name: str, source: str) -> Callable[[Any, int, int], None]:
    """Compile a kernel for the current GPU, or take it from the cache.

    Args:
        name: the kernel.
        source: its complete source text.

    Returns:
        A function with the arguments (pointers to the arguments, blocks, threads per block) that launches the kernel in
        torch's current stream.

    Raises:
        RuntimeError: the kernel cannot be compiled, loaded or launched.
    """
    torch.cuda.init()
    # The driver's functions work on the context of the calling thread, which torch sets with its first operation.
    torch.cuda.current_stream().synchronize()
    driver = libraries._get_gpu_runtime_library()
    module, function = ctypes.c_void_p(), ctypes.c_void_p()
    if driver.cuModuleLoadData(ctypes.byref(module), _binary_of(name, source)):
        # A file in the cache may be damaged.
        _check(driver, driver.cuModuleLoadData(ctypes.byref(module), _binary_of(name, source, again=True)))
    _check(driver, driver.cuModuleGetFunction(ctypes.byref(function), module, name.encode()))
    run, current_stream, pointer = driver.cuLaunchKernel, torch.cuda.current_stream, ctypes.c_void_p

    def launch(pointers: Any, blocks: int, threads: int) -> None:
        stream = pointer(current_stream().cuda_stream)
        status = run(function, blocks, 1, 1, threads, 1, 1, 0, stream, pointers, None)
        if status == _NO_CONTEXT:
            # The first operation of a thread, for which torch makes one.
            current_stream().synchronize()
            status = run(function, blocks, 1, 1, threads, 1, 1, 0, stream, pointers, None)
        if status:
            _check(driver, status)

    return launch


def _check(driver: ctypes.CDLL, status: int) -> None:
    if not status:
        return
    text = ctypes.c_char_p()
    if torch.version.hip:
        driver.cuGetErrorString.restype = ctypes.c_char_p
        text.value = driver.cuGetErrorString(status)
    else:
        driver.cuGetErrorString(status, ctypes.byref(text))
    raise RuntimeError(f"CUDA error: {text.value.decode() if text.value else status}")


def _binary_of(name: str, source: str, again: bool = False) -> bytes:
    """Return a kernel's machine code for the current GPU; `again`: not from the cache."""
    option, compiler = _target(), _compiler()
    version = torch.version.hip or torch.version.cuda
    digest = hashlib.sha256(f"{option} {version} {source}".encode()).hexdigest()[:24]
    kept = Path(numba.config.CACHE_DIR) / f"objectgs-{name}-{digest}.bin" if numba.config.CACHE_DIR else None
    if kept and not again:
        with contextlib.suppress(OSError):
            return kept.read_bytes()
    binary = compile_source(compiler, name, source, [option])
    if kept:
        # Without a writable cache, kernels are compiled in each process.
        with contextlib.suppress(OSError):
            kept.parent.mkdir(parents=True, exist_ok=True)
            write_atomic(kept, binary)
    return binary


def _target() -> str:
    """Return the compiler's option for the architecture of the current GPU."""
    if torch.version.hip:
        return f"--offload-arch={torch.cuda.get_device_properties().gcnArchName}"
    major, minor = torch.cuda.get_device_capability()
    return f"--gpu-architecture=sm_{major}{minor}"


@functools.cache
def _compiler() -> ctypes.CDLL:
    """Return the library NVRTC or HIPRTC: of torch where it has one, since another may be older."""
    if torch.version.cuda:
        major, packages = torch.version.cuda.partition(".")[0], Path(torch.__file__).parents[1]
        name, second = f"libnvrtc.so.{major}", f"libnvrtc-builtins.so.{major}*"
        if sys.platform == "win32":
            name, second = f"nvrtc64_{major}0_0.dll", f"nvrtc-builtins64_{major}*[0-9].dll"
        for folder in ("torch/lib", "nvidia/*/lib", "nvidia/*/bin", "nvidia/*/bin/*"):
            for path in sorted(packages.glob(f"{folder}/{name}")):
                # Which NVRTC opens by its name alone, and so finds only where it is loaded already.
                for beside in sorted(path.parent.glob(second)):
                    with contextlib.suppress(OSError):
                        ctypes.CDLL(str(beside))
                with contextlib.suppress(OSError):
                    return ctypes.CDLL(str(path))
    try:
        return libraries._get_gpu_rtc_library()
    except OSError as error:
        raise RuntimeError(f"the compiler of GPU kernels is missing, which comes with PyTorch ({error})") from error


def compile_source(compiler: ctypes.CDLL, name: str, source: str, options: list[str]) -> bytes:
    """Compile source text to machine code.

    Args:
        compiler: the library NVRTC, or HIPRTC with the names of NVRTC's functions.
        name: the kernel, for messages.
        source: its complete source text.
        options: options of the compiler, with the architecture.

    Raises:
        RuntimeError: the text cannot be compiled; with the compiler's messages.
    """
    given = [option.encode() for option in (*options, "--std=c++17")]
    program, size = ctypes.c_void_p(), ctypes.c_size_t()
    status = compiler.nvrtcCreateProgram(ctypes.byref(program), source.encode(), f"{name}.cu".encode(), 0, None, None)
    if status:
        raise RuntimeError(f"the compiler of GPU kernels does not start (error {status})")
    try:
        if compiler.nvrtcCompileProgram(program, len(given), (ctypes.c_char_p * len(given))(*given)):
            compiler.nvrtcGetProgramLogSize(program, ctypes.byref(size))
            log = ctypes.create_string_buffer(size.value)
            compiler.nvrtcGetProgramLog(program, log)
            raise RuntimeError(f"the kernel {name} cannot be compiled:\n{log.value.decode(errors='replace')}")
        compiler.nvrtcGetCUBINSize(program, ctypes.byref(size))
        binary = ctypes.create_string_buffer(size.value)
        compiler.nvrtcGetCUBIN(program, binary)
        return binary.raw
    finally:
        compiler.nvrtcDestroyProgram(ctypes.byref(program))
