"""shot.json: through which camera, at which moments and with which objects where, film frames are drawn.

    {"version": 1, "width": 960, "height": 540, "pixel_aspect": 1.0, "depth_scale": 1.0, "only_named": false,
     "objects": {"1": {"visible": true, "maps": [[[1, 0, 0, 0.2], ...]]}, "4": {"visible": false}},
     "frames": [{"frame": 1, "shutter": [0.75, 1.25], "samples": [
         {"time": 1.0, "viewmat": [[...], ...], "K": [[...], ...], "clip": [0.1, 100.0],
          "objects": {"2": {"maps": [[[...], ...], [[...], ...]]}}}, ...]}, ...]}

width and height are pixels; pixel_aspect, the width of one over its height, only goes into the pictures' headers, since
K says what is seen. depth_scale: how many of the depth's units are one of the capture's. Each frame is the mean of its
samples: one, or moments while the shutter is open, whose first and last are `shutter` (in frames).

viewmat (4, 4) maps the capture's coordinates to the camera's (OpenCV axes: x right, y down, looking along z) without
scale. K (3, 3), in pixels with the first pixel's center at (0.5, 0.5), is that of a pinhole: lens shift moves its
center, pixels that are not square make its focal lengths differ, skew is refused. Orthographic and panoramic cameras
have no K and cannot be drawn. clip: nearest and farthest depth drawn, in the capture's units.

objects: what is known of an object by its ID, in all samples and, where it differs, in one. `maps`: where it is, as
4x4 affine maps of the capture's coordinates from where it was captured; several are copies, none is as `visible`:
false. An object without maps is where objects.json says, one that is not named too, unless only_named is true: then it
is not drawn. Standard library and NumPy only, so that Blender's own Python can import it.
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

from ..errors import InputError
from ..formats.json_file import read_json, write_json
from .objects import LARGEST_ID, affine_map

VERSION = 1
NAME = "shot.json"
LARGEST_SIDE = 65536
LARGEST_FRAME = 9_999_999


@dataclass(frozen=True)
class Placed:
    """An object at a moment: whether it is seen, and its maps (n, 4, 4); None: where objects.json says."""

    visible: bool = True
    maps: NDArray[np.float64] | None = None

    @property
    def is_seen(self) -> bool:
        """Whether there is anything of it to draw."""
        return self.visible and (self.maps is None or len(self.maps) > 0)

    def stored(self) -> dict[str, Any]:
        """As shot.json holds it."""
        maps = {} if self.maps is None else {"maps": self.maps.tolist()}
        return {**({} if self.visible else {"visible": False}), **maps}


@dataclass(frozen=True)
class Sample:
    """A moment: time in frames, viewmat (4, 4), K (3, 3), clip (nearest, farthest) and the objects by ID."""

    time: float
    viewmat: NDArray[np.float64]
    K: NDArray[np.float64]
    clip: tuple[float, float]
    objects: Mapping[int, Placed] = field(default_factory=dict)


@dataclass(frozen=True)
class Frame:
    """A picture: the mean of its samples, in the order of their times; shutter: when it opens and closes."""

    number: int
    shutter: tuple[float, float]
    samples: Sequence[Sample]

    @property
    def middle(self) -> int:
        """The sample in the middle, which depth is taken from."""
        return len(self.samples) // 2


@dataclass(frozen=True)
class Shot:
    """All of a shot file; see above. Every sample's objects are complete."""

    width: int
    height: int
    frames: Sequence[Frame]
    pixel_aspect: float = 1.0
    depth_scale: float = 1.0
    only_named: bool = False


def write_shot(path: Path, shot: Shot) -> None:
    """Write a shot file; what does not change about objects is written once."""
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
    })  # fmt: skip


def read_shot(path: Path) -> Shot:
    """Read a shot file; InputError says in one sentence what is wrong with it and where."""
    content = read_json(path)
    try:
        return _shot(content)
    except _Wrong as error:
        raise InputError(f"{path} cannot be drawn: {error}.") from error


