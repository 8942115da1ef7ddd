"""shot.json: the camera, sample times and object transforms of film frames.

    {"version": 1, "width": 960, "height": 540, "pixel_aspect": 1.0, "depth_scale": 1.0, "only_named": false,
     "objects": {"1": {"visible": true, "maps": [[[1, 0, 0, 0.2], ...]]}, "4": {"visible": false}},
     "frames": [{"frame": 1, "shutter": [0.75, 1.25], "samples": [
         {"time": 1.0, "viewmat": [[...], ...], "K": [[...], ...], "clip": [0.1, 100.0],
          "objects": {"2": {"maps": [[[...], ...], [[...], ...]]}}}, ...]}, ...]}

width, height: size of the images in pixels. pixel_aspect: width of a pixel over its height; it is only written to the
headers of the images, since K defines the projection. depth_scale: factor from the capture's units to those of the
depth channel. Each frame is the mean of its samples: a single one, or several times while the shutter is open. shutter:
the times, in frames, at which the shutter opens and closes.

viewmat (4, 4): rigid transform from the capture's coordinates to the camera's (OpenCV axes: x right, y down, z
forward). K (3, 3): intrinsics of a pinhole camera in pixels; the center of the first pixel is (0.5, 0.5). Lens shift
moves the principal point, and pixels that are not square have different focal lengths for x and y. Skew is not
supported, nor are orthographic and panoramic cameras, which have no K. clip: smallest and largest depth to render, in
the capture's units.

objects: the state of objects by ID, for all samples and, where it differs, for a single sample. maps: affine maps
(4, 4) in the capture's coordinates, applied to the object as captured; several maps make duplicates, and an empty list
hides the object, like "visible": false. An object that has no maps or is not listed is placed as in objects.json, but
with only_named, objects that are not listed are not rendered.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..class_table import LARGEST_ID
from ..errors import InputError
from ..formats.json_file import read_json, write_json
from .objects import affine_map

VERSION = 1
NAME = "shot.json"
LARGEST_SIDE = 65536
LARGEST_FRAME = 9_999_999
LARGEST = 1 << 30
"""Bytes of the largest file that is read."""


@dataclass(frozen=True)
class Placed:
    """An object at a sample time: its visibility, and its maps (n, 4, 4); None for the placement in objects.json."""

    visible: bool = True
    maps: NDArray[np.float64] | None = None

    @property
    def is_seen(self) -> bool:
        """Whether the object is visible and has at least one placement."""
        return self.visible and (self.maps is None or len(self.maps) > 0)

    def stored(self) -> dict[str, Any]:
        """Return the entry as stored in shot.json."""
        maps = {} if self.maps is None else {"maps": self.maps.tolist()}
        return {**({} if self.visible else {"visible": False}), **maps}


@dataclass(frozen=True)
class Sample:
    """A sample time of a frame: time in frames, viewmat (4, 4), K (3, 3), clip (near, far) and the objects by ID."""

    time: float
    viewmat: NDArray[np.float64]
    K: NDArray[np.float64]
    clip: tuple[float, float]
    objects: Mapping[int, Placed] = field(default_factory=dict)


@dataclass(frozen=True)
class Frame:
    """A frame: its number, the times at which the shutter opens and closes, and its samples in the order of time."""

    number: int
    shutter: tuple[float, float]
    samples: Sequence[Sample]

    @property
    def middle(self) -> int:
        """Index of the middle sample, which provides the depth."""
        return len(self.samples) // 2


@dataclass(frozen=True)
class Shot:
    """The content of a shot file; the objects of each sample include those that are the same in all samples."""

    width: int
    height: int
    frames: Sequence[Frame]
    pixel_aspect: float = 1.0
    depth_scale: float = 1.0
    only_named: bool = False


def write_shot(path: Path, shot: Shot) -> None:
    """Write a shot file; objects that are the same in all samples are written once."""
    samples = [sample for frame in shot.frames for sample in frame.samples]
    stored = [{str(key): placed.stored() for key, placed in sample.objects.items()} for sample in samples]
    steady = {key: entry for key, entry in (stored[0] if stored else {}).items()
              if all(other.get(key) == entry for other in stored)}  # fmt: skip
    of_sample = iter(stored)
    frames = []
    for frame in shot.frames:
        entries = []
        for sample in frame.samples:
            moving = {key: entry for key, entry in next(of_sample).items() if key not in steady}
            entries.append({
                "time": sample.time, "viewmat": sample.viewmat.tolist(), "K": sample.K.tolist(),
                "clip": list(sample.clip), **({"objects": moving} if moving else {}),
            })  # fmt: skip
        frames.append({"frame": frame.number, "shutter": list(frame.shutter), "samples": entries})
    write_json(path, {
        "version": VERSION, "width": shot.width, "height": shot.height, "pixel_aspect": shot.pixel_aspect,
        "depth_scale": shot.depth_scale, "only_named": shot.only_named, "objects": steady, "frames": frames,
    }, indent=None)  # fmt: skip


def read_shot(path: Path) -> Shot:
    """Read a shot file; raise InputError with a one-sentence message that locates the problem if it is invalid."""
    content = read_json(path, LARGEST)
    try:
        return _shot(content)
    except _Wrong as error:
        raise InputError(f"{path} cannot be rendered: {error}.") from error


def chosen_frames(text: str | None, shot: Shot) -> list[Frame]:
    """Select frames of a shot.

    Args:
        text: Frame numbers such as 1-24 or 1,5,9-12; None for all frames.
        shot: The shot.

    Returns:
        The frames in the order of the shot.

    Raises:
        InputError: `text` is invalid, or the shot has none of these frames.
    """
    if text is None:
        return list(shot.frames)
    wanted = frame_ranges(text)
    found = [frame for frame in shot.frames if any(frame.number in numbers for numbers in wanted)]
    if not found:
        there = f"{shot.frames[0].number} to {shot.frames[-1].number}"
        raise InputError(f"The shot has none of the frames {text}; it has {len(shot.frames)}, from {there}.")
    return found


def frame_ranges(text: str) -> list[range]:
    """Parse a list of frames such as 1-24 or 1,5,9-12; raise InputError if it is invalid."""
    found = []
    for word in text.split(","):
        match = re.fullmatch(r"\s*(\d{1,7})\s*(?:-\s*(\d{1,7})\s*)?", word)
        first, last = (int(match[1]), int(match[2] or match[1])) if match else (0, -1)
        if last < first:
            raise InputError(f"--frames {text} is not valid; specify frames as 1-24 or 1,5,9-12.")
        found.append(range(first, last + 1))
    return found


class _Wrong(Exception):
    """Invalid content of a shot file; the message is the second half of a sentence."""


def _shot(content: Any) -> Shot:
    if not isinstance(content, dict) or "frames" not in content:
        raise _Wrong("it is not a shot file, since it has no frames")
    if content.get("version") != VERSION:
        raise _Wrong(f"its version is {content.get('version')!r}, and {VERSION} was expected")
    steady = _objects(content.get("objects", {}), "objects")
    frames = content["frames"]
    if not isinstance(frames, list) or not frames:
        raise _Wrong("its frames are not a list, or the list is empty")
    shot = Shot(
        width=_whole(content.get("width"), 1, LARGEST_SIDE, "width"),
        height=_whole(content.get("height"), 1, LARGEST_SIDE, "height"),
        pixel_aspect=_pixel_aspect(content.get("pixel_aspect", 1.0)),
        depth_scale=_above_zero(content.get("depth_scale", 1.0), "depth_scale"),
        only_named=_truth(content.get("only_named", False), "only_named"),
        frames=[_frame(entry, steady) for entry in frames],
    )
    numbers = [frame.number for frame in shot.frames]
    if any(b <= a for a, b in itertools.pairwise(numbers)):
        raise _Wrong("its frames are not in ascending order")
    return shot


def _frame(entry: Any, steady: Mapping[int, Placed]) -> Frame:
    if not isinstance(entry, dict):
        raise _Wrong("a frame is not a JSON object")
    number = _whole(entry.get("frame"), 0, LARGEST_FRAME, "frame")
    where = f"frame {number}"
    samples = entry.get("samples")
    if not isinstance(samples, list) or not samples:
        raise _Wrong(f"{where} has no samples")
    shutter = _numbers(entry.get("shutter", [number, number]), (2,), f"shutter of {where}")
    return Frame(number, (shutter[0], shutter[1]), [_sample(sample, steady, where) for sample in samples])


def _sample(entry: Any, steady: Mapping[int, Placed], where: str) -> Sample:
    if not isinstance(entry, dict):
        raise _Wrong(f"a sample of {where} is not a JSON object")
    if "viewmat" not in entry or "K" not in entry:
        raise _Wrong(f"a sample of {where} has no viewmat or no K; only perspective cameras can be drawn")
    viewmat = np.array(_numbers(entry["viewmat"], (4, 4), f"viewmat of {where}"))
    turn = viewmat[:3, :3]
    if not np.allclose(turn @ turn.T, np.eye(3), atol=1e-4) or np.linalg.det(turn) < 0:
        raise _Wrong(f"the viewmat of {where} is not a rigid transform")
    if not np.array_equal(viewmat[3], (0, 0, 0, 1)):
        raise _Wrong(f"the viewmat of {where} does not end in 0 0 0 1")
    K = np.array(_numbers(entry["K"], (3, 3), f"K of {where}"))
    if K[0, 0] <= 0 or K[1, 1] <= 0:
        raise _Wrong(f"the K of {where} has no focal length")
    if abs(K[0, 1]) > 1e-9 * K[0, 0] or K[1, 0] or not np.array_equal(K[2], (0, 0, 1)):
        raise _Wrong(f"the K of {where} is not that of a camera without skew")
    near, far = _numbers(entry.get("clip", [1e-6, 1e12]), (2,), f"clip of {where}")
    if not 0 < near < far:
        raise _Wrong(f"the clip of {where} is not two ascending numbers above 0")
    time = _numbers(entry.get("time", 0.0), (), f"time of {where}")
    objects = {**steady, **_objects(entry.get("objects", {}), f"objects of {where}")}
    return Sample(time, viewmat, K, (near, far), objects)


def _objects(entries: Any, where: str) -> dict[int, Placed]:
    if not isinstance(entries, dict):
        raise _Wrong(f"the {where} are not listed by ID")
    found = {}
    for key, entry in entries.items():
        if not key.isdecimal() or not key.isascii() or int(key) > LARGEST_ID:
            raise _Wrong(f"{key!r} in the {where} is not an object ID")
        if not isinstance(entry, dict):
            raise _Wrong(f"entry {key} of the {where} is not an object")
        visible = _truth(entry.get("visible", True), f"visible of object {key}")
        maps = entry.get("maps")
        if maps is not None and not isinstance(maps, list):
            raise _Wrong(f"the maps of object {key} are not a list")
        try:
            places = None if maps is None else np.array([affine_map(place) for place in maps]).reshape(-1, 4, 4)
        except (TypeError, ValueError) as error:
            raise _Wrong(f"a map of object {key} cannot be used: {error}") from error
        found[int(key)] = Placed(visible, places)
    return found


def _numbers(value: Any, shape: tuple[int, ...], what: str) -> Any:
    """Convert a value of the given shape to nested lists of finite floats, or to one float for the shape ()."""
    try:
        array = np.array(value, np.float64)
    except (TypeError, ValueError):
        array = np.full(1, np.nan)
    if array.shape != shape or not np.isfinite(array).all() or isinstance(value, str | bool):
        size = "x".join(map(str, shape)) or "1"
        raise _Wrong(f"{what} is not {size} finite number{'' if shape == () else 's'}")
    return array.tolist()


def _above_zero(value: Any, what: str) -> float:
    number = _numbers(value, (), what)
    if number <= 0:
        raise _Wrong(f"{what} is not above 0")
    return number


def _pixel_aspect(value: Any) -> float:
    number = _above_zero(value, "pixel_aspect")
    if not 1e-6 <= number <= 1e6:  # The limits of OpenEXR.
        raise _Wrong("pixel_aspect is not between 1e-6 and 1e6")
    return number


def _whole(value: Any, least: int, largest: int, what: str) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or not least <= value <= largest:
        raise _Wrong(f"{what} is {value!r}, expected an integer from {least} to {largest}")
    return value


def _truth(value: Any, what: str) -> bool:
    if not isinstance(value, bool):
        raise _Wrong(f"{what} is neither true nor false")
    return value
