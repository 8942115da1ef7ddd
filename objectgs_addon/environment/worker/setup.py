# SPDX-License-Identifier: GPL-3.0-or-later
"""Setup of an environment."""

from __future__ import annotations

import argparse
import contextlib
import errno
import json
import os
import platform
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any

from . import layout
from .checks import (
    KERNEL_SECONDS,
    check_backend,
    check_can_make_environments,
    check_place,
    check_python,
    check_runtime,
    check_space,
)
from .choice import check_system, choose
from .events import Progress, Refused, Stopped, emit, print_error
from .pip import Pip
from .programs import guarded, run

MEGABYTES = {"cpu": 180, "cuda": 3000}
"""Size of the downloads in MB, for the progress; on most systems that of cpu includes torch."""

_LOCKED_BYTE = 1 << 30
_PATIENCE = 3.0
"""Time in seconds for which a file that is in use is tried again."""
_STAMP_TEXT = "ObjectGS for Blender keeps the Python packages of its backend here; its preferences remove them.\n"


def set_up(options: argparse.Namespace, stop: Callable[[], bool]) -> None:
    """Create the environment in `options.folder`; on failure, remove its files and put an earlier one back.

    Raises:
        Refused: the environment cannot be created.
        Stopped: `stop` returned true.
    """
    folder, device = options.folder.absolute(), options.device
    check_python()
    check_place()
    check_can_make_environments()
    check_runtime()
    check_space(folder, device)
    check_system(options.requirements, device)
    progress = Progress(
        {
            "venv": ("Preparing", 5.0),
            "packages": ("Installing", 60.0 if device == "cpu" else 300.0),
            "torch": ("Installing", 60.0),
            "kernels": ("Compiling kernels", KERNEL_SECONDS),
        }
    )
    said: list[str] = []

    def print_and_keep(line: str) -> None:
        print_error(line)
        said.append(line)

    with claimed(folder), layout.short_path(folder) as short:
        progress.begin("venv", "Making an environment")
        if run(guarded(Path(sys.executable), "venv", str(short / layout.VENV)), stop, print_and_keep) != 0:
            why = f" ({said[-1].rstrip('.')})" if said else ""
            raise Refused(
                f"{sys.executable} could not make an environment in {folder}{why}; make sure that files can be written "
                "there, or choose another Python."
            )
        pip = Pip.of_environment(short, progress, stop)
        progress.begin("packages", "Resolving the packages")
        chosen = choose(pip, options.requirements, device, layout.GIGABYTES["cuda"])
        digest = layout.requirements_digest(options.requirements, chosen.device, layout.system())
        if chosen.device != device:
            check_space(folder, chosen.device)
        files = [argument for path in chosen.files for argument in ("-r", str(path))]
        pip.install(["--require-hashes", *files], MEGABYTES[chosen.device])
        if chosen.torch:
            # Without dependencies, so that no other package can come from the index of this build.
            progress.begin("torch", "Resolving PyTorch")
            pip.install(["--no-deps", *chosen.torch], megabytes=500)
        progress.begin("kernels", "Starting the backend")
        checked = check_backend(layout.environment_python(folder), progress, stop)
        shutil.rmtree(pip.temporary, ignore_errors=True)
        ready = {
            "python": platform.python_version(),
            "base": getattr(sys, "_base_executable", None) or sys.executable,
            "device": chosen.device,
            "system": layout.system(),
            "requirements": digest,
            "packages": pip.packages,
            "machine": checked.get("machine", {}),
        }
        _write_marker(folder, ready, stop)
    emit("done", message=checked.get("message", "The backend works."), machine=ready["machine"], folder=str(folder))


def _write_marker(folder: Path, ready: dict[str, Any], stop: Callable[[], bool]) -> None:
    part = folder / (layout.MARKER + ".part")
    with part.open("w", encoding="utf-8") as file:
        json.dump(ready, file, indent=1)
        file.flush()
        os.fsync(file.fileno())
    if stop():
        raise Stopped
    _replace(part, folder / layout.MARKER)


