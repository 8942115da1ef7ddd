# SPDX-License-Identifier: GPL-3.0-or-later
"""The command `film`, which renders the splats of a .blend through its camera and combines them with its render."""

from __future__ import annotations

import argparse
import contextlib
import os
from pathlib import Path
from typing import Any

import bpy

from ...backend.shared.errors import InputError
from ...backend.shared.events import Reporter
from ...backend.shared.formats.json_file import read_json, write_json
from ...backend.shared.reconstruction.folder import Reconstruction
from ...backend.shared.reconstruction.objects import read_objects
from ...backend.shared.reconstruction.shot import NAME, frame_ranges, write_shot
from .. import film as filming
from .. import scene
from ..environment import known_folders
from ..film.compositing import PATTERN
from ..film.properties import samples_of
from ..state import folder_trust
from . import apart
from .built import digest_of
from .commands import absolute, find_backend, run_backend, save_blend
from .picture import choose_camera, choose_engine, may_run_scripts, open_blend, write_picture

COMPOSITES = "composite.json"
"""File beside the composites with what they were made of, apart from the splats."""


def film(options: argparse.Namespace) -> None:
    """Render film frames of a .blend and, with --composite, combine them with Blender's render."""
    reporter = options.reporter
    find_backend(options.backend_python)
    blend, out = absolute(options.blend), absolute(options.out)
    target = open_blend(blend, reporter)
    opened = digest_of(blend)
    if options.size is not None:
        target.render.resolution_x, target.render.resolution_y = options.size
        target.render.resolution_percentage = 100
    choose_camera(target, options.camera, blend)
    camera = target.camera if options.camera else None
    found = apart.reconstructions(target)
    if not found:
        raise InputError(f"{blend} has no reconstruction; make one with the build command, or append one to it.")
    root = found[0]
    if len(found) > 1:
        reporter.warning(f"{blend} has {len(found)} reconstructions; {root.name} is rendered.")
    folder = absolute(options.dir) if options.dir else _folder_of(root, blend, reporter)
    if not Reconstruction(folder).splats.is_file():
        raise InputError(f"The reconstruction folder {folder} has no splats.ply; name its present location with --dir.")
    frames = _frames(options, target)
    layer = filming.layer_of(target, root)
    shot = filming.shot_of(target, layer, root, frames, options.subframes or samples_of(target), camera=camera)
    target.camera = camera or target.camera
    for problem in (
        filming.ignored_settings(target, camera),
        filming.empty_frames(shot, layer, root),
        _newer_places(root, Reconstruction(folder).objects),
    ):
        if problem is not None:
            reporter.warning(problem)
    out.mkdir(parents=True, exist_ok=True)
    # Machines that share the folder require separate files.
    path = out / (f"shot.{frames[0]:04d}-{frames[-1]:04d}.json" if options.frames else NAME)
    write_shot(path, shot)
    run_backend(
        reporter,
        "film",
        folder,
        folder,
        "--shot",
        path,
        "--out",
        out,
        "--device",
        options.device,
        *(["--png"] if options.png else []),
    )
    if options.composite or options.save:
        # The reconstruction may have a layer of its own, beside that of other objects.
        rendered = next((each for each in target.view_layers if each.use), layer)
        filming.set_up_compositor(target, rendered, root, out)
        for problem in (
            filming.rendered_twice(target, rendered, root),
            scene.render_problem(target, root),
        ):
            if problem is not None:
                reporter.warning(problem)
    is_replaced = False
    if options.save:
        save_blend(absolute(options.save), reporter)
        is_replaced = absolute(options.save).samefile(blend)
    if options.composite:
        choose_engine(target, options.engine, options.samples, reporter)
        since = _settled(out, opened, digest_of(blend) if is_replaced else opened, _choices(options))
        missing = [number for number in frames if not _is_composed(out, number, options.composite, since)]
        if len(missing) < len(frames):
            reporter.status(f"{len(frames) - len(missing)} of {len(frames)} composites exist already.")
        for number in missing:
            target.frame_set(number)
            # Markers may bring in others.
            target.camera = camera or target.camera
            path = _composite(out, number, options.composite)
            write_picture(target, path)
            reporter.status(f"Wrote {path}.")


def _newer_places(root: bpy.types.Collection, objects: Path) -> str | None:
    """Return a sentence if objects.json has other placements or duplicates than a reconstruction; None if not."""
    if not objects.exists() or scene.shows_places(root, read_objects(objects)):
        return None
    return f"{root.name} does not show the edits in {objects}, which films use; use Reload Result in Blender."


def _choices(options: argparse.Namespace) -> dict[str, Any]:
    """Return the options that composites depend on, as JSON holds them."""
    size = list(options.size) if options.size else None
    return {
        "camera": options.camera,
        "engine": options.engine,
        "samples": options.samples,
        "size": size,
        "scripts": may_run_scripts(),
    }


def _settled(out: Path, opened: str, saved: str, choices: dict[str, Any]) -> int:
    """Return the time (ns) since which the composites in `out` were to have these settings, and store them there.

    Where they are those of an earlier command, also of another computer, it is the time of that.

    Args:
        out: folder of the composites.
        opened: digest of the .blend as it was opened.
        saved: digest of it with its compositor set up, if that replaces it; each time it is saved, it is another.
        choices: options that composites depend on.
    """
    path = out / COMPOSITES
    known, settings = None, {"blend": saved, **choices}
    with contextlib.suppress(InputError):
        known = read_json(path)
    since = path.stat().st_mtime_ns if known == {"blend": opened, **choices} else None
    if known != settings:
        write_json(path, settings)
        if since is not None:
            os.utime(path, ns=(since, since))
    return path.stat().st_mtime_ns


def _is_composed(out: Path, number: int, suffix: str, since: int) -> bool:
    """Return whether the composite of a frame exists, and is newer than its splats and settings."""
    try:
        made = _composite(out, number, suffix).stat().st_mtime_ns
        return made >= since and made >= (out / PATTERN.format(number)).stat().st_mtime_ns
    except FileNotFoundError:
        return False


def _composite(out: Path, number: int, suffix: str) -> Path:
    return out / f"composite.{number:04d}.{suffix}"


def _folder_of(root: bpy.types.Collection, blend: Path, reporter: Reporter) -> Path:
    """Return the reconstruction folder of a .blend: the one at its place relative to the .blend, else the stored."""
    stored = scene.folder_of(root)
    beside = folder_trust.moved_folder(root)
    if beside is not None:
        reporter.status(
            f"Using the folder {beside} instead of {stored}, since it was moved or copied with {blend.name}."
        )
        return beside
    if known_folders.is_remote(stored):
        raise InputError(f"{blend} names the folder {stored} on another computer; give it with --dir to use it.")
    return stored


def _frames(options: argparse.Namespace, target: bpy.types.Scene) -> list[int]:
    if options.frames:
        return sorted({number for numbers in frame_ranges(options.frames) for number in numbers})
    return list(range(target.frame_start, target.frame_end + 1, target.frame_step))
