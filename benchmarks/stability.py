"""Train on difficult captures and compare each result with its expectation.

    python benchmarks/stability.py [--json] [--write] [--only CASE ...]

Each case trains on synthetic captures of colored spheres for a fixed number of steps, so the machine's load affects
only the seconds. All values must stay finite in every case; the table lists the other expectations. --write saves the
table to docs/stability.md. The exit code is 1 if an expectation does not hold.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import os
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from backend.capture import load_capture
from backend.evaluation import IdScores, psnr
from backend.labels import vote
from backend.model.draw import draw
from backend.shared.events import Reporter
from backend.training.budget import Budget
from backend.training.settings import Settings
from backend.training.trainer import Trainer
from benchmarks import documents
from tests.backend.conftest import Scene, rays_of, write_model, write_scene

SIZE = (96, 72)
VIEWS = 24
STEPS = 300
SETTINGS = {"3d": Settings(offsets=5), "2d": Settings(offsets=5, primitive="2d")}


class Trained(NamedTuple):
    """Quality of a training.

    psnr: mean over the held-out views, or over all views if none is held out. miou: of the rendered IDs in the training
    views against the exact masks; given_miou: of their given masks. lost: number of losses, model values and updates
    that are not finite.
    """

    psnr: float
    miou: float | None
    given_miou: float | None
    lost: int
    trainer: Trainer


class Row(NamedTuple):
    """One line of the table."""

    case: str
    expected: str
    found: str
    held: bool
    seconds: float


Change = Callable[[Scene], None]


def each_image(change: Callable[[int, np.ndarray], np.ndarray]) -> Change:
    """Return a change that maps the pixels (h, w, 3) uint8 of every view."""

    def apply(scene: Scene) -> None:
        for view, name in enumerate(scene.names):
            path = scene.folder / "images" / name
            Image.fromarray(change(view, np.asarray(Image.open(path)))).save(path)

    return apply


def each_mask(change: Callable[[int, np.ndarray], np.ndarray | None]) -> Change:
    """Return a change that maps the IDs (h, w) of every view; None removes the mask."""

    def apply(scene: Scene) -> None:
        for view, name in enumerate(scene.names):
            path = (scene.folder / "masks" / name).with_suffix(".png")
            changed = change(view, scene.ids[view])
            if changed is None:
                path.unlink()
            else:
                Image.fromarray(changed.astype(np.uint16)).save(path)

    return apply


def elsewhere(scale: float, offset: float) -> Change:
    """Return a change that scales the world and then translates it by `offset` along each axis."""

    def apply(scene: Scene) -> None:
        scene.xyz = scene.xyz * scale + offset
        for viewmat in scene.viewmats:
            viewmat[:3, 3] = scale * viewmat[:3, 3] - viewmat[:3, :3] @ np.full(3, offset)

    return apply


def enlarged(times: int) -> Change:
    """Return a change that multiplies the width and height of all images and masks by `times`."""

    def apply(scene: Scene) -> None:
        model, width, height, params = scene.camera
        scene.camera = (model, width * times, height * times, [p * times for p in params])
        scene.pixels = [pixels * times for pixels in scene.pixels]
        for view, name in enumerate(scene.names):
            for folder in ("images", "masks"):
                path = scene.folder / folder / name
                image = Image.open(path)
                image.resize((width * times, height * times), Image.Resampling.NEAREST).save(path, compress_level=1)
            scene.ids[view] = scene.ids[view].repeat(times, 0).repeat(times, 1)

    return apply


def paint(scene: Scene) -> None:
    """Paint a view-independent pattern on the spheres, and the background in one color."""
    rays = rays_of(scene.lens())

    def painted(view: int, _: np.ndarray) -> np.ndarray:
        viewmat, depth = scene.viewmats[view], scene.depths[view]
        there = np.isfinite(depth)
        xyz = (rays * np.where(there, depth, 1)[..., None] - viewmat[:3, 3]) @ viewmat[:3, :3]
        pattern = 130 + 90 * np.sin(7 * xyz + scene.ids[view][..., None] * np.array([1.0, 2.0, 3.0]))
        return np.where(there[..., None], pattern, (40, 60, 90)).astype(np.uint8)

    each_image(painted)(scene)


def take_colors(scene: Scene) -> None:
    """Set each point's color from an image that shows it, as COLMAP does, and write the model."""
    for name, seen, pixels in zip(scene.names, scene.seen, scene.pixels, strict=True):
        x, y = pixels.astype(np.int64).T
        scene.rgb[seen] = np.asarray(Image.open(scene.folder / "images" / name))[y, x]
    write_model(scene, scene.folder / "sparse" / "0", ".bin")


