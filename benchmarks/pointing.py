"""Objects from strokes: held-out mIoU over the number of photos with strokes, with the true masks as the user.

    python benchmarks/pointing.py [--photos 1 2 3] [--minutes 2.4] [--seeds 1] [--capture NAME ...]
    python benchmarks/pointing.py --write [--proposals [--capture NAME ...]]
    python benchmarks/pointing.py --write --meshes [--photos 2] [--minutes 2.4]

Captures are the demo (`make demo`), and the real tabletop of ../shared/data if it is there. Each is trained without its
masks. In each of the photos, one stroke then marks each object that shows there: along the row through the middle of
the object's largest inscribed circle, without a fifth at both ends. If the masks leave pixels unlabeled, one such
stroke in one photo marks them, too. `label` separates the objects, and the IDs of its renders are compared with the
true masks of the held-out views. Before, the objects are marked one after the other, and `propose` finds objects
without any stroke. --write saves the figures of two seeds to docs/figures/pointing.json and the table to
docs/pointing.md; with --proposals, only `propose` is measured, and with --meshes, meshes of the demo's objects from
strokes and from the true masks are compared with its true ones. The document then keeps its other figures.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from backend.capture import Capture, load_capture
from backend.commands.objects.pointable import Pointable, open_pointable
from backend.evaluation.metrics import IdScores, psnr
from backend.model.draw import draw
from backend.pointing import strokes as strokes_file
from backend.pointing.strokes import stroke_through
from backend.shared.events import Reporter
from backend.training.scene import Scene
from backend.training.state import load_model
from benchmarks import documents, shared

CAPTURES = {
    "demo": ROOT / "build" / "demo" / "capture",
    "tabletop": ROOT.parent / "shared" / "data" / "tabletop",
}
GOOD = 0.8
"""IoU from which on a proposed object counts as found."""

IN_TURN = (1, 2, 3, 5, 1000)
"""Numbers of marked objects that the document shows; the last one stands for all."""

SMALLEST = 30
"""Number of pixels below which an object is not marked in a photo."""


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
                points = stroke_through(mask == object_id)
                strokes.append({"object": object_id, "view": truth.views[index].name, "points": points})
    mask = truth.mask(chosen[0])
    everything = mask is not None and bool((mask > 0).all())
    if mask is not None and not everything:
        strokes.append({"object": 0, "view": truth.views[chosen[0]].name, "points": stroke_through(mask == 0)})
    return {"strokes": strokes, "everything": everything}


def open_splats(folder: Path) -> Pointable:
    """Open the splats of a reconstruction as the add-on does for strokes."""
    return open_pointable(argparse.Namespace(folder=folder, capture=None, device="cpu", memory_mb=2000.0), Reporter())


def in_turn(folder: Path, truth: Capture, seed: int) -> dict[str, float]:
    """Mark the objects of a training one after the other, in random order, each by one stroke in the same photo.

    Returns:
        By the number of objects that are marked so far, the mean IoU of these over what splats show in training photos.
        What is not marked yet belongs to none of them.
    """
    opened = open_splats(folder)
    pointer = opened.pointer(lambda _done, _total: None)
    numbers = {name: index for index, name in enumerate(opened.views.names)}
    masks = {numbers[truth.views[index].name]: truth.mask(index) for index in truth.train_indices}
    objects = np.array([0, *truth.object_ids.tolist()])
    voting = {index: pointer.voting_mask(index, mask) for index, mask in masks.items() if mask is not None}
    shown = pointer.votes(voting, objects, lambda _done: None)
    drawn = strokes_file.strokes_of(json.loads(json.dumps(strokes_of(truth, 1))), "the truth", opened.views.names)
    order = np.random.default_rng(seed).permutation(sorted({stroke.object for stroke in drawn.strokes} - {0})).tolist()
    found = {}
    for count in range(1, len(order) + 1):
        marked = order[:count]
        some = tuple(stroke for stroke in drawn.strokes if stroke.object in marked)
        ids = pointer.solve(replace(drawn, strokes=some, everything=False))
        found[str(count)] = float(np.mean([_iou(shown, objects, ids, object_id) for object_id in marked]))
    return found


def _iou(shown: np.ndarray, objects: np.ndarray, ids: np.ndarray, object_id: int) -> float:
    """Return the IoU of an object by the pixels (N, C) of each object that splats show, and the splats' IDs (N,)."""
    true, is_found = shown[:, objects == object_id][:, 0], ids == object_id
    return float(true[is_found].sum() / (shown[is_found].sum() + true[~is_found].sum()))


