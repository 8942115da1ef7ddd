"""`clean-labels`: the masks of all photos together correct those that they contradict, and the splats' objects."""

from __future__ import annotations

import argparse
import shutil
from collections import Counter
from typing import Any

import numpy as np

from ...capture import Capture, load_capture
from ...capture.files import Files, is_three_channel, mask_names
from ...capture.made_masks import (
    RECORD,
    REPAIRED,
    SAME_IDS,
    has_ids_of,
    is_made,
    is_repaired,
    kept_masks,
    new_masks,
    require_place_for_given,
    write_mask,
)
from ...labels.renumbering import renumber_masks
from ...model.generate import Generated
from ...model.splats import Splats
from ...pointing.mask_repair import Repair, repair_masks
from ...shared.errors import InputError
from ...shared.formats.json_file import write_json
from ...shared.reconstruction.folder import STROKES
from ...shared.reconstruction.objects import default_name
from ...shared.stopping import StoppingReporter
from ..exported import EXPORT
from ..folder import READ, Trained, locked_reconstruction, memory_for_files
from ..imported import write_labeled
from ..setup.kernels import PART as KERNELS
from ..setup.kernels import ensure_kernels, kernel_seconds
from ..stages import stage
from .label import begin_border_training, border_seconds, train_borders
from .pointable import GRAPH, open_pointable, require_splats

_VOTE, _MASKS, _TRAIN = "vote", "masks", "train"
_CONSISTENT = 0.8
"""Agreement of the IDs of points between photos from which on the masks' IDs are taken as they are."""

_WORST = 5
_MOVED = 0.01
"""Fraction of an object's splats that another object gets, or more, from which on this is told."""


def clean_labels(options: argparse.Namespace, reporter: StoppingReporter) -> None:
    """Repair the masks, give the splats their objects anew, and after a training, train their borders."""
    reporter.expect(
        {
            READ: ("Preparing", 5.0), KERNELS: ("Preparing", 0.0), GRAPH: ("Preparing", 5.0),
            _VOTE: ("Comparing masks", 20.0), _MASKS: ("Making masks", 5.0), _TRAIN: ("Training", 25.0),
            EXPORT: ("Saving", 5.0),
        }
    )  # fmt: skip
    with locked_reconstruction(options):
        _clean_labels(options, reporter)


def _clean_labels(options: argparse.Namespace, reporter: StoppingReporter) -> None:
    opened = open_pointable(options, reporter)
    source = require_splats(opened)
    trained = None if isinstance(source, Splats) else source
    capture = opened.capture if trained is None else _with_masks(trained, options, reporter)
    if capture is None:
        raise InputError(f"{opened.folder.folder} has no capture with masks; import the splats again with --capture.")
    there = {
        index: mask.astype(np.min_scalar_type(mask.max()))
        for index in range(len(capture))
        if (mask := capture.uncorrected_mask(index)) is not None
    }
    trained_on = set(capture.train_indices)
    given = {index: mask for index, mask in there.items() if index in trained_on}
    if not any(mask.any() for mask in given.values()):
        raise InputError(f"{capture.folder} has no masks of the training's photos; import masks, or mark objects.")
    if not is_made(capture.folder / "masks"):
        require_place_for_given(capture.folder)
    reporter.expect({
        KERNELS: ("Preparing", kernel_seconds(opened.device)),
        _TRAIN: ("Training", 0.0 if trained is None else border_seconds(trained)),
    })  # fmt: skip
    ensure_kernels(reporter, opened.device)
    reporter.begin(GRAPH, "Comparing the splats with their neighbors")
    with stage(opened.folder, "label cleanup"):
        pointer = opened.pointer(reporter.progress)
        reporter.begin(_VOTE, f"Comparing the splats with {len(given)} masks")
        scene = None if trained is None else trained.scene
        zero_is_known = scene is not None and (scene.supervise_background or scene.zero_is_object)
        others = {index: there[index] for index in there.keys() - given.keys()}
        anew = renumber_masks(capture, given, others, _CONSISTENT)
        if anew.agreement < _CONSISTENT:
            reporter.status(f"Masks agree on the ID of {anew.agreement:.0%} of what they show; IDs are found anew")
        repair = repair_masks(pointer, anew.masks, zero_is_known, reporter.progress)
        del pointer  # The training needs its memory.
        reporter.begin(_MASKS, f"Writing masks of {len(capture)} photos")
        changed, moved = _changed(capture, given, repair), _moved(source, opened.splats, capture, repair)
        is_same = anew.agreement >= _CONSISTENT
        record = {"changed": changed, "moved": moved}
        _write(capture, repair.masks if is_same else {**anew.others, **repair.masks}, record, is_same, reporter)
    if isinstance(source, Splats):
        reporter.begin(EXPORT, f"Writing {opened.folder.splats.name}")
        write_labeled(opened.folder, source, repair.ids, capture.names, reporter)
    else:
        offsets = opened.splats.source.cpu().numpy()
        trainer = begin_border_training(source, offsets, repair.ids, options, reporter)
        train_borders(source, trainer, reporter)
    _tell(changed, moved, reporter)
    reporter.done(
        masks=str(capture.folder / "masks"),
        views=len(repair.masks),
        changed=round(float(np.mean(list(changed.values()))), 4),
        moved=moved,
        splats=str(opened.folder.splats),
        **({} if trained is None else {"steps": trainer.progress.step}),
    )


