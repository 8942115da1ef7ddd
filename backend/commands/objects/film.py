"""`film`: render the frames of a shot file as multilayer EXR files, and as PNG with --png."""

from __future__ import annotations

import argparse
import io
import time
from pathlib import Path

import numpy as np
from PIL import Image

from ...film import cryptomatte, exr
from ...film.render import FilmImage, draw_frame, to_srgb_8bit
from ...film.stage import Stage
from ...shared.errors import InputError
from ...shared.formats.atomic import write_atomic
from ...shared.reconstruction.folder import Reconstruction
from ...shared.reconstruction.record import read_record
from ...shared.reconstruction.shot import Frame, Shot, chosen_frames, read_shot
from ...shared.stopping import StoppingReporter
from ..folder import READ
from ..setup.device import choose_device
from ..setup.kernels import PART as KERNELS
from ..setup.kernels import ensure_kernels, kernel_seconds

MATTES = "CryptoObject"
REC709 = (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329)
"""Chromaticities of sRGB: red, green, blue and white, x and y each."""

_SECONDS_A_FRAME = 3.0


def film(options: argparse.Namespace, reporter: StoppingReporter) -> None:
    """Render the missing frames of a shot into the folder of --out."""
    device = choose_device(options.device, reporter)
    folder = Reconstruction(options.folder)
    if not folder.splats.is_file():
        raise InputError(f"{folder.folder} has no {folder.splats.name}; give the --out folder of a training.")
    shot = read_shot(options.shot)
    frames = chosen_frames(options.frames, shot)
    reporter.expect(
        {
            READ: ("Preparing", 3.0), KERNELS: ("Preparing", kernel_seconds(device)),
            "frames": ("Rendering", _SECONDS_A_FRAME * len(frames)),
        }
    )  # fmt: skip
    reporter.begin(READ, "Reading the splats")
    stage = Stage(folder, _primitive(folder), device, reporter)
    wanted = [(frame, stage.digest(shot, frame)) for frame in frames]
    missing = [(frame, digest) for frame, digest in wanted if not _is_done(options, frame, digest)]
    _create_folder(options.out)
    if missing:
        ensure_kernels(reporter, device)
    reporter.expect({"frames": ("Rendering", _SECONDS_A_FRAME * len(missing))})
    reporter.begin("frames", _progress_text(len(missing), len(frames)))
    started = time.monotonic()
    for done, (frame, digest) in enumerate(missing):

        def after_sample(drawn: int, done: int = done, frame: Frame = frame) -> None:
            # The last sample counts when the frame is written.
            if drawn < len(frame.samples):
                reporter.progress(done + drawn / len(frame.samples), len(missing), what="frames")

        image = draw_frame(stage, shot, frame, after_sample)
        _write(options, stage, shot, frame, image, digest)
        reporter.progress(done + 1, len(missing), what="frames")
    seconds = round((time.monotonic() - started) / len(missing), 2) if missing else None
    reporter.done(film=str(options.out), frames=len(frames), drawn=len(missing), seconds_a_frame=seconds)


def frame_path(folder: Path, number: int) -> Path:
    """Return the path of a frame, numbered so that programs recognize a sequence."""
    return folder / f"splats.{number:04d}.exr"


def _create_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"The folder {folder} cannot be created ({error.strerror}); choose another one with --out."
        ) from error


def _is_done(options: argparse.Namespace, frame: Frame, digest: str) -> bool:
    path = frame_path(options.out, frame.number)
    return exr.digest_of(path) == digest and (not options.png or path.with_suffix(".png").is_file())


def _primitive(folder: Reconstruction) -> str:
    """Return what the splats in splats.ply are; those that were fitted to a view-dependent model are no discs."""
    training = read_record(folder).training
    if training is None or training.settings.get("mode", "explicit") != "explicit":
        return "3d"
    return training.settings.get("primitive", "3d")


def _progress_text(missing: int, total: int) -> str:
    if not missing:
        return f"All {total} frames exist already"
    existing = f"; {total - missing} exist already" if missing < total else ""
    return f"Rendering {missing} frame{'' if missing == 1 else 's'}{existing}"


def _write(options: argparse.Namespace, stage: Stage, shot: Shot, frame: Frame, image: FilmImage, digest: str) -> None:
    path = frame_path(options.out, frame.number)
    # The PNG is written first, so that one beside a complete EXR is of the same frame.
    if options.png:
        buffer = io.BytesIO()
        Image.fromarray(to_srgb_8bit(image.rgba), "RGBA").save(buffer, "PNG", compress_level=3)
        write_atomic(path.with_suffix(".png"), buffer.getvalue())
    elif exr.digest_of(path) is not None:
        # An earlier frame of this command had a PNG, which would be out of date.
        path.with_suffix(".png").unlink(missing_ok=True)
    header = {
        **cryptomatte.header(MATTES, stage.names),
        "pixelAspectRatio": shot.pixel_aspect,
        "chromaticities": REC709,
        "objectgs/frame": str(frame.number),
    }
    exr.write(path, channels(stage, image), header, digest)


def channels(stage: Stage, image: FilmImage) -> dict[str, np.ndarray]:
    """Return the channels of a frame's EXR by name: R, G, B, A, depth Z, object IDs and mattes."""
    return {
        **{name: image.rgba[..., i].astype(np.float16) for i, name in enumerate("RGBA")},
        "Z": image.depth,
        "IndexOB.X": stage.classes.ids_of(image.ids[0]).astype(np.uint32),
        **cryptomatte.channels(MATTES, stage.names, image.ids, image.coverage),
    }
