# SPDX-License-Identifier: GPL-3.0-or-later
"""Packages for models in folders of the user, which are not part of the environment."""

from __future__ import annotations

import argparse
import importlib.metadata
import re
import sys
import sysconfig
import tempfile
from collections.abc import Callable
from pathlib import Path

from . import layout
from .events import Progress, emit
from .pip import Pip

MEGABYTES = 40.0
"""Size of the downloads in MB, for the progress."""


def add(options: argparse.Namespace, stop: Callable[[], bool]) -> None:
    """Install the packages of models.txt in this Python; those that the backend needs keep their versions.

    Raises:
        Refused: the packages cannot be installed.
        Stopped: `stop` returned true.
    """
    progress = Progress({"packages": ("Installing", 60.0)})
    progress.begin("packages", "Resolving the packages")
    wanted = options.requirements / layout.MODELS
    with tempfile.TemporaryDirectory(prefix="objectgs-", ignore_cleanup_errors=True) as name:
        temporary = Path(name)
        pip = Pip(Path(sys.executable), Path(sysconfig.get_path("purelib")), temporary, progress, stop)
        kept = temporary / "installed.txt"
        needed = _needed(options.requirements)
        pinned = {name: version for name, version in pip.packages.items() if _normalized(name) in needed}
        kept.write_text("".join(f"{name}=={version}\n" for name, version in sorted(pinned.items())))
        pip.install(["-c", str(kept), "-r", str(wanted)], MEGABYTES)
    names = [re.split("[<>=]", line)[0] for line in layout.requirement_lines(wanted)]
    installed = [f"{name} {importlib.metadata.version(name)}" for name in names]
    emit("done", message=f"Installed {', '.join(installed)}.")


def _needed(requirements: Path) -> set[str]:
    """Return the names of the packages that the backend needs, also those that others of them need."""
    paths = [*(requirements / name for name in layout.REQUIREMENTS), *(requirements / layout.LOCKED).glob("*.txt")]
    lines = [line for path in paths for line in layout.requirement_lines(path)]
    return {_normalized(found[0]) for line in lines if (found := re.match(r"[A-Za-z0-9][\w.-]*", line))}


def _normalized(name: str) -> str:
    """Return the name of a package as package indexes compare it."""
    return re.sub(r"[-_.]+", "-", name).lower()
