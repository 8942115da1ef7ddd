"""CVAT's XML, for images and for videos: polygons, boxes, ellipses and masks."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Hashable, Sequence
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from ...shared.errors import InputError
from ...shared.formats.photos_source import natural_order
from ..models.photos import Photos, require_single
from .segments import Segments, Shape, checked_size, draw_shapes, polygon, turned

_SHAPES = ("polygon", "box", "ellipse", "mask")


class CvatMasks:
    """The masks of a file of CVAT.

    Args:
        root: its XML.
        file: the file, for messages.
        photos: the photos of the capture; the frames of a video are theirs in natural order.

    Raises:
        InputError: the file is not valid, or of a video with other frames.
    """

    what = "CVAT annotations"

    def __init__(self, root: Element, file: Path, photos: Photos) -> None:
        self._file = file
        self._sizes: dict[str, tuple[int, int]] = {}
        self._shapes: dict[str, list[tuple[Element, str, Hashable]]] = {}
        try:
            self._read_images(root, photos)
            self._read_tracks(root, photos)
        except (TypeError, ValueError, KeyError) as error:
            raise self._invalid(error) from error
        self.photos: Sequence[str] = sorted(self._shapes)
        self._is_unique = all(
            count == 1
            for found in self._shapes.values()
            for count in Counter(label for _, label, track in found if track is None).values()
        )

    def _read_images(self, root: Element, photos: Photos) -> None:
        named: dict[str, str] = {}
        for image in root.iter("image"):
            reference = image.get("name", "")
            name = photos.find(reference)
            shapes: list[tuple[Element, str, Hashable]] = [
                (each, each.get("label", ""), None) for each in image if each.tag in _SHAPES
            ]
            # Photos that nobody has annotated yet are listed, too.
            if name is not None and shapes:
                require_single(named, name, reference, self._file)
                width, height = int(image.attrib["width"]), int(image.attrib["height"])
                self._sizes[name] = checked_size(width, height, f"{self._file}: {name}")
                self._shapes[name] = shapes

    def _read_tracks(self, root: Element, photos: Photos) -> None:
        tracks = list(root.iter("track"))
        if not tracks:
            return
        size = root.find(".//original_size")
        if size is None:
            raise ValueError("without original_size")
        width, height = (int(size.findtext(side, "")) for side in ("width", "height"))
        ordered = sorted(photos.names, key=natural_order)
        frames = root.findtext(".//meta//size")
        if frames is not None and int(frames) != len(ordered):
            raise InputError(
                f"{self._file} is of a video of {frames} frames, and the capture has {len(ordered)} photos; annotate "
                f"the photos in {photos.folder}."
            )
        # Frames are numbered as in the video, of which a task may have a part, or every tenth frame.
        first = int(root.findtext(".//meta//start_frame") or 0)
        step = int((re.findall(r"step=(\d+)", root.findtext(".//meta//frame_filter") or "") or ["1"])[0])
        for track in tracks:
            key = ("track", track.get("id"))
            for each in track:
                if each.tag in _SHAPES and each.get("outside") != "1":
                    number, rest = divmod(int(each.attrib["frame"]) - first, max(step, 1))
                    if rest or not 0 <= number < len(ordered):
                        raise InputError(
                            f"{self._file} has a shape in frame {each.attrib['frame']}, which is none of the "
                            f"{len(ordered)} photos; annotate the photos in {photos.folder}."
                        )
                    name = ordered[number]
                    self._sizes[name] = checked_size(width, height, f"{self._file}: {name}")
                    self._shapes.setdefault(name, []).append((each, track.get("label", ""), key))

    def read(self, photo: str) -> Segments:
        """Return the segments of a photo; raises InputError."""
        size, shapes = self._sizes[photo], []
        for element, label, track in self._shapes[photo]:
            try:
                inside = _inside(element, size)
            except (TypeError, ValueError, KeyError) as error:
                raise self._invalid(error, photo) from error
            known = track if track is not None else label if label and self._is_unique else None
            shapes.append(Shape.of(inside, known, label))
        return draw_shapes(shapes, size)

    def _invalid(self, error: Exception, photo: str = "") -> InputError:
        where = f" for {photo}" if photo else ""
        return InputError(f"{self._file} is not valid{where} ({error}); export it again from CVAT.")


def _inside(element: Element, size: tuple[int, int]) -> np.ndarray:
    """Return the pixels (h, w) bool of a shape."""
    width, height = size
    values = element.attrib
    degrees = float(values.get("rotation", 0.0))
    if element.tag == "polygon":
        return polygon([tuple(map(float, pair.split(","))) for pair in values["points"].split(";")], size)  # type: ignore[misc]
    if element.tag == "box":
        left, top, right, bottom = (float(values[key]) for key in ("xtl", "ytl", "xbr", "ybr"))
        corners = [(left, top), (right, top), (right, bottom), (left, bottom)]
        return polygon(turned(corners, degrees, ((left + right) / 2, (top + bottom) / 2)), size)
    if element.tag == "ellipse":
        turns = np.linspace(0, 2 * np.pi, 64, endpoint=False)
        center = float(values["cx"]), float(values["cy"])
        x = center[0] + float(values["rx"]) * np.cos(turns)
        y = center[1] + float(values["ry"]) * np.sin(turns)
        return polygon(turned(list(zip(x.tolist(), y.tolist(), strict=True)), degrees, center), size)
    left, top, wide, tall = (int(values[key]) for key in ("left", "top", "width", "height"))
    runs = [int(run) for run in values["rle"].split(",")]
    fits = 0 <= left <= left + wide <= width and 0 <= top <= top + tall <= height
    if min(runs) < 0 or sum(runs) != wide * tall or not fits:
        raise ValueError(f"a mask of {wide} x {tall} pixels whose run lengths add up to {sum(runs)}")
    inside = np.zeros((height, width), bool)
    inside[top : top + tall, left : left + wide] = np.repeat(np.arange(len(runs)) % 2 == 1, runs).reshape(tall, wide)
    return inside