def train(
    change: Change | None = None,
    settings: Settings = SETTINGS["3d"],
    steps: int = STEPS,
    max_size: int = 0,
    scored: bool = True,
    **options,
) -> Trained:
    """Make a capture, change it, train and measure.

    Args:
        scored: also compute mIoU.
        options: passed to `write_scene`.
    """
    with tempfile.TemporaryDirectory(prefix="objectgs-stability-") as folder:
        scene = write_scene(Path(folder) / "capture", **{"views": VIEWS, "size": SIZE, "points": 200, **options})
        paint(scene)
        if change is not None:
            change(scene)
        take_colors(scene)
        capture = load_capture(scene.folder, Path(folder) / "cache", max_size=max_size)
        ids = vote(capture).ids if capture.has_masks else np.zeros(len(capture.points.xyz), np.int64)
        trainer = Trainer.start(capture, ids, settings)
        lost = 0
        inner = trainer.step

        def step(progress: float) -> torch.Tensor:
            nonlocal lost
            loss = inner(progress)
            lost += not math.isfinite(float(loss))
            return loss

        trainer.step = step  # type: ignore[method-assign]
        trainer.run(Budget(steps=steps), Path(folder) / "checkpoint", Reporter())
        model, own = trainer.shown, trainer.model
        numbers = [own.anchors.rows, own.background, *own.heads.parameters(), model.anchors.rows]
        lost += trainer.progress.skipped + sum(int((~t.isfinite()).sum()) for t in numbers)
        shown = [
            psnr(draw(model, trainer.scene.camera(i), want_ids=False).image, capture.image(i))
            for i in capture.test_indices or capture.train_indices
        ]
        miou = given = None
        if scored and capture.has_masks:
            rendered, masks = IdScores(), IdScores()
            for i in capture.train_indices:
                truth, mask = scene.ids[i], capture.mask(i)
                found = draw(model, trainer.scene.camera(i)).ids
                assert found is not None
                if truth.shape == found.shape:
                    rendered.add(found, truth)
                    masks.add(np.zeros_like(truth) if mask is None else mask, truth)
            miou, given = rendered.result()["miou"], masks.result()["miou"]
        return Trained(float(np.mean(shown)), miou, given, lost, trainer)


def row(case: str, expected: str, found: str, held: bool, *trained: Trained) -> Row:
    """Return a table row that holds only if all values of these trainings are finite; `main` sets its seconds."""
    lost = sum(t.lost for t in trained)
    return Row(case, expected, found + (f"; {lost} numbers not finite" if lost else ""), held and not lost, 0.0)


def seeds() -> list[Row]:
    """Train with 20 seeds for capture and training, alternating between the primitives."""
    found = []
    for seed in range(20):
        settings = dataclasses.replace(SETTINGS["2d" if seed % 2 else "3d"], seed=seed)
        found.append(train(settings=settings, steps=150, size=(96, 72), seed=seed, scored=False))
    values = [t.psnr for t in found]
    spread = f"{min(values):.1f} to {max(values):.1f} dB"
    return [row("20 seeds", "all numbers finite", spread, all(map(math.isfinite, values)), *found)]


def scale_and_offset() -> list[Row]:
    """Train on the same world scaled or translated, and compare means over seeds.

    A coordinate with 1e6 added keeps ten decimals. This changes at most the last bit of some float32 values, but over
    300 steps the effect grows to that of another seed: a single training can end 0.1 dB higher or lower.
    """
    rows = []
    for primitive, settings in SETTINGS.items():
        seeded = [dataclasses.replace(settings, seed=seed) for seed in range(8)]
        here = [train(settings=each, scored=False) for each in seeded]
        for name, scale, offset in (
            ("scaled by 1e-4", 1e-4, 0.0), ("scaled by 1e4", 1e4, 0.0), ("moved by 1e6", 1.0, 1e6)
        ):  # fmt: skip
            there = [train(elsewhere(scale, offset), each, scored=False) for each in seeded]
            differences = np.array([t.psnr - h.psnr for t, h in zip(there, here, strict=True)])
            mean, error = differences.mean(), differences.std(ddof=1) / math.sqrt(len(differences))
            rows.append(
                row(
                    f"capture {name}, {primitive}",
                    "the mean over eight seeds within 0.1 dB of that of the capture as it is",
                    f"{np.mean([t.psnr for t in there]):.2f} dB, {mean:+.3f} ± {error:.3f}; single seeds "
                    f"{differences.min():+.3f} to {differences.max():+.3f}", abs(mean) <= 0.1, *here, *there,
                )
            )  # fmt: skip
    return rows


