# SPDX-License-Identifier: GPL-3.0-or-later
"""Layout of an environment's folder, and the packages of the environment."""

from __future__ import annotations

import contextlib
import hashlib
import os
import platform
import shutil
import subprocess
import sysconfig
import tempfile
import time
from collections.abc import Iterable, Iterator
from pathlib import Path

MARKER = "ready.json"
STAMP = "objectgs-environment"
VENV = "venv"
OLD, OLD_MARKER = "venv-old", "ready-old.json"
"""An earlier environment and its marker, until the set-up of a new one is complete."""
TEMPORARY = "tmp"
REMOVED = ".removed-"
"""Infix of the name of a folder that is being removed."""

OLDEST, NEWEST = (3, 11), (3, 13)
VERSIONS = "3.11, 3.12 or 3.13"
REQUIREMENTS = ("torch.txt", "backend.txt")
MODELS = "models.txt"
"""File of the requirements with the packages for models in folders of the user."""
GIGABYTES = {"cpu": 2.5, "cuda": 9.0}
"""Free disk space in GB that the setup requires for the packages and their wheels."""
LOCKED = "locked"
"""Folder in that of the requirements with the packages of each system and their hashes."""


def environment_python(folder: Path) -> Path:
    """Return the path of the environment's Python, which may be missing."""
    return folder / VENV / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def system() -> str:
    """Return the system and processor of this Python, as in the names of locked files: linux-x86_64, macos-arm64."""
    # An emulated Python needs packages for the processor that is emulated.
    is_windows = platform.system() == "Windows"
    machine = sysconfig.get_platform().rpartition("-")[2] if is_windows else platform.machine()
    name = {"Darwin": "macos"}.get(platform.system(), platform.system().lower())
    return f"{name}-{machine.lower().replace('amd64', 'x86_64')}"


def locked_files(requirements: Path, device: str, system: str) -> list[Path]:
    """Return the files of locked packages for a device (cpu or cuda) that exist; none for an unsupported system."""
    paths = [requirements / LOCKED / f"{system}{part}.txt" for part in ("", f"-{device}")]
    return [path for path in paths if path.is_file()]


def requirements_digest(requirements: Path, device: str, system: str) -> str:
    """Return a digest of the packages and their hashes, without comments; raise OSError if files are missing."""
    paths = [requirements / "torch.txt", *locked_files(requirements, device, system)]
    lines = [line for path in paths for line in requirement_lines(path)]
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()[:16]


def requirement_lines(path: Path) -> list[str]:
    """Return the lines of a requirements file without comments and blank lines."""
    lines = (line.partition("#")[0].strip() for line in path.read_text(encoding="utf-8").splitlines())
    return [line for line in lines if line]


def is_ours(folder: Path) -> bool:
    """Return whether the setup may use `folder` and remove its own files: it is missing, empty, or has the stamp."""
    if folder.is_symlink() or not folder.is_dir():
        return not os.path.lexists(folder)
    return (folder / STAMP).is_file() or not any(folder.iterdir())


def remove_own(folder: Path, seconds: float = 10.0) -> None:
    """Remove the files of the setup from `folder`, then the folder itself if it is empty.

    The markers are removed first and the stamp last.

    Args:
        folder: folder of an environment.
        seconds: time to retry for, since files may be in use.

    Raises:
        OSError: files are still in use after that time.
    """
    for name in (MARKER, OLD_MARKER):
        (folder / name).unlink(missing_ok=True)
    remove_folders([folder / name for name in (VENV, OLD, TEMPORARY)], seconds)
    (folder / (MARKER + ".part")).unlink(missing_ok=True)
    (folder / STAMP).unlink(missing_ok=True)
    with contextlib.suppress(OSError):
        folder.rmdir()


def remove_folders(folders: Iterable[Path], seconds: float = 10.0) -> None:
    """Remove those of the folders that exist; `seconds` and errors are as for `remove_own`."""
    deadline: float | None = None
    for folder in folders:
        while os.path.lexists(folder):
            try:
                shutil.rmtree(long_path(folder))
            except OSError:
                # From the first failure on, since the removal itself may take long.
                deadline = deadline or time.monotonic() + seconds
                if time.monotonic() > deadline:
                    raise
                time.sleep(0.2)


def long_path(path: Path) -> str:
    """Return `path` as text, on Windows with the prefix that removes the limit on its length."""
    whole = str(path.absolute())
    return "\\\\?\\" + whole if os.name == "nt" and not whole.startswith("\\\\") else whole


@contextlib.contextmanager
def short_path(folder: Path) -> Iterator[Path]:
    """Yield a short path to `folder` on Windows, where most programs refuse paths of 260 characters or more.

    Blender's user folders are deep, and paths in packages have up to 171 characters. If no junction can be created,
    and on other systems, yield `folder`.
    """
    if os.name != "nt":
        yield folder
        return
    link = Path(tempfile.mkdtemp(prefix="ogs")) / "e"
    command = ["cmd", "/c", "mklink", "/J", str(link), str(folder)]
    made = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, check=False)
    try:
        yield folder if made.returncode else link
    finally:
        with contextlib.suppress(OSError):
            # This removes the junction, not its target.
            link.rmdir()
            link.parent.rmdir()
