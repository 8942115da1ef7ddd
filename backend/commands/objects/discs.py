"""The model that meshes are made of: discs, which are fitted once to a training of 3D Gaussians and kept."""

from __future__ import annotations

import argparse
import shutil
import time
from typing import Any

from ...model.object_model import ObjectModel
from ...shared.errors import InputError
from ...shared.events import Reporter
from ...shared.stopping import StoppingReporter
from ...training.fine_tuning.fit_discs import begin_discs, budget_of_discs, digest_of_model
from ...training.trainer import Trainer
from ..folder import Trained, memory_for_targets
from ..stages import finish_stage

DISCS = "discs"
"""Name of the fit among the parts of a command, and of its stage."""

_PREFIX = "discs-"


def seconds_of_discs(trained: Trained) -> float:
    """Return the expected duration of the fit in seconds, 0 if the model is meshed as it is."""
    progress = trained.progress
    if not _needs_discs(trained):
        return 0.0
    return (budget_of_discs(progress.step).steps or 0) * progress.seconds / progress.step


def model_of_discs(trained: Trained, options: argparse.Namespace, reporter: StoppingReporter) -> ObjectModel:
    """Return the model of discs, fitted if that has not been done for this state of the training.

    Models of discs, and models that depend on the view, are returned as they are.

    Args:
        trained: The reconstruction, locked by this process, whose scene has corrected masks.
        options: With the limit of memory.
        reporter: Receives the progress.

    Raises:
        Cancelled: A stop was requested; the fit so far is kept and continued next time.
    """
    model, cache = trained.model, trained.folder.cache
    if not _needs_discs(trained):
        return model
    folder = cache / f"{_PREFIX}{digest_of_model(model)}"
    for other in cache.glob(f"{_PREFIX}*"):
        if other != folder:
            shutil.rmtree(other, ignore_errors=True)
    capture, memory, gains = trained.scene.capture, memory_for_targets(options), trained.scene.gains
    try:
        resumed = Trainer.resume(capture, folder, None, memory, model.device, gains)
    except InputError:
        # A damaged fit is made anew, as it can be computed again.
        shutil.rmtree(folder, ignore_errors=True)
        resumed = None
    trainer = resumed[0] if resumed else begin_discs(model, capture, trained.folder.checkpoint, memory, gains)
    budget = budget_of_discs(trained.progress.step)
    if budget.progress(trainer.progress) < 1.0:
        reporter.begin(DISCS, "Fitting discs for the meshes")
        started = time.monotonic()
        trainer.run(budget, folder, _Fit(reporter.reporter), stop=reporter.stop)
        finish_stage(trained.folder, DISCS, time.monotonic() - started)
    return trainer.shown


def _needs_discs(trained: Trained) -> bool:
    return trained.model.explicit and trained.model.primitive == "3d" and trained.progress.step > 0


class _Fit(Reporter):
    """Forwards the progress of a training without its figures, which are not those of the model."""

    def __init__(self, reporter: Reporter) -> None:
        self._reporter = reporter

    def warning(self, message: str) -> None:
        self._reporter.warning(message)

    def progress(self, done: float, total: float, **fields: Any) -> None:
        self._reporter.progress(done, total, seconds_left=fields["seconds_left"])
