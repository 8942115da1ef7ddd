"""`evaluate`: measure splats and meshes on the held-out views, into evaluation.json."""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np

from ...evaluation import evaluate as evaluate_views
from ...evaluation.meshes import evaluate_mesh, mesh_entries
from ...evaluation.truth import load_truth
from ...model.draw import draw, objects_alone
from ...shared.errors import NothingMade
from ...shared.reconstruction.folder import Reconstruction
from ...shared.reconstruction.report import Evaluation, write_evaluation
from ...shared.stopping import StoppingReporter
from ..folder import READ, Trained, open_trained
from ..stages import stage


def evaluate(options: argparse.Namespace, reporter: StoppingReporter) -> None:
    """Measure splats and meshes on the held-out views, and write evaluation.json, which `report` reads."""
    parts = {READ: ("Preparing", 5.0), "views": ("Measuring the views", 20.0), "meshes": ("Measuring the meshes", 20.0)}
    reporter.expect(parts)
    Reconstruction(options.folder).require_writable()
    trained = open_trained(options, reporter)
    folder, capture = trained.folder, trained.capture
    if not capture.test_indices:
        raise NothingMade(
            f"{capture.folder} holds out no view or has too few views for it, so nothing can be measured."
        )
    reporter.begin("views", f"Measuring on the {len(capture.test_indices)} held-out views")

    def drawn(index: int) -> tuple[np.ndarray, np.ndarray]:
        rendered = draw(trained.model, trained.scene.camera(index))
        assert rendered.ids is not None
        return rendered.image, rendered.ids

    with stage(folder, "evaluate"):
        found = evaluate_views(
            capture, drawn, capture.test_indices, reporter, trained.scene.zero_is_object,
            trained.scene.supervise_background,
            lambda index: objects_alone(trained.model, trained.scene.camera(index)),
        )  # fmt: skip
        quality = {name: value for name, value in found["quality"].items() if value is not None}
        # Before the meshes, which take longer, and the file, which may not be written.
        miou = "miou_all" if trained.scene.supervise_background else "miou"
        named = (("psnr", "PSNR of {:.2f} dB"), (miou, "mIoU of {:.3f}"))
        measured = ", ".join(words.format(quality[name]) for name, words in named if name in quality)
        reporter.status(f"Measured on the held-out views: {measured}")
        meshes = _meshes(trained, reporter)
    write_evaluation(folder.folder, Evaluation(trained.progress.step, **found, meshes=meshes))
    figures = {name: round(float(value), 4) for name, value in quality.items()}
    reporter.done(**figures, zero_is_background=trained.scene.supervise_background)


def _meshes(trained: Trained, reporter: StoppingReporter) -> dict[str, dict[str, Any]]:
    """Measure the meshes in the folder that were made from the current model."""
    capture, folder = trained.capture, trained.folder.meshes
    entries = mesh_entries(folder, trained.progress.step, reporter)
    if not entries:
        return {}
    reporter.begin("meshes", f"Measuring {len(entries)} meshes")
    truth = load_truth(capture, capture.train_indices)
    found = {}
    for done, (key, entry) in enumerate(entries.items()):
        reporter.progress(done, len(entries), what="meshes")
        found[key] = evaluate_mesh(folder, entry, trained.scene, truth, capture.test_indices, reporter)
    reporter.progress(len(entries), len(entries), what="meshes")
    return found
