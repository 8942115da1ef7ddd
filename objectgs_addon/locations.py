# SPDX-License-Identifier: GPL-3.0-or-later
"""Where things are: the extension's files, the user's folder, the backend's Python."""

import itertools
import os
import re
import sys
from collections.abc import Callable
from pathlib import Path

import bpy

from . import environment
from .backend_process import backend_command, backend_environment
from .environment_worker import VERSIONS
from .jobs import Job

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = __package__.rpartition(".")[0]


def preferences():
    """The add-on's preferences, or None where it was not enabled as an add-on (headless)."""
    addon = bpy.context.preferences.addons.get(PACKAGE)
    return addon.preferences if addon else None


def user_folder() -> Path:
    """The folder for what must outlive an update of the extension; made where it is not there."""
    if PACKAGE.startswith("bl_ext."):
        return Path(bpy.utils.extension_path_user(PACKAGE, create=True))
    return Path(bpy.utils.user_resource("DATAFILES", path="objectgs", create=True))


def environment_folder() -> Path:
    """Where the backend's own environment is set up."""
    return user_folder() / "environment"


def reconstructions_folder() -> Path:
    """Where reconstructions go unless the user says otherwise."""
    chosen = preferences().reconstructions if preferences() else ""
    return Path(bpy.path.abspath(chosen)) if chosen else user_folder() / "reconstructions"


def new_reconstruction(name: str, is_free: Callable[[Path], bool]) -> Path:
    """A folder for a reconstruction of this name, numbered until `is_free` says that it may be taken."""
    name = re.sub(r"[^\w.-]+", "_", name) or "capture"
    numbered = (name if number == 1 else f"{name}-{number}" for number in itertools.count(1))
    return next(folder for each in numbered if is_free(folder := reconstructions_folder() / each))


def backend_python() -> Path | None:
    """The Python that runs the backend: the user's, or the environment that was set up; None where there is none."""
    chosen = _chosen_python()
    if chosen is not None:
        return chosen if chosen.is_file() else None
    state = environment.inspect(environment_folder())
    return state.python if state.state == "ready" else None


def backend_sentence() -> str:
    """What there is to say about the backend: where it is, or why it cannot be run and what to do."""
    chosen = _chosen_python()
    if chosen is None:
        return environment.inspect(environment_folder()).sentence
    if chosen.is_file():
        return f"The backend is at {chosen}."
    return f"The backend's Python {chosen} does not exist; choose the program of a Python, or empty the field."


def _chosen_python() -> Path | None:
    """The Python that the user has chosen, whether it is there or not."""
    chosen = os.environ.get("OBJECTGS_PYTHON") or (preferences().backend_python if preferences() else "")
    return Path(bpy.path.abspath(chosen)) if chosen else None


def base_python() -> Path:
    """The Python that a new environment is made from: the user's choice, or Blender's own."""
    chosen = preferences().base_python if preferences() else ""
    return Path(bpy.path.abspath(chosen)) if chosen else Path(sys.executable)


def backend_job(title: str, kind: str, folder: Path | None, *arguments: str) -> Job:
    """A job that runs `python -m backend ARGUMENTS --json`; the backend must be there (`backend_python`)."""
    python = backend_python()
    silent = f"{python} cannot run the backend; choose a Python {VERSIONS} that has its packages, or set it up anew."
    cache = os.environ.get("NUMBA_CACHE_DIR") or user_folder() / "cache"
    return Job(title=title, kind=kind, folder=folder, command=backend_command(python, *arguments), cwd=ROOT,
               environment=backend_environment(cache), if_silent=silent)


def demo_folder() -> Path:
    """Where the demo capture goes."""
    return user_folder() / "demo-capture"


def demo_job() -> Job:
    """A job in which another Blender, without a window, renders the demo capture."""
    script = [str(ROOT / "headless.py"), "--", "demo", str(demo_folder()), "--json"]
    return Job(title="Make demo capture", kind="demo", folder=demo_folder(),
               command=[bpy.app.binary_path, "--background", "--factory-startup", "--python", *script], cwd=ROOT,
               environment={})
