"""What each command does: the stages in the order of the data, and what they leave in the reconstruction folder.

objectgs.json keeps what was asked, so that a later command knows what the files beside it were made from:
`capture` (folder, max_size, digest), `votes` (what points.ply came from), `training` (settings, minutes or steps, the
votes it began with), `export` (what splats.ply holds) and `stages` (seconds and peak memory).
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.metadata
import io
import os
import platform
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numba
import numpy as np
import psutil
import torch
from PIL import Image

from . import __version__
from .capture import Capture, check_capture, load_capture
from .evaluation import IdScores, ImageScores, comparison, save_picture, write_report
from .evaluation import evaluate as evaluate_views
from .evaluation.pictures import as_bytes
from .export import agreement, fit_splats, write_splats
from .labels import vote as vote_points
from .labels.points import read_points, write_points
from .model.object_model import ObjectModel
from .palette import object_colours
from .protocol import (
    Cancelled,
    InputError,
    Reconstruction,
    Reporter,
    StoppingReporter,
    plain,
    read_json,
    write_atomic,
    write_json,
)
from .raster import compile_kernels
from .raster.draw import draw
from .training.loop import Budget, Progress, Trainer, load_model, progress_of
from .training.scene import Scene
from .training.settings import Settings, downscale_at

PICTURES_IN_REPORT = 3


def set_threads(threads: int | None) -> None:
    """Use so many threads in kernels and in torch (None: every core that this process may use)."""
    count = max(min(threads or _cores(), numba.config.NUMBA_NUM_THREADS), 1)
    numba.set_num_threads(count)
    torch.set_num_threads(count)


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


# --- the commands ----------------------------------------------------------------------------------------------------


def check(options: argparse.Namespace, reporter: StoppingReporter) -> None:
    """Report on a capture; InputError with the first problem if it cannot be used."""
    found = check_capture(options.capture, options.max_size, reporter)
    for sentence in found["warnings"] + found["problems"][1:]:
        reporter.warning(sentence)
    if found["problems"]:
        raise InputError(found["problems"][0])
    sizes = ", ".join(found["view_sizes"])
    error = found["mean_reprojection_error"]
    off = "" if error is None else f", on average {error:.2f} pixels off in the images"
    reporter.status(f"{found['counts']['used']} views with poses ({sizes}), {found['points']:,} points{off}")
    for camera in found["cameras"]:
        undo = "undistorted on first use" if camera["undistort"] else "used as it is"
        reporter.status(f"camera {camera['id']}: {camera['model']} {camera['width']}x{camera['height']}, {undo}")
    for entry in found["objects"]:
        reporter.status(f"object {entry['id']} {entry['name']}: in {entry['views']} views")
    if not found["objects"]:
        reporter.status("no masks: the scene can be trained as one, without objects")
    reporter.done(message="The capture can be used.", check=found)


def vote(options: argparse.Namespace, reporter: StoppingReporter) -> None:
    """Write points.ply and objects.json."""
    folder, capture = _open(options, reporter)
    if not capture.has_masks:
        reporter.warning(f"{capture.folder / 'masks'} does not exist, so no point belongs to an object.")
    _vote(folder, capture, options, reporter)
    reporter.done(points=str(folder.points), objects=str(folder.objects))


def train(options: argparse.Namespace, reporter: StoppingReporter) -> None:
    """Train, resume or extend; leaves a checkpoint, previews and splats.ply."""
    folder, capture = _open(options, reporter)
    settings = _settings(options)
    budget = Budget(options.steps, None if options.steps else 60.0 * options.minutes)
    trainer = None if options.restart else _resumed(folder, capture, settings, options, reporter)
    if trainer is None:
        if not _votes_are_current(folder, capture, options):
            _vote(folder, capture, options, reporter)
        trainer = Trainer.start(capture, read_points(folder.points).ids, settings, options.memory_mb)
        if options.restart:
            shutil.rmtree(folder.checkpoint, ignore_errors=True)
    progress = trainer.progress
    if progress.step and budget.share(progress.step, progress.seconds) >= 1:
        reporter.status(
            f"Already trained for {progress.step} steps in {progress.seconds:.0f} s; ask for more --minutes or "
            "--steps to extend it, or --restart to begin anew."
        )
    else:
        _remember(
            folder,
            capture=_described(capture, options.max_size),
            training={
                "settings": settings.as_dict(),
                "minutes": None if options.steps else options.minutes,
                "steps": options.steps,
                "votes": _votes_key(capture, options),
            },
        )
        folder.previews.mkdir(exist_ok=True)
        begun = f"Going on after step {progress.step} with" if progress.step else "Training"
        reporter.status(f"{begun} {len(trainer.model.anchors):,} anchors")
        _run(trainer, budget, folder, options.checkpoint_seconds, reporter)
    with _stage(folder, "export"):
        export = _export(trainer.model, trainer.scene, folder, reporter)
    _remember(folder, export=export)
    latest = progress.curve[-1] if progress.curve else {}
    reporter.done(
        steps=progress.step, seconds=round(progress.seconds, 1), anchors=len(trainer.model.anchors),
        splats=str(folder.splats), psnr=latest.get("psnr"), miou=latest.get("miou"),
        psnr_of_export=export["psnr_of_export"],
    )  # fmt: skip


def render(options: argparse.Namespace, reporter: StoppingReporter) -> None:
    """Draw views into DIR/renders, named as the images."""
    trained = _trained(options, reporter)
    folder, capture = trained.folder, trained.capture
    indices = list(capture.test_indices)
    if options.views == "all" or not indices:
        indices = list(range(len(capture.views)))
    reporter.status(f"Drawing {len(indices)} views")
    paths = _render_paths(folder.renders, [view.name for view in capture.views])
    with _stage(folder, "render"):
        for done, index in enumerate(indices, 1):
            picture = draw(trained.model, trained.scene.camera(index), options.ids, options.depth)
            path = paths[index]
            path.parent.mkdir(parents=True, exist_ok=True)
            _save_png(path, as_bytes(picture.image))
            if picture.ids is not None:
                _save_ids(path, picture.ids)
            if picture.depth is not None:
                _save_array(path.with_suffix(".depth.npy"), picture.depth)
            reporter.progress(done, len(indices), what="views")
    reporter.done(renders=str(folder.renders), views=len(indices))


def evaluate(options: argparse.Namespace, reporter: StoppingReporter) -> None:
    """Measure on the held-out views; leaves evaluation.json, which `report` reads."""
    trained = _trained(options, reporter)
    folder, capture = trained.folder, trained.capture
    if not capture.test_indices:
        raise InputError(f"{capture.folder} has too few views to hold any out; there is nothing to measure on.")
    reporter.status(f"Measuring on the {len(capture.test_indices)} held-out views")

    def drawn(index: int) -> tuple[np.ndarray, np.ndarray]:
        picture = draw(trained.model, trained.scene.camera(index))
        assert picture.ids is not None
        return picture.image, picture.ids

    with _stage(folder, "evaluate"):
        found = evaluate_views(capture, drawn, capture.test_indices, reporter, trained.scene.zero_is_object)
    write_json(_evaluation_file(folder), plain({"step": trained.progress.step, **found}))
    quality = {name: value for name, value in found["quality"].items() if value is not None}
    reporter.done(**{name: round(float(value), 4) for name, value in quality.items()})


def report(options: argparse.Namespace, reporter: StoppingReporter) -> None:
    """Write report.json, report.md and their pictures from what the earlier commands left."""
    trained = _trained(options, reporter)
    folder, capture, model, progress = trained.folder, trained.capture, trained.model, trained.progress
    evaluation = _evaluation(folder, progress, reporter)
    with _stage(folder, "report"):
        pictures = _report_pictures(trained, reporter)
    memory = _memory(folder)
    training = memory["training"]
    export = memory.get("export", {})
    value = {
        "capture": {
            "folder": capture.folder.name, "views": len(capture.views), "held_out": len(capture.test_indices),
            "objects": len(capture.object_ids), **capture.counts,
            "exposure_varies": trained.scene.exposure_varies,
            "cameras": ", ".join(f"{count} {name}" for name, count in capture.counts["cameras"].items()),
        },
        "settings": {
            "minutes": training["minutes"], "steps": training["steps"], "max_size": memory["capture"]["max_size"],
            "strategy": training["votes"]["strategy"], **training["settings"],
        },
        "machine": machine(),
        "left_out": _left_out(trained),
        "stages": memory.get("stages", []),
        "curve": progress.curve,
        "model": {
            "anchors": len(model.anchors),
            "gaussians": len(model.generate().source) if model.explicit else export.get("splats"),
            "bytes": folder.splats.stat().st_size if folder.splats.exists() else None,
            "trained_steps": progress.step, "trained_seconds": round(progress.seconds, 1),
            "psnr_of_export": export.get("psnr_of_export"),
        },
        "quality": evaluation["quality"],
        "objects": _objects_of_report(trained, evaluation["objects"]),
        "views": evaluation["views"],
    }  # fmt: skip
    write_report(folder, value, pictures, title=capture.folder.resolve().name)
    reporter.done(report=str(folder.report_md))


def doctor(options: argparse.Namespace, reporter: StoppingReporter) -> None:
    """Versions, devices, and whether the kernels compile and a small training runs here."""
    found = machine()
    for key, value in found.items():
        reporter.status(f"{key}: {value}")
    started = time.monotonic()
    reporter.status("Compiling the renderer's kernels (once for a machine)")
    compile_kernels(lambda done, total: reporter.progress(done, total))
    reporter.status("Training a few splats")
    with tempfile.TemporaryDirectory(prefix="objectgs-doctor-") as place:
        _train_a_little(Path(place), reporter)
    seconds = time.monotonic() - started
    reporter.done(message=f"The backend works; the kernels were ready in {seconds:.1f} s.", machine=found)


def machine() -> dict[str, Any]:
    """What the figures were measured on."""
    return {
        "objectgs": __version__,
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.machine()}",
        "cores": _cores(),
        "threads": numba.get_num_threads(),
        "memory_gb": round(psutil.virtual_memory().total / 1e9, 1),
        "device": "cpu",
        **{name: importlib.metadata.version(name) for name in ("torch", "numpy", "numba", "pycolmap")},
    }


# --- opening what is there -------------------------------------------------------------------------------------------


def _open(options: argparse.Namespace, reporter: Reporter) -> tuple[Reconstruction, Capture]:
    """The reconstruction folder, made where it is not there, and the capture; bad input leaves nothing behind."""
    folder = Reconstruction(options.out)
    absent = [path for path in (folder.cache, folder.folder, *folder.folder.parents) if not path.exists()]
    try:
        folder.create()
        with _stage(folder, "read"):
            capture = load_capture(options.capture, folder.cache, options.memory_mb, options.max_size, reporter)
    except (InputError, OSError):
        if absent:
            shutil.rmtree(absent[-1], ignore_errors=True)
        raise
    return folder, capture


class _Trained(NamedTuple):
    """A reconstruction folder with a model in it, opened."""

    folder: Reconstruction
    capture: Capture
    model: ObjectModel
    scene: Scene
    progress: Progress


def _trained(options: argparse.Namespace, reporter: Reporter) -> _Trained:
    folder = Reconstruction(options.folder)
    if not folder.folder.is_dir():
        raise InputError(f"{folder.folder} does not exist; give the folder that `train` was told with --out.")
    if not folder.settings.exists():
        raise InputError(
            f"{folder.folder} is no reconstruction, since it holds no {folder.settings.name}; train first."
        )
    memory = _memory(folder)
    model, state, warning = load_model(folder.checkpoint)
    if warning:
        reporter.warning(warning)
    if "training" not in memory:
        raise InputError(
            f"{folder.settings} does not say what {folder.checkpoint} was trained from; train again with --restart."
        )
    place = Path(options.capture or memory["capture"]["folder"])
    if not place.is_dir():
        raise InputError(f"The capture {place} of {folder.folder} is gone; say with --capture where it is now.")
    max_size = memory["capture"]["max_size"]
    capture = load_capture(place, folder.cache, options.memory_mb, max_size, reporter)
    if _digest(capture) != memory["capture"]["digest"]:
        raise InputError(
            f"The capture {place} is not the one that {folder.folder} was trained on; put that one back, say with "
            "--capture where it is, or train again."
        )
    if options.capture:
        _remember(folder, capture=_described(capture, max_size))
    zero_is_object = state["settings"]["zero_is_object"]
    scene = Scene(capture, model.object_ids, model.normalization, zero_is_object, options.memory_mb)
    return _Trained(folder, capture, model, scene, progress_of(state))


def _resumed(
    folder: Reconstruction, capture: Capture, settings: Settings, options: argparse.Namespace, reporter: Reporter
) -> Trainer | None:
    """The training that DIR holds, or None; InputError where it was one of another capture or other choices."""
    resumed = Trainer.resume(capture, folder.checkpoint, settings, options.memory_mb)
    if resumed is None:
        return None
    trainer, warning = resumed
    if warning:
        reporter.warning(warning)
    memory = _memory(folder)
    otherwise = "use the same, another --out, or --restart to train anew."
    if "training" not in memory:
        raise InputError(f"{folder.settings} does not say what {folder.checkpoint} was trained from; {otherwise}")
    if memory["capture"]["digest"] != _digest(capture):
        raise InputError(f"{folder.checkpoint} was trained on another capture than {capture.folder}; {otherwise}")
    if memory["capture"]["max_size"] != options.max_size:
        before = memory["capture"]["max_size"]
        raise InputError(f"{folder.checkpoint} was trained with --max-size {before}; {otherwise}")
    strategy = memory["training"]["votes"]["strategy"]
    if strategy != options.strategy:
        raise InputError(f"{folder.checkpoint} was trained with --strategy {strategy}; {otherwise}")
    return trainer


def _settings(options: argparse.Namespace) -> Settings:
    given = {
        "offsets": options.offsets, "max_anchors": options.max_anchors, "voxel": options.voxel,
        "semantic_weight": options.semantic_weight,
    }  # fmt: skip
    return Settings(
        seed=options.seed, mode=options.mode, sh_degree=options.sh_degree, background=options.background,
        zero_is_object=options.unlabelled_is_object, **{k: v for k, v in given.items() if v is not None},
    )  # fmt: skip


# --- voting ----------------------------------------------------------------------------------------------------------


def _vote(folder: Reconstruction, capture: Capture, options: argparse.Namespace, reporter: Reporter) -> None:
    with _stage(folder, "vote"):
        votes = vote_points(capture, options.strategy, options.seed, reporter=reporter)
        colours = object_colours(votes.counts)
        objects = [
            {"id": i, "name": _name(capture, i), "colour": list(colours[i]), "points": n}
            for i, n in sorted(votes.counts.items())
            if i
        ]
        write_points(folder.points, capture.points, votes)
        write_json(folder.objects, {"objects": objects})
    _remember(folder, votes=_votes_key(capture, options))
    for entry in objects:
        reporter.status(f"object {entry['id']} {entry['name']}: {entry['points']:,} points")


def _votes_are_current(folder: Reconstruction, capture: Capture, options: argparse.Namespace) -> bool:
    if not folder.points.exists() or _memory(folder).get("votes") != _votes_key(capture, options):
        return False
    try:
        return len(read_points(folder.points).ids) == len(capture.points.xyz)
    except InputError:
        return False


def _votes_key(capture: Capture, options: argparse.Namespace) -> dict[str, Any]:
    """What the votes depend on; a mask that was edited since counts as another one."""
    masks = hashlib.sha256()
    for view in capture.views:
        if view.mask_file is not None:
            status = view.mask_file.stat()
            masks.update(f"{view.name}\0{status.st_size}\0{status.st_mtime_ns}\0".encode())
    return {
        "strategy": options.strategy,
        "seed": options.seed if options.strategy == "probability" else None,
        "max_size": options.max_size,
        "capture": _digest(capture),
        "masks": masks.hexdigest()[:16] if capture.has_masks else None,
    }


def _digest(capture: Capture) -> str:
    """Tells one capture from another, wherever it lies: names, poses and points."""
    digest = hashlib.sha256()
    for view in capture.views:
        digest.update(view.name.encode() + b"\0" + np.ascontiguousarray(view.viewmat).tobytes())
    digest.update(np.ascontiguousarray(capture.points.xyz).tobytes())
    return digest.hexdigest()[:16]


def _described(capture: Capture, max_size: int) -> dict[str, Any]:
    return {"folder": str(capture.folder.resolve()), "max_size": max_size, "digest": _digest(capture)}


def _name(capture: Capture, object_id: int) -> str:
    return capture.names.get(object_id, f"object {object_id}" if object_id else "unlabelled")


# --- training and export ---------------------------------------------------------------------------------------------


def _run(
    trainer: Trainer, budget: Budget, folder: Reconstruction, checkpoint_seconds: float, reporter: StoppingReporter
) -> None:
    """Train. The loop heeds a stop by itself, since it has a checkpoint to write first."""
    measure = _held_out(folder, reporter)
    try:
        trainer.run(budget, folder.checkpoint, reporter.reporter, measure, reporter.should_stop, checkpoint_seconds)
    except Cancelled:
        _record_stage(folder, "train", trainer.progress.seconds)
        raise
    _record_stage(folder, "train", trainer.progress.seconds)


def _held_out(folder: Reconstruction, reporter: StoppingReporter) -> Callable[[ObjectModel, Scene], dict[str, Any]]:
    """Figures of the held-out views for the curve, and a preview of the first of them."""

    def measure(model: ObjectModel, scene: Scene) -> dict[str, Any]:
        images, ids = ImageScores(), IdScores(scene.zero_is_object)
        capture = scene.capture
        for place, index in enumerate(capture.test_indices or (0,)):
            photo, truth = capture.image(index), capture.mask(index)
            picture = draw(model, scene.camera(index), want_ids=truth is not None or place == 0)
            if place == 0:
                assert picture.ids is not None
                preview = comparison(photo, picture.image, truth, picture.ids, None, capture.names)
                reporter.preview(save_picture(preview, folder.previews / "latest.png"))
            if capture.test_indices:
                images.add(picture.image, photo)
                if truth is not None and picture.ids is not None:
                    ids.add(picture.ids, truth)
        scores = ids.result()
        return {"psnr": images.result()["psnr"], "miou": scores["miou"], "mbiou": scores["mbiou"]}

    return measure


def _export(model: ObjectModel, scene: Scene, folder: Reconstruction, reporter: Reporter) -> dict[str, Any]:
    """Write splats.ply; returns how many splats it holds and, where they are only a fit, their PSNR to the model."""
    reporter.status(f"Writing {folder.splats.name}")
    if model.explicit:
        splats, psnr = model.splats(), None
    else:
        capture = scene.capture
        splats = fit_splats(model, [scene.camera(i) for i in capture.train_indices], reporter)
        views = capture.test_indices or capture.train_indices
        psnr = plain(agreement(model, splats, [scene.camera(i) for i in views]))
        where = "held-out" if capture.test_indices else "training"
        how_well = "cannot be measured" if psnr is None else f"is {psnr:.1f} dB"
        reporter.warning(
            f"A view-dependent model has no exact splats: {folder.splats.name} is a fit, whose PSNR to the model's own "
            f"pictures of the {where} views {how_well}."
        )
    for sentence in write_splats(folder.splats, splats):
        reporter.warning(sentence)
    return {"splats": len(splats), "psnr_of_export": None if psnr is None else round(psnr, 2)}


# --- rendering -------------------------------------------------------------------------------------------------------


def _render_paths(folder: Path, names: Sequence[str]) -> list[Path]:
    """Where each view's picture goes: its own name as .png; two that differ in their suffix alone keep it before."""
    paths = [folder / Path(name).with_suffix(".png") for name in names]
    return [
        path if paths.count(path) == 1 else path.with_name(Path(name).name + ".png")
        for path, name in zip(paths, names, strict=True)
    ]


