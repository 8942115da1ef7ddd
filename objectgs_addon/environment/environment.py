# SPDX-License-Identifier: GPL-3.0-or-later
"""State of the backend's environment, and jobs that create it or check another Python."""

from __future__ import annotations

import contextlib
import errno
import functools
import itertools
import json
import os
import shutil
import subprocess
import sys
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...backend.shared.formats.atomic import replace_file
from ..process.backend_process import backend_environment
from ..process.jobs import Job
from .extension import ROOT
from .worker import layout

REQUIREMENTS = ROOT / "requirements"
WORKER = Path(layout.__file__).resolve().parent
"""Program that creates environments: a folder with `__main__.py`."""

_removed = itertools.count()


@dataclass(frozen=True)
class EnvironmentState:
    """State of an environment.

    Attributes:
        state: absent, incomplete, outdated, ready or broken.
        python: Python of a ready environment, else None.
        sentence: description for the user.
        device: what a ready environment was set up for, cpu or cuda, else None.
    """

    state: str
    python: Path | None
    sentence: str
    device: str | None = None


def inspect(folder: str | Path, remedy: str = "press Set Up Backend") -> EnvironmentState:
    """Return the state of the environment in `folder`; reads few files, so panels can call this while drawing.

    Args:
        folder: folder of the environment.
        remedy: what the user can do if it is not ready.
    """
    folder = Path(folder)
    python = layout.environment_python(folder)
    try:
        ours = layout.is_ours(folder)
    except OSError as error:
        return EnvironmentState("broken", None, f"{folder} cannot be read ({error.strerror}); check its permissions.")
    if not ours:
        return EnvironmentState("broken", None, f"{folder} contains files that are not ObjectGS's; move them away.")
    if not (folder / layout.STAMP).is_file():
        return EnvironmentState("absent", None, f"The compute backend is not set up; {remedy}.")
    try:
        ready = _ready(folder / layout.MARKER, (folder / layout.MARKER).stat().st_mtime_ns)
    except OSError:
        return EnvironmentState("incomplete", None, f"The set-up of the compute backend is not complete; {remedy}.")
    if ready is None:
        return EnvironmentState("broken", None, f"{folder / layout.MARKER} cannot be read; {remedy} again.")
    # The environment's Python is a link to the base Python or, on Windows, a small program that starts it.
    if not python.exists() or not Path(ready["base"]).exists():
        gone = ready["base"] if python.is_symlink() or python.exists() else python
        return EnvironmentState("broken", None, f"The backend's Python {gone} is missing; {remedy} again.")
    # The environment's Python can be for another processor than Blender's.
    if ready["requirements"] != _wanted(ready["device"], ready.get("system") or layout.system()):
        return EnvironmentState(
            "outdated", None, f"The compute backend was set up for another version of ObjectGS; {remedy} again."
        )
    found = f"Python {ready['python']}, PyTorch {ready['packages'].get('torch', '?')}"
    return EnvironmentState("ready", python, f"The compute backend is ready: {found}.", ready["device"])


@functools.lru_cache(4)
def _ready(path: Path, _changed: int) -> dict[str, Any] | None:
    """Return the content of the marker, cached until the file changes; None if it is invalid."""
    try:
        ready = json.loads(path.read_text(encoding="utf-8"))
        shape = {"python": str, "base": str, "requirements": str, "packages": dict, "device": str}
        return ready if all(isinstance(ready[name], kind) for name, kind in shape.items()) else None
    except (ValueError, KeyError, TypeError):
        return None


@functools.lru_cache(2)
def _wanted(device: str, system: str) -> str:
    """Return the digest of this extension's packages for a device and a system."""
    return layout.requirements_digest(REQUIREMENTS, device, system)


def cache_folder(folder: str | Path) -> Path:
    """Return the folder for compiled kernels: NUMBA_CACHE_DIR, else beside the environment, to survive a new setup."""
    return Path(os.environ.get("NUMBA_CACHE_DIR") or Path(folder).parent / "cache")


def find_python() -> Path:
    """Return a Python that the setup supports: Blender's own, else the newest in the PATH, else Blender's own.

    Linux distributions build Blender with the Python of their system, which may be newer than the supported ones.
    """
    if layout.OLDEST <= sys.version_info[:2] <= layout.NEWEST:
        return Path(sys.executable)
    for minor in range(layout.NEWEST[1], layout.OLDEST[1] - 1, -1):
        found = shutil.which(f"python3.{minor}")
        if found is not None and _runs(found):
            return Path(found)
    return Path(sys.executable)


def _runs(python: str) -> bool:
    """Return whether a program starts; a version manager's link may belong to a version that is not installed."""
    try:
        return subprocess.run([python, "-c", ""], capture_output=True, timeout=10).returncode == 0
    except (OSError, subprocess.TimeoutExpired):
        return False


def set_up_job(base_python: str | Path, folder: str | Path, device: str) -> Job:
    """Return a job that creates the environment in `folder` for `device` (cpu or cuda), replacing an earlier one."""
    return _job("Set up backend", "setup", base_python, folder, "setup", "--folder", str(folder), "--device", device)


def probe_job(python: str | Path, folder: str | Path) -> Job:
    """Return a job that checks whether a Python has the backend's packages, and runs the backend with it.

    Args:
        python: the Python to check.
        folder: folder of the environment; it identifies the job and may be missing.
    """
    return _job("Check backend", "doctor", python, folder, "probe")


def add_models_job(python: str | Path, folder: str | Path) -> Job:
    """Return a job that installs the packages for models in a Python; `folder` is as for `probe_job`."""
    return _job("Install Transformers", "packages", python, folder, "add")


def _job(title: str, kind: str, python: str | Path, folder: str | Path, *arguments: str) -> Job:
    silent = (
        f"{python} is not a Python, or it is older than {layout.OLDEST[0]}.{layout.OLDEST[1]}; choose a Python "
        f"{layout.VERSIONS}."
    )
    return Job(
        title=title,
        kind=kind,
        folder=Path(folder),
        cwd=ROOT,
        if_silent=silent,
        command=[str(python), str(WORKER), *arguments, "--requirements", str(REQUIREMENTS)],
        environment=backend_environment(cache_folder(folder)),
    )


def remove(folder: str | Path) -> None:
    """Remove the environment: rename the folder immediately, and delete its many files in the background.

    Raises:
        OSError: the folder is in use, or contains files that the setup did not create.
    """
    folder = Path(folder)
    if not os.path.lexists(folder):
        return
    own = {
        layout.STAMP, layout.MARKER, layout.MARKER + ".part", layout.OLD_MARKER, layout.VENV, layout.OLD,
        layout.TEMPORARY,
    }  # fmt: skip
    if not layout.is_ours(folder) or not own.issuperset(path.name for path in folder.iterdir()):
        raise OSError(errno.ENOTEMPTY, "it contains files that are not ObjectGS's", str(folder))
    away = folder.with_name(f"{folder.name}{layout.REMOVED}{os.getpid()}-{next(_removed)}")
    # A process that was ended just now may not have let go of its files yet, on Windows.
    replace_file(folder, away)
    threading.Thread(target=_finish_removing, args=(away,), daemon=True).start()


def _finish_removing(folder: Path) -> None:
    # On failure, the remaining files and the stamp are left for the next setup to remove.
    with contextlib.suppress(OSError):
        layout.remove_own(folder)
