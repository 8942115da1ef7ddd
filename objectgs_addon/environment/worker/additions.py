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
    """Install the packages of models.txt in this Python; the packages that it has keep their versions.

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
        kept.write_text("".join(f"{name}=={version}\n" for name, version in sorted(pip.packages.items())))
        pip.install(["-c", str(kept), "-r", str(wanted)], MEGABYTES)
    names = [re.split("[<>=]", line)[0] for line in layout.requirement_lines(wanted)]
    installed = [f"{name} {importlib.metadata.version(name)}" for name in names]
    emit("done", message=f"Installed {', '.join(installed)}.")
