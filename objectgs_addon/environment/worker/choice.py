# SPDX-License-Identifier: GPL-3.0-or-later
"""Choice of the packages for this system and device, and of the source of PyTorch."""

from __future__ import annotations

import platform
from dataclasses import dataclass
from pathlib import Path

from . import layout
from .events import Refused, emit
from .pip import Pip

MACOS = 14
"""Oldest macOS that all packages have wheels for."""
WHEELS = "https://download.pytorch.org/whl/"
_BUILDS = {"cpu": "cpu", "cuda": "cu130"}
"""Names of PyTorch's builds for the devices, and of the indexes that have them."""
_FALLBACKS = {
    "cpu": "PyTorch's builds for processors could not be reached, so its build for NVIDIA GPUs is installed, which "
    "also works without one but takes about {gigabytes:g} GB.",
    "cuda": "PyTorch's builds for NVIDIA GPUs could not be reached, so the one for processors is installed; set the "
    "backend up again when they can be reached.",
}


@dataclass(frozen=True)
class Choice:
    """Packages of an environment.

    Attributes:
        device: device of PyTorch's build: cpu or cuda.
        files: requirements with hashes.
        torch: arguments of pip for PyTorch itself, which has no hash; empty if the files contain it.
    """

    device: str
    files: list[Path]
    torch: list[str]


def check_system(requirements: Path, device: str) -> None:
    """Raise Refused if there are no locked packages for this system and device."""
    system, folder = layout.system(), requirements / layout.LOCKED
    computer = f"this computer ({platform.system()} {platform.machine()})"
    if not (folder / f"{system}.txt").is_file():
        names = sorted(path.stem for path in folder.glob("*.txt") if not path.stem.endswith(("-cpu", "-cuda")))
        raise Refused(
            f"The backend's packages are not available for {computer}, only for {', '.join(names)}; choose a Python "
            "for one of these, or a Python that already has the packages."
        )
    version = platform.mac_ver()[0]
    if version and int(version.partition(".")[0]) < MACOS:
        raise Refused(f"The backend's packages need macOS {MACOS} or newer, and this is {version}; update macOS.")
    if device == "cuda" and system.startswith("macos"):
        raise Refused(f"There are no packages for NVIDIA GPUs for {computer}; choose the device CPU.")


def choose(pip: Pip, requirements: Path, device: str, gigabytes: float) -> Choice:
    """Choose the packages for this system.

    PyPI has one build of PyTorch for each system, whose hashes are locked. The other build is in an index of its own,
    and is asked for by its exact version; if neither the user's indexes nor that one can be reached, PyPI's is taken.

    Args:
        pip: the pip of the environment.
        requirements: folder of the requirements.
        device: the device that the user chose.
        gigabytes: disk space that the build for NVIDIA GPUs takes.
    """
    files = layout.locked_files(requirements, device, layout.system())
    if _contain_torch(files):
        return Choice(device, files, [])
    torch, build = layout.requirement_lines(requirements / "torch.txt")[0], _BUILDS[device]
    for index in (None, WHEELS + build):
        if pip.offers(torch, build, index):
            return Choice(device, files, [*(["--index-url", index] if index else []), f"{torch}+{build}"])
    emit("warning", message=_FALLBACKS[device].format(gigabytes=gigabytes))
    other = "cuda" if device == "cpu" else "cpu"
    return Choice(other, layout.locked_files(requirements, other, layout.system()), [])


def _contain_torch(files: list[Path]) -> bool:
    return any(line.startswith("torch==") for path in files for line in layout.requirement_lines(path))
