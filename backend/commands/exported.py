"""splats.ply and anchors.ply of a trained model."""

from __future__ import annotations

from ..capture import Capture
from ..export import (
    ExactSplats,
    FittedSplats,
    ModelSplats,
    agreement,
    fit_splats,
    write_anchors,
    write_splat_parts,
)
from ..model.object_model import ObjectModel
from ..shared.events import Reporter
from ..shared.formats.json_file import plain
from ..shared.formats.splat_ply import Description
from ..shared.reconstruction.folder import Reconstruction
from ..shared.reconstruction.record import ExportRecord, update_record
from ..training.scene import Scene
from .stages import stage

EXPORT = "export"
"""Name of the export among the parts of a command, and of its stage."""

_CLEAR_ON_BLACK = 40.0
"""PSNR in dB above which a missing background makes no visible difference."""

_CHECKED_VIEWS = 5
"""Largest number of views on which others are compared, to check them and the background."""

_COMPARED_VIEWS = 20
"""Largest number of views on which exported splats that are not exactly the model are compared with it."""


def export_model(
    model: ObjectModel, scene: Scene, folder: Reconstruction, reporter: Reporter, compare: bool = True
) -> ExportRecord:
    """Write splats.ply and anchors.ply of a model, and record what they contain.

    Args:
        model: The trained model.
        scene: The capture that it was trained on.
        folder: The reconstruction, locked by this process.
        reporter: Receives messages.
        compare: Also measure their PSNR to the model.

    Returns:
        Their sizes and PSNR.
    """
    with stage(folder, EXPORT):
        export = _write_export(model, scene, folder, reporter, compare)
    update_record(folder, export=export)
    return export


def _write_export(
    model: ObjectModel, scene: Scene, folder: Reconstruction, reporter: Reporter, compare: bool
) -> ExportRecord:
    reporter.begin(EXPORT, "Turning the anchors into splats")
    capture = scene.capture
    splats: ModelSplats
    if model.explicit:
        splats = ExactSplats(model)
    else:
        cameras = [scene.camera(i) for i in capture.train_indices]
        splats = FittedSplats(model, *fit_splats(model, cameras, reporter))
    background = [round(float(value), 4) for value in model.background.detach().cpu()]
    psnr = on_black = None
    if compare:
        most = _COMPARED_VIEWS if _is_approximate(model) else _CHECKED_VIEWS
        views = (capture.test_indices or capture.train_indices)[:most]
        found = agreement(model, splats, [scene.camera(i) for i in views])
        psnr, on_black = plain(found) or (None, None)
        _say_how_well(model, folder, capture, psnr, on_black, reporter)
    reporter.status(f"Writing {folder.splats.name}")
    count, warnings = write_splat_parts(
        folder.splats,
        lambda: (part.splats for part in splats.parts()),
        description=Description(background=background),
    )
    for sentence in warnings:
        reporter.warning(sentence)
    write_anchors(folder.anchors, model, splats)
    return ExportRecord(count, len(model.anchors), _rounded(psnr), _rounded(on_black), background)


def _is_approximate(model: ObjectModel) -> bool:
    """Return whether plain splats are not exactly the model."""
    return not model.explicit or model.primitive == "2d"


def _say_how_well(
    model: ObjectModel,
    folder: Reconstruction,
    capture: Capture,
    psnr: float | None,
    on_black: float | None,
    reporter: Reporter,
) -> None:
    """Report how well splats.ply shows a model that it is not, and what is lost without the background."""
    where = "held-out" if capture.test_indices else "training"
    if _is_approximate(model):
        what, has = (
            ("A view-dependent model has no exact splats", "a fit")
            if not model.explicit
            else ("Most programs do not support flat splats", "thin Gaussians instead")
        )
        report = reporter.status if model.explicit else reporter.warning
        report(
            f"{what}: {folder.splats.name} contains {has}, whose PSNR to renders of the model in the {where} views "
            f"{'cannot be measured' if psnr is None else f'is {psnr:.1f} dB'}."
        )
    if on_black is not None and on_black < _CLEAR_ON_BLACK and (psnr is None or on_black < psnr - 1):
        reporter.status(
            f"Programs that draw {folder.splats.name} on black show it with a PSNR of {on_black:.1f} dB to the model "
            f"in the {where} views, since the model has a background; `export --bake-background` adds it as splats."
        )


def _rounded(psnr: float | None) -> float | None:
    return None if psnr is None else round(psnr, 2)
