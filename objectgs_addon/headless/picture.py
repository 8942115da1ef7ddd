# SPDX-License-Identifier: GPL-3.0-or-later
"""A picture of a .blend file."""

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import bpy

from ...backend.protocol import EXIT_CANCELLED, Cancelled, InputError
from ..quiet import quiet
from .lines import say

FORMATS = {".png": "PNG", ".jpg": "JPEG", ".jpeg": "JPEG", ".exr": "OPEN_EXR"}


def render_picture(blend: Path, out: Path, camera: str | None = None, engine: str | None = None,
                   samples: int | None = None, size: tuple[int, int] | None = None,
                   prepare: Callable[[bpy.types.Scene], None] | None = None) -> None:
    """Open `blend` and render its scene into `out`; what is None stays as the file says.

    camera: name of a camera object. engine: CYCLES or EEVEE. samples: a pixel. size: (width, height) in pixels.
    prepare: changes the opened scene when it has its size; engine and samples go on top. Raises `InputError`.
    """
    if out.suffix.lower() not in FORMATS:
        raise InputError(f"{out.name} has no known picture format; name it .png, .jpg or .exr.")
    scene = open_blend(blend)
    if size is not None:
        scene.render.resolution_x, scene.render.resolution_y = size
        scene.render.resolution_percentage = 100
    if prepare is not None:
        prepare(scene)
    choose_camera(scene, camera, blend)
    choose_engine(scene, engine, samples)
    write_picture(scene, out)


def write_picture(scene, out: Path) -> None:
    """Render the scene as it is into `out`, which is the picture before or the new one, never half. Raises
    `InputError`."""
    out.parent.mkdir(parents=True, exist_ok=True)
    part = out.with_name(f"{out.stem}.part{out.suffix}")
    try:
        _render(scene, part)
        if not part.is_file():
            raise InputError(f"{out} could not be written; check its folder and the free space.")
        os.replace(part, out)
    finally:
        part.unlink(missing_ok=True)


def open_blend(blend: Path) -> bpy.types.Scene:
    """Open a .blend without running its scripts; returns its scene. Raises `InputError`."""
    try:
        with quiet():
            bpy.ops.wm.open_mainfile(filepath=str(blend), load_ui=False, use_scripts=False)
    except RuntimeError as error:
        raise InputError(f"{blend} cannot be opened as a .blend file.") from error
    return bpy.context.scene


def choose_camera(scene, name: str | None, blend: Path) -> None:
    """Make the camera object of a name the scene's; None: it must have one. Raises `InputError`."""
    cameras = [entry for entry in scene.objects if entry.type == "CAMERA"]
    if name is not None:
        scene.camera = next((entry for entry in cameras if entry.name == name), None)
        if scene.camera is None:
            some = ", ".join(entry.name for entry in cameras[:5]) or "none at all"
            raise InputError(f"{blend} has no camera {name!r}; it has {len(cameras)}: {some}"
                             f"{', ...' if len(cameras) > 5 else ''}.")
    elif scene.camera is None:
        raise InputError(f"{blend} has no active camera; name one with --camera.")


def choose_engine(scene, engine: str | None, samples: int | None) -> None:
    """Set the renderer (CYCLES or EEVEE) and its samples a pixel, as far as they are given."""
    if engine == "CYCLES":
        scene.render.engine = "CYCLES"
    elif engine == "EEVEE":
        try:
            scene.render.engine = "BLENDER_EEVEE_NEXT"  # 4.2 to 4.5
        except TypeError:
            scene.render.engine = "BLENDER_EEVEE"
    if scene.render.engine == "CYCLES" and scene.cycles.use_denoising and not scene.cycles.denoiser:
        scene.cycles.use_denoising = False
        say("Warning: this Blender cannot denoise; more --samples make a cleaner picture.")
    if samples is not None:
        if scene.render.engine == "CYCLES":
            scene.cycles.samples = samples
        else:
            scene.eevee.taa_render_samples = samples


def _render(scene, path: Path) -> None:
    settings = scene.render.image_settings
    if hasattr(settings, "media_type"):  # 5.0 and newer: a file's kind before its format
        settings.media_type = "IMAGE"
    settings.file_format = FORMATS[path.suffix.lower()]
    scene.render.filepath = str(path)
    scene.render.use_file_extension = False
    try:
        with quiet(), _ended_by_signals(path):
            result = bpy.ops.render.render(write_still=True, scene=scene.name)
    except RuntimeError as error:
        reason = str(error).strip().splitlines()[0].removeprefix("Error: ").rstrip(".")
        raise InputError(f"The picture could not be rendered: {reason}.") from error
    if "FINISHED" not in result:
        raise Cancelled("Cancelled; no picture was written.")


@contextlib.contextmanager
def _ended_by_signals(part: Path):
    """End the process where a signal comes: Python's own handlers would wait until the rendering is over.

    Nothing is lost but the picture being rendered, and `part` of it is removed.
    """
    listen, ring = os.pipe()
    os.set_blocking(ring, False)

    def wait():
        if os.read(listen, 1) in (bytes([signal.SIGINT]), bytes([signal.SIGTERM])):
            part.unlink(missing_ok=True)
            print("Cancelled; no picture was written.", file=sys.stderr, flush=True)
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
