"""What mistakes in the masks do to the result: rendered IDs beside the masks that were given, both against the truth.

    python benchmarks/mask_noise.py [--capture build/demo/capture] [--steps 200] [--restart] [--json]

--capture is the demo capture, which brings exact masks in truth/masks. Its masks are replaced by the true ones with
mistakes of four kinds, from none to about half of them, and the demo is trained with each for so many --steps. Rendered
IDs and masks are compared on the same views, those that were trained on, and the rendered IDs on the held-out ones too.
Leaves docs/mask-noise.md and a plot beside it. What is done is kept in build/mask-noise.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import shutil
import sys
import tempfile
import zlib
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy import ndimage

ROOT = Path(__file__).resolve().parents[1]
if str(ROOT) not in sys.path:
    sys.path.insert(0, str(ROOT))

from benchmarks import shared  # noqa: E402

WORK = ROOT / "build" / "mask-noise"
LEVELS = (0.1, 0.2, 0.3, 0.4, 0.5)
SPECK = 3
"""A hole of fewer pixels counts as an edge's roughness, in masks and renders alike."""


# --- mistakes --------------------------------------------------------------------------------------------------------


def segmenter(ids: np.ndarray, level: float, rng: np.random.Generator) -> np.ndarray:
    """The demo's own mistakes (`--mask-noise`), at most as poor as it knows."""
    path = ROOT / "objectgs_addon" / "demo" / "mask_noise.py"
    # By its file, since the package around it belongs to Blender.
    spec = importlib.util.spec_from_file_location("objectgs_mask_noise", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.disturb(ids, 2 * level, rng)


def wrong_ids(ids: np.ndarray, level: float, rng: np.random.Generator) -> np.ndarray:
    """Each object of a view, by this chance, carries another one's ID."""
    present = np.unique(ids[ids > 0])
    result = ids.copy()
    for value in present:
        if len(present) > 1 and rng.random() < level:
            result[ids == value] = rng.choice(present[present != value])
    return result


def missing(ids: np.ndarray, level: float, rng: np.random.Generator) -> np.ndarray | None:
    """A view has no mask, by this chance."""
    return None if rng.random() < level else ids


def holes(ids: np.ndarray, level: float, rng: np.random.Generator) -> np.ndarray:
    """Discs of 2 to 7 pixels' radius without a label, until this part of the picture is."""
    rows, columns = np.mgrid[: ids.shape[0], : ids.shape[1]]
    gone = np.zeros(ids.shape, bool)
    while gone.mean() < level:
        y, x, radius = rng.uniform(0, ids.shape[0]), rng.uniform(0, ids.shape[1]), rng.uniform(2, 7)
        gone |= (rows - y) ** 2 + (columns - x) ** 2 < radius**2
    return np.where(gone, 0, ids)


Mistake = Callable[[np.ndarray, float, np.random.Generator], "np.ndarray | None"]
KINDS: dict[str, tuple[Mistake, str]] = {
    "segmenter": (
        segmenter,
        "borders that wander, objects too large, too small, exchanged or missing, as --mask-noise",
    ),
    "wrong IDs": (wrong_ids, "so many of the objects in a view carry another object's ID"),
    "holes": (holes, "so much of each mask is cut out as discs without a label"),
    "missing masks": (missing, "so many views have no mask"),
}


def disturbed_capture(source: Path, kind: str, level: float, folder: Path) -> None:
    """A copy of the demo capture in `folder`, with mistakes in its true masks."""
    shutil.copytree(source / "images", folder / "images")
    shutil.copytree(source / "sparse", folder / "sparse")
    shutil.copy(source / "labels.json", folder / "labels.json")
    mistake = KINDS[kind][0]
    for path in sorted((source / "truth" / "masks").rglob("*.png")):
        rng = np.random.default_rng([zlib.crc32(f"{kind} {path.name}".encode()), round(1000 * level)])
        true = np.asarray(Image.open(path))
        given = mistake(true, level, rng) if level else true
        if given is not None:
            target = folder / "masks" / path.relative_to(source / "truth" / "masks")
            target.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(given.astype(true.dtype)).save(target)


# --- measures --------------------------------------------------------------------------------------------------------


def holes_of(found: np.ndarray, true: np.ndarray) -> tuple[int, int]:
    """How many holes of SPECK pixels or more the objects of an ID map (H, W) have, and of how many pixels: what an
    object's region encloses on all sides, and the truth says is that object's."""
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
    """ID maps of several views against the truth."""

    def __init__(self) -> None:
        from backend.evaluation import IdScores

        self._scores = IdScores()
        self._views = self._holes = self._hole_pixels = self._labelled = self._unlabelled = 0

    def add(self, found: np.ndarray | None, true: np.ndarray) -> None:
        """Count a view; None: it has no ID map, so all of it is unlabelled."""
        found = np.zeros_like(true) if found is None else found
        self._scores.add(found, true)
        count, pixels = holes_of(found, true)
        self._views += 1
        self._holes += count
        self._hole_pixels += pixels
        self._labelled += int((true > 0).sum())
        self._unlabelled += int(((found <= 0) & (true > 0)).sum())

    def result(self) -> dict[str, float]:
        """miou and error (part of the labelled pixels with another ID or none), holes for each view and the part of the
        labelled pixels in them, and the part without a label."""
        scores = self._scores.result()
        return {
            "miou": scores["miou"],
            "mbiou": scores["mbiou"],
            "error": 1 - scores["accuracy"],
            "holes": self._holes / self._views,
            "hole_share": self._hole_pixels / self._labelled,
            "unlabelled": self._unlabelled / self._labelled,
        }


def measured(capture: str, kind: str, level: float, steps: int) -> dict[str, Any]:
    """Train with such masks; `masks` and `rendered` on the views that were trained on, `held_out` rendered there. In a
    process of its own."""
    from backend.capture import load_capture
    from backend.labels import vote
    from backend.protocol import Reporter
    from backend.raster import compile_kernels
    from backend.raster.draw import draw
    from backend.training.budget import Budget
    from backend.training.loop import Trainer
    from backend.training.settings import Settings

    compile_kernels()
    source = Path(capture)
    with tempfile.TemporaryDirectory(prefix="objectgs-benchmark-") as scratch:
        folder = Path(scratch) / "capture"
        disturbed_capture(source, kind, level, folder)
        loaded = load_capture(folder, Path(scratch) / "cache")
        trainer = Trainer.start(loaded, vote(loaded).ids, Settings())
        trainer.run(Budget(steps=steps), Path(scratch) / "checkpoint", Reporter())
        given, rendered, held_out = Tally(), Tally(), Tally()
        for index, view in enumerate(loaded.views):
            true = np.asarray(Image.open((source / "truth" / "masks" / view.name).with_suffix(".png"))).astype(np.int64)
            found = draw(trainer.shown, trainer.scene.camera(index)).ids
            if index in loaded.test_indices:
                held_out.add(found, true)
            else:
                given.add(loaded.mask(index), true)
                rendered.add(found, true)
    return {"masks": given.result(), "rendered": rendered.result(), "held_out": held_out.result()}


# --- what comes of it ------------------------------------------------------------------------------------------------


def plot(found: dict[str, dict[float, dict[str, Any]]]) -> Any:
    """mIoU and holes of masks and renders over the level of the mistakes, a column for each kind."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(2.65 * len(found), 5.2), layout="constrained")
    axes = figure.subplots(2, len(found), squeeze=False, sharex=True, sharey="row")
    for column, (kind, levels) in enumerate(found.items()):
        x = [100 * level for level in levels]
        for row, (name, text, factor) in enumerate(
            (("miou", "mIoU against the truth", 1), ("hole_share", "pixels in holes (%)", 100))
        ):
            ax = axes[row, column]
            for who, label, colour, style in (
                ("masks", "masks given", shared.GREY, "o--"),
                ("rendered", "rendered, same views", shared.MARKED, "o-"),
                ("held_out", "rendered, held-out views", shared.COLOURS[0], "o-"),
            ):
                y = [factor * entry[who][name] for entry in levels.values()]
                ax.plot(x, y, style, color=colour, label=label, markersize=4, linewidth=1.8)
            ax.set_ylim(bottom=0 if row else None)
            if not row:
                ax.set_title(kind)
            else:
                ax.set_xlabel("level of mistakes (%)")
            if not column:
                ax.set_ylabel(text)
                if not row:
                    ax.legend(fontsize=8, loc="lower left")
    return figure


def document(found: dict[str, dict[float, dict[str, Any]]], steps: int, views: tuple[int, int]) -> str:
    """docs/mask-noise.md."""
    entries = [(kind, level, entry) for kind, levels in found.items() for level, entry in levels.items() if level]
    closer = [e for e in entries if e[2]["rendered"]["miou"] > e[2]["masks"]["miou"]]
    with_holes = [e for e in entries if e[2]["masks"]["holes"] > 0]
    fewer = [e for e in with_holes if e[2]["rendered"]["holes"] < e[2]["masks"]["holes"]]
    lines = [
        "# Mistakes in the masks",
        "",
        "Made by `python benchmarks/mask_noise.py`; every figure here was measured by it. The demo's exact masks get",
        f"mistakes before each training of {steps} steps; masks and rendered IDs are then compared with the exact ones",
        f"on the {views[0]} views that were trained on, rendered IDs on the {views[1]} held-out views as well.",
        "",
        f"- The rendered IDs are closer to the truth than the masks (mIoU) in {len(closer)} of {len(entries)} cases"
        f"{_named(entries, closer)}.",
        f"- The paper says that its results have fewer holes than the masks: so it is in {len(fewer)} of"
        f" {len(with_holes)} cases whose masks have holes{_named(with_holes, fewer)}.",
        "",
        "![mIoU and holes of masks and rendered IDs over the level of mistakes](mask-noise.png)",
        "",
        f"A hole is what an object's region encloses on all sides though the truth says that it is the object's, of"
        f" {SPECK} pixels or more; their number is that in a view. *Wrong*: the part of the labelled pixels with"
        " another ID, or none.",
        "",
    ]
    head = ("level", "masks: mIoU", "wrong", "holes", "rendered: mIoU", "wrong", "holes", "held out: mIoU", "wrong")
    for kind, levels in found.items():
        rows = []
        for level, entry in levels.items():
            cells = [f"{level:.0%}"]
            for who in ("masks", "rendered", "held_out"):
                of = entry[who]
                cells += [f"{of['miou']:.4f}", f"{of['error']:.1%}"] + [f"{of['holes']:.1f}"] * (who != "held_out")
            rows.append(cells)
        text = KINDS[kind][1]
        lines += [f"## {kind[0].upper()}{kind[1:]}", "", f"{text[0].upper()}{text[1:]}.", "", *shared.table(head, rows)]
        lines.append("")
    return "\n".join(lines).rstrip() + "\n"


def _named(all_of: Sequence[tuple[str, float, Any]], good: Sequence[tuple[str, float, Any]]) -> str:
    """The cases where it is otherwise, in words."""
    bad = [f"{kind} {level:.0%}" for kind, level, entry in all_of if (kind, level, entry) not in good]
    return f"; not with {', '.join(bad)}" if bad else ""


def main() -> None:
    """Measure, and write the document and the plot."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--capture", type=Path, default=ROOT / "build/demo/capture", help="the demo capture")
    parser.add_argument("--steps", type=int, default=200, help="how long to train with each kind of masks")
    parser.add_argument("--docs", type=Path, default=ROOT / "docs", help="where document and plot go")
    parser.add_argument("--restart", action="store_true", help="forget what earlier runs have left")
    parser.add_argument("--json", action="store_true", help="print one JSON object as the last line")
    options = parser.parse_args()
    capture = options.capture.resolve()
    truths = sorted((capture / "truth" / "masks").rglob("*.png"))
    if not truths:
        raise SystemExit(f"{capture} brings no true masks; make the demo capture by `make demo`.")
    if options.restart:
        shared.forget(WORK)
    shared.compile_everything()
    code = [*shared.sources(), Path(__file__), ROOT / "objectgs_addon" / "demo" / "mask_noise.py"]
    results = shared.Results(WORK, shared.digest([*code, *truths], options.steps), len(KINDS) * len(LEVELS) + 1)

    def case(kind: str, level: float) -> dict[str, Any]:
        return results.get(
            f"{kind} {level:.0%}" if level else "no mistakes",
            partial(
                shared.in_child, "benchmarks.mask_noise:measured",
                capture=str(capture), kind=kind, level=level, steps=options.steps,
            ),
            lambda row: "mIoU of masks {:.4f}, rendered {:.4f}; holes {:.1f}, rendered {:.1f}".format(
                *(row[who][name] for name in ("miou", "holes") for who in ("masks", "rendered"))
            ),
        )  # fmt: skip

    clean = case(next(iter(KINDS)), 0.0)
    found = {}
    for kind in KINDS:
        entries = {0.0: clean, **{level: case(kind, level) for level in LEVELS}}
        found[kind] = {level: entry for level, entry in entries.items() if entry}
    if results.failures:
        raise SystemExit("Not measured: " + "; ".join(results.failures))
    from backend.capture import load_capture

    with tempfile.TemporaryDirectory(prefix="objectgs-benchmark-") as cache:
        loaded = load_capture(capture, Path(cache))
    options.docs.mkdir(parents=True, exist_ok=True)
    with shared.plot_style():
        shared.save_figure(plot(found), options.docs / "mask-noise.png")
    path = options.docs / "mask-noise.md"
    path.write_text(document(found, options.steps, (len(loaded.train_indices), len(loaded.test_indices))))
    print(f"\nWrote {path} and its plot.")
    if options.json:
        print(json.dumps(found))


if __name__ == "__main__":
    main()
