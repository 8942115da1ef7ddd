# SPDX-License-Identifier: GPL-3.0-or-later
"""Commands of headless.py, except those with a module of their own."""

from __future__ import annotations

import argparse
import os
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import bpy

from ...backend.shared.errors import EXIT_BAD_INPUT, EXIT_CANCELLED, EXIT_DONE, Cancelled, InputError, NothingMade
from ...backend.shared.events import Reporter
from ...backend.shared.formats.file_names import legible
from ...backend.shared.reconstruction.folder import Reconstruction
from ...backend.shared.reconstruction.lock import FolderInUse
from ...backend.shared.stopping import StopRequest
from .. import scene
from ..blender.quiet import quiet
from ..demo import capture as demo_capture
from ..environment import locations
from ..process.blocking import run_blocking
from ..state import folder_trust
from ..state import viewports as view
from . import apart
from .built import blend_to_render, blend_to_write, remember_built
from .picture import render_picture

PICTURE = "render.png"
APART_PICTURE = "pulled-apart.png"
SAMPLES = 16
"""Samples per pixel set in a .blend made by `build`."""


class StepFailed(Exception):
    """A step failed for a reason other than its input; the message is one sentence."""


def sentence(error: OSError) -> str:
    """Describe a file error in one sentence."""
    name = legible(str(error.filename))
    return f"{name} cannot be used ({error.strerror}); check it, its permissions and the free space."


def absolute(path: Path) -> Path:
    """Return the absolute path, with symbolic links unresolved."""
    return Path(os.path.abspath(path.expanduser()))  # noqa: PTH100


def demo(options: argparse.Namespace) -> None:
    """Render the demo capture."""
    _empty_file()
    settings = demo_capture.Settings(
        objects=options.objects,
        views=options.views,
        width=options.width,
        height=options.height,
        seed=options.seed,
        mask_noise=options.mask_noise,
        samples=options.samples,
    )
    stop = StopRequest()
    with stop.listening(read_stdin=options.json):
        demo_capture.make(options.out, settings, options.overwrite, options.reporter, stop)


def backend(options: argparse.Namespace) -> None:
    """Run the backend's import, vote or train command on a capture."""
    find_backend(options.backend_python)
    folder = absolute(options.out)
    run_backend(
        options.reporter,
        options.command,
        folder,
        absolute(Path(options.source)),
        "--out",
        folder,
        *path_options(options),
        *options.rest,
    )


def plan(options: argparse.Namespace) -> None:
    """Run the backend's plan command on a capture."""
    find_backend(options.backend_python)
    folder = absolute(options.out) if options.out else None
    out = ("--out", folder) if folder else ()
    run_backend(
        options.reporter, "plan", folder, absolute(Path(options.source)), *out, *path_options(options), *options.rest
    )


def on_result(options: argparse.Namespace) -> None:
    """Run the backend's mesh, edit or export command on a reconstruction."""
    find_backend(options.backend_python)
    folder = absolute(Path(options.source))
    out = ("--out", absolute(options.out)) if options.command == "export" else ()
    run_backend(options.reporter, options.command, folder, folder, *out, *path_options(options), *options.rest)


def import_splats(options: argparse.Namespace) -> None:
    """Run the backend's import-splats command on splats from another program."""
    find_backend(options.backend_python)
    folder = absolute(options.out)
    run_backend(
        options.reporter,
        "import-splats",
        folder,
        absolute(Path(options.source)),
        "--out",
        folder,
        *path_options(options),
        *options.rest,
    )


def build(options: argparse.Namespace) -> None:
    """Build a .blend from a reconstruction."""
    folder = absolute(options.folder)
    blend = absolute(options.blend) if options.blend else blend_to_write(folder, options.reporter)
    build_blend(folder, blend, options.reporter)


def render(options: argparse.Namespace) -> None:
    """Render an image of a .blend."""
    source = absolute(options.source)
    blend = blend_to_render(source, options.reporter) if source.is_dir() else source
    if not blend.is_file():
        raise InputError(f"{blend} does not exist; make it with the build command.")
    if options.apart and options.camera:
        raise InputError("--apart adds its own camera; omit --camera.")
    if options.apart:
        _render_apart(blend, absolute(options.out), options)
    else:
        render_picture(
            options.reporter,
            blend,
            absolute(options.out),
            options.camera,
            options.engine,
            options.samples,
            options.size,
            _showing(options.show) if options.show else None,
        )
    options.reporter.status(f"Wrote {options.out}.")


def run(options: argparse.Namespace) -> None:
    """Run all steps from a capture to a .blend and images."""
    find_backend(options.backend_python)
    reconstruct(absolute(Path(options.source)), absolute(options.out), options)


def reconstruct(
    capture: Path, folder: Path, options: argparse.Namespace, begin: Callable[[str], None] = lambda _step: None
) -> None:
    """Create splats, meshes, a report, a .blend and images of `capture` in `folder`; continue an earlier run.

    Args:
        capture: the capture.
        folder: the reconstruction folder.
        options: those of `run`.
        begin: called with the name of each command before it runs.
    """
    no_meshes = ["--no-meshes"] if options.no_meshes else []
    compute = _compute_options(options)
    begin("train")
    run_backend(
        options.reporter,
        "train",
        folder,
        capture,
        "--out",
        folder,
        *no_meshes,
        *path_options(options),
        *compute,
        *options.rest,
    )
    for command in ["evaluate"] if options.no_meshes else ["mesh", "evaluate"]:
        begin(command)
        try:
            run_backend(options.reporter, command, folder, folder, *compute)
        except NothingMade as error:  # Splats without a surface, or without held-out views, are still a valid result.
            options.reporter.warning(str(error))
    begin("report")
    run_backend(options.reporter, "report", folder, folder, *compute)
    begin("build")
    blend = blend_to_write(folder, options.reporter)
    has_meshes = build_blend(folder, blend, options.reporter)
    begin("render")
    render_picture(
        options.reporter,
        blend,
        folder / PICTURE,
        None,
        options.engine,
        options.samples,
        options.size,
        _showing("splats"),
    )
    options.reporter.status(f"Wrote {folder / PICTURE}.")
    if has_meshes:
        _render_apart(blend, folder / APART_PICTURE, options)
        options.reporter.status(f"Wrote {folder / APART_PICTURE}.")