def copy_without_masks(folder: Path, copy: Path) -> None:
    """Copy a capture without what says which objects it has; its ground truth remains for comparison."""
    shutil.copytree(
        folder, copy,
        ignore=lambda path, _: {"masks", "labels.json", "objects.json"} if Path(path) == folder else set(),
    )  # fmt: skip


def scores(checkpoint: Path, truth: Capture) -> dict[str, float]:
    """Return the scores of a trained model's IDs and images in the held-out views."""
    model, _, _ = load_model(checkpoint)
    scene = Scene(truth, model.classes, model.normalization, blur=model.blur)
    found, images = IdScores(False), []
    for index in truth.test_indices:
        drawn, mask = draw(model, scene.camera(index)), truth.mask(index)
        assert drawn.ids is not None and mask is not None
        found.add(drawn.ids, mask)
        images.append(psnr(drawn.image, truth.image(index)))
    return {**found.result(), "psnr": float(np.mean(images))}


def matched(checkpoint: Path, truth: Capture) -> dict[str, float]:
    """Return the scores of a trained model whose objects have other IDs: each true object is compared with the one that
    fits it, so that the sum of the IoU is largest."""
    model, _, _ = load_model(checkpoint)
    scene = Scene(truth, model.classes, model.normalization, blur=model.blur)
    rows, columns = int(model.classes.ids.max()) + 1, int(truth.object_ids.max()) + 1
    shown, images = np.zeros((rows, columns)), []
    for index in truth.test_indices:
        drawn, mask = draw(model, scene.camera(index)), truth.mask(index)
        assert drawn.ids is not None and mask is not None
        np.add.at(shown, (drawn.ids.astype(np.int64), mask.astype(np.int64)), 1)
        images.append(psnr(drawn.image, truth.image(index)))
    # As for strokes, over labeled pixels, and over all.
    found = {}
    for key, first in (("miou", 1), ("miou_all", 0)):
        both = shown[1:, 1:]
        either = shown[1:, first:].sum(1)[:, None] + shown[:, 1:].sum(0) - both
        iou = both / np.maximum(either, 1)
        pairs = linear_sum_assignment(-iou)
        of_object = np.zeros(columns - 1)
        of_object[pairs[1]] = iou[pairs]
        of_object = of_object[shown[:, 1:].sum(0) > 0]
        found[key] = float(of_object.mean())
    found |= {"good": float((of_object >= GOOD).sum()), "objects": float(len(of_object)), "proposed": float(rows - 1)}
    return {**found, "psnr": float(np.mean(images))}


def measured(folder: Path, photos: Sequence[int], minutes: float, seed: int) -> dict[str, Any]:
    """Train a capture without its masks, and return the scores by the number of photos with strokes."""
    rows: dict[str, Any] = {}
    with tempfile.TemporaryDirectory(prefix="objectgs-benchmark-") as place:
        scratch = Path(place)
        truth = load_capture(folder, scratch / "cache")
        capture, unlabeled = scratch / "capture", scratch / "unlabeled"
        copy_without_masks(folder, capture)
        shared.run_backend("train", capture, "--out", unlabeled, "--minutes", minutes, "--seed", seed)
        rows["0"] = {"psnr": scores(unlabeled / "checkpoint", truth)["psnr"]}
        rows["in turn"] = in_turn(unlabeled, truth, seed)
        file, out = scratch / "proposed.json", scratch / "proposed"
        shutil.copytree(unlabeled, out)
        seconds = shared.run_backend("propose", out, "--strokes", file)
        seconds += shared.run_backend("label", out, "--strokes", file)
        rows["proposed"] = {**matched(out / "checkpoint", truth), "seconds": seconds}
        for count in photos:
            file, out = scratch / "strokes.json", scratch / f"labeled-{count}"
            file.write_text(json.dumps(strokes_of(truth, count)))
            shutil.rmtree(capture / "masks", ignore_errors=True)
            (capture / "labels.json").unlink(missing_ok=True)
            shutil.copytree(unlabeled, out)
            seconds = shared.run_backend("label", out, "--strokes", file)
            rows[str(count)] = {**scores(out / "checkpoint", truth), "seconds": seconds}
    return rows


