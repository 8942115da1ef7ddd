# SPDX-License-Identifier: GPL-3.0-or-later
"""Resolve the backend's packages for each supported system, and write them with their hashes to `locked/`.

    python requirements/lock.py

Needs uv (`dev.txt`) and access to PyPI. Run it after each change of backend.txt or torch.txt. A system that lacks a
wheel of any package is refused. The files of a system:

    SYSTEM.txt       packages of every environment
    SYSTEM-cpu.txt   torch, where PyPI's build is the one for processors
    SYSTEM-cuda.txt  torch and its packages for NVIDIA GPUs, where PyPI's build is the one for these

Other builds of torch are not on PyPI; Set Up Backend installs them by version.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tempfile
import tomllib
from dataclasses import dataclass
from pathlib import Path

HERE = Path(__file__).resolve().parent
LOCKED = HERE / "locked"
SOURCES = ("backend.txt", "torch.txt")
PYTHONS = ("3.11", "3.12", "3.13")
GPU_PACKAGE = re.compile(r"nvidia-|cuda-|triton$")


@dataclass(frozen=True)
class System:
    """A supported system.

    Attributes:
        name: as in `objectgs_addon/environment/worker/layout.py`.
        marker: environment marker, with the terms in uv's order.
        platform: uv's name for it.
        torch: device (cpu or cuda) of PyPI's build of torch.
    """

    name: str
    marker: str
    platform: str
    torch: str


SYSTEMS = (
    System("linux-x86_64", "platform_machine == 'x86_64' and sys_platform == 'linux'", "x86_64-manylinux_2_28", "cuda"),
    System("macos-arm64", "platform_machine == 'arm64' and sys_platform == 'darwin'", "aarch64-apple-darwin", "cpu"),
    System(
        "windows-x86_64", "platform_machine == 'AMD64' and sys_platform == 'win32'", "x86_64-pc-windows-msvc", "cpu"
    ),
)


def main() -> None:
    """Write the locked files of all systems and remove those of others."""
    written = [path for system in SYSTEMS for path in lock(system)]
    for path in set(LOCKED.glob("*.txt")) - set(written):
        path.unlink()


def lock(system: System) -> list[Path]:
    """Resolve the packages of a system, write its files and return their paths."""
    with tempfile.TemporaryDirectory(prefix="objectgs-lock-") as scratch:
        project = Path(scratch)
        (project / "pyproject.toml").write_text(_project(system), encoding="utf-8")
        _uv(project, "lock")
        sources = _source_hashes(project / "uv.lock")
        everything = _export(project, system, sources)
        pruned = [option for name in everything if GPU_PACKAGE.match(name) for option in ("--prune", name)]
        common = _export(project, system, sources, *pruned)
    for_gpus = {name: everything[name] for name in everything.keys() - common.keys()}
    files = {"": common, "-cpu": {}, "-cuda": for_gpus}
    files[f"-{system.torch}"]["torch"] = common.pop("torch")
    paths = [_write(f"{system.name}{suffix}.txt", packages) for suffix, packages in files.items() if packages]
    for python in PYTHONS:
        _check_wheels(system, python, paths)
    print(f"{system.name}: {len(everything)} packages")
    return paths


def _project(system: System) -> str:
    """Return a pyproject.toml that requires the packages of all sources, for uv."""
    lines = [line for name in SOURCES for line in (HERE / name).read_text(encoding="utf-8").splitlines()]
    wanted = [line for line in lines if line and not line.startswith("#")]
    return (
        f'[project]\nname = "locked"\nversion = "0"\nrequires-python = ">={PYTHONS[0]},<3.{int(PYTHONS[-1][2:]) + 1}"\n'
        f"dependencies = {json.dumps(wanted)}\n"
        f"[tool.uv]\nenvironments = {json.dumps([system.marker])}\n"
        f"required-environments = {json.dumps([system.marker])}\n"
        'fork-strategy = "fewest"\nno-build = true\n'
    )


def _uv(folder: Path, *arguments: str) -> str:
    """Run uv in a folder and return its output."""
    command = [sys.executable, "-m", "uv", *arguments, "--quiet"]
    environment = {**os.environ, "MACOSX_DEPLOYMENT_TARGET": "14.0", "UV_PYTHON_DOWNLOADS": "never"}
    return subprocess.run(command, cwd=folder, env=environment, stdout=subprocess.PIPE, text=True, check=True).stdout


def _source_hashes(lock_file: Path) -> set[str]:
    """Return the hashes of source archives, which are never installed."""
    packages = tomllib.loads(lock_file.read_text(encoding="utf-8"))["package"]
    return {package["sdist"]["hash"] for package in packages if "sdist" in package}


def _export(project: Path, system: System, sources: set[str], *options: str) -> dict[str, str]:
    """Return the resolved packages: name -> entry of a requirements file with the hashes of all wheels."""
    text = _uv(project, "export", "--frozen", "--no-emit-project", "--no-annotate", "--no-header", *options)
    # A file is of one system, so the system's own marker says nothing; markers of Python versions stay.
    text = text.replace(f" ; {system.marker}", "").replace(f" and {system.marker}", "")
    packages: dict[str, str] = {}
    for line in text.splitlines():
        word = line.removesuffix("\\").strip()
        if not line.startswith(" "):
            name = word.partition("==")[0]
            assert name not in packages, f"{name} has different versions for different Pythons"
            packages[name] = word
        elif word.removeprefix("--hash=") not in sources:
            packages[name] += f" \\\n    {word}"
    return packages


def _write(name: str, packages: dict[str, str]) -> Path:
    LOCKED.mkdir(exist_ok=True)
    heading = "# Written by requirements/lock.py; do not edit.\n"
    path = LOCKED / name
    path.write_text(
        heading + "".join(f"{packages[name]}\n" for name in sorted(packages)), encoding="utf-8", newline="\n"
    )
    return path


def _check_wheels(system: System, python: str, paths: list[Path]) -> None:
    """Raise CalledProcessError unless all packages have wheels for this version of Python and fit together."""
    wanted = ["--python-platform", system.platform, "--python-version", python, "--only-binary", ":all:"]
    _uv(HERE, "pip", "compile", *wanted, *map(str, paths))


if __name__ == "__main__":
    main()
