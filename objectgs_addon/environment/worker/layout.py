# SPDX-License-Identifier: GPL-3.0-or-later
"""The folder of an environment, and the requirements that it is made from."""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

MARKER = "ready.json"
STAMP = "objectgs-environment"
VENV = "venv"
TEMPORARY = "tmp"
REMOVED = ".removed-"
"""Appended to the name of a folder that is being removed."""

OLDEST, NEWEST = (3, 11), (3, 13)
VERSIONS = "3.11, 3.12 or 3.13"
REQUIREMENTS = ("torch.txt", "backend.txt")
CUDA_REQUIREMENTS = "cuda.txt"
"""Additional requirements of an environment for NVIDIA GPUs."""


def environment_python(folder: Path) -> Path:
    """The path of the environment's Python, whether it exists or not."""
    return folder / VENV / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def requirement_files(requirements: Path, device: str) -> list[Path]:
    """The requirement files for a device (cpu or cuda), torch first."""
    return [requirements / name for name in (*REQUIREMENTS, *([CUDA_REQUIREMENTS] if device == "cuda" else []))]


def requirements_digest(requirements: Path, device: str) -> str:
    """A digest of the requirements without comments and blank lines. Raises OSError if files are missing."""
    lines = [line for path in requirement_files(requirements, device) for line in requirement_lines(path)]
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()[:16]


def requirement_lines(path: Path) -> list[str]:
    """The requirements in a file, as `name==version`."""
    lines = (line.partition("#")[0].strip() for line in path.read_text(encoding="utf-8").splitlines())
    return [line for line in lines if line]


def is_ours(folder: Path) -> bool:
    """Whether the set-up may use `folder` and remove its files there: it is missing, empty, or has the stamp."""
    if folder.is_symlink() or not folder.is_dir():
        return not os.path.lexists(folder)
    return (folder / STAMP).is_file() or not any(folder.iterdir())


def remove_own(folder: Path, seconds: float = 10.0) -> None:
    """Remove the files of the set-up from `folder`, and the folder itself if that leaves it empty.

    The marker is removed first and the stamp last.

    Args:
        folder: folder of an environment.
        seconds: time to retry while files are in use.

    Raises:
        OSError: files are still in use after that time.
    """
    deadline = time.monotonic() + seconds
    (folder / MARKER).unlink(missing_ok=True)
    for name in (VENV, TEMPORARY):
        while os.path.lexists(folder / name):
            try:
                shutil.rmtree(long_path(folder / name))
            except OSError:
                if time.monotonic() > deadline:
                    raise
                time.sleep(0.2)
    (folder / (MARKER + ".part")).unlink(missing_ok=True)
    (folder / STAMP).unlink(missing_ok=True)
    with contextlib.suppress(OSError):
        folder.rmdir()


def long_path(path: Path) -> str:
    """`path` in the form that has no limit of length on Windows."""
    whole = str(path.absolute())
    return "\\\\?\\" + whole if os.name == "nt" and not whole.startswith("\\\\") else whole


@contextlib.contextmanager
def short_path(folder: Path) -> Iterator[Path]:
    """`folder` under a short name on Windows, whose programs by default refuse paths from 260 characters on.

    Blender's user folders are deep, and names in packages have up to 171 characters.
    """
    if os.name != "nt":
        yield folder
        return
    link = Path(tempfile.mkdtemp(prefix="ogs")) / "e"
    made = subprocess.run(["cmd", "/c", "mklink", "/J", str(link), str(folder)], capture_output=True, check=False)
    try:
        yield folder if made.returncode else link
    finally:
        with contextlib.suppress(OSError):
            # This removes the junction and not its target.
            link.rmdir()
            link.parent.rmdir()
