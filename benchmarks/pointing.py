"""Objects from strokes: held-out mIoU over the number of photos with strokes, with the true masks as the user.

    python benchmarks/pointing.py [--photos 1 2 3] [--minutes 2.4] [--capture build/demo/capture]

The capture is trained without its masks. In each of the photos, one stroke then marks each object that shows there:
along the row through the middle of the object's largest inscribed circle, without a fifth at both ends. If the masks
leave pixels unlabeled, one such stroke in one photo marks them, too. `label` separates the objects, and the IDs of its
renders are compared with the true masks of the held-out views.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import distance_transform_edt

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from backend.capture import Capture, load_capture
from backend.evaluation.metrics import IdScores, psnr
from backend.model.draw import draw
from backend.training.scene import Scene
from backend.training.state import load_model

SMALLEST = 30
"""Number of pixels below which an object is not marked in a photo."""


def widest_row(mask: np.ndarray) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the ends (x, y) of a stroke through the widest part of a mask (H, W), as fractions of its size."""
    inside = distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1]
    row, column = np.unravel_index(inside.argmax(), mask.shape)
    gaps = np.flatnonzero(~np.pad(mask[row], 1, constant_values=False)) - 1
    first, last = gaps[gaps < column].max() + 1, gaps[gaps > column].min() - 1
    margin = (last - first) // 5
    height, width = mask.shape
    y = (row + 0.5) / height
    return ((first + margin + 0.5) / width, y), ((last - margin + 0.5) / width, y)


def strokes_of(truth: Capture, photos: int) -> dict[str, Any]:
    """Return the strokes in this number of training photos, spread evenly; a single one shows most objects."""
    training = list(truth.train_indices)
    chosen = [training[(2 * i + 1) * len(training) // (2 * photos)] for i in range(photos)]
    if photos == 1:
        chosen = [max(training, key=lambda index: len(truth.ids_in(index)))]
    strokes = []
    for index in chosen:
        mask = truth.mask(index)
        for object_id in truth.object_ids.tolist():
            if mask is not None and (mask == object_id).sum() > SMALLEST:
                points = widest_row(mask == object_id)
                strokes.append({"object": object_id, "view": truth.views[index].name, "points": points})
    mask = truth.mask(chosen[0])
    everything = mask is not None and bool((mask > 0).all())
    if mask is not None and not everything:
        strokes.append({"object": 0, "view": truth.views[chosen[0]].name, "points": widest_row(mask == 0)})
    return {"strokes": strokes, "everything": everything}


def scores(checkpoint: Path, truth: Capture) -> dict[str, float]:
    """Return the scores of a trained model's IDs and images in the held-out views."""
    model, _, _ = load_model(checkpoint)
    scene = Scene(truth, model.classes, model.normalization)
    found, images = IdScores(False), []
    for index in truth.test_indices:
        drawn, mask = draw(model, scene.camera(index)), truth.mask(index)
        assert drawn.ids is not None and mask is not None
        found.add(drawn.ids, mask)
        images.append(psnr(drawn.image, truth.image(index)))
    return {**found.result(), "psnr": float(np.mean(images))}


def run(*words: object) -> float:
    """Run a command of the backend; return the seconds it took."""
    started = time.monotonic()
    done = subprocess.run(
        [sys.executable, "-m", "backend", *map(str, words)], cwd=ROOT, capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise RuntimeError(done.stderr.strip() or done.stdout)
    return time.monotonic() - started


def main() -> None:
    """Print a row for each number of photos."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--photos", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--minutes", type=float, default=2.4)
    parser.add_argument("--capture", type=Path, default=ROOT / "build/demo/capture")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="objectgs-benchmark-") as scratch:
        truth = load_capture(options.capture.resolve(), Path(scratch) / "cache")
        capture = Path(scratch) / "capture"
        shutil.copytree(options.capture, capture, ignore=shutil.ignore_patterns("masks", "labels.json", "objects.json"))
        unlabeled = Path(scratch) / "unlabeled"
        run("train", capture, "--out", unlabeled, "--minutes", options.minutes)
        for photos in options.photos:
            file, out = Path(scratch) / "strokes.json", Path(scratch) / f"labeled-{photos}"
            file.write_text(json.dumps(strokes_of(truth, photos)))
            shutil.rmtree(capture / "masks", ignore_errors=True)
            (capture / "labels.json").unlink(missing_ok=True)
            shutil.copytree(unlabeled, out)
            seconds = run("label", out, "--strokes", file)
            found = scores(out / "checkpoint", truth)
            print(
                f"{photos} photos: mIoU {found['miou']:.4f}, with unlabeled {found['miou_all']:.4f}, "
                f"PSNR {found['psnr']:.2f} dB; {seconds:.0f} s",
                flush=True,
            )


if __name__ == "__main__":
    main()
