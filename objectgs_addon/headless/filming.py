# SPDX-License-Identifier: GPL-3.0-or-later
"""`film`: the splats of a .blend through its camera, frame by frame, and joined with Blender's own rendering."""

from ...backend.film.shot import NAME, frame_ranges, write_shot
from ...backend.protocol import InputError, Reconstruction
from .. import film as filming
from .. import scene
from ..film.properties import samples_of
from . import apart
from .commands import find_backend, run_backend, save_blend, whole
from .lines import say
from .picture import choose_camera, choose_engine, open_blend, write_picture


def film(options) -> None:
    """Film frames of a .blend, and composites where they are asked for."""
    find_backend(options.backend_python)
    blend, out = whole(options.blend), whole(options.out)
    target = open_blend(blend)
    if options.size is not None:
        target.render.resolution_x, target.render.resolution_y = options.size
        target.render.resolution_percentage = 100
    choose_camera(target, options.camera, blend)
    found = apart.reconstructions(target)
    if not found:
        raise InputError(f"{blend} has no reconstruction; make one with the build command, or append one to it.")
    root = found[0]
    if len(found) > 1:
        say(f"Warning: {blend} has {len(found)} reconstructions; {root.name} is drawn.")
    folder = whole(options.dir) if options.dir else scene.folder_of(root)
    if not Reconstruction(folder).splats.is_file():
        raise InputError(f"The reconstruction folder {folder} has no splats.ply; say with --dir where it is now.")
    frames = _frames(options, target)
    shot = filming.shot_of(target, target.view_layers[0], root, frames, options.subframes or samples_of(target))
    out.mkdir(parents=True, exist_ok=True)
    # Machines that share the folder must not write the same file.
    path = out / (f"shot.{frames[0]:04d}-{frames[-1]:04d}.json" if options.frames else NAME)
    write_shot(path, shot)
    run_backend("film", folder, folder, "--shot", path, "--out", out, "--device", options.device,
                *(["--png"] if options.png else []))
    if options.composite or options.save:
        filming.set_up_compositor(target, target.view_layers[0], root, out)
    if options.save:
        save_blend(whole(options.save))
    if options.composite:
        choose_engine(target, options.engine, options.samples)
        for number in frames:
            target.frame_set(number)
            path = out / f"composite.{number:04d}.{options.composite}"
            write_picture(target, path)
            say(f"Wrote {path}.")


def _frames(options, target) -> list[int]:
    if options.frames:
        return sorted({number for numbers in frame_ranges(options.frames) for number in numbers})
    return list(range(target.frame_start, target.frame_end + 1, target.frame_step))
