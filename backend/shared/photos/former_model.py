"""The earlier model of a capture, which a run of `sfm` keeps until it has ended, and its return after a kill."""

from __future__ import annotations

import shutil
from pathlib import Path

from ..formats.atomic import replace_file, write_atomic
from ..formats.photos_source import FORMER, SOURCE, SPARSE, WORK
from ..formats.regular_file import is_folder
from ..reconstruction.lock import locked


def keep_former(capture: Path) -> None:
    """Copy the sparse/0 of a capture and its sfm/source.json to sfm/former; the caller holds the lock on sfm/."""
    # Not beside the model, where it would be another one of the capture.
    part = capture / WORK / f"{FORMER}.part"
    shutil.rmtree(part, ignore_errors=True)
    shutil.copytree(capture / SPARSE, part)
    shutil.copyfile(capture / WORK / SOURCE, part / SOURCE)
    replace_file(part, capture / WORK / FORMER)


def forget_former(capture: Path) -> None:
    """Remove what `keep_former` has copied, if anything; the caller holds the lock on sfm/."""
    former, part = capture / WORK / FORMER, capture / WORK / f"{FORMER}.part"
    if former.exists():
        replace_file(former, part)
    shutil.rmtree(part, ignore_errors=True)


def put_former_back(capture: Path) -> None:
    """Replace the model by the one that `keep_former` has copied; the caller holds the lock on sfm/."""
    target, former = capture / SPARSE, capture / WORK / FORMER
    write_atomic(capture / WORK / SOURCE, (former / SOURCE).read_bytes())
    old = target.with_name("old")
    shutil.rmtree(old, ignore_errors=True)
    if target.exists():
        replace_file(target, old)
    replace_file(former, target)
    (target / SOURCE).unlink()
    shutil.rmtree(old, ignore_errors=True)


def undo_killed_run(capture: Path) -> None:
    """Put the earlier model of a capture back if a run of `sfm` was killed after it had replaced it.

    Raises:
        FolderInUse: `sfm` is running.
        OSError: The model cannot be put back.
    """
    if not is_folder(capture / WORK / FORMER):
        return
    with locked(capture / WORK):
        if (capture / WORK / FORMER / SOURCE).exists():
            put_former_back(capture)
        forget_former(capture)
