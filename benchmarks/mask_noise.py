"""Effect of errors in masks: compare the given masks and the rendered IDs with the exact masks.

    python benchmarks/mask_noise.py [--capture build/demo/capture] [--steps 200] [--restart] [--json]

--capture is the demo capture, with exact masks in truth/masks. They get errors of four kinds, from none to about half
of the labels, and the demo is trained with each for --steps. Masks and rendered IDs are compared on the training views,
and rendered IDs also on the held-out views. Writes docs/figures/mask-noise.json,
docs/mask-noise.md and its plot; results are kept in build/mask-noise.
"""

from __future__ import annotations

import argparse
import importlib.util
import itertools
import json
import shutil
import sys
import tempfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy import ndimage

ROOT = Path(__file__).resolve().parents[1]
if str(ROOT) not in sys.path:
    sys.path.insert(0, str(ROOT))

from benchmarks import documents, shared

WORK = ROOT / "build" / "mask-noise"
LEVELS = (0.1, 0.2, 0.3, 0.4, 0.5)
FEW = 3
"""Number of labeled objects where the rest of the demo counts as background."""
CLEAR = 0.001
"""Fraction of the pixels by which the wrong pixels of two cases differ clearly."""
SPECK = 3
"""Minimum size of a hole in pixels; smaller ones count as rough edges, in masks and renders alike."""


# --- errors --------------------------------------------------------------------------------------------------------


