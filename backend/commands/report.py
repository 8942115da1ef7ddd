"""`report`: report.json, report.md and their pictures, from what the earlier commands left."""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
from PIL import Image

from .. import device
from ..capture import Capture
from ..evaluation import comparison, write_report
from ..evaluation.mesh_pictures import MESHES_SHOWN, Card, figures_line, mesh_sheet, view_of
from ..evaluation.meshes import digest, mesh_entries, object_of, read_texture
from ..mesh_file import read_mesh
from ..protocol import InputError, Reconstruction, Reporter, read_json
from ..raster.draw import draw
from ..stopping import StoppingReporter
from ..training.budget import Progress
from .evaluate import evaluation_file
from .folder import Trained, open_trained
from .machine import machine_facts
from .record import recorded, stage
from .votes import object_name

PICTURES_IN_REPORT = 3


def report(options: argparse.Namespace, reporter: StoppingReporter) -> None:
    """Write report.json, report.md and their pictures from what the earlier commands left."""
    trained = open_trained(options, reporter)
    folder, capture, model, progress = trained.folder, trained.capture, trained.model, trained.progress
    evaluation = _evaluation(folder, progress, reporter)
    with stage(folder, "report"):
        pictures = _pictures(trained, reporter)
        meshes = _meshes(trained, evaluation["meshes"], reporter)
        sheet = _mesh_sheet(trained, meshes, reporter)
    memory = recorded(folder)
    training = memory["training"]
    export = memory.get("export", {})
    value = {
        "capture": {
            "folder": capture.folder.name, "views": len(capture.views), "held_out": len(capture.test_indices),
            "objects": len(capture.object_ids), **capture.counts,
            "exposure_varies": trained.scene.exposure_varies,
            "unlabelled_is_taught": trained.scene.teach_unlabelled,
            "cameras": ", ".join(f"{count} {name}" for name, count in capture.counts["cameras"].items()),
        },
        "settings": {
            "minutes": training["minutes"], "steps": training["steps"],
            "max_size": training["votes"]["max_size"], "strategy": training["votes"]["strategy"],
            **training["settings"],
        },
        "machine": {**machine_facts(model.device), "device": trained.trained_on},
        "left_out": _left_out(trained),
        "plan": trained.plan.as_list(),
        "stages": memory.get("stages", []),
        "curve": progress.curve,
        "model": {
            "anchors": len(model.anchors),
            "gaussians": len(model.generate().source) if model.explicit else export.get("splats"),
            "bytes": folder.splats.stat().st_size if folder.splats.exists() else None,
            "trained_steps": progress.step, "trained_seconds": round(progress.seconds, 1),
            "psnr_of_export": export.get("psnr_of_export"),
            "skipped_updates": progress.skipped, "skipped_because_of": progress.causes or None,
        },
        "quality": evaluation["quality"],
        "objects": _objects(trained, evaluation["objects"], meshes),
        "views": evaluation["views"],
        "meshes": [
            {**mesh, "name": _mesh_name(capture, key, mesh)}
            for key, mesh in meshes.items() if object_of(key, mesh) is None
        ],
    }  # fmt: skip
    write_report(folder, value, pictures, title=capture.folder.resolve().name, mesh_sheet=sheet)
    reporter.done(report=str(folder.report_md))


def _evaluation(folder: Reconstruction, progress: Progress, reporter: Reporter) -> dict[str, Any]:
    """What `evaluate` found; nothing, and a warning, where that is missing or of an earlier state of the model."""
    nothing: dict[str, Any] = {"quality": {}, "objects": [], "views": [], "meshes": {}}
    path = evaluation_file(folder)
    if not path.exists():
        reporter.warning(f"{path} does not exist, so the report has no quality; run `evaluate` first.")
        return nothing
    found = read_json(path)
    if found.get("step") != progress.step:
        reporter.warning(f"{path} is of an earlier state of the model, so the report leaves it out; run `evaluate`.")
        return nothing
    return {**nothing, **found}


