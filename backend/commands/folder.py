"""Opening of reconstruction folders, to create a reconstruction or to render and measure its trained model."""

from __future__ import annotations

import argparse
import hashlib
import shutil
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..capture import Capture, load_capture
from ..model.object_model import ObjectModel
from ..planning.decisions import planned_capture
from ..raster import devices
from ..shared.errors import InputError
from ..shared.events import Reporter
from ..shared.reconstruction.folder import Reconstruction
from ..shared.reconstruction.lock import FolderInUse, locked
from ..shared.reconstruction.objects import read_objects
from ..shared.reconstruction.plan import Plan
from ..shared.reconstruction.record import CaptureRecord, TrainingRecord, read_record, update_record
from ..training.budget import TrainingProgress
from ..training.exposure import measure_gains
from ..training.scene import Scene
from ..training.state import load_model, progress_of
from .cameras import write_capture_cameras
from .stages import stage


def memory_for_files(options: argparse.Namespace) -> float:
    """Return the part of --memory-mb, in MB, for decoded uint8 images; their float32 planes take four times as much."""
    return options.memory_mb / 5


def memory_for_planes(options: argparse.Namespace) -> float:
    """Return the part of --memory-mb, in MB, for the float32 planes of the same images, which are training targets."""
    return options.memory_mb - memory_for_files(options)


@contextmanager
def open_reconstruction(options: argparse.Namespace, reporter: Reporter) -> Iterator[tuple[Reconstruction, Capture]]:
    """Create and lock the folder of --out, load the capture and write cameras.json.

    If the input is invalid, a new folder is removed again.

    Yields:
        The folder, locked for the duration of the context, and the capture.
    """
    folder = Reconstruction(options.out)
    with ExitStack() as held:
        with removed_if_refused(folder):
            folder.create()
            held.enter_context(locked(folder.folder))
            with stage(folder, "read"):
                capture = load_capture(
                    options.capture, folder.cache, memory_for_files(options), options.max_size, reporter
                )
                write_capture_cameras(folder, capture)
        yield folder, capture


@contextmanager
def removed_if_refused(folder: Reconstruction) -> Iterator[None]:
    """Remove newly created folders on InputError or OSError, unless the folder is in use by another process."""
    absent = [path for path in (folder.cache, folder.folder, *folder.folder.parents) if not path.exists()]
    try:
        yield
    except FolderInUse:
        raise
    except (InputError, OSError):
        if absent:
            shutil.rmtree(absent[-1], ignore_errors=True)
        raise


class Trained(NamedTuple):
    """An opened reconstruction with its trained model."""

    folder: Reconstruction
    capture: Capture
    model: ObjectModel
    scene: Scene
    progress: TrainingProgress
    plan: Plan
    training: TrainingRecord

    @property
    def trained_on(self) -> str:
        """Name of the device that the model was trained on, as from `backend.raster.devices.name_of`."""
        return self.training.device


def open_trained(options: argparse.Namespace, reporter: Reporter) -> Trained:
    """Open a trained reconstruction with its capture.

    Args:
        options: Options with the folder, and the device to load the model on; `capture` replaces a recorded folder.
        reporter: Receives status and warnings.

    Returns:
        The reconstruction, with the capture edited and planned as for its training.

    Raises:
        InputError: The folder, its model or its capture is missing, or the capture is not that of the training.
    """
    device = devices.pick(options.device)
    folder = Reconstruction(options.folder)
    if not folder.folder.is_dir():
        raise InputError(f"{folder.folder} does not exist; specify the folder given to `train --out`.")
    if not folder.settings.exists():
        raise InputError(
            f"{folder.folder} is not a reconstruction, since it has no {folder.settings.name}; train first."
        )
    record = read_record(folder)
    model, state, warning = load_model(folder.checkpoint, device)
    if warning:
        reporter.warning(warning)
    training = record.training
    if training is None:
        raise InputError(
            f"{folder.settings} has no record of the training in {folder.checkpoint}; train again with --restart."
        )
    if options.capture is None and record.capture is None:
        raise InputError(f"{folder.settings} has no path of the capture; specify it with --capture.")
    source = Path(options.capture or (record.capture.folder if record.capture else ""))
    if not source.is_dir():
        raise InputError(f"The capture {source} of {folder.folder} does not exist; specify its folder with --capture.")
    # The capture of the training; record.capture changes with a later import of another capture.
    max_size = training.votes.max_size
    capture = load_capture(source, folder.cache, memory_for_files(options), max_size, reporter)
    if digest(capture) != training.votes.capture:
        raise InputError(
            f"The capture {source} is not the one that {folder.folder} was trained on; put that one back, say with "
            "--capture where it is, or train again."
        )
    if options.capture:
        update_record(folder, capture=capture_record(capture, max_size))
        write_capture_cameras(folder, capture)
    # The objects left out of the training, regardless of later edits.
    plan = plan_of(training)
    capture = planned_capture(edited(capture, folder, training.left_out), plan)
    exposure = plan["exposure"]
    gains = None if exposure is None else measure_gains(capture) if exposure.done else np.ones((len(capture), 3))
    zero_is_object = state["settings"]["zero_is_object"]
    scene = Scene(
        capture, model.classes, model.normalization, zero_is_object, memory_for_planes(options),
        supervise_background=state["supervise_background"], gains=gains,
    )  # fmt: skip
    return Trained(folder, capture, model, scene, progress_of(state), plan, training)


def plan_of(training: TrainingRecord | None) -> Plan:
    """Return the plan of a training; empty without a training or for those of older versions."""
    return Plan.of(training.plan or () if training else ())


def edited(capture: Capture, folder: Reconstruction, left_out: Iterable[int]) -> Capture:
    """Return the capture with the user's names of its objects, and without the objects in `left_out`."""
    known = read_objects(folder.objects) if folder.objects.exists() else []
    return capture.edited({entry.id: entry.name for entry in known}, left_out)


def digest(capture: Capture) -> str:
    """Return a hash of a capture's view names, poses and points; it does not depend on the capture's folder."""
    sha = hashlib.sha256()
    for view in capture.views:
        sha.update(view.name.encode() + b"\0" + np.ascontiguousarray(view.viewmat).tobytes())
    sha.update(np.ascontiguousarray(capture.points.xyz).tobytes())
    return sha.hexdigest()[:16]


def capture_record(capture: Capture, max_size: int) -> CaptureRecord:
    """Return the entry of a capture for objectgs.json."""
    return CaptureRecord(str(capture.folder.resolve()), max_size, digest(capture))
