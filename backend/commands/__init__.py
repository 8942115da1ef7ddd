"""The commands, one module each: functions of the parsed options and a reporter.

Importing this package imports torch, so `backend.cli.main` does it only after parsing the command line.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

from ..shared.stopping import StoppingReporter
from .capture import check, import_capture, import_splats, masks, plan, sfm, vote
from .cells import merge, split, train_cell
from .objects import clean_labels, edit, export, film, label, mesh, point, propose
from .setup import doctor
from .training import evaluate, render, report, train

COMMANDS: dict[str, Callable[[argparse.Namespace, StoppingReporter], None]] = {
    "sfm": sfm.sfm,
    "masks": masks.masks,
    "check": check.check,
    "import": import_capture.import_capture,
    "plan": plan.plan,
    "vote": vote.vote,
    "train": train.train,
    "split": split.split,
    "train-cell": train_cell.train_cell,
    "merge": merge.merge,
    "propose": propose.propose,
    "label": label.label,
    "clean-labels": clean_labels.clean_labels,
    "point": point.point,
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
