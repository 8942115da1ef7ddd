"""The segments that a model finds in each photo of a capture, as a source of masks."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from PIL import ExifTags, Image

from ..capture.files import read_image, read_mask
from ..capture.mask_sources.segments import Segments, Shape, draw_shapes
from ..networks.checkpoint_folder import CONFIG
from ..shared.errors import InputError
from ..shared.formats.atomic import make_folder, require_still_there, write_atomic
from ..shared.formats.json_file import parse_json

_VERSION = 3
"""Number to be raised with changes of what is found or kept, so that earlier results are not used any more."""

_PARTS = (".json", ".safetensors", ".bin", ".txt", ".pt", ".pth", ".yaml", ".yml")
"""Suffixes of the files of a checkpoint; the original model may be beside that of the package transformers."""

_TURN = Image.Transpose
_TURNS = {
    2: (_TURN.FLIP_LEFT_RIGHT, _TURN.FLIP_LEFT_RIGHT), 3: (_TURN.ROTATE_180, _TURN.ROTATE_180),
    4: (_TURN.FLIP_TOP_BOTTOM, _TURN.FLIP_TOP_BOTTOM), 5: (_TURN.TRANSPOSE, _TURN.TRANSPOSE),
    6: (_TURN.ROTATE_270, _TURN.ROTATE_90), 7: (_TURN.TRANSVERSE, _TURN.TRANSVERSE),
    8: (_TURN.ROTATE_90, _TURN.ROTATE_270),
}  # fmt: skip
"""By EXIF orientation: how the pixels become upright, and how they are turned back."""


def is_checkpoint(folder: Path) -> bool:
    """Return whether a folder is one of a model rather than one with masks."""
    if any(folder.glob("*.safetensors")):
        return True
    try:
        content = parse_json((folder / CONFIG).read_bytes())
    except (OSError, ValueError):
        return False
    return isinstance(content, dict) and "model_type" in content


Find = Callable[[np.ndarray, Callable[[int, int], object]], Iterable[tuple[np.ndarray, str]]]
"""Takes an upright photo (H, W, 3) uint8, and what receives the number of finished steps, and of all; returns the mask
(H, W) bool and the name of each segment, or ""."""


class Finder(NamedTuple):
    """What finds the segments of a photo.

    Attributes:
        what: the kind of segments, such as "segments by a model of the type sam2".
        key: identifies the models and what they look for; results of others are not used.
        longest_side: the longer side in pixels to which larger photos are reduced before.
        load: loads the models to a device, and returns what finds the segments; raises InputError if they cannot be
            used.
    """

    what: str
    key: str
    longest_side: int
    load: Callable[[torch.device], Find]


def chosen_checkpoint(path: Path) -> Path:
    """Return the folder of a checkpoint if one of its files was chosen in place of it, or else the path."""
    is_part = path.is_file() and path.suffix.lower() in _PARTS
    return path.parent if is_part and is_checkpoint(path.parent) else path


class PhotoSegments:
    """The segments of photos, found by models and kept in files; a `MaskSource`.

    Args:
        finder: what finds them.
        images: the folder of the photos.
        photos: their names.
        kept: the folder in which results are kept.
    """

    def __init__(self, finder: Finder, images: Path, photos: Sequence[str], kept: Path) -> None:
        self.what = finder.what
        self.photos: Sequence[str] = photos
        self._finder, self._images = finder, images
        self._kept = kept / f"{finder.key}-{_VERSION}"

    def missing(self) -> list[str]:
        """Return the photos that have no kept results, or those of other files of the same names."""
        return [name for name in self.photos if not self._is_kept(name)]

    def find(self, device: torch.device, progress: Callable[[float, float], object]) -> None:
        """Find the segments of the missing photos, and keep those of each photo at once.

        Args:
            device: where the models run.
            progress: receives the number of finished photos, and of all that were missing; asked many times a photo.

        Raises:
            InputError: A photo cannot be read, or a model cannot be used.
        """
        missing = self.missing()
        find = self._finder.load(device)
        for done, name in enumerate(missing):
            stamp = self._stamp(name)
            photo = read_image(self._images / name)
            photo.thumbnail((self._finder.longest_side,) * 2, Image.Resampling.BOX)
            turn, back = _turns(self._images / name, photo)
            upright = photo if turn is None else photo.transpose(turn)

            def report(step: int, steps: int, done: int = done) -> None:
                progress(done + step / (steps + 1), len(missing))

            found = find(np.array(upright), report)
            shapes = (Shape.of(_transposed(mask, back), None, text) for mask, text in found)
            self._keep(name, stamp, draw_shapes(shapes, photo.size))
            progress(done + 1, len(missing))

    def read(self, photo: str) -> Segments:
        """Return the segments of a photo that `find` has found; raises InputError if their file cannot be read."""
        path = self._path(photo)
        numbers = read_mask(path)
        try:
            with np.load(path) as arrays:
                names = arrays["names"].tolist()
        except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
            raise InputError(f"{path} cannot be read; delete it, and it is made again.") from error
        # Segments that smaller ones cover completely are not numbered.
        found, numbered = np.unique(numbers[numbers > 0], return_inverse=True)
        renumbered = np.zeros(numbers.shape, np.int32)
        renumbered[numbers > 0] = numbered + 1
        return Segments(renumbered, [None] * len(found), [names[number - 1] for number in found])

    def _path(self, name: str) -> Path:
        return self._kept / f"{name}.npz"

    def _stamp(self, name: str) -> list[int]:
        """Return what tells a photo from others of its name: its size in bytes, and its time, whatever the clock."""
        status = (self._images / name).stat()
        return [status.st_size, status.st_mtime_ns]

    def _is_kept(self, name: str) -> bool:
        try:
            with np.load(self._path(name)) as arrays:
                return bool(arrays["photo"].tolist() == self._stamp(name))
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
            return False

    def _keep(self, name: str, stamp: list[int], found: Segments) -> None:
        stream, names = io.BytesIO(), np.array(found.names, np.str_)
        np.savez_compressed(stream, ids=found.numbers.astype(np.uint16), names=names, photo=np.array(stamp, np.int64))
        require_still_there(self._images)
        make_folder(self._path(name).parent)
        write_atomic(self._path(name), stream.getvalue())


def _turns(path: Path, photo: Image.Image) -> tuple[Image.Transpose | None, Image.Transpose | None]:
    """Return how a photo, which was read as it is stored, becomes upright, as models expect it, and the way back."""
    try:
        with Image.open(path) as file:
            # The file of a PNG would be decoded again, and what was read of a TIFF has no orientation.
            exif = (file if file.format == "TIFF" else photo).getexif()
            return _TURNS.get(exif.get(ExifTags.Base.Orientation, 1), (None, None))
    except Exception:  # Its EXIF data may be damaged in any way.
        return None, None


def _transposed(mask: np.ndarray, turn: Image.Transpose | None) -> np.ndarray:
    """Return a mask (h, w) bool as Pillow transposes images."""
    return mask if turn is None else np.asarray(Image.fromarray(mask.astype(np.uint8)).transpose(turn)) > 0
