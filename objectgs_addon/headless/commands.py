# SPDX-License-Identifier: GPL-3.0-or-later
"""What the commands of headless.py do, one function each; `batch` has a module of its own."""

import os
import shutil
from pathlib import Path

import bpy

from ...backend.protocol import EXIT_BAD_INPUT, EXIT_CANCELLED, EXIT_DONE, Cancelled, InputError, Reconstruction
from ...backend.stopping import StopRequest
from .. import demo_capture, locations, scene, view
from ..jobs import run_blocking
from ..quiet import quiet
from . import apart
from .lines import say
from .picture import render_picture

BLEND = "objectgs.blend"
PICTURE = "render.png"
APART_PICTURE = "pulled-apart.png"
SAMPLES = 16
"""Rays a pixel in the .blend that is built, unless --samples says otherwise."""

_TITLES = {"import": "Import", "plan": "Plan", "vote": "Vote", "train": "Train", "mesh": "Mesh", "edit": "Edit",
           "export": "Export", "import-splats": "Import splats", "film": "Film", "evaluate": "Evaluate",
           "report": "Report"}


class StepFailed(Exception):
    """A step failed for a reason that is not the input; the message is one sentence."""


def sentence(error: OSError) -> str:
    """A file that cannot be used, in one sentence."""
    return f"{error.filename} cannot be used ({error.strerror}); check it, its permissions and the free space."


def whole(path: Path) -> Path:
    """A path that stays right in another working directory; links are left as they are."""
    return Path(os.path.abspath(path.expanduser()))


def demo(options) -> None:
    """Render the demo capture."""
    _empty_file()
    settings = demo_capture.Settings(
        objects=options.objects, views=options.views, width=options.width, height=options.height, seed=options.seed,
        mask_noise=options.mask_noise, samples=options.samples)
    stop = StopRequest()
    with stop.listening(read_stdin=options.json):
        demo_capture.make(options.out, settings, options.overwrite, options.reporter, stop)


def backend(options) -> None:
    """One of the backend's own commands on a capture: import, vote or train."""
    find_backend(options.backend_python)
    folder = whole(options.out)
    run_backend(options.command, folder, whole(Path(options.source)), "--out", folder, *_groups(options), *options.rest)


def plan(options) -> None:
    """What training would do with a capture, and what it would leave out."""
    find_backend(options.backend_python)
    folder = whole(options.out) if options.out else None
    out = ("--out", folder) if folder else ()
    run_backend("plan", folder, whole(Path(options.source)), *out, *_groups(options), *options.rest)


def on_result(options) -> None:
    """One of the backend's own commands on a reconstruction: mesh, edit or export."""
    find_backend(options.backend_python)
    folder = whole(Path(options.source))
    out = ("--out", whole(options.out)) if options.command == "export" else ()
    run_backend(options.command, folder, folder, *out, *options.rest)


def import_splats(options) -> None:
    """The backend's own command on splats of another program."""
    find_backend(options.backend_python)
    folder = whole(options.out)
    capture = ("--capture", whole(options.capture)) if options.capture else ()
    run_backend("import-splats", folder, whole(Path(options.source)), "--out", folder, *capture, *options.rest)


def build(options) -> None:
    """A .blend of a reconstruction."""
    folder = whole(options.folder)
    build_blend(folder, whole(options.blend) if options.blend else folder / BLEND)


def render(options) -> None:
    """A picture of a .blend."""
    source = whole(options.source)
    blend = source / BLEND if source.is_dir() else source
    if not blend.is_file():
        raise InputError(f"There is no file {blend}; make it with the build command.")
    if options.apart and options.camera:
        raise InputError("--apart brings a camera of its own; leave --camera out.")
    if options.apart:
        _render_apart(blend, whole(options.out), options)
    else:
        render_picture(blend, whole(options.out), options.camera, options.engine, options.samples, options.size,
                       _showing(options.show) if options.show else None)
    say(f"Wrote {options.out}.")


def run(options) -> None:
    """Everything for one capture: train, evaluate, report, build and render."""
    find_backend(options.backend_python)
    reconstruct(whole(Path(options.source)), whole(options.out), options)