def _save_png(path: Path, pixels: np.ndarray) -> None:
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG")
    write_atomic(path, buffer.getvalue())


def _save_array(path: Path, values: np.ndarray) -> None:
    buffer = io.BytesIO()
    np.save(buffer, values)
    write_atomic(path, buffer.getvalue())


def _save_ids(picture: Path, ids: np.ndarray) -> None:
    """The IDs of a render beside it, as 16-bit PNG; as .npy where one is larger than that."""
    if ids.max(initial=0) > 0xFFFF:
        _save_array(picture.with_suffix(".ids.npy"), ids.astype(np.uint32))
    else:
        _save_png(picture.with_suffix(".ids.png"), ids.astype(np.uint16))


# --- the report ------------------------------------------------------------------------------------------------------


def _evaluation_file(folder: Reconstruction) -> Path:
    return folder.folder / "evaluation.json"


def _evaluation(folder: Reconstruction, progress: Progress, reporter: Reporter) -> dict[str, Any]:
    """What `evaluate` found; nothing, and a warning, where that is missing or of an earlier state of the model."""
    nothing: dict[str, Any] = {"quality": {}, "objects": [], "views": []}
    path = _evaluation_file(folder)
    if not path.exists():
        reporter.warning(f"{path} does not exist, so the report has no quality; run `evaluate` first.")
        return nothing
    found = read_json(path)
    if found.get("step") != progress.step:
        reporter.warning(f"{path} is of an earlier state of the model, so the report leaves it out; run `evaluate`.")
        return nothing
    return found


