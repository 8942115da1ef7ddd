"""What each command does: the stages in the order of the data, and what they leave in the reconstruction folder."""

from __future__ import annotations

import argparse
import importlib.metadata
import os
import platform
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numba
import numpy as np
import psutil
import torch
from PIL import Image

from . import __version__
from .capture import Capture, check_capture, load_capture
from .evaluation import IdScores, ImageScores, comparison, save_picture, write_report
from .evaluation import evaluate as evaluate_views
from .export.ply import write_splats
from .labels import vote as vote_points
from .labels.points import read_points, write_points
from .model.object_model import ObjectModel
from .palette import object_colours
from .protocol import InputError, Reconstruction, Reporter, read_json, write_json
from .raster.draw import draw
from .training.loop import Budget, Trainer, load_model, progress_of
from .training.scene import Scene
from .training.settings import Settings

DEFAULT_MINUTES = 5.0


def set_threads(threads: int | None) -> None:
    """Use so many threads in kernels and in torch (None: every core that this process may use)."""
    count = max(min(threads or _cores(), numba.config.NUMBA_NUM_THREADS), 1)
    numba.set_num_threads(count)
    torch.set_num_threads(count)


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


# --- the commands ----------------------------------------------------------------------------------------------------


def check(options: argparse.Namespace, reporter: Reporter, stop: Callable[[], bool]) -> None:
    """Report on a capture; InputError with the first problem if it cannot be used."""
    found = check_capture(options.capture, options.max_size, reporter)
    for sentence in found["warnings"]:
        reporter.warning(sentence)
    if found["problems"]:
        for sentence in found["problems"][1:]:
            reporter.warning(sentence)
        raise InputError(found["problems"][0])
    counts = found["counts"]
    reporter.status(
        f"{counts['registered']} views with poses ({', '.join(found['view_sizes'])}), {found['points']} points"
    )
    for camera in found["cameras"]:
        undo = "undistorted on first use" if camera["undistort"] else "used as it is"
        reporter.status(f"camera {camera['id']}: {camera['model']} {camera['width']}x{camera['height']}, {undo}")
    for entry in found["objects"]:
        reporter.status(f"object {entry['id']} {entry['name']}: in {entry['views']} views")
    if not found["objects"]:
        reporter.status("no masks: the scene can be trained as one, without objects")
    reporter.done(message="The capture can be used.", check=found)


def vote(options: argparse.Namespace, reporter: Reporter, stop: Callable[[], bool]) -> None:
    """Write points.ply and objects.json."""
    folder, capture = _open(options, reporter)
    _vote(folder, capture, options, reporter)
    reporter.done(points=str(folder.points), objects=str(folder.objects))


def train(options: argparse.Namespace, reporter: Reporter, stop: Callable[[], bool]) -> None:
    """Train, resume or extend; leaves a checkpoint, previews and splats.ply."""
    folder, capture = _open(options, reporter)
    settings = _settings(options)
    asked = _asked(options, capture)
    if options.restart:
        shutil.rmtree(folder.checkpoint, ignore_errors=True)
    budget = Budget(options.steps, None if options.steps else 60.0 * (options.minutes or DEFAULT_MINUTES))
    resumed = Trainer.resume(capture, folder.checkpoint, settings, options.memory_mb)
    if resumed is not None:
        trainer, warning = resumed
        if warning:
            reporter.warning(warning)
        progress = trainer.progress
        if budget.share(progress.step, progress.seconds) >= 1:
            reporter.status(
                f"Already trained for {progress.step} steps in {progress.seconds:.0f} s; ask for more --minutes or "
                "--steps to extend it, or --restart to begin anew."
            )
        else:
            reporter.status(f"Going on after step {progress.step}")
    else:
        ids = np.zeros(len(capture.points.xyz), np.int64)
        if capture.has_masks:
            if not _vote_is_current(folder, asked, len(ids)):
                _vote(folder, capture, options, reporter)
            ids = read_points(folder.points).ids
        trainer = Trainer.start(capture, ids, settings, options.memory_mb)
    _remember(folder, asked=asked, settings=settings.as_dict())
    folder.previews.mkdir(exist_ok=True)
    reporter.status(f"Training {len(trainer.model.anchors)} anchors")
    with _stage(folder, "train"):
        trainer.run(budget, folder.checkpoint, reporter, _held_out(folder, reporter), stop, options.checkpoint_seconds)
    with _stage(folder, "export"):
        reporter.status("Writing splats.ply")
        splats, note = _explicit(trainer.model, trainer.scene)
        if note:
            reporter.warning(note)
        for sentence in write_splats(folder.splats, splats):
            reporter.warning(sentence)
    progress = trainer.progress
    latest = progress.curve[-1] if progress.curve else {}
    reporter.done(
        steps=progress.step, seconds=round(progress.seconds, 1), anchors=len(trainer.model.anchors),
        splats=str(folder.splats), psnr=latest.get("psnr"), miou=latest.get("miou"),
    )  # fmt: skip