def mesh_scores(out: Path) -> dict[str, float | None]:
    """Make the meshes of a reconstruction, and return the medians over the objects."""
    for words in (("mesh", out), ("evaluate", out), ("report", out)):
        shared.run_backend(*words)
    report = json.loads((out / "report.json").read_text())
    return {name: shared.over_objects(report, name) for name in ("f1", "f1_005")}


def measured_meshes(folder: Path, photos: Sequence[int], minutes: float, seed: int) -> dict[str, Any]:
    """Return the scores of meshes from the true masks, "masks", and from strokes, by the number of photos with them."""
    rows: dict[str, Any] = {}
    with tempfile.TemporaryDirectory(prefix="objectgs-benchmark-") as place:
        scratch = Path(place)
        truth = load_capture(folder, scratch / "cache")
        length = ("--minutes", minutes, "--seed", seed)
        shared.run_backend("train", folder, "--out", scratch / "masks", *length)
        rows["masks"] = mesh_scores(scratch / "masks")
        capture, unlabeled = scratch / "capture", scratch / "unlabeled"
        copy_without_masks(folder, capture)
        shared.run_backend("train", capture, "--out", unlabeled, *length)
        for count in photos:
            file, out = scratch / "strokes.json", scratch / f"labeled-{count}"
            file.write_text(json.dumps(strokes_of(truth, count)))
            shutil.copytree(unlabeled, out)
            shared.run_backend("label", out, "--strokes", file)
            rows[str(count)] = mesh_scores(out)
    return rows


def _table_in_turn(captures: Mapping[str, Sequence[Mapping[str, Any]]]) -> list[str]:
    """Return the lines on objects that are marked one after the other."""
    rows = []
    for name, seeds in captures.items():
        turns = [seed["in turn"] for seed in seeds if "in turn" in seed]
        if turns:
            counts = [min(count, len(turns[0])) for count in IN_TURN]
            rows.append((name, *(shared.spread([turn[str(count)] for turn in turns], "{:.3f}") for count in counts)))
    head = ("capture", *(f"{count} marked" for count in IN_TURN[:-1]), "all")
    return [
        "A user marks one object after the other, so that most of the scene belongs to none at first: mean IoU of "
        "those that are marked so far, in random order, over what the splats show in training photos, before the "
        "borders are trained.",
        "",
        *shared.table(head, rows),
    ]


