# SPDX-License-Identifier: GPL-3.0-or-later
"""Locations of the user's folders and of the backend's Python."""

from __future__ import annotations

import itertools
import os
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import bpy

from ...backend.shared.errors import InputError
from ...backend.shared.formats.file_names import file_stem
from ...backend.shared.formats.json_file import write_json
from ...backend.shared.formats.photos_source import PhotosSource, read_source
from ...backend.shared.formats.regular_file import is_file
from ..process.backend_process import backend_command, backend_environment
from ..process.jobs import Job
from . import environment, online_access
from .extension import PACKAGE, ROOT
from .worker.layout import VERSIONS

_LONGEST_NAMES = 8000
"""Number of characters of photos' names from which on they are given in a file; a command line of Windows has 32,767
for everything, with a space and two quotes for each name."""


def _package() -> str:
    """Return the package of the user's settings: for headless.py of another folder, that of the enabled extension."""
    names = bpy.context.preferences.addons.keys()
    if PACKAGE.startswith("bl_ext.") or PACKAGE in names:
        return PACKAGE
    return next((name for name in names if name.startswith("bl_ext.") and name.endswith(".objectgs")), PACKAGE)


def preferences() -> Any:
    """Return the extension's preferences, or None if it is not enabled."""
    addon = bpy.context.preferences.addons.get(_package())
    return addon.preferences if addon else None


def user_folder() -> Path:
    """Return the folder for files that survive updates of the extension; it may be missing."""
    # Where Blender was to create it and could not, the path would be empty, which means the working folder.
    if _package().startswith("bl_ext."):
        return Path(bpy.utils.extension_path_user(_package()))
    return Path(bpy.utils.user_resource("DATAFILES", path="objectgs"))


def environment_folder() -> Path:
    """Return the folder of the backend's environment."""
    return user_folder() / "environment"


def reconstructions_folder() -> Path:
    """Return the default folder for new reconstructions.

    It is not in the folder of the extension, which Blender deletes when the extension is uninstalled.

    Raises:
        InputError: as for `absolute`.
    """
    chosen = preferences().reconstructions if preferences() else ""
    return absolute(chosen) if chosen else Path.home() / "ObjectGS"


def absolute(chosen: str) -> Path:
    """Return the absolute path of a folder that the user has chosen, maybe relative to the .blend.

    Raises:
        InputError: The .blend is not saved yet, or the path has no drive.
    """
    folder = Path(bpy.path.abspath(chosen))
    if not folder.is_absolute():
        if chosen.startswith("//"):
            raise InputError(f"The folder {chosen} is relative to the .blend; save the .blend first, or choose another")
        raise InputError(f"The folder {chosen} is relative, or without a drive; choose another")
    return folder


def new_reconstruction(name: str, is_free: Callable[[Path], bool]) -> Path:
    """Return a folder for a new reconstruction named `name`, with a number if needed for `is_free` to be true."""
    name = file_stem(name, "capture")
    numbered = (name if number == 1 else f"{name}-{number}" for number in itertools.count(1))
    return next(folder for each in numbered if is_free(folder := reconstructions_folder() / each))


def name_of_photos(sources: Sequence[Path]) -> str:
    """Return a name for a folder of photos, a video or files of a folder.

    Where the folder's name says nothing, it is that of the folder above.
    """
    if len(sources) == 1 and sources[0].is_file():
        return file_stem(sources[0].stem, "video")
    photos = sources[0] if len(sources) == 1 else sources[0].parent
    named = photos.parent if photos.name.lower() in ("images", "photos", "dcim") else photos
    named = named.parent if named.name.lower() == "capture" else named
    return file_stem(named.name, "photos")


def new_capture(sources: Sequence[Path]) -> Path:
    """Return the folder for the capture of photos or a video: a new one, or that where its computation has begun."""
    captures = reconstructions_folder() / "captures"
    name = name_of_photos(sources)
    numbered = (captures / (name if number == 1 else f"{name}-{number}") for number in itertools.count(1))

    def is_of_sources(folder: Path) -> bool:
        stored = read_source(folder)
        return stored is not None and stored.photos == list(sources)

    return next(folder for folder in numbered if not folder.exists() or is_of_sources(folder))


def backend_python() -> Path | None:
    """Return the backend's Python: the user's choice, else that of the environment; None if it is not usable."""
    chosen = chosen_python()
    if chosen is not None:
        return chosen if is_file(chosen) else None
    state = environment.inspect(environment_folder())
    return state.python if state.state == "ready" else None


def may_use_gpu() -> bool:
    """Return whether the backend's environment was set up for a GPU; that of another Python is not known."""
    return chosen_python() is None and environment.inspect(environment_folder()).device == "cuda"