def render(options: argparse.Namespace, reporter: Reporter, stop: Callable[[], bool]) -> None:
    """Draw views into DIR/renders, named as the images."""
    folder, capture, model, _state = _trained(options, reporter)
    scene = Scene(capture, model.object_ids, model.normalization)
    indices = range(len(capture.views)) if options.views == "all" else capture.test_indices
    for done, index in enumerate(indices):
        if stop():
            raise KeyboardInterrupt
        picture = draw(model, scene.camera(index), options.ids, options.depth)
        path = folder.renders / Path(capture.views[index].name).with_suffix(".png")
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.round(picture.image * 255).astype(np.uint8)).save(path)
        if picture.ids is not None:
            _save_ids(picture.ids, path.with_suffix(".ids.png"))
        if picture.depth is not None:
            np.save(path.with_suffix(".depth.npy"), picture.depth)
        reporter.progress(done + 1, len(indices))
    reporter.done(renders=str(folder.renders))


def evaluate(options: argparse.Namespace, reporter: Reporter, stop: Callable[[], bool]) -> None:
    """Measure on the held-out views; leaves evaluation.json, which `report` reads."""
    folder, capture, model, _state = _trained(options, reporter)
    scene = Scene(capture, model.object_ids, model.normalization)
    if not capture.test_indices:
        raise InputError(f"{capture.folder} has too few views to hold any out; there is nothing to measure on.")
    reporter.status("Measuring on the held-out views")
    with _stage(folder, "evaluate"):
        found = evaluate_views(capture, _renderer(model, scene), capture.test_indices, reporter)
    counts = dict(zip(*np.unique(model.object_ids[model.anchors.ids], return_counts=True), strict=True))
    for entry in found["objects"]:
        entry["anchors"] = int(counts.get(entry["id"], 0))
    write_json(folder.folder / "evaluation.json", _without_nan(found))
    quality = {k: v for k, v in found["quality"].items() if v is not None}
    reporter.done(**{k: round(float(v), 4) for k, v in quality.items()})