def _meshes(trained: Trained, evaluated: dict[str, Any], reporter: Reporter) -> dict[str, dict[str, Any]]:
    """What is known of each mesh, by its key in meshes.json; of `evaluated` only what was measured on these files."""
    folder = trained.folder.meshes
    found, unmeasured = {}, 0
    for key, entry in mesh_entries(folder, trained.progress.step, reporter).items():
        figures = dict(evaluated.get(key) or {})
        if entry.get("file") and figures.pop("digest", None) != digest(folder, entry):
            figures, unmeasured = {}, unmeasured + 1
        found[key] = {**entry, **figures}
    if unmeasured and trained.capture.test_indices:
        reporter.warning(f"{unmeasured} meshes of {folder} have not been measured; run `evaluate` first.")
    return found


def _mesh_name(capture: Capture, key: str, mesh: dict[str, Any]) -> str:
    object_id = object_of(key, mesh)
    return (mesh.get("name") or key) if object_id is None else object_name(capture, object_id)


def _mesh_sheet(trained: Trained, meshes: dict[str, dict[str, Any]], reporter: Reporter) -> Image.Image | None:
    """Pictures of the meshes, or None where there are none."""
    capture, folder = trained.capture, trained.folder.meshes
    cards = []
    if len(meshes) > MESHES_SHOWN:
        reporter.status(f"The picture of the meshes shows the first {MESHES_SHOWN} of {len(meshes)}")
    for key, mesh in list(meshes.items())[:MESHES_SHOWN]:
        card = Card(_mesh_name(capture, key, mesh), figures_line(mesh), why=mesh.get("why") or "")
        if mesh.get("file") and not card.why:
            try:
                card.mesh = read_mesh(folder / mesh["file"])
                card.texture = read_texture(folder / card.mesh.texture) if card.mesh.texture else None
                card.view = view_of(capture, mesh["ids"], capture.train_indices)
            except InputError as error:
                reporter.warning(str(error))
                card = Card(card.name, "", why="its files cannot be read")
            else:
                if not len(card.mesh.faces) or not np.isfinite(card.mesh.vertices).all():
                    card = Card(card.name, "", why="it has no surface")
        cards.append(card)
    if not cards:
        return None
    reporter.status("Drawing the meshes")
    return mesh_sheet(cards, reporter)


def _pictures(trained: Trained, reporter: Reporter) -> list[tuple[str, Image.Image]]:
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


def _objects(
    trained: Trained, evaluated: list[dict[str, Any]], meshes: dict[str, dict[str, Any]]
) -> list[dict[str, Any]]:
    """Every object that the masks show or the model holds; those that no held-out view shows were not measured."""
    model, capture = trained.model, trained.capture
    anchors = np.bincount(device.host(model.anchors.ids), minlength=len(model.object_ids))
    anchors_of = dict(zip(model.object_ids.tolist(), anchors.tolist(), strict=True))
    own = {object_of(key, mesh): mesh for key, mesh in meshes.items()}
    measured = {entry["id"]: entry for entry in evaluated}
    ids = ({*anchors_of, *capture.object_ids.tolist()} - {0}) | set(measured)
    return [
        {
            "iou": None, **measured.get(i, {}), "id": i, "name": object_name(capture, i),
            "anchors": anchors_of.get(i, 0), "mesh": own.get(i),
        }
        for i in sorted(ids)
    ]  # fmt: skip


def _left_out(trained: Trained) -> list[dict[str, str]]:
    """What was not done, and why this scene did not need it or could not have it: as planned, and as it turned out."""
    folder, capture, progress = trained.folder, trained.capture, trained.progress
    settings = recorded(folder)["training"]["settings"]
    counts = capture.counts
    cases = [
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
    planned = [{"what": decision.what, "why": decision.reason} for decision in trained.plan.left_out]
    return planned + [{"what": what, "why": why} for applies, what, why in cases if applies]