def _with_masks(trained: Trained, options: argparse.Namespace, reporter: StoppingReporter) -> Capture:
    """Return the capture of a training with its masks, which may have been made since."""
    capture = trained.capture
    if capture.has_masks:
        return capture
    size = trained.training.votes.max_size
    fresh = load_capture(capture.folder, trained.folder.cache, memory_for_files(options), size, reporter)
    return fresh.excluding_from_training(trained.plan.views_left_out).validating_on(trained.plan.validation_views)


def _changed(capture: Capture, given: dict[int, np.ndarray], repair: Repair) -> dict[str, float]:
    """Return the fraction of each photo's pixels whose ID has changed; 1 where there was no mask."""
    return {
        capture.views[index].name: round(float(np.mean(mask != given[index])), 4) if index in given else 1.0
        for index, mask in repair.masks.items()
    }


def _moved(
    source: Trained | Splats, splats: Generated, capture: Capture, repair: Repair
) -> list[dict[str, float | str]]:
    """Return for each object the fraction of its splats that other objects get, the largest first."""
    if isinstance(source, Splats):
        before = source.object_ids
    else:
        before = source.model.classes.ids_of(splats.ids.cpu().numpy()).astype(np.int64)
    total, gone = Counter(before.tolist()), Counter(before[before != repair.ids].tolist())
    names = capture.names
    found: list[dict[str, float | str]] = [
        {"object": names.get(i, default_name(i)) if i else "no object", "moved": round(gone[i] / total[i], 4)}
        for i in total
    ]
    return sorted(found, key=lambda entry: -float(entry["moved"]))


def _write(
    capture: Capture,
    masks: dict[int, np.ndarray],
    record: dict[str, Any],
    keeps_ids: bool,
    reporter: StoppingReporter,
) -> None:
    """Write masks of all photos with IDs, which replace the given ones; those that are not in `masks` are unchanged.

    keeps_ids: whether IDs mean the objects that they meant in the given masks.
    """
    before, kept = capture.folder / "masks", kept_masks(capture.folder)
    # Masks that were repaired already are not given ones.
    is_given = before.is_dir() and not is_repaired(before) and not kept.exists()
    with new_masks(capture.folder, kept if is_given else None) as folder:
        whole, files = capture.edited({}, ()), Files(before)
        for index, view in enumerate(capture.views):
            mask, file = masks.get(index), whole.uncorrected_mask(index)
            if mask is not None and file is not None:
                # Objects that are left out of the training are still in the file.
                mask = np.where((mask == 0) & np.isin(file, capture.left_out), file, mask)
            given = files.first(mask_names(view.name)[0])
            is_same = mask is None or (file is not None and np.array_equal(mask, file))
            if given is not None and is_same and not is_three_channel(given):
                # As it is, since the view may be smaller than the photo, or show less of it. Colors that are IDs are
                # rewritten, since whether files are such is told from all of them.
                same = folder / given.relative_to(before)
                same.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(given, same)
            elif (ids := file if mask is None else mask) is not None:
                write_mask(folder, view.name, capture.photo_mask(index, ids))
            reporter.progress(index + 1, len(capture), what="photos")
        for name in (STROKES, *([RECORD] if keeps_ids else [])):
            if (before / name).is_file():
                shutil.copyfile(before / name, folder / name)
        write_json(folder / REPAIRED, {**record, SAME_IDS: keeps_ids and has_ids_of(before, kept)})


def _tell(changed: dict[str, float], moved: list[dict[str, float | str]], reporter: StoppingReporter) -> None:
    """Report in which masks most has changed, and which objects have lost splats."""
    worst = sorted(changed, key=lambda name: -changed[name])[:_WORST]
    parts = [f"{name} ({changed[name]:.0%})" for name in worst if changed[name] >= _MOVED]
    if parts:
        reporter.status(f"The masks that changed most: {', '.join(parts)}")
    for entry in moved:
        if float(entry["moved"]) >= _MOVED:
            reporter.status(f"{float(entry['moved']):.0%} of the splats of {entry['object']} belong to another object")