def exposure() -> list[Row]:
    """Train with a random known gain per image and channel, and compare at the common exposure."""
    rng = np.random.default_rng(0)
    logs = rng.uniform(-0.3, 0.3, (VIEWS, 1)) + rng.uniform(-0.1, 0.1, (VIEWS, 3))
    size = (240, 180)  # a gain is measured on 3 x 3 pixels at each point
    plain = train(each_image(lambda view, pixels: (pixels * 0.6).astype(np.uint8)), size=size)
    held_out = plain.trainer.scene.capture.test_indices
    trained = plain.trainer.scene.capture.train_indices
    gains = np.exp(logs - logs[list(trained)].mean(0))
    varied = train(each_image(lambda view, pixels: (pixels * 0.6 * gains[view]).astype(np.uint8)), size=size)
    photos = [plain.trainer.scene.capture.image(i) for i in held_out]

    def against_photos(images: list[np.ndarray]) -> float:
        return float(np.mean([psnr(image, photo) for image, photo in zip(images, photos, strict=True)]))

    scene, model = varied.trainer.scene, varied.trainer.shown
    as_taken = against_photos([scene.capture.image(i) for i in held_out])
    common = against_photos(
        [draw(model, dataclasses.replace(scene.camera(i), gain=(1.0, 1.0, 1.0)), False).image for i in held_out]
    )
    return [
        row(
            "exposure and white balance change from photo to photo", "at the common exposure, within 1 dB of the same "
            "photos unchanged", f"{common:.1f} dB, unchanged {plain.psnr:.1f}; the photos themselves {as_taken:.1f}",
            common >= plain.psnr - 1 and scene.exposure_varies, plain, varied,
        )
    ]  # fmt: skip


def masks() -> list[Row]:
    """Train with wrong, missing and shifted masks."""
    rng = np.random.default_rng(0)
    known = (1, 2, 5)

    def wrong(view: int, ids: np.ndarray) -> np.ndarray:
        out = ids.copy()
        for i in known:
            if rng.random() < 0.3:
                out[ids == i] = rng.choice([j for j in known if j != i])
        return out

    def shifted(view: int, ids: np.ndarray) -> np.ndarray:
        angle = rng.uniform(0, 2 * np.pi)
        return np.roll(ids, (round(5 * np.sin(angle)), round(5 * np.cos(angle))), (0, 1))

    rows = []
    clean = train()
    for name, change, expected in (
        ("30 % of the objects in the masks are another", wrong, "better than its masks"),
        ("masks shifted by 5 pixels, in a random direction per view", shifted, "better than its masks"),
    ):
        found = train(each_mask(change))
        rows.append(
            row(
                name, expected, f"mIoU {found.miou:.3f} of masks with {found.given_miou:.3f}",
                found.miou > found.given_miou, found,
            )
        )  # fmt: skip
    found = train(each_mask(lambda view, ids: None if view % 10 == 1 else ids))
    rows.append(
        row(
            "10 % of the masks are missing", "mIoU within 0.02 of that with all",
            f"mIoU {found.miou:.3f}, with all {clean.miou:.3f}", abs(found.miou - clean.miou) <= 0.02, clean, found,
        )
    )  # fmt: skip
    return rows


