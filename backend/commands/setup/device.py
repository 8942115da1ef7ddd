"""The device that a command computes on: a GPU only where it computes what the CPU computes.

Before a GPU is used for the first time, and again after a change of its driver, of PyTorch or of the kernels, a process
of its own tests it (see `self_test`). The outcome is kept beside the compiled kernels.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import torch

from ...gpu.kernel import digest_of_sources
from ...raster import devices
from ...raster.kernel import digest_up_to
from ...shared.errors import InputError
from ...shared.events import Reporter
from ...shared.formats.json_file import read_json, write_json
from .kernels import path_beside_kernels

_ROOT = Path(__file__).parents[3]
_TEST = (sys.executable, "-m", "backend.commands.setup.self_test")
_LONGEST, _POLLED_EVERY, _ENDS_WITHIN = 900.0, 0.3, 10.0
"""Seconds after which the test has failed, as it compiles kernels, too, between two looks at it, and for its end."""
_PASSING = re.compile(
    r"out.of.memory|of memory free|_ALLOC_FAILED|MemoryError|not enough memory|Errno (?:12|28)\b"
    r"|WinError (?:8|14|112|1455)\b|busy or unavailable|^KeyboardInterrupt"
    r"|^it ended with exit code (?:-2|-9|-15|3221225786)$",
    re.IGNORECASE,
)
"""Problems that are not the GPU's: other programs use it or its memory, the computer's memory, page file or disk is
full, or the test was ended by the user or the system (with SIGINT, SIGKILL, SIGTERM or, on Windows, an interrupt)."""

_ERROR = re.compile(r"[\w.]*(?:Error|Exception|Interrupt)\b")
"""Beginning of the line in which Python names the error that ends a process."""


def choose_device(requested: str, reporter: Reporter, again: bool = False) -> torch.device:
    """Choose the device to compute on, and test it if it is a GPU that was not tested before.

    Args:
        requested: "cpu", "cuda", or "auto": CUDA if it is available and passes the test, otherwise the CPU.
        reporter: Receives status and a warning if the GPU fails; its progress is called repeatedly during the test, so
            that it can stop the command.
        again: Whether to repeat the test.

    Returns:
        The torch device; of a GPU, torch then says when its memory is full.

    Raises:
        InputError: `requested` is "cuda", and CUDA is not available or fails the test.
    """
    device = devices.pick(requested)
    if device.type == "cpu":
        if requested == "auto" and (reason := devices.refused_gpu()):
            reporter.warning(f"{reason} The CPU is used.")
        return device
    problem = None if again else _known_problem(device)
    if problem is None:
        reporter.status(f"Testing {devices.name_of(device)}, once")
        problem = _test(device, reporter)
        # Without a writable folder, the next command tests again, too.
        if not _PASSING.search(problem):
            with contextlib.suppress(OSError):
                write_json(_outcome(device), {"problem": problem})
    if not problem:
        devices.limit_memory(device)
        return device
    failure = f"{devices.name_of(device)} fails a test ({problem})"
    if requested == "cuda":
        raise InputError(
            f"{failure}; choose --device cpu, or install a newer driver of the GPU; `doctor` tests it again."
        )
    reporter.warning(f"{failure}, so the CPU is used; a newer driver of the GPU may help, and `doctor` tests it again.")
    return devices.CPU


def _known_problem(device: torch.device) -> str | None:
    """Return the outcome of an earlier test, "" for a GPU that passed; None if there was none."""
    with contextlib.suppress(InputError, KeyError, TypeError):
        return str(read_json(_outcome(device))["problem"])
    return None


def _outcome(device: torch.device) -> Path:
    """Return the path of the outcome, which changes with all that the results depend on."""
    versions = (torch.__version__, digest_up_to("training"), digest_of_sources(), _driver())
    return path_beside_kernels(".device.json", *versions, devices.name_of(device))


def _driver() -> str:
    """Return the version of NVIDIA's driver, "" where it cannot be found out."""
    with contextlib.suppress(OSError, AttributeError):
        library = ctypes.CDLL("nvml.dll" if sys.platform == "win32" else "libnvidia-ml.so.1")
        text = ctypes.create_string_buffer(80)
        library.nvmlInit_v2()
        if not library.nvmlSystemGetDriverVersion(text, len(text)):
            return text.value.decode(errors="replace")
    return ""


def _test(device: torch.device, reporter: Reporter) -> str:
    """Test a GPU in a process of its own, and return its problem, for a sentence; "" if there is none."""
    with tempfile.TemporaryDirectory(prefix="objectgs-device-", ignore_cleanup_errors=True) as scratch:
        printed, errors = Path(scratch) / "printed.txt", Path(scratch) / "errors.txt"
        with printed.open("wb") as output, errors.open("wb") as stream:
            process = subprocess.Popen(
                [*_TEST, str(Path(scratch) / "files"), str(device.index or 0)], cwd=_ROOT,
                stdin=subprocess.DEVNULL, stdout=output, stderr=stream,
            )  # fmt: skip
            try:
                until = time.monotonic() + _LONGEST
                while process.poll() is None:
                    if time.monotonic() > until:
                        return f"it did not end in {_LONGEST / 60:.0f} minutes"
                    reporter.progress(0, 1)
                    time.sleep(_POLLED_EVERY)
                # An interrupt in a terminal ends the test, too, and is no failure of it.
                reporter.progress(0, 1)
            finally:
                process.kill()
                # A driver that blocks keeps the process from ending.
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(timeout=_ENDS_WITHIN)
        with contextlib.suppress(ValueError, IndexError, KeyError, TypeError):
            return str(json.loads(printed.read_bytes().splitlines()[-1])["problem"])
        lines = errors.read_text(errors="replace").strip().splitlines()
        # torch's errors have further lines, which advise programmers.
        last = next((line for line in reversed(lines) if _ERROR.match(line)), lines[-1] if lines else "")
        return last.strip().rstrip(".") or f"it ended with exit code {process.returncode}"
