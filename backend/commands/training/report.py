"""`report`: write report.json, report.md and their images, from the results of the other commands."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from typing import Any

import numpy as np
from PIL import Image

from ...capture import Capture
from ...evaluation import comparison, write_report
from ...evaluation.mesh_sheet import MESHES_SHOWN, TEXELS_SHOWN, Card, mesh_sheet, summarize_figures, view_of
from ...evaluation.meshes import digest, mesh_entries, read_texture
from ...export import ExactSplats
from ...model.draw import draw
from ...model.object_model import ObjectModel
from ...raster import devices
from ...shared.errors import InputError
from ...shared.events import Reporter
from ...shared.formats.mesh_ply import read_mesh
from ...shared.reconstruction.folder import Reconstruction
from ...shared.reconstruction.meshes import MeshEntry
from ...shared.reconstruction.record import read_record
from ...shared.reconstruction.report import Evaluation, Report, read_evaluation
from ...shared.stopping import StoppingReporter
from ...training.budget import TrainingProgress
from ..folder import READ, Trained, open_trained
from ..setup.machine import machine_facts
from ..stages import stage
from ..votes import object_name

IMAGES_IN_REPORT = 3


def report(options: argparse.Namespace, reporter: StoppingReporter) -> None:
    """Write report.json, report.md and their images from the results of the other commands."""
    parts = {
        READ: ("Preparing", 5.0),
        "images": ("Drawing", 10.0),
        "meshes": ("Drawing", 10.0),
        "write": ("Saving", 2.0),
    }
    reporter.expect(parts)
    Reconstruction(options.folder).require_writable()
    trained = open_trained(options, reporter)
    folder, capture, model, progress = trained.folder, trained.capture, trained.model, trained.progress
    evaluation = _evaluation(folder, progress, reporter)
    with stage(folder, "report"):
        images = _sample_images(trained, reporter)
        meshes = _meshes(trained, evaluation.meshes, reporter)
        sheet = _mesh_sheet(trained, meshes, reporter)
    reporter.begin("write", f"Writing {folder.report_md.name}")
    record = read_record(folder)
    training, export = trained.training, record.export
    value = Report(
        capture={
            "folder": capture.folder.name, "views": len(capture.views), "held_out": len(capture.test_indices),
            "validation": len(capture.validation_indices), "validation_joined": trained.progress.joined,
            "objects": len(capture.object_ids), **capture.counts,
            "exposure_varies": trained.scene.exposure_varies,
            "supervise_background": trained.scene.supervise_background,
            "cameras": ", ".join(f"{count} {name}" for name, count in capture.counts["cameras"].items()),
        },
        settings={
            "minutes": training.minutes, "steps": training.steps,
            "max_size": training.votes.max_size, "strategy": training.votes.strategy,
            **training.settings,
        },
        machine={**machine_facts(model.device), "device": trained.trained_on},
        left_out=_left_out(trained, evaluation),
        plan=trained.plan.as_list(),
        stages=[asdict(stage) for stage in record.stages],
        curve=[entry for entry in progress.curve if "psnr" in entry],
        model={
            "anchors": len(model.anchors),
            "gaussians": export.splats if export else _count(model),
            "bytes": folder.splats.stat().st_size if folder.splats.exists() else None,
            "trained_steps": progress.step, "trained_seconds": round(progress.seconds, 1),
            "psnr_of_export": export.psnr_of_export if export else None,
            "expected_psnr": training.expected_psnr, "expected_steps": training.expected_steps,
            "skipped_updates": progress.skipped, "skipped_because_of": progress.causes or None,
        },
        quality=evaluation.quality,
        objects=_objects(trained, evaluation.objects, meshes),
        views=evaluation.views,
        meshes=[
            {**mesh, "name": _mesh_name(capture, key, mesh)}
            for key, mesh in meshes.items() if _object_id(key, mesh) is None
        ],
    )  # fmt: skip
    write_report(folder, value, images, title=capture.folder.resolve().name, mesh_sheet=sheet)
    reporter.done(report=str(folder.report_md))


def _evaluation(folder: Reconstruction, progress: TrainingProgress, reporter: Reporter) -> Evaluation:
    """Read the results of `evaluate`; empty ones, with a warning, if they are missing or outdated."""
    nothing = Evaluation(progress.step)
    found = read_evaluation(folder.folder)
    if found is None:
        reporter.warning(
            f"{folder.evaluation} does not exist, so the report has no quality metrics; run `evaluate` first."
        )
        return nothing
    if found.step != progress.step:
        reporter.warning(
            f"{folder.evaluation} is from an earlier state of the model and is left out; run `evaluate` again."
        )
        return nothing
    return found


def _meshes(trained: Trained, evaluated: dict[str, Any], reporter: Reporter) -> dict[str, dict[str, Any]]:
    """Return the figures of each mesh by its key in meshes.json, from `evaluated` only if measured on these files."""
    folder = trained.folder.meshes
    found, unmeasured = {}, 0
    for key, entry in mesh_entries(folder, trained.progress.step, reporter).items():
        figures = dict(evaluated.get(key) or {})
        if entry.file and figures.pop("digest", None) != digest(folder, entry):
            figures, unmeasured = {}, unmeasured + 1
        found[key] = {**entry.as_dict(), **figures}
    if unmeasured and trained.capture.test_indices:
        reporter.warning(f"{unmeasured} meshes of {folder} have not been measured; run `evaluate` first.")
    return found


def _object_id(key: str, mesh: dict[str, Any]) -> int | None:
    """Return the object's ID if the mesh is that of one object; None for a set or the whole scene."""
    return MeshEntry(key, "", mesh["ids"]).object_id


