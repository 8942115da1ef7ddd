"""Quality during a training, on the views that it is not trained on, and previews of it."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
from PIL.Image import Image

from ...evaluation import IdScores, color_corrected, comparison, curve_image, psnr, save_image, thumbnail
from ...model.draw import draw
from ...model.object_model import ObjectModel
from ...shared.events import Reporter
from ...shared.reconstruction.folder import Reconstruction
from ...shared.stopping import Check, proceed
from ...training.budget import Budget, TrainingProgress
from ...training.scene import Scene

CURVE_VIEWS = 20
"""Largest number of held-out views that are measured during training; `evaluate` measures all."""

SHARE = 0.1
"""Largest fraction of the training time for measurements of held-out views, except for the one at the end."""


class Measuring:
    """Measures a model in training, and writes previews of the first held-out view and of the curve.

    Held-out views are for the user; they do not decide anything. Where they would take more than `SHARE` of the time,
    as with many large photos on a CPU, they are left for later, and only the preview is written. Views that decide on
    the training (validation and spared views) are measured each time. `check` is called before each view.
    """

    def __init__(self, folder: Reconstruction, budget: Budget, reporter: Reporter, check: Check = proceed) -> None:
        self._folder = folder
        self._budget = budget
        self._reporter = reporter
        self._check = check
        self._spent = 0.0
        self._warned = False

    def __call__(self, model: ObjectModel, scene: Scene, progress: TrainingProgress) -> dict[str, Any]:
        """Return the figures of the views that are measured now."""
        started = time.monotonic()
        allowed = SHARE * progress.seconds - self._spent
        if self._budget.progress(progress) >= 1.0:
            allowed = float("inf")
        figures = self._held_out(model, scene, allowed)
        self._spent += time.monotonic() - started
        capture = scene.capture
        validation = () if progress.joined else capture.validation_indices
        for name, indices in (("validation_psnr", validation), ("watched_psnr", progress.watched)):
            if indices:
                # Their exposure is not known, since they are not trained on.
                found = []
                for index in indices:
                    self._check()
                    photo, drawn = capture.image(index), draw(model, scene.camera(index), want_ids=False).image
                    found.append(psnr(color_corrected(drawn, photo), photo))
                figures[name] = float(np.mean(found))
        curve = curve_image([*progress.curve, {"seconds": progress.seconds, **figures}])
        if curve is not None:
            self._save(curve, "curve.png")
        return figures

    def _save(self, image: Image, name: str) -> Path | None:
        """Write a preview and return its path; None if that is impossible, which is reported once."""
        path = self._folder.previews / name
        try:
            return save_image(image, path, quick=True)
        except OSError as error:
            if not self._warned:
                self._reporter.warning(
                    f"{path} could not be written ({error.strerror}); the training goes on without it."
                )
            self._warned = True
            return None

    def _held_out(self, model: ObjectModel, scene: Scene, allowed: float) -> dict[str, Any]:
        """Measure the held-out views, or only draw the first if all would take more than `allowed` seconds."""
        # Without SSIM, which would take most of the time.
        started, capture = time.monotonic(), scene.capture
        held_out = capture.test_indices
        places = np.linspace(0, len(held_out) - 1, min(len(held_out), CURVE_VIEWS)).round().astype(int)
        indices = [held_out[place] for place in places]
        found, ids = [], IdScores(scene.zero_is_object)
        for number, index in enumerate(indices or (0,)):
            self._check()
            photo, truth = capture.image(index), capture.mask(index)
            rendered = draw(model, scene.camera(index), want_ids=truth is not None or number == 0)
            if indices:
                found.append(psnr(rendered.image, photo))
                if truth is not None and rendered.ids is not None:
                    ids.add(rendered.ids, truth)
            if number == 0:
                assert rendered.ids is not None
                # Where no view is held out, it is a training view, whose corrected mask has pixels without an ID.
                shown = None if truth is None else np.maximum(truth, 0)
                preview = comparison(photo, rendered.image, shown, rendered.ids, None, capture.names)
                render, latest = self._save(thumbnail(rendered.image), "render.png"), self._save(preview, "latest.png")
                if render is not None and latest is not None:
                    self._reporter.preview(latest, render=render)
                if (time.monotonic() - started) * len(indices) > allowed:
                    return {}
        scores = ids.result()
        return {
            "psnr": float(np.mean(found)) if found else None,
            **{name: scores[name] for name in ("miou", "miou_all", "mbiou")},
        }