def path_options(options: argparse.Namespace) -> list[str]:
    """Return those of the backend's options --capture and --groups that were given, with absolute paths."""
    given = {name: vars(options).get(name) for name in ("capture", "groups")}
    return [word for name, path in given.items() if path for word in (f"--{name}", str(absolute(path)))]


def _compute_options(options: argparse.Namespace) -> list[str]:
    given = {"--device": options.device, "--threads": options.threads, "--memory-mb": options.memory_mb}
    return [word for name, value in given.items() if value is not None for word in (name, str(value))]


def _render_apart(blend: Path, out: Path, options: argparse.Namespace) -> None:
    render_picture(
        options.reporter,
        blend,
        out,
        None,
        options.engine or "CYCLES",
        options.samples or apart.SAMPLES,
        options.size or apart.SIZE,
        apart.pull_apart,
    )


def _showing(which: str) -> Callable[[bpy.types.Scene], None]:
    """Return a function that makes a scene show splats, meshes or both."""

    def prepare(target: bpy.types.Scene) -> None:
        for root in apart.reconstructions(target):
            scene.show_kinds(root, which)

    return prepare


def find_backend(python: str | None) -> None:
    """Choose the backend's Python: `python`, OBJECTGS_PYTHON, or that of the preferences or the environment.

    Raises:
        InputError: no Python is found.
    """
    wanted = python or os.environ.get("OBJECTGS_PYTHON")
    if wanted:
        path = str(Path(wanted).expanduser())
        found = shutil.which(path) or (shutil.which(path + ".exe") if sys.platform == "win32" else None)
        if found is None:
            raise InputError(f"There is no Python at {wanted}; check --backend-python or OBJECTGS_PYTHON.")
        os.environ["OBJECTGS_PYTHON"] = str(absolute(Path(found)))
    elif locations.backend_python() is None:
        raise InputError(
            "The compute backend is not set up; name a Python that has it with --backend-python or "
            "OBJECTGS_PYTHON, or set it up in the preferences of ObjectGS."
        )


def show_reconstruction(folder: Path, reporter: Reporter) -> bpy.types.Collection:
    """Show the reconstruction in `folder` in a new file and return its collection.

    Raises:
        InputError: `folder` contains no reconstruction, or its files cannot be used.
    """
    files = Reconstruction(folder)
    if not files.cameras.is_file():
        raise InputError(f"{folder} contains no reconstruction; make one with the import or train command.")
    _empty_file()
    with quiet():
        root = scene.show_capture(bpy.context.scene, folder)
        warnings = scene.warnings_of(root)
        if files.splats.exists():
            warnings += scene.show_result(root, folder).warnings
            view.hide_capture(root)
    for warning in warnings:
        reporter.warning(warning)
    return root


def build_blend(folder: Path, blend: Path, reporter: Reporter) -> bool:
    """Show the reconstruction in `folder` in a new file and save it as `blend`.

    Returns:
        Whether any object has a mesh.

    Raises:
        InputError: `folder` contains no reconstruction, or the file cannot be written.
    """
    root = show_reconstruction(folder, reporter)
    target = bpy.context.scene
    with quiet():
        scene.set_up_render(target, root)
        view.hide_relationship_lines()
        view.widen_clipping(root)
        has_meshes = bool(scene.object_meshes(root))
        if has_meshes or scene.scene_meshes(root):
            apart.add_even_light(target)
        # Cycles works on every machine; EEVEE requires a display.
        target.render.engine = "CYCLES"
        target.cycles.samples = SAMPLES
    folder_trust.store_relative(root, str(blend))
    save_blend(blend, reporter)
    if blend.parent == folder:
        remember_built(blend)
    return has_meshes


def save_blend(path: Path, reporter: Reporter) -> None:
    """Save the open file as `path`; raise InputError if it cannot be written."""
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        with quiet():
            bpy.ops.wm.save_as_mainfile(filepath=str(path))
    except RuntimeError as error:
        raise InputError(f"{path} could not be written; check its folder and the free space.") from error
    reporter.status(f"Wrote {path}.")


def run_backend(reporter: Reporter, command: str, folder: Path | None, *arguments: object) -> None:
    """Run a command of the backend.

    Args:
        reporter: receives messages, warnings and progress.
        command: name of the command.
        folder: the reconstruction folder, or None.
        arguments: arguments of the command.

    Raises:
        NothingMade: the backend could make nothing of valid input.
        FolderInUse: another process uses the folder.
        InputError: the backend refused the input.
        Cancelled: the user cancelled.
        StepFailed: the command failed for another reason.
    """
    job = locations.backend_job(command.replace("-", " ").capitalize(), command, folder, command, *map(str, arguments))
    code = run_blocking(job, reporter)
    if code == EXIT_DONE:
        return
    if code == EXIT_CANCELLED:
        raise Cancelled
    if code == EXIT_BAD_INPUT:
        raise (NothingMade if job.nothing_made else FolderInUse if job.in_use else InputError)(job.error)
    raise StepFailed(job.error)


def _empty_file() -> None:
    """Open a new file without objects, keeping the user's preferences."""
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
