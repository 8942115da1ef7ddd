# SPDX-License-Identifier: GPL-3.0-or-later
"""The backend's environment: whether it is there, and the jobs that make it or check a Python of the user's.

No bpy, and no other process except in the jobs: `inspect` is asked while panels are drawn.
"""

from __future__ import annotations

import errno
import functools
import itertools
import json
import os
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from . import environment_worker as worker
from .backend_process import backend_environment
from .jobs import Job

ROOT = Path(__file__).resolve().parents[1]
REQUIREMENTS = ROOT / "requirements"
WORKER = Path(worker.__file__).resolve()

_AGAIN = "press Set Up Backend"
_removed = itertools.count()


@dataclass(frozen=True)
class EnvironmentState:
    """state: absent, incomplete, outdated, ready or broken; python: the environment's, where it may be run."""

    state: str
    python: Path | None
    sentence: str


def inspect(folder: str | Path) -> EnvironmentState:
    """What the folder of the environment holds, from a few files alone; cheap enough to ask at every redraw."""
    folder = Path(folder)
    python = worker.environment_python(folder)
    try:
        ours = worker.is_ours(folder)
    except OSError as error:
        return EnvironmentState("broken", None, f"{folder} cannot be read ({error.strerror}); see to its permissions.")
    if not ours:
        return EnvironmentState("broken", None, f"{folder} holds files that are not ObjectGS's; move them away.")
    if not (folder / worker.STAMP).is_file():
        return EnvironmentState("absent", None, f"The compute backend is not set up; {_AGAIN}.")
    try:
        ready = _ready(folder / worker.MARKER, (folder / worker.MARKER).stat().st_mtime_ns)
    except OSError:
        return EnvironmentState("incomplete", None, f"The set-up of the compute backend was not finished; {_AGAIN}.")
    if ready is None:
        return EnvironmentState("broken", None, f"{folder / worker.MARKER} cannot be read; {_AGAIN} again.")
    # The first is a link to the second, or on Windows a small program that starts it.
    if not python.exists() or not os.path.exists(ready["base"]):
        gone = ready["base"] if python.is_symlink() or python.exists() else python
        return EnvironmentState("broken", None, f"The backend's Python {gone} is gone; {_AGAIN} again.")
    if ready["requirements"] != _wanted(ready["device"]):
        return EnvironmentState(
            "outdated", None, f"The compute backend was set up for another version of ObjectGS; {_AGAIN} again.")
    found = f"Python {ready['python']}, PyTorch {ready['packages'].get('torch', '?')}"
    return EnvironmentState("ready", python, f"The compute backend is ready: {found}.")


@functools.lru_cache(4)
def _ready(path: Path, _changed: int) -> dict[str, Any] | None:
    """The marker, read again only when its file has changed; None where it is not as the set-up writes it."""
    try:
        ready = json.loads(path.read_text(encoding="utf-8"))
        shape = {"python": str, "base": str, "requirements": str, "packages": dict, "device": str}
        return ready if all(isinstance(ready[name], kind) for name, kind in shape.items()) else None
    except (ValueError, KeyError, TypeError):
        return None


@functools.lru_cache(2)
def _wanted(device: str) -> str:
    """The digest of this extension's requirements for a device; its files do not change while it is loaded."""
    return worker.requirements_digest(REQUIREMENTS, device)


def cache_folder(folder: str | Path) -> Path:
    """Where the kernels compiled for the environment in `folder` go: beside it, so that they outlive it."""
    return Path(folder).parent / "cache"


def set_up_job(base_python: str | Path, folder: str | Path, device: str) -> Job:
    """A job that makes the environment in `folder` for `device` (cpu or cuda), in the place of an earlier one."""
    return _job("Set up backend", "setup", base_python, folder, "setup", "--folder", str(folder), "--device", device)


def probe_job(python: str | Path, folder: str | Path) -> Job:
    """A job that checks whether a Python has what the backend needs, and tries the backend with it.

    folder: that of the environment, by which the job is found, and which need not be there.
    """
    return _job("Check backend", "doctor", python, folder, "probe")


def _job(title: str, kind: str, python: str | Path, folder: str | Path, *arguments: str) -> Job:
    silent = (f"{python} is no Python, or one older than {worker.OLDEST[0]}.{worker.OLDEST[1]}; choose a Python "
              f"{worker.VERSIONS}.")
    return Job(title=title, kind=kind, folder=Path(folder), cwd=ROOT, if_silent=silent,
               command=[str(python), str(WORKER), *arguments, "--requirements", str(REQUIREMENTS)],
               environment=backend_environment(cache_folder(folder)))


def remove(folder: str | Path) -> None:
    """Remove the environment; the folder is gone at once, its many files go in the background.

    Raises OSError where it is in use, or holds what the set-up did not make.
    """
    folder = Path(folder)
    if not os.path.lexists(folder):
        return
    own = {worker.STAMP, worker.MARKER, worker.MARKER + ".part", worker.VENV, worker.TEMPORARY}
    if not worker.is_ours(folder) or not own.issuperset(os.listdir(folder)):
        raise OSError(errno.ENOTEMPTY, "it holds files that are not ObjectGS's", str(folder))
    away = folder.with_name(f"{folder.name}{worker.REMOVED}{os.getpid()}-{next(_removed)}")
    folder.rename(away)
    threading.Thread(target=_finish_removing, args=(away,), daemon=True).start()


def _finish_removing(folder: Path) -> None:
    try:
        worker.remove_own(folder)
    except OSError:
        pass  # What is left bears the stamp, and the next set-up removes it.
