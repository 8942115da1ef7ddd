"""Opening of reconstruction folders, to create a reconstruction or to render and measure its trained model."""

from __future__ import annotations

import argparse
import hashlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..capture import Capture, default_split, load_capture
from ..labels import correct_masks
from ..model.anchors import Anchors
from ..model.object_model import ObjectModel
from ..planning.decisions import planned_capture
from ..shared.errors import InputError
from ..shared.events import Reporter
from ..shared.formats.atomic import recorded, remove_abandoned
from ..shared.formats.points_ply import read_points
from ..shared.reconstruction.folder import Reconstruction
from ..shared.reconstruction.lock import locked
from ..shared.reconstruction.meshes import outdate_meshes
from ..shared.reconstruction.objects import read_objects
from ..shared.reconstruction.plan import Plan
from ..shared.reconstruction.record import CaptureRecord, TrainingRecord, read_record, update_record
from ..shared.stopping import StoppingReporter
from ..training.budget import TrainingProgress
from ..training.exposure.gains import measure_gains
from ..training.scene import Scene
from ..training.state import blur_warning, load_model, progress_of
from .cameras import write_capture_cameras
from .setup.device import choose_device
from .stages import stage

READ = "read"
"""Name of the opening of a capture or reconstruction among the parts of a command."""


def memory_for_files(options: argparse.Namespace) -> float:
    """Return the part of --memory-mb, in MB, for decoded files, each of which most commands need only a few times."""
    return options.memory_mb / 5


def memory_for_targets(options: argparse.Namespace) -> float:
    """Return the part of --memory-mb, in MB, for targets, which a training needs in each step."""
    return options.memory_mb - memory_for_files(options)


class Output:
    """A reconstruction folder that this process has locked and writes to."""

    def __init__(self, folder: Reconstruction) -> None:
        self.folder = folder
        self._kept_from: tuple[type[Exception], ...] = ()

    def read(self) -> None:
        """Keep what has been written if the disk is full or fails, but not if the input is refused."""
        self._kept_from = (OSError,)

    def accept(self) -> None:
        """Keep what has been written, whatever fails from now on."""
        self._kept_from = (Exception,)

    def is_kept_from(self, error: Exception) -> bool:
        """Return whether what has been written is kept in spite of an error."""
        return isinstance(error, self._kept_from)


@contextmanager
def open_output(options: argparse.Namespace) -> Iterator[Output]:
    """Create the folder of --out if necessary, and lock it.

    If the input is refused before `Output.accept`, or writing fails before `Output.read`, what this process has created
    is deleted: its files while the folder is still locked, then those new folders that are empty.

    Raises:
        FolderInUse: another process uses the folder.
        InputError: the folder contains files but no reconstruction, or cannot be written to.
    """
    output = Output(Reconstruction(options.out))
    if not options.overwrite:
        output.folder.require_own(getattr(options, "capture", None))
    with recorded() as created:
        try:
            output.folder.create()
            with locked(output.folder.folder):
                try:
                    remove_abandoned(output.folder.folder)
                    update_record(output.folder)
                    yield output
                except (InputError, OSError) as error:
                    if not output.is_kept_from(error):
                        created.remove_files()
                    raise
        except (InputError, OSError) as error:
            if not output.is_kept_from(error):
                created.remove_folders()
            raise


@contextmanager
def open_reconstruction(options: argparse.Namespace, reporter: Reporter) -> Iterator[tuple[Output, Capture]]:
    """Create the folder of --out if necessary, lock it, read the capture and write cameras.json.

    Raises:
        InputError: as `open_output`, or the capture cannot be used; what this process has created is deleted.
    """
    with open_output(options) as output:
        capture = read_capture(output.folder, options, reporter)
        output.read()
        yield output, capture


def read_capture(
    folder: Reconstruction,
    options: argparse.Namespace,
    reporter: Reporter,
    check: Callable[[Capture], None] | None = None,
) -> Capture:
    """Read a capture, prepare its images in the cache of the reconstruction, and write cameras.json.

    Args:
        folder: The reconstruction, locked by this process.
        options: capture (its folder), max_size (longest side in pixels) and the limits of memory.
        reporter: Receives progress and warnings.
        check: Raises InputError for a capture that is not wanted, before cameras.json is written.

    Returns:
        The prepared capture.

    Raises:
        InputError: The capture cannot be used.
    """
    reporter.begin(READ, "Reading the capture")
    with stage(folder, "read"):
        capture = load_capture(options.capture, folder.cache, memory_for_files(options), options.max_size, reporter)
        if check is not None:
            check(capture)
        write_capture_cameras(folder, capture)
    return capture


class Trained(NamedTuple):
    """An opened reconstruction with its trained model.

    is_latest: whether the model is that of the latest checkpoint, and not of an older one since that is damaged.
    """

    folder: Reconstruction
    capture: Capture
    model: ObjectModel
    scene: Scene
    progress: TrainingProgress
    plan: Plan
    training: TrainingRecord
    is_latest: bool

    @property
    def trained_on(self) -> str:
        """Name of the device that the model was trained on, as from `backend.raster.devices.name_of`."""
        return self.training.device


def require_reconstruction(folder: Reconstruction) -> None:
    """Raise InputError if a folder does not exist, or is not a reconstruction."""
    if not folder.folder.is_dir():
        raise InputError(f"{folder.folder} does not exist; specify the folder given to `train --out`.")
    if not folder.settings.exists():
        raise InputError(
            f"{folder.folder} is not a reconstruction, since it has no {folder.settings.name}; train first."
        )


