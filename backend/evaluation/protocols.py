"""Evaluation of renders on the views of a capture."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..shared.events import Reporter
from .lpips import load_lpips
from .metrics import AloneScores, IdScores, ImageScores


class _View(Protocol):
    @property
    def name(self) -> str: ...


class EvaluatedCapture(Protocol):
    """The part of a capture that `evaluate` needs."""

    @property
    def views(self) -> Sequence[_View]: ...

    @property
    def names(self) -> Mapping[int, str]: ...

    def image(self, i: int) -> NDArray:
        """Return the image (h, w, 3) uint8 of view `i`."""

    def mask(self, i: int) -> NDArray | None:
        """Return the object IDs (h, w) int64 of view `i`, or None if it has no mask."""


def evaluate(
    capture: EvaluatedCapture,
    render: Callable[[int], tuple[NDArray, NDArray]],
    indices: Sequence[int],
    reporter: Reporter | None = None,
    zero_is_class: bool = False,
    zero_is_background: bool = False,
    alone: Callable[[int], Iterable[tuple[int, NDArray]]] | None = None,
) -> dict[str, Any]:
    """Compare renders with the images and masks of a capture.

    Args:
        capture: The capture with the true images and masks.
        render: Function that returns the image (h, w, 3), float in [0, 1], and the object IDs (h, w) int64 of a view.
        indices: The views to measure; for comparable results, the held-out views.
        reporter: Receives the progress, and a warning for each render with NaN or Inf.
        zero_is_class: Count the ID 0 as an object, instead of as unlabeled.
        zero_is_background: Whether 0 means background, so that `miou_all` is shown as the progress instead of `miou`.
        alone: Function that returns the IDs and the alphas (h, w) of the objects in a view, each rendered alone,
            except those out of view; used if 0 means background.

    Returns:
        {"quality": {psnr, psnr_corrected, ssim, lpips, miou, miou_all, miou_alone, mbiou, dice, accuracy}, "objects":
        [{id, name, iou, iou_all, iou_alone, biou, dice, pixels}], "views": [{name, psnr, psnr_corrected, ssim, miou,
        miou_all}]}, see `ImageScores`, `IdScores` and `AloneScores`. Scores of a view are those of its pixels and
        objects only. The ID scores are None if no pixel is labeled, those of objects alone unless 0 means background,
        and lpips, the mean over the views, if it cannot be computed, see `load_lpips`.
    """
    reporter = reporter or Reporter()
    images = ImageScores()
    lpips, distances = load_lpips(), []
    ids, of_objects_alone = IdScores(zero_is_class), AloneScores()
    views = []
    for done, i in enumerate(indices):
        image, found = render(i)
        name = capture.views[i].name
        if not np.isfinite(image).all():
            reporter.warning(f"The render of {name} contains NaN or Inf.")
        photo = capture.image(i)
        of_image = images.add(image, photo)
        if lpips is not None:
            distances.append(lpips(image, photo))
        truth = capture.mask(i)
        of_view: dict[str, float | None] = {"miou": None, "miou_all": None}
        if truth is not None:
            view_ids = IdScores(zero_is_class)
            view_ids.add(found, truth)
            ids.merge(view_ids)
            found_scores = view_ids.result()
            of_view = {key: found_scores[key] for key in of_view}
            if alone and zero_is_background and not zero_is_class:
                # The model may lack objects that the masks show, or have them elsewhere.
                missing = set(np.unique(truth[truth > 0]).tolist())
                for object_id, shown in alone(i):
                    reporter.check()
                    of_objects_alone.add(object_id, shown, truth)
                    missing.discard(object_id)
                for object_id in sorted(missing):
                    of_objects_alone.add(object_id, np.zeros(truth.shape, np.float32), truth)
        views.append({"name": name, **of_image, **of_view})
        reporter.progress(
            done + 1, len(indices), psnr=of_image["psnr"], **of_view, zero_is_background=zero_is_background
        )

    perceptual = float(np.mean(distances)) if distances else None
    iou_alone = of_objects_alone.result()
    objects = [
        {"id": row["id"], "name": capture.names.get(row["id"], str(row["id"])), **row,
         "iou_alone": iou_alone.get(row["id"])}
        for row in ids.table()
    ]  # fmt: skip
    measured = [entry["iou_alone"] for entry in objects if entry["iou_alone"] is not None]
    miou_alone = float(np.mean(measured)) if measured else None
    quality: dict[str, Any] = {
        **images.result(), "lpips": perceptual, **ids.result(), "miou_alone": miou_alone
    }  # fmt: skip
    del quality["objects"]
    return {"quality": quality, "objects": objects, "views": views}
