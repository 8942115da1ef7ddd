# SPDX-License-Identifier: GPL-3.0-or-later
"""Checks of the Python, the free disk space and the backend."""

from __future__ import annotations

import argparse
import ctypes
import importlib.metadata
import json
import os
import platform
import shutil
import struct
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from . import layout
from .events import Progress, Refused, emit, print_error
from .programs import run

_FATAL = ("Fatal Python error", "Windows fatal exception")
"""First words of what Python prints when it crashes."""
KERNEL_SECONDS = 60.0
"""Typical time of the compilation of the backend's kernels."""


def check_python() -> None:
    """Raise Refused if the backend's packages do not support this Python."""
    if not layout.OLDEST <= sys.version_info[:2] <= layout.NEWEST:
        raise Refused(
            f"{sys.executable} is Python {platform.python_version()}, and the backend needs {layout.VERSIONS}; "
            "choose such a Python, from python.org or your system's packages."
        )
    if struct.calcsize("P") != 8:
        raise Refused(f"{sys.executable} is a 32-bit Python, and the backend needs a 64-bit one; choose another.")


def check_place() -> None:
    """Raise Refused if this Python will be elsewhere later, or if Blender would not see the files that it writes."""
    base = getattr(sys, "_base_executable", None) or sys.executable
    if sys.platform == "darwin" and ("/AppTranslocation/" in base or _is_on_disk_image(base)):
        # An environment consists of links to this path.
        raise Refused(
            f"macOS runs Blender from a temporary place ({base}), where the backend would not find it later; move "
            "Blender into Applications with Finder, start it from there, and try again."
        )
    if sys.platform == "win32" and "\\WindowsApps\\PythonSoftwareFoundation.Python." in f"{base} {sys.base_prefix}":
        # Windows redirects what such a Python writes to the user's folder of settings.
        raise Refused(
            f"{sys.executable} is from the Microsoft Store, and Blender does not see the files that such a Python "
            "writes; choose a Python from python.org as Base Python, or clear that setting."
        )


def _is_on_disk_image(path: str) -> bool:
    """Return whether a path of macOS is on a disk image, which cannot be written to, unlike most external disks."""
    return path.startswith("/Volumes/") and bool(os.statvfs(path).f_flag & os.ST_RDONLY)


def check_can_make_environments() -> None:
    """Raise Refused if this Python cannot create environments; some systems package venv separately."""
    try:
        import ensurepip  # noqa: F401
        import venv  # noqa: F401
    except ImportError as error:
        package = f"python{sys.version_info[0]}.{sys.version_info[1]}-venv"
        raise Refused(
            f"{sys.executable} cannot make environments, since its module {error.name} is missing; install "
            f"it (on Debian and Ubuntu the package {package}) or choose another Python."
        ) from error


def check_space(folder: Path, device: str) -> None:
    """Raise Refused if the disk of `folder` has too little free space."""
    existing = next(parent for parent in (folder, *folder.parents) if parent.is_dir())
    free, needed = shutil.disk_usage(existing).free / 1e9, layout.GIGABYTES[device]
    if free < needed:
        has_earlier = (folder / layout.MARKER).exists() or (folder / layout.OLD_MARKER).exists()
        advice = "use Remove Backend first, or make" if has_earlier else "make"
        raise Refused(
            f"The backend needs about {needed:g} GB and the disk of {existing} has {free:.1f} GB free; {advice} "
            "room and try again."
        )


def check_runtime() -> None:
    """Raise Refused if Windows lacks the libraries of Visual C++, without which PyTorch cannot be loaded."""
    if sys.platform != "win32":
        return
    for name in ("vcruntime140.dll", "msvcp140.dll", "vcruntime140_1.dll"):
        try:
            ctypes.CDLL(name)
        except OSError as error:
            raise Refused(
                f"Windows lacks {name}, which PyTorch needs; install the Visual C++ Redistributable, "
                "https://aka.ms/vs/17/release/vc_redist.x64.exe, and try again."
            ) from error


def check_backend(python: Path, progress: Progress, stop: Callable[[], bool]) -> dict[str, Any]:
    """Run the backend's `doctor` command on a tiny scene, which also compiles the kernels; return its `done` event.

    Raises:
        Refused: the backend failed.
        Stopped: `stop` returned true.
    """
    output = _DoctorOutput(progress)
    code = run([str(python), "-m", "backend", "doctor", "--json"], stop, output.take, first=b"attached\n")
    if code != 0:
        # On Windows, a crash has a code such as 0xC0000005.
        how = f"signal {-code}" if code < 0 else f"exit code {code if code < 0xC0000000 else hex(code)}"
        raise Refused(
            f"The packages are installed, but the backend does not work with them ({how}): "
            f"{output.last_message.rstrip('.')}."
        )
    return output.result


class _DoctorOutput:
    """Converter from events of `doctor` to events of the worker."""

    def __init__(self, progress: Progress) -> None:
        self.progress = progress
        self.result: dict[str, Any] = {}
        self.last_message = "it said nothing"

    def take(self, line: str) -> None:
        """Process a line of output."""
        try:
            event = json.loads(line)
        except ValueError:
            event = None
        if not isinstance(event, dict):
            print_error(line)
            # The lines after that are those of a stack.
            if not self.last_message.startswith(_FATAL):
                self.last_message = line
            return
        kind, message = event.get("type"), str(event.get("message", ""))
        if kind == "status":
            self.progress.status(message)
        elif kind == "progress" and event.get("total"):
            self.progress.at(event["done"] / event["total"])
        elif kind == "warning":
            emit("warning", message=message)
        elif kind == "error":
            self.last_message = message
        elif kind == "done":
            self.result = event


def probe(options: argparse.Namespace, stop: Callable[[], bool]) -> None:
    """Check whether this Python has the backend's packages, then run the backend with it; raise Refused on failure."""
    check_python()
    missing, warnings = [], []
    for name in layout.REQUIREMENTS:
        for line in layout.requirement_lines(options.requirements / name):
            package, _, wanted = line.partition("==")
            try:
                found = importlib.metadata.version(package)
            except importlib.metadata.PackageNotFoundError:
                missing.append(package)
                continue
            if found.partition("+")[0] != wanted:
                warnings.append(f"{package} is version {found}; ObjectGS was tested with {wanted}.")
    if missing:
        files = " ".join(f'-r "{options.requirements / name}"' for name in layout.REQUIREMENTS)
        raise Refused(
            f"{sys.executable} lacks {' and '.join(filter(None, [', '.join(missing[:-1]), missing[-1]]))}; "
            f"install them (pip install {files}) or choose another Python."
        )
    for warning in warnings:
        emit("warning", message=warning)
    progress = Progress({"kernels": ("Compiling kernels", KERNEL_SECONDS)})
    progress.begin("kernels", "Starting the backend")
    checked = check_backend(Path(sys.executable), progress, stop)
    emit("done", message=checked.get("message", "The backend works."), machine=checked.get("machine", {}))