def segmenter(ids: np.ndarray, level: float, rng: np.random.Generator) -> np.ndarray:
    """Apply the errors of the demo's `--mask-noise`; level 0.5 is its maximum."""
    path = ROOT / "objectgs_addon" / "demo" / "mask_noise.py"
    # Loaded as a file, since its package requires Blender.
    spec = importlib.util.spec_from_file_location("objectgs_mask_noise", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.disturb(ids, 2 * level, rng)


def wrong_ids(ids: np.ndarray, level: float, rng: np.random.Generator) -> np.ndarray:
    """Replace each object's ID in a view by another object's ID, with probability `level`."""
    present = np.unique(ids[ids > 0])
    result = ids.copy()
    for value in present:
        if len(present) > 1 and rng.random() < level:
            result[ids == value] = rng.choice(present[present != value])
    return result


def missing(ids: np.ndarray, level: float, rng: np.random.Generator) -> np.ndarray | None:
    """Drop the mask of a view, with probability `level`."""
    return None if rng.random() < level else ids


def holes(ids: np.ndarray, level: float, rng: np.random.Generator) -> np.ndarray:
    """Cover the fraction `level` of the image with unlabeled discs of radius 2 to 7 pixels."""
    rows, columns = np.mgrid[: ids.shape[0], : ids.shape[1]]
    gone = np.zeros(ids.shape, bool)
    while gone.mean() < level:
        y, x, radius = rng.uniform(0, ids.shape[0]), rng.uniform(0, ids.shape[1]), rng.uniform(2, 7)
        gone |= (rows - y) ** 2 + (columns - x) ** 2 < radius**2
    return np.where(gone, 0, ids)


def flooded(ids: np.ndarray, level: float, rng: np.random.Generator) -> np.ndarray:
    """Give the background the ID of one of the view's objects, with probability `level`."""
    present = np.unique(ids[ids > 0])
    return np.where(ids == 0, rng.choice(present), ids) if len(present) and rng.random() < level else ids


Disturbance = Callable[[np.ndarray, float, np.random.Generator], "np.ndarray | None"]
KINDS: dict[str, tuple[Disturbance, str]] = {
    "segmenter": (
        segmenter,
        "shifted borders, and objects that are too large, too small, exchanged or missing, as with --mask-noise",
    ),
    "wrong IDs": (wrong_ids, "part of the objects in a view have the ID of another object"),
    "holes": (holes, "part of each mask is replaced by unlabeled discs"),
    "missing masks": (missing, "part of the views have no mask"),
    "flooded background": (
        flooded,
        f"only {FEW} objects are labeled, the rest is background; part of the masks give it the ID of an object",
    ),
}


def exact_mask(source: Path, name: str, kind: str) -> np.ndarray:
    """Return the exact IDs (h, w) of a view; for `flooded background`, those of the first FEW objects only."""
    true = np.asarray(Image.open((source / "truth" / "masks" / name).with_suffix(".png")))
    return np.where(true <= FEW, true, 0) if kind == "flooded background" else true


def disturbed_capture(source: Path, kind: str, level: float, folder: Path) -> None:
    """Copy the demo capture to `folder`, with errors in its exact masks."""
    shutil.copytree(source / "images", folder / "images")
    shutil.copytree(source / "sparse", folder / "sparse")
    shutil.copy(source / "labels.json", folder / "labels.json")
    disturb = KINDS[kind][0]
    for path in sorted((source / "truth" / "masks").rglob("*.png")):
        rng = np.random.default_rng([zlib.crc32(f"{kind} {path.name}".encode()), round(1000 * level)])
        true = exact_mask(source, path.relative_to(source / "truth" / "masks").as_posix(), kind)
        given = disturb(true, level, rng) if level else true
        if given is not None:
            target = folder / "masks" / path.relative_to(source / "truth" / "masks")
            target.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(given.astype(true.dtype)).save(target)


# --- measures --------------------------------------------------------------------------------------------------------


def holes_of(found: np.ndarray, true: np.ndarray) -> tuple[int, int]:
    """Count the holes of at least SPECK pixels in the objects of an ID map (H, W), and their pixels.

    A hole is enclosed by an object's region on all sides and belongs to the object in the exact masks.
    """
    count = pixels = 0
    for value in np.unique(true[true > 0]):
        region = found == value
        inside = ndimage.binary_fill_holes(region) & ~region & (true == value)
        labels, _ = ndimage.label(inside)
        sizes = np.bincount(labels.ravel())[1:]
        count += int((sizes >= SPECK).sum())
        pixels += int(sizes[sizes >= SPECK].sum())
    return count, pixels


class Tally:
    """Comparison of ID maps of several views with the exact masks."""

    def __init__(self) -> None:
        from backend.evaluation import IdScores

        self._scores = IdScores()
        self._views = self._holes = self._hole_pixels = self._labeled = self._unlabeled = 0
        self._wrong = self._pixels = 0

    def add(self, found: np.ndarray | None, true: np.ndarray) -> None:
        """Add a view; `found` None: all pixels are unlabeled."""
        found = np.zeros_like(true) if found is None else found
        self._scores.add(found, true)
        count, pixels = holes_of(found, true)
        self._views += 1
        self._holes += count
        self._hole_pixels += pixels
        self._labeled += int((true > 0).sum())
        self._wrong += int((np.maximum(found, 0) != true).sum())
        self._pixels += true.size
        self._unlabeled += int(((found <= 0) & (true > 0)).sum())

    def result(self) -> dict[str, float]:
        """Return miou, miou_all, mbiou, error (fraction of all pixels with a wrong ID), holes per view, hole_share
        (fraction of the labeled pixels in holes), and unlabeled (fraction of the labeled pixels without a label)."""
        scores = self._scores.result()
        return {
            "miou": scores["miou"],
            "miou_all": scores["miou_all"],
            "mbiou": scores["mbiou"],
            "error": self._wrong / self._pixels,
            "holes": self._holes / self._views,
            "hole_share": self._hole_pixels / self._labeled,
            "unlabeled": self._unlabeled / self._labeled,
        }


def measured(capture: str, kind: str, level: float, steps: int) -> dict[str, Any]:
    """Train with erroneous masks; must run in a separate process.

    Returns the scores of the masks and of the rendered IDs on the training views, and of the rendered IDs on the
    held-out views.
    """
    from backend.capture import load_capture
    from backend.labels import correct_masks, vote
    from backend.model.draw import draw
    from backend.raster import compile_kernels
    from backend.shared.events import Reporter
    from backend.training.budget import Budget
    from backend.training.settings import Settings, background_is_masked
    from backend.training.trainer import Trainer

    compile_kernels()
    source = Path(capture)
    with tempfile.TemporaryDirectory(prefix="objectgs-benchmark-") as scratch:
        folder = Path(scratch) / "capture"
        disturbed_capture(source, kind, level, folder)
        loaded = load_capture(folder, Path(scratch) / "cache")
        ids = vote(loaded).ids
        corrected, _ = correct_masks(loaded, ids, ignore_gaps=background_is_masked(ids == 0))
        trainer = Trainer.start(corrected, ids, Settings())
        trainer.run(Budget(steps=steps), Path(scratch) / "checkpoint", Reporter())
        given, rendered, held_out = Tally(), Tally(), Tally()
        for index, view in enumerate(loaded.views):
            true = exact_mask(source, view.name, kind).astype(np.int64)
            found = draw(trainer.shown, trainer.scene.camera(index)).ids
            if index in loaded.test_indices:
                held_out.add(found, true)
            else:
                given.add(loaded.mask(index), true)
                rendered.add(found, true)
    return {"masks": given.result(), "rendered": rendered.result(), "held_out": held_out.result()}


# --- results ------------------------------------------------------------------------------------------------


def plot(found: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> Any:
    """Plot mIoU and holes of masks and renders over the level of errors, one column per kind."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(2.65 * len(found), 5.2), layout="constrained")
    axes = figure.subplots(2, len(found), squeeze=False, sharex=True, sharey="row")
    for column, (kind, levels) in enumerate(found.items()):
        x = [100 * float(level) for level in levels]
        for row, (name, text, factor) in enumerate(
            (("miou_all", "mIoU against the truth", 1), ("hole_share", "pixels in holes (%)", 100))
        ):
            ax = axes[row, column]
            for who, label, color, style in (
                ("masks", "masks given", shared.GRAY, "o--"),
                ("rendered", "rendered, same views", shared.MARKED, "o-"),
                ("held_out", "rendered, held-out views", shared.COLORS[0], "o-"),
            ):
                y = [factor * entry[who][name] for entry in levels.values()]
                ax.plot(x, y, style, color=color, label=label, markersize=4, linewidth=1.8)
            ax.set_ylim(bottom=0 if row else None)
            if not row:
                ax.set_title(kind)
            else:
                ax.set_xlabel("level of errors (%)")
            if not column:
                ax.set_ylabel(text)
                if not row:
                    ax.legend(fontsize=8, loc="lower left")
    return figure


def document(figures: Mapping[str, Any]) -> str:
    """Return the text of docs/mask-noise.md."""
    found, views = figures["cases"], figures["views"]
    entries = [
        (kind, level, entry) for kind, levels in found.items() for level, entry in levels.items() if float(level)
    ]
    closer = [e for e in entries if e[2]["rendered"]["miou_all"] > e[2]["masks"]["miou_all"]]
    with_holes = [e for e in entries if e[2]["masks"]["holes"] > 0]
    fewer = [e for e in with_holes if e[2]["rendered"]["holes"] < e[2]["masks"]["holes"]]
    lines = [
        "# Errors in masks",
        "",
        "Made by `python benchmarks/mask_noise.py`; all figures here are its output. The demo's exact masks get",
        f"errors before each training of {figures['steps']} steps; then masks and rendered IDs are compared with the",
        f"exact masks on the {views['training']} training views, and rendered IDs also on the {views['held_out']}"
        " held-out views.",
        "",
        f"- The rendered IDs are closer to the truth than the masks (mIoU) in {len(closer)} of {len(entries)} cases"
        f"{_named(entries, closer)}.",
        f"- The paper states that its results have fewer holes than the masks. This holds in {len(fewer)} of"
        f" {len(with_holes)} cases whose masks have holes{_named(with_holes, fewer)}.",
        *_ranking(found),
        "",
        "![mIoU and holes of masks and rendered IDs over the level of errors](mask-noise.png)",
        "",
        f"A hole is a region of {SPECK} pixels or more that an object's region encloses on all sides, and that belongs"
        " to the object in the exact masks; the number is per view. *Wrong*: fraction of the pixels whose ID is not"
        " that of the exact masks. mIoU is over all pixels.",
        "",
    ]
    head = ("level", "masks: mIoU", "wrong", "holes", "rendered: mIoU", "wrong", "holes", "held out: mIoU", "wrong")
    for kind, levels in found.items():
        rows = []
        for level, entry in levels.items():
            cells = [f"{float(level):.0%}"]
            for who in ("masks", "rendered", "held_out"):
                of = entry[who]
                cells += [f"{of['miou_all']:.4f}", f"{of['error']:.1%}"] + [f"{of['holes']:.1f}"] * (who != "held_out")
            rows.append(cells)
        text = KINDS[kind][1]
        lines += [f"## {kind[0].upper()}{kind[1:]}", "", f"{text[0].upper()}{text[1:]}.", "", *shared.table(head, rows)]
        lines.append("")
    return "\n".join(lines).rstrip() + "\n"


def _ranking(found: Mapping[str, Any]) -> list[str]:
    """Say how often mIoU, with and without unlabeled pixels, orders two cases as the fraction of wrong pixels does."""
    right = {"miou_all": 0, "miou": 0}
    pairs = 0
    for levels in found.values():
        for who in ("masks", "rendered", "held_out"):
            for one, other in itertools.combinations([entry[who] for entry in levels.values()], 2):
                if abs(one["error"] - other["error"]) >= CLEAR:
                    pairs += 1
                    for name in right:
                        right[name] += (one[name] > other[name]) == (one["error"] < other["error"])
    return [
        f"- Of {pairs} pairs of levels whose wrong pixels differ by at least {CLEAR:.1%} of the pixels, mIoU over all"
        f" pixels orders {right['miou_all']} as the wrong pixels do; mIoU over the labeled pixels alone orders"
        f" {right['miou']}.",
    ]


def _named(all_of: Sequence[tuple[str, str, Any]], good: Sequence[tuple[str, str, Any]]) -> str:
    """Return the exceptions as text."""
    bad = [f"{kind} {float(level):.0%}" for kind, level, entry in all_of if (kind, level, entry) not in good]
    return f"; exceptions: {', '.join(bad)}" if bad else ""


def main() -> None:
    """Measure, and write the document and the plot."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--capture", type=Path, default=ROOT / "build/demo/capture", help="the demo capture")
    parser.add_argument("--steps", type=int, default=200, help="number of training steps with each kind of masks")
    parser.add_argument("--restart", action="store_true", help="discard the results of earlier runs")
    parser.add_argument("--json", action="store_true", help="print one JSON object as the last line")
    options = parser.parse_args()
    capture = options.capture.resolve()
    truths = sorted((capture / "truth" / "masks").rglob("*.png"))
    if not truths:
        raise SystemExit(f"{capture} has no exact masks; make the demo capture by `make demo`.")
    if options.restart:
        shared.forget(WORK)
    shared.compile_everything()
    code = [*shared.sources(), Path(__file__), ROOT / "objectgs_addon" / "demo" / "mask_noise.py"]
    results = shared.Results(WORK, shared.digest([*code, *truths], options.steps), len(KINDS) * len(LEVELS) + 2)

    def case(kind: str, level: float) -> dict[str, Any]:
        return results.get(
            f"{kind} {level:.0%}",
            partial(
                shared.in_child, "benchmarks.mask_noise:measured",
                capture=str(capture), kind=kind, level=level, steps=options.steps,
            ),
            lambda row: "mIoU of masks {:.4f}, rendered {:.4f}; holes {:.1f}, rendered {:.1f}".format(
                *(row[who][name] for name in ("miou_all", "holes") for who in ("masks", "rendered"))
            ),
        )  # fmt: skip

    found = {}
    for kind in KINDS:
        alike = kind if kind == "flooded background" else next(iter(KINDS))
        entries = {0.0: case(alike, 0.0), **{level: case(kind, level) for level in LEVELS}}
        found[kind] = {level: entry for level, entry in entries.items() if entry}
    if results.failures:
        raise SystemExit("Not measured: " + "; ".join(results.failures))
    from backend.capture import load_capture

    with tempfile.TemporaryDirectory(prefix="objectgs-benchmark-") as cache:
        loaded = load_capture(capture, Path(cache))
    with shared.plot_style():
        shared.save_figure(plot(found), documents.DOCS / "mask-noise.png")
    views = {"training": len(loaded.train_indices), "held_out": len(loaded.test_indices)}
    documents.save("mask-noise", {"steps": options.steps, "views": views, "cases": found})
    if options.json:
        print(json.dumps(found))


if __name__ == "__main__":
    main()