def report(options: argparse.Namespace, reporter: Reporter, stop: Callable[[], bool]) -> None:
    """Write report.json, report.md and their pictures from what the earlier commands left."""
    folder, capture, model, state = _trained(options, reporter)
    evaluation_file = folder.folder / "evaluation.json"
    evaluation = read_json(evaluation_file) if evaluation_file.exists() else {"quality": {}, "objects": []}
    memory = read_json(folder.settings)
    scene = Scene(capture, model.object_ids, model.normalization)
    reporter.status("Drawing the report's pictures")
    pictures = []
    indices = capture.test_indices or tuple(range(len(capture.views)))
    for index in indices[:: max(len(indices) // 3, 1)][:3]:
        drawn = draw(model, scene.camera(index))
        truth = capture.mask(index)
        assert drawn.ids is not None
        shown = comparison(capture.image(index), drawn.image, truth, drawn.ids, None, capture.names)
        pictures.append((f"View {capture.views[index].name}", shown))
    progress = progress_of(state)
    model_file = folder.splats
    value = {
        "capture": {
            "folder": capture.folder.name, "views": len(capture.views), "held_out": len(capture.test_indices),
            "points": len(capture.points.xyz), "objects": len(capture.object_ids), **_flat(capture.counts),
        },
        "settings": {**memory["settings"], **memory["asked"]["vote"], "steps": progress.step,
                     "seconds": round(progress.seconds, 1)},
        "machine": machine(),
        "left_out": _left_out(capture),
        "stages": memory.get("stages", []),
        "curve": progress.curve,
        "model": {
            "anchors": len(model.anchors),
            "gaussians": len(model.generate(eye=np.zeros(3)).source),
            "bytes": model_file.stat().st_size if model_file.exists() else None,
            "classes": len(model.object_ids),
        },
        "quality": evaluation["quality"],
        "objects": evaluation["objects"],
        "views": evaluation.get("views", []),
    }  # fmt: skip
    write_report(folder, value, pictures, title=capture.folder.resolve().name)
    reporter.done(report=str(folder.report_md))


def doctor(options: argparse.Namespace, reporter: Reporter, stop: Callable[[], bool]) -> None:
    """Versions, devices, and whether the kernels compile and run here."""
    found = machine()
    for key, value in found.items():
        reporter.status(f"{key}: {value}")
    from .raster import compile_kernels

    reporter.status("Compiling the kernels (once for a machine)")
    seconds = compile_kernels(lambda done, total: reporter.progress(done, total))
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


# --- what they share -------------------------------------------------------------------------------------------------


def _open(options: argparse.Namespace, reporter: Reporter) -> tuple[Reconstruction, Capture]:
    """Read the capture first, so that bad input leaves no folder behind."""
    if not Path(options.capture).exists():
        raise InputError(f"{options.capture} does not exist; give the folder that holds images/ and sparse/.")
    fresh = not options.out.exists()
    folder = Reconstruction(options.out).create()
    try:
        with _stage(folder, "read"):
            capture = load_capture(options.capture, folder.cache, options.memory_mb, options.max_size, reporter)
    except InputError:
        if fresh:
            shutil.rmtree(options.out, ignore_errors=True)
        raise
    for sentence in capture.warnings:
        reporter.warning(sentence)
    return folder, capture


def _trained(options: argparse.Namespace, reporter: Reporter) -> tuple[Reconstruction, Capture, ObjectModel, dict]:
    folder = Reconstruction(options.folder)
    if not folder.folder.is_dir():
        raise InputError(f"{folder.folder} does not exist; train first.")
    asked = read_json(folder.settings)["asked"]
    model, state, warning = load_model(folder.checkpoint)
    if warning:
        reporter.warning(warning)
    capture = load_capture(Path(asked["capture"]), folder.cache, options.memory_mb, asked["max_size"], reporter)
    return folder, capture, model, state


def _settings(options: argparse.Namespace) -> Settings:
    given = {
        "offsets": options.offsets, "max_anchors": options.max_anchors, "voxel": options.voxel,
        "semantic_weight": options.semantic_weight,
    }  # fmt: skip
    return Settings(
        seed=options.seed, mode=options.mode, sh_degree=options.sh_degree, background=options.background,
        zero_is_object=options.unlabelled_is_object, **{k: v for k, v in given.items() if v is not None},
    )  # fmt: skip


def _asked(options: argparse.Namespace, capture: Capture) -> dict[str, Any]:
    return {
        "capture": str(Path(options.capture).resolve()),
        "max_size": options.max_size,
        "vote": {"strategy": options.strategy, "vote_seed": options.seed},
    }


def _vote_is_current(folder: Reconstruction, asked: dict[str, Any], points: int) -> bool:
    if not (folder.points.exists() and folder.settings.exists()):
        return False
    before = read_json(folder.settings).get("asked", {})
    return before == asked and len(read_points(folder.points).ids) == points


def _vote(folder: Reconstruction, capture: Capture, options: argparse.Namespace, reporter: Reporter) -> None:
    reporter.status("Voting: from masks to points")
    with _stage(folder, "vote"):
        votes = vote_points(capture, options.strategy, options.seed, reporter=reporter)
        for sentence in votes.warnings:
            reporter.warning(sentence)
        colours = object_colours(votes.counts)
        objects = [
            {"id": i, "name": capture.names.get(i, f"object {i}"), "colour": list(colours[i]), "points": n}
            for i, n in sorted(votes.counts.items())
            if i
        ]
        write_points(folder.points, capture.points, votes)
        write_json(folder.objects, {"objects": objects})
    _remember(folder, asked=_asked(options, capture))
    for entry in objects:
        reporter.status(f"object {entry['id']} {entry['name']}: {entry['points']} points")


def _renderer(model: ObjectModel, scene: Scene) -> Callable[[int], tuple[np.ndarray, np.ndarray]]:
    def draw_view(index: int) -> tuple[np.ndarray, np.ndarray]:
        picture = draw(model, scene.camera(index))
        assert picture.ids is not None
        return picture.image, picture.ids

    return draw_view


def _held_out(folder: Reconstruction, reporter: Reporter) -> Callable[[ObjectModel, Scene], dict[str, Any]]:
    """Figures of the held-out views for the curve, and a preview of the first of them."""

    def measure(model: ObjectModel, scene: Scene) -> dict[str, Any]:
        images, ids = ImageScores(), IdScores()
        for index in scene.capture.test_indices:
            truth = scene.capture.mask(index)
            picture = draw(model, scene.camera(index), want_ids=truth is not None)
            images.add(picture.image, scene.capture.image(index))
            if truth is not None and picture.ids is not None:
                ids.add(picture.ids, truth)
        first = (scene.capture.test_indices or (0,))[0]
        shown = draw(model, scene.camera(first))
        assert shown.ids is not None
        preview = comparison(scene.capture.image(first), shown.image, scene.capture.mask(first), shown.ids)
        path = save_picture(preview, folder.previews / "latest.png")
        scores = ids.result()
        reporter.preview(path)
        return {"psnr": images.result()["psnr"], "miou": scores["miou"], "mbiou": scores["mbiou"]}

    return measure


def _explicit(model: ObjectModel, scene: Scene) -> tuple[Any, str | None]:
    """The model as plain splats and a warning; a `view` model as seen from the middle of the cameras."""
    if model.explicit:
        return model.splats(), None
    eyes = np.array([scene.camera(i).centre for i in scene.capture.train_indices])
    return model.splats(eyes.mean(0)), (
        "A view-dependent model has no exact splats: splats.ply holds its look from the middle of the cameras."
    )


def _left_out(capture: Capture) -> list[dict[str, str]]:
    left = []
    if not capture.has_masks:
        left.append({"what": "votes, the label loss and object maps", "why": "the capture has no masks"})
    if not any(Path(v.image_file).is_relative_to(capture.folder) for v in capture.views):
        return left
    if all(Path(v.image_file).is_relative_to(capture.folder) for v in capture.views):
        left.append({"what": "undistortion", "why": "every camera is a pinhole already"})
    return left


def _save_ids(ids: np.ndarray, path: Path) -> None:
    if ids.max(initial=0) > 65535:
        np.save(path.with_suffix(".npy"), ids.astype(np.uint32))
    else:
        Image.fromarray(ids.astype(np.uint16)).save(path)


def _flat(counts: dict[str, Any]) -> dict[str, Any]:
    return {k: v for k, v in counts.items() if not isinstance(v, dict | list)}


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _without_nan(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(v) for v in value]
    if isinstance(value, np.generic):
        return _without_nan(value.item())
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


def _remember(folder: Reconstruction, **values: Any) -> None:
    """Merge into objectgs.json."""
    memory = read_json(folder.settings) if folder.settings.exists() else {"version": __version__}
    memory.update(values)
    write_json(folder.settings, memory)


@contextmanager
def _stage(folder: Reconstruction, name: str) -> Iterator[None]:
    """Measure a stage and keep its seconds and peak memory in objectgs.json once it is done."""
    started = time.monotonic()
    yield
    before = read_json(folder.settings).get("stages", []) if folder.settings.exists() else []
    stages = [stage for stage in before if stage["name"] != name]
    stages.append({"name": name, "seconds": round(time.monotonic() - started, 2), "peak_rss_mb": _peak_mb()})
    _remember(folder, stages=stages)


def _peak_mb() -> float:
    """Peak memory of this process so far."""
    if sys.platform == "win32":
        return round(psutil.Process().memory_info().peak_wset / 1e6, 1)
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(peak / 1e6 if sys.platform == "darwin" else peak / 1e3, 1)
