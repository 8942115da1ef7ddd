"""LERF-Mask, in the layout of Gaussian Grouping.

images/                     the photos
images_train/               those that are trained on; the others are test views
object_mask/NAME.png        object IDs of the training views
sparse/0/                   the COLMAP model
test_mask/VIEW/PROMPT.png   what a prompt stands for in a test view; a VIEW is the photo's name without suffix, or
                            a number, and the numbers in ascending order are those of the test views by name
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from backend.capture.colmap import Model
from backend.shared.errors import InputError

from .captures import as_seen, copy_capture, need, read_binary_mask, read_colmap
from .metrics import Results, mean_over_prompts, percent, prompt_rows, score_prompts

TRAINING = ("--semantic-weight", "0.01")
AFTER_TRAINING = ("render", "--ids")

FIGURES = {
    "miou": ("mIoU (%)", "{:.1f}"),
    "mbiou": ("mBIoU (%)", "{:.1f}"),
    "miou_others": ("mIoU (%), without the views of the association", "{:.1f}"),
    "mbiou_others": ("mBIoU (%), without the views of the association", "{:.1f}"),
}

NOTES = (
    "Each prompt is associated with the object whose rendered IDs have the largest IoU with its mask in the first test "
    "view that shows it; the paper finds objects by their text.",
    "IoU and boundary IoU are taken over the full frame of each test view, averaged over the views of a prompt, and "
    "then over the prompts.",
)

_PAPER = {"figurines": (88.2, 85.2), "ramen": (88.0, 79.9), "teatime": (88.9, 88.6)}


def paper(scene: str) -> dict[str, float]:
    """Return the paper's figures of a scene; {} if it has none."""
    return dict(zip(("miou", "mbiou"), _PAPER.get(scene, ()), strict=False))


def convert(scene: Path, folder: Path) -> None:
    """Write a scene as a capture to a new folder.

    Raises:
        InputError: The scene lacks something.
    """
    model = read_colmap(scene)
    masks = need(scene / "object_mask", "the object IDs of the training views")
    copy_capture(scene, folder, model, masks, _test_views(scene, model))


def _test_views(scene: Path, model: Model) -> list[str]:
    """Return the names of the test views, sorted."""
    trained = {path.stem for path in need(scene / "images_train", "the photos to train on").iterdir()}
    present = [image.name for image in model.images if (scene / "images" / image.name).exists()]
    views = sorted(name for name in present if Path(name).stem not in trained)
    if not views:
        raise InputError(f"{scene / 'images_train'} contains all photos, so there is no test view; remove those.")
    return views


def true_masks(scene: Path) -> dict[str, dict[str, np.ndarray]]:
    """Return test view -> prompt -> mask of the photo (H, W) bool.

    Raises:
        InputError: The folders of test_mask cannot be matched with the test views.
    """
    views = _test_views(scene, read_colmap(scene))
    parent = need(scene / "test_mask", "a folder for each test view")
    folders = [path for path in sorted(parent.iterdir()) if path.is_dir()]
    by_stem = {Path(view).stem: view for view in views}
    if all(path.name in by_stem for path in folders):
        of_view = {by_stem[path.name]: path for path in folders}
    elif len(folders) == len(views) and all(path.name.isdecimal() for path in folders):
        of_view = dict(zip(views, sorted(folders, key=lambda path: int(path.name)), strict=True))
    else:
        raise InputError(
            f"{parent} has {len(folders)} folders for {len(views)} test views; expected one for each, named as the "
            "view or by a number."
        )
    return {
        view: {path.stem: read_binary_mask(path) for path in sorted(of_view[view].glob("*.png"))}
        for view in sorted(of_view)
    }


def measure(scene: Path, capture: Path, results: Results) -> dict[str, Any]:
    """Return the figures of a reconstruction in percent, and `prompts`, a row for each prompt."""
    scores = score_prompts(results.ids, as_seen(capture, true_masks(scene)))
    others = [score for score in scores if not score.is_first]
    return {
        "miou": percent(mean_over_prompts(scores, "iou")),
        "mbiou": percent(mean_over_prompts(scores, "biou")),
        "miou_others": percent(mean_over_prompts(others, "iou")),
        "mbiou_others": percent(mean_over_prompts(others, "biou")),
        "prompts": prompt_rows(scores),
    }