def _report_pictures(trained: _Trained, reporter: Reporter) -> list[tuple[str, Image.Image]]:
    capture = trained.capture
    views = capture.test_indices or tuple(range(len(capture.views)))
    views = views[:: max(len(views) // PICTURES_IN_REPORT, 1)][:PICTURES_IN_REPORT]
    reporter.status("Drawing the report's pictures")
    pictures = []
    for done, index in enumerate(views, 1):
        drawn = draw(trained.model, trained.scene.camera(index))
        assert drawn.ids is not None
        shown = comparison(capture.image(index), drawn.image, capture.mask(index), drawn.ids, None, capture.names)
        pictures.append((f"View {capture.views[index].name}", shown))
        reporter.progress(done, len(views), what="pictures")
    return pictures


def _objects_of_report(trained: _Trained, evaluated: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Every object that the masks show or the model holds; those that no held-out view shows were not measured."""
    model, capture = trained.model, trained.capture
    anchors = np.bincount(model.anchors.ids, minlength=len(model.object_ids))
    anchors_of = dict(zip(model.object_ids.tolist(), anchors.tolist(), strict=True))
    measured = {entry["id"]: entry for entry in evaluated}
    ids = ({*anchors_of, *capture.object_ids.tolist()} - {0}) | set(measured)
    return [
        {"iou": None, **measured.get(i, {}), "id": i, "name": _name(capture, i), "anchors": anchors_of.get(i, 0)}
        for i in sorted(ids)
    ]


def _left_out(trained: _Trained) -> list[dict[str, str]]:
    """What was not done, and why this scene did not need it or could not have it."""
    folder, capture, progress = trained.folder, trained.capture, trained.progress
    memory = _memory(folder)
    settings = memory["training"]["settings"]
    counts = capture.counts
    longest = max(max(view.width, view.height) for view in capture.views)
    cases = [
        (not capture.has_masks, "votes, the label loss and object scores", "the capture has no masks"),
        (
            capture.has_masks and settings["semantic_weight"] == 0, "the label loss",
            "--semantic-weight 0 was asked for",
        ),
        (
            not any(view.image_file.is_relative_to(folder.cache) for view in capture.views),
            "undistortion and reduction of the images",
            f"all are pinhole pictures of at most {memory['capture']['max_size']} pixels already",
        ),
        (
            counts["unregistered"] > 0, f"{counts['unregistered']} images without a pose",
            "COLMAP could not place them",
        ),
        (
            counts["missing"] > 0, f"{counts['missing']} images that the model names",
            "their files are not in the capture",
        ),
        (
            capture.has_masks and counts["masks"] < counts["used"],
            f"labels of {counts['used'] - counts['masks']} views", "their masks are missing",
        ),
        (
            not trained.scene.exposure_varies, "undoing of exposure and white balance",
            "the photos agree about the points that they share",
        ),
        (
            downscale_at(0.0, longest) == 1, "reduced pictures at the start of training",
            f"{longest} pixels are few enough to train on from the start",
        ),
        (
            progress.last_growth == 0, "growth and pruning of anchors",
            f"{progress.step} steps are too few to say where anchors are missing",
        ),
        (
            len(trained.model.anchors) >= settings["max_anchors"], "further growth of anchors",
            f"--max-anchors {settings['max_anchors']} was reached",
        ),
        (
            settings["background"] != "learned", "a learned background",
            f"--background {settings['background']} was asked for",
        ),
        (not capture.test_indices, "quality on held-out views", "there are too few views to hold any out"),
        (bool(capture.test_indices), "LPIPS", "it needs a trained network, which is not part of this program"),
    ]  # fmt: skip
    return [{"what": what, "why": why} for applies, what, why in cases if applies]


# --- doctor ----------------------------------------------------------------------------------------------------------


def _train_a_little(place: Path, reporter: StoppingReporter) -> None:
    """Take a made-up capture through every part, so that each kernel is compiled, cached and seen to run."""
    capture_folder, folder = place / "capture", Reconstruction(place / "out").create()
    _write_small_capture(capture_folder)
    quiet = Reporter()
    capture = load_capture(capture_folder, folder.cache, reporter=quiet)
    ids = vote_points(capture, reporter=quiet).ids
    trainer = Trainer.start(capture, ids, Settings(offsets=2))
    trainer.run(Budget(steps=220), folder.checkpoint, reporter.reporter, should_stop=reporter.should_stop)
    picture = draw(trainer.model, trainer.scene.camera(0), want_depth=True)
    if not np.isfinite(picture.image).all():
        raise RuntimeError("a small training ended in a picture that is not finite")


def _write_small_capture(folder: Path) -> None:
    """Four views, 64x48, of two clusters of points, with masks; a COLMAP model in text."""
    rng = np.random.default_rng(0)
    for name in ("images", "masks", "sparse/0"):
        (folder / name).mkdir(parents=True)
    points = rng.normal(0, 0.3, (200, 3)) + np.where(np.arange(200) < 100, -0.5, 0.5)[:, None] * [1, 0, 0]
    pictures = []
    for i in range(4):
        pictures += [f"{i + 1} 1 0 0 0 {0.2 * i - 0.3} 0 3 1 {i}.png", ""]
        Image.fromarray(rng.integers(0, 255, (48, 64, 3), np.uint8)).save(folder / "images" / f"{i}.png")
        Image.fromarray(np.repeat([[1] * 32 + [2] * 32], 48, 0).astype(np.uint8)).save(folder / "masks" / f"{i}.png")
    model = {
        "cameras": ["1 PINHOLE 64 48 64 64 32 24"],
        "images": pictures,
        "points3D": [f"{i} {x} {y} {z} 128 128 128 0" for i, (x, y, z) in enumerate(points.tolist())],
    }
    for name, lines in model.items():
        (folder / "sparse/0" / f"{name}.txt").write_text("\n".join(lines) + "\n")


# --- objectgs.json ---------------------------------------------------------------------------------------------------


def _memory(folder: Reconstruction) -> dict[str, Any]:
    """What objectgs.json holds; empty where there is none."""
    if not folder.settings.exists():
        return {}
    memory = read_json(folder.settings)
    if not isinstance(memory, dict):
        raise InputError(f"{folder.settings} was not written by this program; choose another folder.")
    return memory


def _remember(folder: Reconstruction, **values: Any) -> None:
    """Merge into objectgs.json."""
    write_json(folder.settings, {**_memory(folder), "version": __version__, **values})


@contextmanager
def _stage(folder: Reconstruction, name: str) -> Iterator[None]:
    """Measure a stage and keep its figures in objectgs.json once it is done."""
    started = time.monotonic()
    yield
    _record_stage(folder, name, time.monotonic() - started)


def _record_stage(folder: Reconstruction, name: str, seconds: float) -> None:
    """Seconds of a stage, and this process's peak memory until its end; the latest run of a stage counts."""
    stages = {stage["name"]: stage for stage in _memory(folder).get("stages", [])}
    stages[name] = {"name": name, "seconds": round(seconds, 2), "peak_rss_mb": _peak_mb()}
    _remember(folder, stages=list(stages.values()))


def _peak_mb() -> float:
    """Peak memory of this process so far."""
    if sys.platform == "win32":
        return round(psutil.Process().memory_info().peak_wset / 1e6, 1)
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(peak / 1e6 if sys.platform == "darwin" else peak / 1e3, 1)
