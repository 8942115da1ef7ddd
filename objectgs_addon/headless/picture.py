# SPDX-License-Identifier: GPL-3.0-or-later
"""Rendering of a .blend file."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import bpy

from ...backend.shared.errors import EXIT_CANCELLED, Cancelled, InputError
from ...backend.shared.events import Reporter
from ..blender.quiet import quiet

FORMATS = {".png": "PNG", ".jpg": "JPEG", ".jpeg": "JPEG", ".exr": "OPEN_EXR"}


def render_picture(
    reporter: Reporter,
    blend: Path,
    out: Path,
    camera: str | None = None,
    engine: str | None = None,
    samples: int | None = None,
    size: tuple[int, int] | None = None,
    prepare: Callable[[bpy.types.Scene], None] | None = None,
) -> None:
    """Open a .blend and render its scene; a setting of None keeps the value in the file.

    Args:
        reporter: receives warnings.
        blend: file to open.
        out: image to write: .png, .jpg, .jpeg or .exr.
        camera: name of a camera object.
        engine: CYCLES or EEVEE.
        samples: samples per pixel.
        size: (width, height) in pixels.
        prepare: called with the scene after its size is set and before its camera, engine and samples are set.

    Raises:
        InputError: the file, the camera or the format cannot be used.
        Cancelled: the render was cancelled.
    """
    if out.suffix.lower() not in FORMATS:
        raise InputError(f"{out.name} has no known image format; name it .png, .jpg or .exr.")
    scene = open_blend(blend, reporter)
    if size is not None:
        scene.render.resolution_x, scene.render.resolution_y = size
        scene.render.resolution_percentage = 100
    if prepare is not None:
        prepare(scene)
    choose_camera(scene, camera, blend)
    choose_engine(scene, engine, samples, reporter)
    write_picture(scene, out)


def write_picture(scene: bpy.types.Scene, out: Path) -> None:
    """Render the scene and replace `out` with the complete image.

    Raises:
        InputError: the image cannot be rendered or written.
        Cancelled: the render was cancelled.
    """
    out.parent.mkdir(parents=True, exist_ok=True)
    part = out.with_name(f"{out.stem}.part{out.suffix}")
    try:
        _render(scene, part)
        if not part.is_file():
            raise InputError(f"{out} could not be written; check its folder and the free space.")
        part.replace(out)
    finally:
        part.unlink(missing_ok=True)


def open_blend(blend: Path, reporter: Reporter) -> bpy.types.Scene:
    """Open a .blend and return its scene; raise InputError if it cannot be opened.

    Its scripts and Python drivers run only with Blender's option -y; without it, a warning tells that there are some.
    """
    try:
        with quiet():
            bpy.ops.wm.open_mainfile(filepath=str(blend), load_ui=False, use_scripts=may_run_scripts())
    except RuntimeError as error:
        raise InputError(f"{blend} cannot be opened as a .blend file.") from error
    if bpy.app.autoexec_fail:
        reporter.warning(
            f"Python in {blend} is not run ({bpy.app.autoexec_fail_message}), and what depends on it may look wrong; "
            "if you trust the file, give Blender the option -y before -P."
        )
    return bpy.context.scene


def may_run_scripts() -> bool:
    """Return whether Blender was given the option that lets scripts and Python drivers of a .blend run."""
    words = sys.argv[: sys.argv.index("--")] if "--" in sys.argv else []
    return not {"-y", "--enable-autoexec"}.isdisjoint(words)


def choose_camera(scene: bpy.types.Scene, name: str | None, blend: Path) -> None:
    """Set the scene's camera by name, or require one without a name; raise InputError if there is none."""
    cameras = [entry for entry in scene.objects if entry.type == "CAMERA"]
    if name is not None:
        scene.camera = next((entry for entry in cameras if entry.name == name), None)
        if scene.camera is None:
            some = ", ".join(entry.name for entry in cameras[:5]) or "none at all"
            raise InputError(
                f"{blend} has no camera {name!r}; it has {len(cameras)}: {some}{', ...' if len(cameras) > 5 else ''}."
            )
    elif scene.camera is None:
        raise InputError(f"{blend} has no active camera; name one with --camera.")


def choose_engine(scene: bpy.types.Scene, engine: str | None, samples: int | None, reporter: Reporter) -> None:
    """Set the render engine (CYCLES or EEVEE) and its samples per pixel, unless they are None."""
    if engine == "CYCLES":
        scene.render.engine = "CYCLES"
    elif engine == "EEVEE":
        try:
            scene.render.engine = "BLENDER_EEVEE_NEXT"  # Blender 4.2 to 4.5
        except TypeError:
            scene.render.engine = "BLENDER_EEVEE"
    if scene.render.engine == "CYCLES" and scene.cycles.use_denoising and not scene.cycles.denoiser:
        scene.cycles.use_denoising = False
        reporter.warning("This Blender cannot denoise; more --samples reduce the noise.")
    if samples is not None:
        if scene.render.engine == "CYCLES":
            scene.cycles.samples = samples
        else:
            scene.eevee.taa_render_samples = samples


def _render(scene: bpy.types.Scene, path: Path) -> None:
    settings = scene.render.image_settings
    if hasattr(settings, "media_type"):  # Blender 5.0 and newer require the media type first.
        settings.media_type = "IMAGE"
    settings.file_format = FORMATS[path.suffix.lower()]
    scene.render.filepath = str(path)
    if bpy.app.version >= (5, 0):  # Braces are variables there.
        scene.render.filepath = str(path).replace("{", "{{").replace("}", "}}")
    scene.render.use_multiview = False  # It writes two files of other names.
    scene.render.use_file_extension = False
    try:
        with quiet(), _ended_by_signals(path):
            result = bpy.ops.render.render(write_still=True, scene=scene.name)
    except RuntimeError as error:
        reason = str(error).strip().splitlines()[0].removeprefix("Error: ").rstrip(".")
        raise InputError(f"The image could not be rendered: {reason}.") from error
    if "FINISHED" not in result:
        raise Cancelled("Cancelled; no image was written.")


@contextlib.contextmanager
def _ended_by_signals(part: Path) -> Iterator[None]:
    """End the process on SIGINT or SIGTERM, since Python's own handlers would run only after the render.

    Only the image in progress is lost; its file `part` is removed.
    """
    listen, ring = os.pipe()
    if hasattr(os, "set_blocking"):  # Windows has it since Python 3.12.
        os.set_blocking(ring, False)

    def wait() -> None:
        if os.read(listen, 1) in (bytes([signal.SIGINT]), bytes([signal.SIGTERM])):
            part.unlink(missing_ok=True)
            print("Cancelled; no image was written.", file=sys.stderr, flush=True)
            os._exit(EXIT_CANCELLED)

    thread = threading.Thread(target=wait, daemon=True)
    before = signal.set_wakeup_fd(ring, warn_on_full_buffer=False)
    thread.start()
    try:
        yield
    finally:
        signal.set_wakeup_fd(before)
        os.write(ring, b"\0")
        thread.join()
        os.close(ring)
        os.close(listen)