def backend_sentence() -> str:
    """Describe the backend in a sentence: its location, or why it cannot run and what to do."""
    chosen = chosen_python()
    if chosen is None:
        return environment.inspect(environment_folder(), online_access.remedy()).sentence
    if is_file(chosen):
        return f"The backend is at {chosen}."
    return f"The backend's Python {chosen} does not exist; choose another, or clear the field."


def how_to_set_up() -> str:
    """Return what the user does to have the backend set up, which would not be used beside a chosen Python."""
    if os.environ.get("OBJECTGS_PYTHON"):
        return "unset OBJECTGS_PYTHON, start Blender again and set the backend up"
    if chosen_python() is not None:
        return "clear Backend Python in the preferences of ObjectGS and set the backend up"
    return "set it up again"


def chosen_python() -> Path | None:
    """Return the Python chosen by the user, which may be missing, or None."""
    chosen = os.environ.get("OBJECTGS_PYTHON") or (preferences().backend_python if preferences() else "")
    return Path(bpy.path.abspath(chosen)) if chosen else None


def base_python() -> Path:
    """Return the Python for new environments: the user's choice, or else one that `find_python` finds."""
    chosen = preferences().base_python if preferences() else ""
    return Path(bpy.path.abspath(chosen)) if chosen else environment.find_python()


def backend_job(title: str, kind: str, folder: Path | None, *arguments: str) -> Job:
    """Return a job that runs `python -m backend ARGUMENTS --json`; `backend_python` must not return None.

    Args:
        title: name shown to the user.
        kind: value of `Job.kind`.
        folder: the reconstruction folder, or None.
        arguments: command and options of the backend.
    """
    python = backend_python()
    assert python is not None
    silent = f"{python} cannot run the backend; choose a Python {VERSIONS} that has its packages, or {how_to_set_up()}."
    return Job(
        title=title,
        kind=kind,
        folder=folder,
        command=backend_command(python, *arguments),
        cwd=ROOT,
        environment=backend_environment(environment.cache_folder(environment_folder())),
        if_silent=silent,
    )


def segmenter() -> Path | None:
    """Return the folder of the segmentation model that the user has chosen, which may be missing, or None."""
    chosen = preferences().segmenter if preferences() else ""
    return Path(bpy.path.abspath(chosen)) if chosen else None


def segmenter_options(folder: Path | None) -> list[str]:
    """Return the options of `point` and `label` for the folder of a segmentation model, or None."""
    return [] if folder is None else ["--segmenter", str(folder)]


def naming_options(names: str) -> list[str]:
    """Return the options of `masks` for objects with names, which semicolons separate; none without names."""
    if not names.strip():
        return []
    chosen = preferences().detector if preferences() else ""
    return ["--text", names, *(["--detector", bpy.path.abspath(chosen)] if chosen else [])]


def sfm_job(capture: Path, source: PhotosSource) -> Job:
    """Return a job that computes the poses of photos, and writes a capture."""
    photos, leave_out, listed = source.photos, source.leave_out, []
    if sum(len(str(each)) for each in (*photos, *leave_out)) > _LONGEST_NAMES:
        # In the folder of this session, since the job may wait.
        folder = Path(tempfile.mkdtemp(prefix="objectgs-", dir=bpy.app.tempdir))
        write_json(folder / "photos.json", {"photos": [str(path) for path in photos[1:]], "leave_out": leave_out})
        photos, leave_out, listed = photos[:1], [], ["--list", str(folder / "photos.json")]
    return backend_job(
        f"Photos of {name_of_photos(source.photos)}",
        "sfm",
        capture,
        "sfm",
        *map(str, photos),
        "--out",
        str(capture),
        "--cameras",
        source.cameras,
        "--features",
        source.features,
        *(["--frames", str(source.frames)] if source.frames else []),
        *(["--set", str(source.set)] if source.set > 1 else []),
        *(["--calibration", str(source.calibration)] if source.calibration else []),
        *(["--matcher", str(source.matcher)] if source.matcher else []),
        *(["--leave-out", *leave_out] if leave_out else []),
        *listed,
    )


def demo_folder() -> Path:
    """Return the folder of the demo capture."""
    return user_folder() / "demo-capture"


def demo_job() -> Job:
    """Return a job that renders the demo capture in a second Blender without a window."""
    script = [str(ROOT / "headless.py"), "--", "demo", str(demo_folder()), "--json"]
    return Job(
        title="Make demo capture",
        kind="demo",
        folder=demo_folder(),
        command=[bpy.app.binary_path, "--background", "--factory-startup", "--python", *script],
        cwd=ROOT,
        environment={},
    )