def _mesh_name(capture: Capture, key: str, mesh: dict[str, Any]) -> str:
    object_id = _object_id(key, mesh)
    return (mesh.get("name") or key) if object_id is None else object_name(capture, object_id)


def _mesh_sheet(trained: Trained, meshes: dict[str, dict[str, Any]], reporter: Reporter) -> Image.Image | None:
    """Draw the overview image of the meshes; return None if there are none."""
    if not meshes:
        return None
    capture, folder = trained.capture, trained.folder.meshes
    cards = []
    reporter.begin("meshes", "Drawing the meshes")
    if len(meshes) > MESHES_SHOWN:
        reporter.status(f"The image of the meshes shows the first {MESHES_SHOWN} of {len(meshes)}")
    for key, mesh in list(meshes.items())[:MESHES_SHOWN]:
        reporter.check()
        card = Card(_mesh_name(capture, key, mesh), summarize_figures(mesh), why=mesh.get("why") or "")
        if mesh.get("file") and not card.why:
            try:
                card.mesh = read_mesh(folder / mesh["file"])
                if card.mesh.texture:
                    card.texture = _shown_texels(read_texture(folder / card.mesh.texture))
                card.view = view_of(capture, mesh["ids"], capture.train_indices)
            except InputError as error:
                reporter.warning(str(error))
                card = Card(card.name, "", why="its files cannot be read")
            else:
                if not len(card.mesh.faces) or not np.isfinite(card.mesh.vertices).all():
                    card = Card(card.name, "", why="it has no surface")
        cards.append(card)
    return mesh_sheet(cards, reporter)


def _shown_texels(texture: np.ndarray) -> np.ndarray:
    """Return a copy of a texture (S, S, 3) without the texels that its panel is too small for."""
    step = max(1, len(texture) // TEXELS_SHOWN)
    return texture[::step, ::step].copy()


def _sample_images(trained: Trained, reporter: Reporter) -> list[tuple[str, Image.Image]]:
    capture = trained.capture
    views = capture.test_indices or tuple(range(len(capture.views)))
    views = views[:: max(len(views) // IMAGES_IN_REPORT, 1)][:IMAGES_IN_REPORT]
    reporter.begin("images", "Rendering the images of the report")
    images = []
    for done, index in enumerate(views, 1):
        drawn = draw(trained.model, trained.scene.camera(index))
        assert drawn.ids is not None
        shown = comparison(capture.image(index), drawn.image, capture.mask(index), drawn.ids, None, capture.names)
        images.append((f"View {capture.views[index].name}", shown))
        reporter.progress(done, len(views), what="images")
    return images


def _objects(
    trained: Trained, evaluated: list[dict[str, Any]], meshes: dict[str, dict[str, Any]]
) -> list[dict[str, Any]]:
    """Return every object in the masks or the model; those that no held-out view shows have no scores."""
    model, capture = trained.model, trained.capture
    anchors = np.bincount(devices.host(model.anchors.ids), minlength=len(model.classes))
    anchors_of = dict(zip(model.classes.ids.tolist(), anchors.tolist(), strict=True))
    own = {_object_id(key, mesh): mesh for key, mesh in meshes.items()}
    measured = {entry["id"]: entry for entry in evaluated}
    ids = ({*anchors_of, *capture.object_ids.tolist()} - {0}) | set(measured)
    return [
        {
            "iou": None, "iou_all": None, **measured.get(i, {}), "id": i, "name": object_name(capture, i),
            "anchors": anchors_of.get(i, 0), "mesh": own.get(i),
        }
        for i in sorted(ids)
    ]  # fmt: skip


def _count(model: ObjectModel) -> int | None:
    """Return the number of splats of a model; None if it depends on the view."""
    return sum(len(part.source) for part in ExactSplats(model).parts()) if model.explicit else None


def _left_out(trained: Trained, evaluation: Evaluation) -> list[dict[str, str]]:
    """Return the steps that were left out by the plan or in the training, with the reasons."""
    capture, progress = trained.capture, trained.progress
    settings = trained.training.settings
    counts = capture.counts
    cases = [
        (
            counts["unregistered"] > 0, f"{counts['unregistered']} images without a pose",
            "COLMAP could not register them",
        ),
        (
            counts["missing"] > 0, f"{counts['missing']} images listed in the COLMAP model",
            "their files are not in the capture",
        ),
        (
            capture.has_masks and counts["masks"] < counts["used"],
            f"labels of {counts['used'] - counts['masks']} views", "their masks are missing",
        ),
        (
            progress.last_growth == 0, "growth and pruning of anchors",
            f"{progress.step} steps are too few to determine where anchors are missing",
        ),
        (
            len(trained.model.anchors) >= settings["max_anchors"], "further growth of anchors",
            f"--max-anchors {settings['max_anchors']} was reached",
        ),
        (
            settings["background"] != "learned", "a learned background",
            f"--background {settings['background']} was given",
        ),
        (not capture.test_indices, "quality on held-out views", "the capture holds out no view, or has too few"),
        (
            bool(capture.test_indices) and evaluation.quality.get("lpips") is None, "LPIPS",
            "its network, the package lpips and the weights of VGG-16, is not on this computer",
        ),
    ]  # fmt: skip
    planned = [{"what": decision.what, "why": decision.reason} for decision in trained.plan.left_out]
    return planned + [{"what": what, "why": why} for applies, what, why in cases if applies]
