"""`film`: the frames of a shot file as multilayer EXR files, and as PNG where asked for."""

from __future__ import annotations

import argparse
import io
import time
from pathlib import Path

import numpy as np
from PIL import Image

from .. import device
from ..film import cryptomatte, exr
from ..film.render import Picture, as_photo, draw_frame
from ..film.shot import Frame, Shot, chosen_frames, read_shot
from ..film.stage import Stage
from ..protocol import InputError, Reconstruction, write_atomic
from ..stopping import StoppingReporter
from .kernels import have_kernels_ready
from .record import recorded

MATTES = "CryptoObject"
REC709 = (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329)
"""Where red, green, blue and white of sRGB lie."""


def film(options: argparse.Namespace, reporter: StoppingReporter) -> None:
    """Draw what is not there yet of a shot's frames into the folder of --out."""
    place = device.pick(options.device)
    folder = Reconstruction(options.folder)
    if not folder.splats.is_file():
        raise InputError(
            f"{folder.folder} has no {folder.splats.name}; give a folder that `train` was told with --out."
        )
    shot = read_shot(options.shot)
    frames = chosen_frames(options.frames, shot)
    _make_folder(options.out)
    reporter.status("Reading the splats")
    primitive = recorded(folder).get("training", {}).get("settings", {}).get("primitive", "3d")
    stage = Stage(folder, primitive, place, reporter)
    wanted = [(frame, stage.digest(shot, frame)) for frame in frames]
    missing = [(frame, digest) for frame, digest in wanted if not _is_done(options, frame, digest)]
    if missing:
        have_kernels_ready(reporter, place)
    reporter.status(_plan(len(missing), len(frames)))
    started = time.monotonic()
    for done, (frame, digest) in enumerate(missing):

        def after_sample(drawn: int, done: int = done, frame: Frame = frame) -> None:
            # The last one's turn is when the frame is written.
            if drawn < len(frame.samples):
                reporter.progress(done + drawn / len(frame.samples), len(missing), what="frames")

        picture = draw_frame(stage, shot, frame, after_sample)
        _write(options, stage, shot, frame, picture, digest)
        reporter.progress(done + 1, len(missing), what="frames")
    seconds = round((time.monotonic() - started) / len(missing), 2) if missing else None
    reporter.done(film=str(options.out), frames=len(frames), drawn=len(missing), seconds_a_frame=seconds)


def frame_path(folder: Path, number: int) -> Path:
    """Where a frame goes, so that programs take the files for a sequence."""
    return folder / f"splats.{number:04d}.exr"


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"The folder {folder} cannot be made ({error.strerror}); choose another with --out."
        ) from error


def _is_done(options: argparse.Namespace, frame: Frame, digest: str) -> bool:
    path = frame_path(options.out, frame.number)
    return exr.digest_of(path) == digest and (not options.png or path.with_suffix(".png").is_file())


def _plan(missing: int, total: int) -> str:
    if not missing:
        return f"All {total} frames are there already"
    there = f"; {total - missing} are there already" if missing < total else ""
    return f"Drawing {missing} frame{'' if missing == 1 else 's'}{there}"


def _write(options: argparse.Namespace, stage: Stage, shot: Shot, frame: Frame, picture: Picture, digest: str) -> None:
    path = frame_path(options.out, frame.number)
    # The PNG comes first, so that one beside a finished EXR is of the same frame.
    if options.png:
        buffer = io.BytesIO()
        Image.fromarray(as_photo(picture.rgba), "RGBA").save(buffer, "PNG", compress_level=3)
        write_atomic(path.with_suffix(".png"), buffer.getvalue())
    else:
        path.with_suffix(".png").unlink(missing_ok=True)
    header = {
        **cryptomatte.header(MATTES, stage.names),
        "pixelAspectRatio": shot.pixel_aspect,
        "chromaticities": REC709,
        "objectgs/frame": str(frame.number),
    }
    exr.write(path, channels(stage, picture), header, digest)


def channels(stage: Stage, picture: Picture) -> dict[str, np.ndarray]:
    """The channels of a frame's EXR by name, as Blender and others read them: R, G, B, A, depth Z, IDs and mattes."""
    ids = np.append(stage.ids, np.uint32(0))
    return {
        **{name: picture.rgba[..., i].astype(np.float16) for i, name in enumerate("RGBA")},
        "Z": picture.depth,
        "IndexOB.X": ids[picture.ids[0]],
        **cryptomatte.channels(MATTES, stage.names, picture.ids, picture.coverage),
    }