def images() -> list[Row]:
    """Train with too few images, and with images that show nothing."""
    rows = []

    def at_least(case: str, decibel: float, found: Trained) -> None:
        rows.append(row(case, f"at least {decibel:g} dB", f"{found.psnr:.1f} dB", found.psnr >= decibel, found))

    at_least("one image", 25, train(views=1, steps=200))

    def twice(scene: Scene) -> None:
        scene.viewmats[1], scene.quaternions[1] = scene.viewmats[0], scene.quaternions[0]
        scene.seen[1], scene.pixels[1], scene.ids[1] = scene.seen[0], scene.pixels[0], scene.ids[0]
        for folder in ("images", "masks"):
            first, second = (scene.folder / folder / name for name in scene.names)
            second.write_bytes(first.read_bytes())

    at_least("two identical images", 25, train(twice, views=2, steps=200))
    for primitive, settings in SETTINGS.items():
        for name, value in (("black", 0), ("white", 255)):
            found = train(each_image(lambda _, pixels, value=value: np.full_like(pixels, value)), settings, steps=200)
            at_least(f"{name} images, {primitive}", 30, found)
    saturated = each_image(lambda _, pixels: np.where(pixels > 127, 255, 0).astype(np.uint8))
    at_least("saturated images: every number 0 or 255", 15, train(saturated))
    return rows


def large() -> list[Row]:
    """Train with more pixels, cameras and objects than usual."""

    found = train(enlarged(16), max_size=0, views=3, size=(344, 228), steps=6, scored=False)
    view = found.trainer.scene.capture.views[0]
    rows = [
        row(
            f"images of {view.width} x {view.height} pixels as they are", "six steps, all numbers finite",
            f"{found.psnr:.1f} dB", math.isfinite(found.psnr), found,
        )
    ]  # fmt: skip
    found = train(views=1000, size=(48, 36), steps=300)
    capture = found.trainer.scene.capture
    rows.append(
        row(
            "1,000 cameras", "all are used; at least 20 dB",
            f"{len(capture.views):,} views, {found.psnr:.1f} dB, mIoU {found.miou:.3f}",
            len(capture.views) == 1000 and found.psnr >= 20, found,
        )
    )  # fmt: skip
    rng = np.random.default_rng(0)
    side = 13
    centers = np.stack(np.meshgrid(*3 * [np.linspace(-1.1, 1.1, side)], indexing="ij"), -1).reshape(-1, 3)[:2000]
    spheres = [(i + 1, p + rng.uniform(-0.02, 0.02, 3), 0.06) for i, p in enumerate(centers)]
    found = train(views=12, size=(320, 240), steps=200, spheres=spheres, points=5)
    objects = len(found.trainer.model.classes) - 1
    rows.append(
        row(
            "2,000 objects", "all that the masks show are learned; mIoU at least 0.5",
            f"{objects:,} objects, {found.psnr:.1f} dB, mIoU {found.miou:.3f}", found.miou >= 0.5, found,
        )
    )  # fmt: skip
    return rows


CASES = {f.__name__: f for f in (seeds, scale_and_offset, exposure, masks, images, large)}


def table(rows: list[Row]) -> str:
    """Return the rows as a Markdown table."""
    lines = ["| Case | Expected | Found | Held | Seconds |", "| --- | --- | --- | --- | ---: |"]
    for r in rows:
        held = "yes" if r.held else "**no**"
        lines.append(f"| {r.case} | {r.expected} | {r.found} | {held} | {r.seconds:.0f} |")
    return "\n".join(lines)


def document(found: Mapping[str, Any]) -> str:
    """Return the text of docs/stability.md."""
    return (
        "# Stability tests\n\n"
        f"Made by `python benchmarks/stability.py --write`, with {found['processors']} processors. Every case is a "
        "complete training on a capture of spheres with known ground truth; it fails if a loss, a gradient or a "
        "value of the model is NaN or infinite. PSNR is that of held-out views if there are any; mIoU compares the "
        "rendered IDs of the training views with the truth. Seconds are the mean over the cases of a group.\n\n"
        + table([Row(**row) for row in found["rows"]])
        + "\n"
    )


def main() -> int:
    """Print the table, or one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--write", action="store_true", help="write docs/stability.md")
    parser.add_argument("--only", nargs="+", choices=CASES, default=list(CASES), metavar="CASE")
    options = parser.parse_args()
    rows: list[Row] = []
    for name in options.only:
        started = time.perf_counter()
        found = CASES[name]()
        each = (time.perf_counter() - started) / len(found)
        rows += [r._replace(seconds=each) for r in found]
        if not options.json:
            print("\n".join(table(rows[-len(found) :]).splitlines()[2:]), flush=True)
    if options.json:
        print(json.dumps([r._asdict() for r in rows], indent=1))
    if options.write:
        documents.save("stability", {"processors": os.cpu_count(), "rows": [r._asdict() for r in rows]})
    return 0 if all(r.held for r in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