@contextlib.contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """Lock `folder` for this process, and replace an earlier environment by what the body makes.

    On exceptions in the body, the earlier environment is put back; if there is none, the folder is removed.

    Raises:
        Refused: the folder contains other files, or another process is using it; nothing is changed.
    """
    if not layout.is_ours(folder):
        raise Refused(f"{folder} is not empty and was not made by ObjectGS, so it is not used; move it away.")
    for old in folder.parent.glob(folder.name + layout.REMOVED + "*"):
        # Blender may be removing it just now.
        with contextlib.suppress(OSError):
            if layout.is_ours(old):
                layout.remove_own(old)
    folder.mkdir(parents=True, exist_ok=True)
    with contextlib.ExitStack() as opened:
        stamp = opened.enter_context((folder / layout.STAMP).open("a+", encoding="utf-8"))
        if not _lock(stamp):
            raise Refused(f"Another Blender is setting up the backend in {folder}; wait for it.")
        is_complete = _put_aside(folder)
        try:
            for name in (layout.VENV, layout.TEMPORARY, *(() if is_complete else (layout.OLD,))):
                if (folder / name).is_dir():
                    emit("status", message="Removing the previous environment")
                    shutil.rmtree(layout.long_path(folder / name))
            stamp.truncate(0)
            stamp.write(_STAMP_TEXT)
            stamp.flush()
            yield
        except BaseException:
            # The next setup removes what is still in use; why this one failed is what the user has to know.
            with contextlib.suppress(OSError):
                if is_complete:
                    _put_back(folder)
                else:
                    # Windows cannot remove open files.
                    opened.close()
                    layout.remove_own(folder)
            raise
        if is_complete:
            emit("status", message="Removing the previous environment")
            with contextlib.suppress(OSError):
                (folder / layout.OLD_MARKER).unlink()
            shutil.rmtree(layout.long_path(folder / layout.OLD), ignore_errors=True)


def _put_aside(folder: Path) -> bool:
    """Rename the earlier environment in `folder` and its marker; return whether it is a complete one.

    Raises:
        Refused: Windows says that it is in use; nothing is changed.
    """
    marker, old_marker = folder / layout.MARKER, folder / layout.OLD_MARKER
    if not marker.exists() and old_marker.exists() and (folder / layout.OLD).is_dir():
        # A setup that was killed has put it aside.
        return True
    if (folder / layout.VENV).is_dir():
        shutil.rmtree(layout.long_path(folder / layout.OLD), ignore_errors=True)
        try:
            _replace(folder / layout.VENV, folder / layout.OLD)
        except OSError as error:
            raise Refused(
                f"The backend in {folder} is in use by a job or by Mark Objects in this or another Blender "
                f"({error.strerror}); end it, and try again."
            ) from error
    if not marker.exists():
        return False
    _replace(marker, old_marker)
    return (folder / layout.OLD).is_dir()


def _put_back(folder: Path) -> None:
    """Restore the earlier environment that `_put_aside` has renamed."""
    # Its removal may take long, and this process may be killed meanwhile.
    with contextlib.suppress(OSError):
        (folder / layout.TEMPORARY).mkdir(exist_ok=True)
        os.replace(folder / layout.VENV, folder / layout.TEMPORARY / layout.VENV)  # noqa: PTH105
    layout.remove_folders([folder / layout.VENV])
    _replace(folder / layout.OLD, folder / layout.VENV)
    _replace(folder / layout.OLD_MARKER, folder / layout.MARKER)
    (folder / (layout.MARKER + ".part")).unlink(missing_ok=True)
    layout.remove_folders([folder / layout.TEMPORARY])


def _replace(path: Path, target: Path) -> None:
    """Rename a file or folder, on Windows as soon as virus scanners have released it."""
    deadline = time.monotonic() + _PATIENCE
    while True:
        try:
            os.replace(layout.long_path(path), layout.long_path(target))  # noqa: PTH105
            return
        except PermissionError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.1)


def _lock(file: IO[str]) -> bool:
    """Lock an open file until it is closed or this process ends; return False if another process holds the lock."""
    try:
        if sys.platform == "win32":
            import msvcrt

            # The byte at the file's position is locked, so everyone has to go to the same; it is beyond the content.
            os.lseek(file.fileno(), _LOCKED_BYTE, os.SEEK_SET)
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        # Some network folders do not support locks; simultaneous setups are not detected there.
        return error.errno not in (errno.EACCES, errno.EAGAIN, errno.EDEADLK)
    return True