def chosen_frames(text: str | None, shot: Shot) -> list[Frame]:
    """The frames that `text` names, as 1-24, 1,5,9 or both mixed, in the shot's order; all of them where it is None."""
    if text is None:
        return list(shot.frames)
    wanted = frame_ranges(text)
    found = [frame for frame in shot.frames if any(frame.number in numbers for numbers in wanted)]
    if not found:
        there = f"{shot.frames[0].number} to {shot.frames[-1].number}"
        raise InputError(f"The shot has none of the frames {text}; it has {len(shot.frames)}, from {there}.")
    return found


def frame_ranges(text: str) -> list[range]:
    """The frames of a list such as 1-24 or 1,5,9-12; InputError where it is none."""
    found = []
    for word in text.split(","):
        match = re.fullmatch(r"\s*(\d{1,7})\s*(?:-\s*(\d{1,7})\s*)?", word)
        first, last = (int(match[1]), int(match[2] or match[1])) if match else (0, -1)
        if last < first:
            raise InputError(f"--frames {text} makes no sense; give frames as 1-24 or 1,5,9-12.")
        found.append(range(first, last + 1))
    return found


class _Wrong(Exception):
    """What is wrong, as the second half of a sentence."""


def _shot(content: Any) -> Shot:
    if not isinstance(content, dict) or "frames" not in content:
        raise _Wrong("it is no shot file, since it has no frames")
    if content.get("version") != VERSION:
        raise _Wrong(f"its version is {content.get('version')!r}, and {VERSION} was expected")
    steady = _objects(content.get("objects", {}), "objects")
    frames = content["frames"]
    if not isinstance(frames, list) or not frames:
        raise _Wrong("its frames are no list, or an empty one")
    shot = Shot(
        width=_whole(content.get("width"), 1, LARGEST_SIDE, "width"),
        height=_whole(content.get("height"), 1, LARGEST_SIDE, "height"),
        pixel_aspect=_above_zero(content.get("pixel_aspect", 1.0), "pixel_aspect"),
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
        raise _Wrong("a frame is no object")
    number = _whole(entry.get("frame"), 0, LARGEST_FRAME, "frame")
    where = f"frame {number}"
    samples = entry.get("samples")
    if not isinstance(samples, list) or not samples:
        raise _Wrong(f"{where} has no samples")
    shutter = _numbers(entry.get("shutter", [number, number]), (2,), f"shutter of {where}")
    return Frame(number, (shutter[0], shutter[1]), [_sample(sample, steady, where) for sample in samples])


def _sample(entry: Any, steady: Mapping[int, Placed], where: str) -> Sample:
    if not isinstance(entry, dict):
        raise _Wrong(f"a sample of {where} is no object")
    if "viewmat" not in entry or "K" not in entry:
        raise _Wrong(f"a sample of {where} has no viewmat or no K; only perspective cameras can be drawn")
    viewmat = np.array(_numbers(entry["viewmat"], (4, 4), f"viewmat of {where}"))
    turn = viewmat[:3, :3]
    if not np.allclose(turn @ turn.T, np.eye(3), atol=1e-4) or np.linalg.det(turn) < 0:
        raise _Wrong(f"the viewmat of {where} is no rotation and translation")
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
            raise _Wrong(f"{key!r} among the {where} is no ID")
        if not isinstance(entry, dict):
            raise _Wrong(f"entry {key} of the {where} is no object")
        visible = _truth(entry.get("visible", True), f"visible of object {key}")
        maps = entry.get("maps")
        if maps is not None and not isinstance(maps, list):
            raise _Wrong(f"the maps of object {key} are no list")
        try:
            places = None if maps is None else np.array([affine_map(place) for place in maps]).reshape(-1, 4, 4)
        except (TypeError, ValueError) as error:
            raise _Wrong(f"a map of object {key} cannot be used: {error}") from error
        found[int(key)] = Placed(visible, places)
    return found


def _numbers(value: Any, shape: tuple[int, ...], what: str) -> Any:
    """Finite numbers as nested lists (or one float), of a shape."""
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


def _whole(value: Any, least: int, largest: int, what: str) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or not least <= value <= largest:
        raise _Wrong(f"{what} is {value!r}, and a whole number from {least} to {largest} was expected")
    return value


def _truth(value: Any, what: str) -> bool:
    if not isinstance(value, bool):
        raise _Wrong(f"{what} is neither true nor false")
    return value
