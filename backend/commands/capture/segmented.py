"""The segments that a model finds in the photos of a capture, as the masks that `masks` is given."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import torch

from ...capture.made_masks import SEGMENTS
from ...capture.mask_sources import MaskSource
from ...capture.models import Photos
from ...raster import devices
from ...segmentation import Finder, PhotoSegments, finders, is_sam3
from ...shared.errors import InputError, is_lack_of_memory
from ...shared.stopping import StoppingReporter
from ..setup.device import choose_device

_MASKS = "MASKS"
"""The argument with the model, for errors."""
_PER_PHOTO = 30.0
"""Expected seconds in which a model segments a photo, until its pace is known."""


def segmented(options: argparse.Namespace, names: Sequence[str], reporter: StoppingReporter, part: str) -> MaskSource:
    """Return the segments that a model finds in the photos; those that were found before are kept.

    Args:
        options: the command's, of which `masks` is the folder of the model.
        names: the capture's photos, of which some may be missing.
        reporter: receives progress.
        part: the part of the command that this is, for the reporter.

    Raises:
        InputError: The model or a photo cannot be used, or the options ask for more than segments.
    """
    if options.objects == "given":
        raise InputError("Segments do not say which of them show the same object; use --objects find.")
    images = Photos(options.capture).folder
    present = [name for name in names if (images / name).is_file()]
    source = PhotoSegments(_finder(options), images, present, options.capture / SEGMENTS)
    missing = len(source.missing())
    reporter.expect({part: ("Segmenting", max(_PER_PHOTO * missing, 1.0))})
    reporter.begin(part, f"Segmenting {missing} photos")
    if missing:
        _find(source, choose_device(options.device, reporter), options.masks, reporter)
    return source


def _find(source: PhotoSegments, device: torch.device, model: Path, reporter: StoppingReporter) -> None:
    """Find the missing segments, on the CPU where the GPU's memory is too small for the model."""
    try:
        source.find(device, lambda done, total: reporter.progress(done, total, what="photos"))
        return
    except InputError:
        raise
    except Exception as error:
        if is_lack_of_memory(error):
            raise InputError(
                f"There is not enough memory for the model in {model}; close other programs, or use a smaller model."
            ) from error
        if device.type == "cpu" or not devices.is_out_of_memory(error):
            raise
    # Here the error, and with it the model, is gone.
    torch.cuda.empty_cache()
    reporter.warning(
        "There is not enough GPU memory for the model, so the CPU is used, which is slower; close programs that use "
        "the GPU, or use a smaller model."
    )
    _find(source, devices.CPU, model, reporter)


def _finder(options: argparse.Namespace) -> Finder:
    """Return what finds the segments of a photo."""
    if options.text is None:
        return finders.everything(options.masks, _MASKS)
    if is_sam3(options.masks, _MASKS):
        return finders.by_words(options.masks, _MASKS, options.text)
    return finders.boxed(options.masks, _MASKS, options.detector, options.text)


def require_fitting_options(options: argparse.Namespace, segments_by_model: bool) -> None:
    """Raise InputError if the options for names do not fit each other or the masks."""
    if not segments_by_model:
        if options.text is not None or options.detector is not None:
            raise InputError(
                f"{options.masks} has no model, which --text and --detector are for; choose a folder with one as MASKS."
            )
        return
    finds_words = is_sam3(options.masks, _MASKS)
    if options.text is None and (finds_words or options.detector is not None):
        model = options.masks if finds_words else options.detector
        raise InputError(f'The model in {model} finds objects by their names; add --text, such as --text "cup; book".')
    if options.text is not None and not finds_words and options.detector is None:
        raise InputError(
            f"The model in {options.masks} does not find objects by their names; add --detector, a folder with a "
            "checkpoint of Grounding DINO."
        )