@contextmanager
def locked_reconstruction(options: argparse.Namespace) -> Iterator[None]:
    """Lock the reconstruction of a command, before it is read, so that nothing changes in between.

    Raises:
        InputError: as `require_reconstruction`, or the folder cannot be written to.
        FolderInUse: another process has locked it.
    """
    folder = Reconstruction(options.folder)
    require_reconstruction(folder)
    folder.require_writable()
    with locked(folder.folder):
        yield


def open_trained(
    options: argparse.Namespace, reporter: Reporter, checkpoint: Path | None = None, own: Path | None = None
) -> Trained:
    """Open a trained reconstruction with its capture.

    Args:
        options: Options with the folder, and the device to load the model on; `capture` replaces a recorded folder.
        reporter: Receives status and warnings.
        checkpoint: Folder of the checkpoint, whose anchors are left out; None: that of the reconstruction, with all.
        own: The only folder that may be written to, as several processes use the reconstruction; None: all of it.

    Returns:
        The reconstruction, with the capture edited and planned as for its training.

    Raises:
        InputError: The folder, its model or its capture is missing, or the capture is not that of the training.
    """
    reporter.begin(READ, "Reading the reconstruction")
    device = choose_device(options.device, reporter)
    folder = Reconstruction(options.folder)
    require_reconstruction(folder)
    record = read_record(folder)
    model, state, warning = load_model(
        checkpoint or folder.checkpoint, device, None if checkpoint is None else _no_anchors
    )
    for each in (warning, blur_warning(state, folder.checkpoint)):
        if each is not None:
            reporter.warning(each)
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
    # Another place of the photos, which this machine alone may have, makes what is cached of them obsolete.
    is_elsewhere = record.capture is None or str(source.resolve()) != record.capture.folder
    cache = own / folder.cache.name if own is not None and is_elsewhere else folder.cache
    capture = load_capture(source, cache, memory_for_files(options), max_size, reporter)
    if digest(capture) != training.votes.capture:
        raise InputError(
            f"The capture {source} is not the one that {folder.folder} was trained on; put that one back, give "
            "its location with --capture, or train again."
        )
    if options.capture and own is None:
        agreement = recorded_agreement(folder, capture, max_size)
        update_record(folder, capture=capture_record(capture, max_size, agreement))
        write_capture_cameras(folder, capture)
    # The objects left out of the training, regardless of later edits.
    plan = plan_of(training)
    capture = planned_capture(edited(capture, folder, training.left_out), plan)
    exposure = plan["exposure"]
    gains = (
        None
        if exposure is None
        else measure_gains(capture, reporter.check)
        if exposure.done
        else np.ones((len(capture), 3))
    )
    zero_is_object = state["settings"]["zero_is_object"]
    scene = Scene(
        capture, model.classes, model.normalization, zero_is_object, memory_for_targets(options),
        supervise_background=state["supervise_background"], gains=gains, blur=model.blur,
    )  # fmt: skip
    return Trained(folder, capture, model, scene, progress_of(state), plan, training, warning is None)


def _no_anchors(block: Anchors) -> np.ndarray:
    return np.zeros(len(block), np.bool_)


def with_corrected_masks(trained: Trained, reporter: StoppingReporter) -> Capture:
    """Return the capture of a training with its masks corrected by votes, if there are any, as the training does."""
    if not trained.capture.has_masks or not trained.folder.points.is_file():
        return trained.capture
    ids = read_points(trained.folder.points).ids
    scene = trained.scene
    ignore_gaps = scene.supervise_background and not scene.zero_is_object
    return correct_masks(trained.capture, ids, ignore_gaps, reporter.check)[0]


def outdate_results(folder: Reconstruction) -> None:
    """Mark meshes as those of an earlier model, and remove its evaluation: another one takes its place."""
    listed = read_objects(folder.objects) if folder.objects.exists() else []
    outdate_meshes(folder.meshes, {entry.id for entry in listed})
    folder.evaluation.unlink(missing_ok=True)


def plan_of(training: TrainingRecord | None) -> Plan:
    """Return the plan of a training; empty without a training or for those of older versions."""
    return Plan.of(training.plan or () if training else ())


def edited(capture: Capture, folder: Reconstruction, left_out: Iterable[int]) -> Capture:
    """Return the capture with the user's names of its objects, and without the objects in `left_out`."""
    known = read_objects(folder.objects) if folder.objects.exists() else []
    return capture.edited({entry.id: entry.name for entry in known}, left_out)


def digest(capture: Capture) -> str:
    """Return a hash of a capture's view names, poses and points, and of its held-out views if it names them.

    It does not depend on the capture's folder.
    """
    sha = hashlib.sha256()
    for view in capture.views:
        sha.update(view.name.encode() + b"\0" + np.ascontiguousarray(view.viewmat).tobytes())
    sha.update(np.ascontiguousarray(capture.points.xyz).tobytes())
    # Without the default choice, which folders of earlier versions have.
    if capture.test_indices != default_split(len(capture)):
        sha.update(b"held out" + np.array(capture.test_indices, "<i8").tobytes())
    return sha.hexdigest()[:16]


def capture_record(capture: Capture, max_size: int, agreement: float | None = None) -> CaptureRecord:
    """Return the entry of a capture for objectgs.json."""
    return CaptureRecord(str(capture.folder.resolve()), max_size, digest(capture), agreement)


def recorded_agreement(folder: Reconstruction, capture: Capture, max_size: int) -> float | None:
    """Return the agreement of the capture's photos that is recorded in a folder; None if there is none."""
    known = read_record(folder).capture
    is_same = known is not None and (known.max_size, known.digest) == (max_size, digest(capture))
    return known.agreement if known is not None and is_same else None