def reconstruct(capture: Path, folder: Path, options) -> None:
    """Make splats, meshes, a report, a .blend and pictures of `capture` in `folder`, from what is there already."""
    no_meshes = ["--no-meshes"] if options.no_meshes else []
    run_backend("train", folder, capture, "--out", folder, *no_meshes, *_groups(options), *options.rest)
    if not options.no_meshes:
        try:
            run_backend("mesh", folder, folder)
        except InputError as error:  # Splats that no surface can be found in are a result still.
            say(f"Warning: {error}")
    run_backend("evaluate", folder, folder)
    run_backend("report", folder, folder)
    has_meshes = build_blend(folder, folder / BLEND)
    render_picture(folder / BLEND, folder / PICTURE, None, options.engine, options.samples, options.size,
                   _showing("splats"))
    say(f"Wrote {folder / PICTURE}.")
    if has_meshes:
        _render_apart(folder / BLEND, folder / APART_PICTURE, options)
        say(f"Wrote {folder / APART_PICTURE}.")


def _groups(options) -> tuple:
    """--groups FILE for the backend, which works elsewhere; nothing where it was not given, or is no option."""
    path = vars(options).get("groups")
    return ("--groups", whole(path)) if path else ()


def _render_apart(blend: Path, out: Path, options) -> None:
    render_picture(blend, out, None, options.engine or "CYCLES", options.samples or apart.SAMPLES,
                   options.size or apart.SIZE, apart.pull_apart)


def _showing(which: str):
    """What makes an opened .blend show splats, meshes or both in its picture."""
    def prepare(target: bpy.types.Scene) -> None:
        for root in apart.reconstructions(target):
            scene.show_kinds(root, which)

    return prepare


def find_backend(python: str | None) -> None:
    """Settle which Python runs the backend: `python`, OBJECTGS_PYTHON, or what the preferences and the set-up say."""
    wanted = python or os.environ.get("OBJECTGS_PYTHON")
    if wanted:
        found = shutil.which(os.path.expanduser(wanted))
        if found is None:
            raise InputError(f"There is no Python at {wanted}; check --backend-python or OBJECTGS_PYTHON.")
        os.environ["OBJECTGS_PYTHON"] = os.path.abspath(found)
    elif locations.backend_python() is None:
        raise InputError("The compute backend is not set up; name a Python that has it with --backend-python or "
                         "OBJECTGS_PYTHON, or set it up in the preferences of ObjectGS.")


def build_blend(folder: Path, blend: Path) -> bool:
    """Put the reconstruction in `folder` into a new file and save it as `blend`; whether objects have meshes there."""
    files = Reconstruction(folder)
    if not (folder / "cameras.json").is_file():
        raise InputError(f"{folder} holds no reconstruction; make one with the import or train command.")
    _empty_file()
    target = bpy.context.scene
    with quiet():
        root = scene.show_capture(target, folder)
        warnings = scene.warnings_of(root)
        if files.splats.exists():
            warnings += scene.show_result(root, folder, target).warnings
            view.hide_points(root)
        scene.prepare_render(target)
        has_meshes = bool(scene.object_meshes(root))
        if has_meshes or scene.scene_meshes(root):
            apart.add_even_light(target)
        # Works on every machine; EEVEE needs a display, or draws on the processor.
        target.render.engine = "CYCLES"
        target.cycles.samples = SAMPLES
    for warning in warnings:
        say(f"Warning: {warning}")
    save_blend(blend)
    return has_meshes


def save_blend(path: Path) -> None:
    """Save the file that is open as `path`; InputError where that cannot be written."""
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        with quiet():
            bpy.ops.wm.save_as_mainfile(filepath=str(path))
    except RuntimeError as error:
        raise InputError(f"{path} could not be written; check its folder and the free space.") from error
    say(f"Wrote {path}.")


def run_backend(command: str, folder: Path | None, *arguments: object) -> None:
    """Run a command of the backend until it ends; raises what main() makes its exit code of."""
    job = locations.backend_job(_TITLES[command], command, folder, command, *map(str, arguments))
    code = run_blocking(job, echo=lambda line: None if job.error else say(line))
    if code == EXIT_DONE:
        return
    if code == EXIT_CANCELLED:
        raise Cancelled
    if code == EXIT_BAD_INPUT:
        raise InputError(job.error)
    raise StepFailed(job.error)


def _empty_file() -> None:
    """A new file without objects; the user's preferences stay as they are."""
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
