"""What each command does. It takes the parsed options and a reporter, and leaves files in the reconstruction folder.

A module for each command; `folder`, `lock`, `record` and `machine` are what they share. Importing this brings in torch
and the rest, so `backend.arguments` does it only once there is something to do.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

from ..stopping import StoppingReporter
from . import (
    check,
    doctor,
    edit,
    evaluate,
    export,
    film,
    import_splats,
    importing,
    mesh,
    plan,
    render,
    report,
    train,
    vote,
)

COMMANDS: dict[str, Callable[[argparse.Namespace, StoppingReporter], None]] = {
    "check": check.check,
    "import": importing.import_capture,
    "plan": plan.plan,
    "vote": vote.vote,
    "train": train.train,
    "render": render.render,
    "mesh": mesh.mesh,
    "film": film.film,
    "edit": edit.edit,
    "export": export.export,
    "import-splats": import_splats.import_splats,
    "evaluate": evaluate.evaluate,
    "report": report.report,
    "doctor": doctor.doctor,
}
