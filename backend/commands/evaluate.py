"""`evaluate`: figures of the held-out views, in evaluation.json."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from ..evaluation import evaluate as evaluate_views
from ..protocol import InputError, Reconstruction, plain, write_json
from ..raster.draw import draw
from ..stopping import StoppingReporter
from .folder import open_trained
from .record import stage


def evaluate(options: argparse.Namespace, reporter: StoppingReporter) -> None:
    """Measure on the held-out views; leaves evaluation.json, which `report` reads."""
    trained = open_trained(options, reporter)
    folder, capture = trained.folder, trained.capture
    if not capture.test_indices:
        raise InputError(f"{capture.folder} has too few views to hold any out; there is nothing to measure on.")
    reporter.status(f"Measuring on the {len(capture.test_indices)} held-out views")

    def drawn(index: int) -> tuple[np.ndarray, np.ndarray]:
        picture = draw(trained.model, trained.scene.camera(index))
        assert picture.ids is not None
        return picture.image, picture.ids

    with stage(folder, "evaluate"):
        found = evaluate_views(capture, drawn, capture.test_indices, reporter, trained.scene.zero_is_object)
    write_json(evaluation_file(folder), plain({"step": trained.progress.step, **found}))
    quality = {name: value for name, value in found["quality"].items() if value is not None}
    reporter.done(**{name: round(float(value), 4) for name, value in quality.items()})


def evaluation_file(folder: Reconstruction) -> Path:
    """Where `evaluate` leaves its figures."""
    return folder.folder / "evaluation.json"
