"""The commands, one module each: functions of the parsed options and a reporter."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from importlib import import_module

from ..shared.stopping import StoppingReporter

_MODULES = {
    "sfm": "capture.sfm",
    "masks": "capture.masks",
    "check": "capture.check",
    "import": "capture.import_capture",
    "plan": "capture.plan",
    "vote": "capture.vote",
    "train": "training.train",
    "split": "cells.split",
    "train-cell": "cells.train_cell",
    "merge": "cells.merge",
    "propose": "objects.propose",
    "label": "objects.label",
    "clean-labels": "objects.clean_labels",
    "point": "objects.point",
    "render": "training.render",
    "mesh": "objects.mesh",
    "film": "objects.film",
    "edit": "objects.edit",
    "export": "objects.export",
    "import-splats": "capture.import_splats",
    "evaluate": "training.evaluate",
    "report": "training.report",
    "doctor": "setup.doctor",
}
"""Commands, and their modules, each with a function of the same name."""


def command_of(name: str) -> Callable[[argparse.Namespace, StoppingReporter], None]:
    """Import a command and return its function. It imports what this command needs, such as torch, and nothing else."""
    path = _MODULES[name]
    function: Callable[[argparse.Namespace, StoppingReporter], None] = getattr(
        import_module(f".{path}", __package__), path.rpartition(".")[2]
    )
    return function
