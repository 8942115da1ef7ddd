"""The paper's ablations: semantics, voting, weight of the ID loss, splats per anchor, primitives and models.

    python benchmarks/ablations.py [--capture FOLDER ...] [--steps 400] [--seeds 3] [--add] [--write]

Every variant is trained with the same number of steps from the same points, and measured on the held-out views; figures
are means over the seeds with their standard deviation. --write writes docs/figures/ablations.json and
docs/ablations.md, with the paper's figures beside ours. Results are kept in build/ablations, so a stopped run goes on;
--add measures only the seeds that docs/figures/ablations.json lacks, and keeps the others.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parents[1]
if str(ROOT) not in sys.path:
    sys.path.insert(0, str(ROOT))

from benchmarks import documents, shared

WRONG_IDS = 0.3
"""Share of the objects in a mask that have a wrong ID, where masks have errors."""

_AS_GIVEN = {"wrong_ids": WRONG_IDS, "corrected": False}

FIGURES = ("miou", "mbiou", "dice", "accuracy", "psnr", "ssim", "miou_alone", "splats")


class Variant(NamedTuple):
    """A training that differs from the default in one point.

    Attributes:
        name: as in the table.
        change: arguments of `measured`; {} for the default.
        paper: the paper's figures of this variant, by figure.
    """

    name: str
    change: Mapping[str, Any]
    paper: Mapping[str, float] = {}


class Table(NamedTuple):
    """Variants that are compared, the figures shown of them, and what the paper says."""

    title: str
    text: str
    figures: Sequence[str]
    variants: Sequence[Variant]


def _paper(miou: float, mbiou: float, psnr: float, ssim: float) -> dict[str, float]:
    return {"miou": miou / 100, "mbiou": mbiou / 100, "psnr": psnr, "ssim": ssim}


def _paper_weight(accuracy: float, dice: float, miou: float, psnr: float, ssim: float) -> dict[str, float]:
    return {"accuracy": accuracy / 100, "dice": dice / 100, "miou": miou / 100, "psnr": psnr, "ssim": ssim}


TABLES = {
    "semantics": Table(
        "Semantics",
        "How splats know their object. *Learnable*: a feature of each anchor is blended like a color and decoded per "
        "pixel. *Object-independent*: each object is rendered alone and compared with its mask. *Alone*: the mIoU of "
        "objects rendered alone, without what hides them. The paper's figures are of the scene figurines of LERF-Mask.",
        ("miou", "mbiou", "miou_alone", "psnr", "ssim"),
        (
            Variant("learnable features", {"semantics": "learnable"}, _paper(69.57, 67.86, 25.67, 0.8876)),
            Variant("object-independent", {"semantics": "independent"}, _paper(37.48, 35.21, 25.14, 0.8911)),
            Variant("one-hot IDs (default)", {}, _paper(88.19, 85.22, 26.75, 0.9134)),
        ),
    ),
    "semantics_wrong": Table(
        "Semantics from masks with wrong IDs",
        f"The same, where {WRONG_IDS:.0%} of the objects in each training view's mask have the ID of another object, "
        "as masks of a segmentation network may. Held-out views are compared with the exact masks. By default, "
        "training corrects regions of masks that contradict the votes of the other views; *as given*: it does not.",
        ("miou", "mbiou", "miou_alone", "psnr", "ssim"),
        (
            Variant("learnable features, masks as given", {"semantics": "learnable", **_AS_GIVEN}),
            Variant("object-independent, masks as given", {"semantics": "independent", **_AS_GIVEN}),
            Variant("one-hot IDs, masks as given", _AS_GIVEN),
            Variant("learnable features", {"semantics": "learnable", "wrong_ids": WRONG_IDS}),
            Variant("one-hot IDs (default)", {"wrong_ids": WRONG_IDS}),
        ),
    ),
    "voting": Table(
        "Voting",
        "How points get their object. The paper's figures are of the scene figurines of LERF-Mask.",
        ("miou", "mbiou", "psnr", "ssim"),
        (
            Variant("probability", {"strategy": "probability"}, _paper(84.46, 81.46, 25.69, 0.9019)),
            Variant("correspondence", {"strategy": "correspondence"}, _paper(59.67, 57.50, 26.13, 0.9031)),
            Variant("majority (default)", {}, _paper(88.19, 85.22, 26.75, 0.9134)),
        ),
    ),
    "weight": Table(
        "Weight of the ID loss",
        "The paper's figures are of Replica. With a weight of 0, the paper reports no objects; ours still have the IDs "
        "that the votes gave them.",
        ("accuracy", "dice", "miou", "psnr", "ssim"),
        (
            Variant("0", {"settings": {"semantic_weight": 0.0}}, _paper_weight(0, 0, 0, 40.19, 0.9823)),
            Variant("0.01", {"settings": {"semantic_weight": 0.01}}, _paper_weight(94.75, 90.7, 86.15, 40.35, 0.9829)),
            Variant("0.1 (default)", {}, _paper_weight(95.65, 92.39, 88.39, 40.26, 0.9842)),
            Variant("1", {"settings": {"semantic_weight": 1.0}}, _paper_weight(94.42, 90.98, 86.67, 35.43, 0.9664)),
        ),
    ),
    "offsets": Table(
        "Splats per anchor (k)",
        "The paper uses k = 10 and shows no other.",
        ("miou", "mbiou", "psnr", "ssim", "splats"),
        (
            Variant("5", {"settings": {"offsets": 5}}),
            Variant("10 (default)", {}),
            Variant("20", {"settings": {"offsets": 20}}),
        ),
    ),
    "primitive": Table(
        "Primitives",
        "3D Gaussians and discs (2D Gaussians). The paper uses the latter for meshes and shows no comparison.",
        ("miou", "mbiou", "psnr", "ssim", "splats"),
        (Variant("3D (default)", {}), Variant("2D", {"settings": {"primitive": "2d"}})),
    ),
    "mode": Table(
        "Models",
        "*Plain*: no heads, every splat has its own color, opacity, scale and rotation. *Explicit*: heads, and "
        "residuals of each splat. *View*: as explicit, and the heads see the camera. *Paper*: as view without "
        "residuals, so that heads alone determine the splats, as in the paper.",
        ("miou", "mbiou", "psnr", "ssim", "splats"),
        (
            Variant("plain", {"plain": True}),
            Variant("explicit (default)", {}),
            Variant("view", {"settings": {"mode": "view"}}),
            Variant("paper", {"settings": {"mode": "paper"}}),
        ),
    ),
}

_SHOWN = {
    "miou": ("mIoU", "{:.4f}"), "mbiou": ("mBIoU", "{:.4f}"), "miou_alone": ("mIoU alone", "{:.4f}"),
    "dice": ("Dice", "{:.4f}"), "accuracy": ("accuracy", "{:.4f}"), "psnr": ("PSNR", "{:.2f}"),
    "ssim": ("SSIM", "{:.4f}"), "splats": ("splats", "{:,.0f}"),
}  # fmt: skip


def measured(
    capture: str,
    steps: int,
    seed: int,
    semantics: str = "one-hot",
    strategy: str = "majority",
    settings: Mapping[str, Any] | None = None,
    plain: bool = False,
    wrong_ids: float = 0.0,
    corrected: bool = True,
) -> dict[str, Any]:
    """Train one variant and measure it; must run in a separate process."""
    import numpy as np

    from backend.capture import load_capture
    from backend.evaluation import evaluate
    from backend.labels import correct_masks, vote
    from backend.model.draw import draw
    from backend.raster import compile_kernels
    from backend.shared.events import Reporter
    from backend.training.budget import Budget
    from backend.training.settings import Settings, background_is_masked
    from backend.training.trainer import Trainer
    from benchmarks import mask_noise, modes
    from benchmarks import semantics as alternatives

    compile_kernels()
    alternatives.use(semantics)
    with tempfile.TemporaryDirectory(prefix="objectgs-benchmark-") as scratch:
        exact = loaded = load_capture(Path(capture), Path(scratch) / "cache")
        if wrong_ids:
            mask_noise.disturbed_capture(Path(capture), "wrong IDs", wrong_ids, Path(scratch) / "capture")
            loaded = load_capture(Path(scratch) / "capture", Path(scratch) / "cache of wrong IDs")
        ids = vote(loaded, strategy, seed).ids  # type: ignore[arg-type]
        if corrected:
            loaded, _ = correct_masks(loaded, ids, ignore_gaps=background_is_masked(ids == 0))
        trainer = Trainer.start(loaded, ids, Settings(seed=seed, **(settings or {})))
        if plain:
            modes.silence(trainer)
        trainer.run(Budget(steps=steps), Path(scratch) / "checkpoint", Reporter())
        alone: dict[int, np.ndarray] = {}
        view_step = trainer.view_step

        def render(index: int) -> tuple[Any, Any]:
            camera = trainer.scene.camera(index)
            rendered = draw(trainer.shown, camera)
            truth = exact.mask(index)
            assert truth is not None
            for value, pixels in alternatives.iou_alone(trainer.shown, camera, truth).items():
                alone[value] = alone.get(value, np.zeros(2, np.int64)) + pixels
            decoded = isinstance(view_step, alternatives.LearnableStep)
            return rendered.image, view_step.ids(trainer.shown, camera) if decoded else rendered.ids

        quality = evaluate(exact, render, exact.test_indices)["quality"]
        return {
            **{name: quality[name] for name in FIGURES if name in quality},
            "miou_alone": statistics.fmean(inside / union for inside, union in alone.values()),
            "splats": len(trainer.shown.generate(camera_center=np.zeros(3)).source),
            "objects": len(alone),
        }


def document(found: Mapping[str, Any]) -> str:
    """Return the text of docs/ablations.md."""
    captures, seeds = found["captures"], found["seeds"]
    spread = "figures of one seed" if seeds == 1 else f"means over {seeds} seeds ± standard deviation"
    lines = [
        "# The paper's ablations",
        "",
        f"Made by `python benchmarks/ablations.py --write`. Trainings of {found['steps']} steps on a laptop's CPU, on "
        + " and ".join(f"{name} ({own['objects']} objects)" for name, own in captures.items())
        + f", measured on held-out views: {spread}. The paper's figures "
        "are of other scenes, 30,000 steps and masks from a segmentation network; compare the order of the rows.",
        "",
    ]
    for key, own in TABLES.items():
        figures = [name for name in own.figures if name != "miou_alone" or key.startswith("semantics")]
        lines += [f"## {own.title}", "", own.text, ""]
        paper = [name for name in figures if any(name in variant.paper for variant in own.variants)]
        if paper:
            rows = (
                [variant.name, *(_SHOWN[name][1].format(variant.paper[name]) for name in paper)]
                for variant in own.variants
            )
            lines += ["In the paper:", "", *shared.table(["", *(_SHOWN[name][0] for name in paper)], rows), ""]
        for name, capture in captures.items():
            head = [name, *(_SHOWN[figure][0] for figure in figures)]
            measured_here = capture["figures"][key].items()
            rows = ([label, *(shared.spread(row[f], _SHOWN[f][1]) for f in figures)] for label, row in measured_here)
            lines += [*shared.table(head, rows), ""]
        if key == "semantics":
            lines += [_reading(captures), ""]
    return "\n".join(lines).rstrip() + "\n"


def _reading(captures: Mapping[str, Any]) -> str:
    """Compare one-hot IDs with the other semantics in words."""
    learnable, independent, default = (variant.name for variant in TABLES["semantics"].variants)

    def ahead(other: str, figure: str) -> str:
        found = []
        for name, capture in captures.items():
            rows = capture["figures"]["semantics"]
            less = statistics.fmean(rows[default][figure]) - statistics.fmean(rows[other][figure])
            found.append(f"{less:+.4f} ({name})")
        return " and ".join(found)

    return (
        f"One-hot IDs less {learnable}: mIoU {ahead(learnable, 'miou')}, mIoU alone {ahead(learnable, 'miou_alone')}. "
        f"One-hot IDs less {independent}: mIoU {ahead(independent, 'miou')}, mIoU alone "
        f"{ahead(independent, 'miou_alone')}. The masks of these captures are exact and the vote gives nearly every "
        "anchor its right ID, so only outlines are left to decide; a decoder may draw a line there that differs from "
        "where the splats end, and loses nothing by it in a whole picture. An object that is taken out of the scene "
        "shows its own splats alone, and there the decoder does not help. A loss on each object alone favors just "
        "that, but says nothing about which object is in front. The masks of the paper come from a network, and have "
        "errors: see below."
    )


def _name(capture: Path) -> str:
    """Return the name of a capture in the tables."""
    return capture.parent.name if capture.name == "capture" else capture.name


def _key(variant: Variant) -> str:
    """Return what tells trainings apart; the default is in every table and trained once."""
    return str(sorted(variant.change.items()))


def main() -> None:
    """Measure, and print or write the document."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--capture", type=Path, nargs="+", default=[ROOT / "build/demo/capture"])
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--add", action="store_true")
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    shared.compile_everything()
    names = [_name(capture) for capture in options.capture]
    earlier = documents.load("ablations") if options.add else {"seeds": 0, "steps": options.steps, "captures": {}}
    if options.add and (earlier["steps"], list(earlier["captures"])) != (options.steps, names):
        raise SystemExit(
            f"docs/figures/ablations.json has {earlier['steps']} steps of {', '.join(earlier['captures'])}"
        )
    runs = {_key(variant): variant for table in TABLES.values() for variant in table.variants}
    code = [*shared.sources(), Path(__file__), Path(__file__).with_name("semantics.py")]
    results = shared.Results(
        ROOT / "build" / "ablations", shared.digest(code, options.steps),
        len(options.capture) * len(runs) * (options.seeds - earlier["seeds"]),
    )  # fmt: skip
    found: dict[str, Any] = {"steps": options.steps, "seeds": options.seeds, "captures": {}}
    # Seed by seed, so that a stopped run has a seed of everything.
    rows: dict[str, dict[str, list[dict[str, Any]]]] = {str(capture): {} for capture in options.capture}
    for seed in range(earlier["seeds"], options.seeds):
        for capture in options.capture:
            for key, variant in runs.items():
                row = results.get(
                    f"{capture} {key} seed {seed}",
                    partial(
                        shared.in_child, "benchmarks.ablations:measured", capture=str(capture.resolve()),
                        steps=options.steps, seed=seed, **variant.change,
                    ),
                    lambda row: f"{row['psnr']:.2f} dB, mIoU {row['miou']:.4f}, alone {row['miou_alone']:.4f}",
                )  # fmt: skip
                rows[str(capture)].setdefault(key, []).append(row)
    if results.failures:
        raise SystemExit("Not measured: " + "; ".join(f"{name}: {why}" for name, why in results.failures.items()))
    for capture in options.capture:
        of, name = rows[str(capture)], _name(capture)
        before = earlier["captures"].get(name, {"objects": 0, "figures": {}})
        found["captures"][name] = {
            "objects": before["objects"] or next(iter(of.values()))[0]["objects"],
            "figures": {
                key: {
                    variant.name: {
                        figure: [
                            *before["figures"].get(key, {}).get(variant.name, {}).get(figure, ()),
                            *(row[figure] for row in of.get(_key(variant), ())),
                        ]
                        for figure in FIGURES
                    }
                    for variant in table.variants
                }
                for key, table in TABLES.items()
            },
        }
    if options.write:
        documents.save("ablations", found)
    print(document(found))


if __name__ == "__main__":
    main()
