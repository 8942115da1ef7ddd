"""3D-OVS.

images/                           the photos
sparse/0/                         the COLMAP model, or its files beside images/
segmentations/classes.txt         the classes, one a line
segmentations/NN/CLASS.png        the mask of a class in photo NN, counted from 0 by name; these are the test views
object_mask/NAME.png or masks/    object IDs of the training views, which the dataset does not have
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from backend.shared.errors import InputError
from backend.shared.formats.photos_source import IMAGES

from .captures import as_seen, copy_capture, need, read_binary_mask, read_colmap
from .metrics import Results, mean, percent, prompt_rows, score_prompts

TRAINING = ()
AFTER_TRAINING = ("render", "--ids")

FIGURES = {
    "miou": ("mIoU (%)", "{:.1f}"),
    "miou_others": ("mIoU (%), without the views of the association", "{:.1f}"),
}

NOTES = (
    "Each class is associated with the object whose rendered IDs have the largest IoU with its mask in the first test "
    "view that shows it; the paper finds objects by their text.",
    "mIoU is the mean over all classes in all test views, over the full frame.",
)

_PAPER = {"bed": 98.0, "bench": 96.4, "room": 95.1, "lawn": 97.2, "sofa": 95.4, "mean": 96.4}


def paper(scene: str) -> dict[str, float]:
    """Return the paper's figures of a scene or their mean; {} if it has none."""
    return {"miou": _PAPER[scene]} if scene in _PAPER else {}


def convert(scene: Path, folder: Path) -> None:
    """Write a scene as a capture to a new folder.

    Raises:
        InputError: The scene lacks something.
    """
    masks = next((path for path in (scene / "object_mask", scene / "masks") if path.is_dir()), None)
    if masks is None:
        raise InputError(
            f"{scene / 'object_mask'} does not exist; 3D-OVS has no object IDs to train on, so put PNGs of them there, "
            "named as the photos."
        )
    model, views = read_colmap(scene), list(_folders(scene))
    absent = sorted(set(views) - {image.name for image in model.images})
    if absent:
        raise InputError(f"{model.file('images')} has no image {absent[0]}, which is a test view; register it.")
    copy_capture(scene, folder, model, masks, views)


def _folders(scene: Path) -> dict[str, Path]:
    """Return test view -> its folder in segmentations, sorted by view."""
    photos = sorted(
        path.name for path in need(scene / "images", "the photos").iterdir() if path.suffix.lower() in IMAGES
    )
    parent = need(scene / "segmentations", "a folder for each test view")
    folders = sorted((path for path in parent.iterdir() if path.name.isdecimal()), key=lambda path: int(path.name))
    if not folders:
        raise InputError(f"{parent} has no folder named by the number of a photo; put the segmentations there.")
    if int(folders[-1].name) >= len(photos):
        raise InputError(f"{folders[-1]} is for a photo that {scene / 'images'}, with {len(photos)}, does not have.")
    return {photos[int(path.name)]: path for path in folders}


def true_masks(scene: Path) -> dict[str, dict[str, np.ndarray]]:
    """Return test view -> class -> mask of the photo (H, W) bool."""
    listed = need(scene / "segmentations" / "classes.txt", "the names of the classes, one a line")
    classes = [line.strip() for line in listed.read_text(encoding="utf-8").splitlines() if line.strip()]
    return {
        view: {name: read_binary_mask(path) for name in classes if (path := folder / f"{name}.png").exists()}
        for view, folder in _folders(scene).items()
    }


def measure(scene: Path, capture: Path, results: Results) -> dict[str, Any]:
    """Return the figures of a reconstruction in percent, and `prompts`, a row for each class."""
    scores = score_prompts(results.ids, as_seen(capture, true_masks(scene)))
    return {
        "miou": percent(mean(score.iou for score in scores)),
        "miou_others": percent(mean(score.iou for score in scores if not score.is_first)),
        "prompts": prompt_rows(scores),
    }