def document(found: Mapping[str, Any]) -> str:
    """Return the text of docs/pointing.md."""
    lines = [
        "# Objects by strokes",
        "",
        "Made by `python benchmarks/pointing.py --write`: captures are trained without their masks, and one stroke "
        "marks each object that shows in one, two or three photos. If the masks leave pixels unlabeled, one stroke in "
        "one photo marks what is there. No stroke corrects the result, as a person would. *mIoU* is that of the "
        "renders' IDs with the true masks of held-out views, over labeled pixels and over all; *PSNR* is that of "
        "held-out views, before and after. *Seconds* are those of the command `label` on two cores of a server CPU, "
        f"its training of borders included. Means over {found['seeds']} seeds ± standard deviation.",
        "",
    ]
    rows = []
    for name, seeds in found["captures"].items():
        for count in sorted(set(seeds[0]) - {"0", "in turn", "proposed"}):
            cells = [
                shared.spread([seed[count][key] for seed in seeds], form)
                for key, form in (("miou", "{:.3f}"), ("miou_all", "{:.3f}"))
            ]
            before, after = (shared.spread([seed[of]["psnr"] for seed in seeds], "{:.2f}") for of in ("0", count))
            seconds = shared.spread([seed[count]["seconds"] for seed in seeds], "{:.0f}")
            rows.append((name, count, *cells, before, after, seconds))
    proposals = [
        (
            name,
            shared.spread([seed["proposed"]["proposed"] for seed in seeds], "{:.0f}"),
            shared.spread([seed["proposed"]["good"] for seed in seeds], "{:.1f}")
            + f" of {seeds[0]['proposed']['objects']:.0f}",
            *(
                shared.spread([seed["proposed"][key] for seed in seeds], form)
                for key, form in (("miou", "{:.3f}"), ("miou_all", "{:.3f}"), ("psnr", "{:.2f}"), ("seconds", "{:.0f}"))
            ),
        )
        for name, seeds in found["captures"].items()
        if "proposed" in seeds[0]
    ]
    head = ("capture", "photos with strokes", "mIoU", "with unlabeled", "PSNR before, dB", "after, dB", "seconds")
    lines += shared.table(head, rows)
    if any("in turn" in seeds[0] for seeds in found["captures"].values()):
        lines += ["", "## One after the other", "", *_table_in_turn(found["captures"])]
    if proposals:
        lines += [
            "",
            "## Without strokes",
            "",
            "`propose` finds objects by the shape of the scene, and `label` separates them. Each true object is "
            f"compared with the proposed one that fits it. *Found* are those of an IoU of {GOOD} or more, over all "
            "pixels. Flat things that lie on others, such as posters on a table, are not found.",
            "",
            *shared.table(("capture", "proposed", "found", "mIoU", "with unlabeled", "PSNR, dB", "seconds"), proposals),
        ]
    if meshes := found.get("meshes"):
        rows = []
        for name in sorted(meshes[0], key=lambda name: name == "masks"):
            of = "true masks" if name == "masks" else f"strokes in {name} photo{'s' if name != '1' else ''}"
            cells = [
                shared.spread([seed[name][key] for seed in meshes], form)
                for key, form in (("f1", "{:.4f}"), ("f1_005", "{:.3f}"))
            ]
            rows.append((of, *cells))
        lines += [
            "",
            "## Meshes",
            "",
            "Made with `--meshes`: the demo's meshes from strokes and from its true masks, compared with the true "
            "surface where training views see it. Medians over the objects.",
            "",
            *shared.table(("objects by", "F1 at 2 cm", "F1 at 5 mm"), rows),
        ]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Measure, and print or write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--photos", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--minutes", type=float, default=2.4)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--capture", nargs="+", choices=CAPTURES, default=list(CAPTURES))
    parser.add_argument("--write", action="store_true", help="all captures and two seeds, for the document")
    parser.add_argument("--proposals", action="store_true", help="measure `propose` alone")
    parser.add_argument("--meshes", action="store_true", help="measure the demo's meshes alone")
    options = parser.parse_args()
    options.photos = [] if options.proposals else options.photos
    seeds = 2 if options.write else options.seeds
    names = CAPTURES if options.write and not options.proposals else options.capture
    folders = {name: CAPTURES[name] for name in (["demo"] if options.meshes else names) if CAPTURES[name].is_dir()}
    shared.compile_everything()
    results = shared.Results(
        ROOT / "build" / "pointing-results",
        shared.digest(shared.sources(), options.photos, options.minutes), len(folders) * seeds,
    )  # fmt: skip
    measure, kind = (measured_meshes, "meshes of ") if options.meshes else (measured, "")
    by_name = {
        name: [
            results.get(
                f"{kind}{name}, seed {seed}",
                lambda folder=folder, seed=seed: measure(folder, options.photos, options.minutes, seed),
                lambda rows: ", ".join(f"{n}: {row.get('miou') or row.get('f1')}" for n, row in rows.items()),
            )
            for seed in range(seeds)
        ]
        for name, folder in folders.items()
    }
    if results.failures:
        sys.exit("\n".join(f"{name}: {why}" for name, why in results.failures.items()))
    found = {"seeds": seeds, "captures": by_name}
    if options.meshes:
        found = {"seeds": seeds, "captures": {}, "meshes": by_name["demo"]}
    if options.write:
        kept = documents.load("pointing")
        if options.meshes:
            found["captures"] = kept["captures"]
        elif "meshes" in kept:
            found["meshes"] = kept["meshes"]
        if options.proposals:
            for name, rows in kept["captures"].items():
                for new, old in zip(by_name.setdefault(name, [{} for _ in rows]), rows, strict=True):
                    new.update({key: row for key, row in old.items() if key not in new})
        documents.save("pointing", found)
    print(document(found))


if __name__ == "__main__":
    main()
