"""Frames of a video as photos, decoded by PyAV."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import av
import numpy as np
from PIL import Image as PilImage

from ...shared.color import hdr
from ...shared.errors import InputError
from ...shared.formats.atomic import atomic_path, make_folder
from ...shared.stopping import StoppingReporter
from .motion import ANALYZED, MotionTracker, choose_frames, sharpness

_SHARPNESS_SIDE = 640
"""Longer side in pixels of the pictures whose sharpness is measured."""
_QUALITY = 97
"""JPEG quality of the frames."""
_HD = 720
"""Height from which on videos that do not tell their color matrix have that of BT.709."""
_INTERLACED = 0.2
"""Fraction of interlaced frames from which on all frames are deinterlaced."""
_CURVES = {16: hdr.pq_to_linear, 18: hdr.hlg_to_linear}
"""Transfer functions of HDR video by their number in ITU-T H.273."""
_BT2020 = 9
_BT709, _UNSPECIFIED = 1, 2


class Analysis(NamedTuple):
    """What a video shows, one value for each frame that can be decoded.

    Attributes:
        positions: (n,) how far the picture has moved, see `MotionTracker.add`.
        sharp: (n,) sharpness.
        interlaced: whether the frames are two half-pictures.
        broken: number of packets that cannot be decoded.
        pixel_aspect: width of the pixels relative to their height.
    """

    positions: np.ndarray
    sharp: np.ndarray
    interlaced: bool
    broken: int
    pixel_aspect: float


def write_frames(video: Path, folder: Path, count: int | None, reporter: StoppingReporter) -> list[str]:
    """Write the frames of a video that are worth being photos.

    Args:
        video: the video's file.
        folder: where the frames are written, as JPEG files named by their number.
        count: wanted number of frames; None: by the motion.
        reporter: receives progress and warnings.

    Returns:
        Names of the files, in order.

    Raises:
        InputError: the file is no video, or none of its frames can be decoded.
    """
    found = analyze(video, reporter)
    chosen = choose_frames(found.positions, found.sharp, count)
    if found.broken:
        reporter.warning(f"{video.name} is damaged: {found.broken} parts of it cannot be decoded and are left out.")
    make_folder(folder)
    wanted = set(chosen.tolist())
    names: list[str] = []
    for number, frame in enumerate(_frames(video, found.interlaced)):
        if number in wanted:
            reporter.progress(0.6 + 0.4 * len(names) / len(wanted), 1.0)
            names.append(f"frame_{number:06d}.jpg")
            image = PilImage.fromarray(to_rgb(frame, found.pixel_aspect))
            with atomic_path(folder / names[-1]) as part:
                image.save(part, "JPEG", quality=_QUALITY, subsampling=0)
            if len(names) == len(wanted):
                break
    return names


def analyze(video: Path, reporter: StoppingReporter) -> Analysis:
    """Measure the motion and sharpness of all frames of a video; raises InputError if none can be decoded."""
    tracker, positions, sharp, interlaced = MotionTracker(), [], [], 0
    problems: list[str] = []
    with _opened(video) as (container, stream):
        expected = float(container.duration or 0) / av.time_base
        aspect = float(stream.sample_aspect_ratio or 1)
        for frame in _decoded(container, stream, problems):
            # Also where the duration is not known, since a request to stop is noticed here.
            is_known = frame.time is not None and expected > 0
            reporter.progress(0.6 * min(frame.time / expected, 1.0) if is_known else 0.0, 1.0)
            gray = _gray(frame, _SHARPNESS_SIDE)
            sharp.append(sharpness(gray))
            positions.append(tracker.add(_gray(frame, ANALYZED)))
            interlaced += frame.interlaced_frame
    if not positions:
        why = f" ({problems[0]})" if problems else ""
        raise InputError(f"No picture of {video} can be decoded{why}; convert it to MP4 by another program.")
    return Analysis(
        np.array(positions), np.array(sharp), interlaced > _INTERLACED * len(positions), len(problems), aspect
    )


def to_rgb(frame: Any, pixel_aspect: float = 1.0) -> np.ndarray:
    """Return a frame as (h, w, 3) uint8 in sRGB, turned as the video says; HDR is brought into its range.

    pixel_aspect: width of its pixels relative to their height, which are made square.
    """
    matrix = frame.colorspace
    if matrix == _UNSPECIFIED and frame.height >= _HD:
        matrix = _BT709
    curve = _CURVES.get(int(frame.color_trc))
    if curve is None:
        pixels = frame.to_ndarray(format="rgb24", src_colorspace=matrix)
    else:
        signal = frame.to_ndarray(format="rgb48le", src_colorspace=matrix).astype(np.float32) / 65535
        shown = hdr.to_srgb(curve(signal), wide=int(frame.color_primaries) == _BT2020)
        pixels = (255 * shown + 0.5).astype(np.uint8)
    if pixel_aspect != 1.0:
        size = (max(round(pixel_aspect * frame.width), 1), frame.height)
        pixels = np.asarray(PilImage.fromarray(pixels).resize(size, PilImage.Resampling.LANCZOS))
    return np.ascontiguousarray(np.rot90(pixels, round(frame.rotation / 90) % 4))


def _gray(frame: Any, longest: int) -> np.ndarray:
    """Return a frame in gray (h, w) uint8, scaled down so that its longer side is at most `longest` pixels."""
    factor = min(1.0, longest / max(frame.width, frame.height))
    width, height = (max(round(side * factor), 2) for side in (frame.width, frame.height))
    return frame.reformat(width=width, height=height, format="gray", interpolation="AREA").to_ndarray()


@contextmanager
def _opened(video: Path) -> Iterator[tuple[Any, Any]]:
    """Open a video and its first stream of pictures; errors are raised as InputError."""
    logging.getLogger("libav").setLevel(logging.CRITICAL)
    try:
        with av.open(str(video)) as container:
            if not container.streams.video:
                raise InputError(f"{video} contains no pictures; choose a video.")
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            yield container, stream
    except (av.FFmpegError, OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise InputError(f"{video} cannot be read as a video ({why}); check it, or convert it to MP4.") from error


def _decoded(container: Any, stream: Any, problems: list[str]) -> Iterator[Any]:
    """Decode a stream; what cannot be decoded is left out, with a word about it in `problems`."""
    packets = container.demux(stream)
    while True:
        try:
            packet = next(packets, None)
            if packet is None:
                return
            yield from packet.decode()
        except (av.FFmpegError, OSError, ValueError) as error:
            problems.append(str(getattr(error, "strerror", None) or error))
            if not isinstance(error, av.InvalidDataError):
                return


def _frames(video: Path, interlaced: bool) -> Iterator[Any]:
    """Decode all frames again, deinterlaced if they are interlaced, in the order of `analyze`."""
    with _opened(video) as (container, stream):
        frames = _decoded(container, stream, [])
        yield from _deinterlaced(frames, stream) if interlaced else frames


def _deinterlaced(frames: Iterator[Any], stream: Any) -> Iterator[Any]:
    """Make whole pictures of half-pictures, one for each frame."""
    graph = av.filter.Graph()
    graph.link_nodes(
        graph.add_buffer(template=stream), graph.add("bwdif", "mode=send_frame"), graph.add("buffersink")
    ).configure()
    for frame in frames:
        graph.vpush(frame)
        yield from _pulled(graph)
    graph.vpush(None)
    yield from _pulled(graph)


def _pulled(graph: Any) -> Iterator[Any]:
    while True:
        try:
            yield graph.vpull()
        except (av.BlockingIOError, av.EOFError):
            return
