"""Masks as image files: one for each photo, or black and white ones in a folder for each object or for each photo."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from pathlib import Path, PurePosixPath

import numpy as np
from scipy import ndimage

from ...shared.errors import InputError
from ..files import (
    LOSSY_SUFFIXES,
    MASK_SUFFIXES,
    Files,
    is_color_mask,
    is_three_channel,
    mask_names,
    read_image,
    read_mask,
)
from ..made_masks import is_made
from ..models.photos import Photos
from ..names import read_names
from .segments import Segments, Shape, draw_shapes

_GRAY, _SOFT = 0.02, 0.1
"""Largest fraction of pixels that are neither black nor white in a JPEG that is black and white, and at soft edges."""

_MOST_COLORS = 256
"""Largest number of colors of a file that is taken for a mask rather than for a picture, where both are there."""


class MaskFiles:
    """A file for each photo with its object IDs, or in black and white with one object.

    Args:
        folder: the folder of the files, which may be that of the photos.
        names: the names of the capture's photos.
        photos: the folder of the photos.
    """

    def __init__(self, folder: Path, names: Collection[str], photos: Path) -> None:
        files = Files(folder)
        with_words = _found(files, names, beside=True)
        self.files = with_words
        if folder.resolve() != photos.resolve():
            found = _found(files, names, beside=False)
            both = [name for name, path in with_words.items() if path != found[name]]
            # Where most photos have both, those without a word for masks may be copies of the photos, but those with
            # one may also be pictures of the masks.
            are_copies = (
                2 * len(both) > len(found)
                and _holds_for_most(is_three_channel, [found[name] for name in both])
                and not _holds_for_most(_is_picture, [with_words[name] for name in both])
            )
            self.files = with_words if are_copies else found
        self.photos: Sequence[str] = sorted(self.files)
        self.lossy = [name for name in self.photos if self.files[name].suffix.lower() in LOSSY_SUFFIXES]
        self.what = "ID masks"
        # Beside masks that were made of these, the names are those of the objects there.
        has_own = folder.name != "masks" and is_made(folder.parent / "masks")
        self._labels = {**({} if has_own else read_names(folder.parent)), **read_names(folder)} if self.files else {}
        color = [path for path in self.files.values() if path.suffix.lower() not in LOSSY_SUFFIXES]
        self._is_color = bool(color) and all(map(is_three_channel, color)) and any(map(is_color_mask, color))
        self._white: int | None = None

    def read(self, photo: str) -> Segments:
        """Return the segments of a photo; raises InputError."""
        path = self.files[photo]
        if path.suffix.lower() in LOSSY_SUFFIXES:
            ids = read_black_and_white(path).astype(np.int64)
        else:
            ids = read_mask(path, self._is_color).astype(np.int64)
            if white := self._common_white():
                ids = _is_white(ids * 255 // white, path, _SOFT).astype(np.int64)
        found, numbers = np.unique(ids, return_inverse=True)
        offset = 0 if len(found) and found[0] == 0 else 1
        values = found[1 - offset :].tolist()
        named = [self._labels.get(value, "") for value in values]
        return Segments((numbers.reshape(ids.shape) + offset).astype(np.int32), values, named)

    def _common_white(self) -> int:
        """Return the value of white if all files are in black and white; otherwise 0, and 255 is an ID as any other."""
        if self._white is None:
            paths = [path for path in self.files.values() if path.suffix.lower() not in LOSSY_SUFFIXES]
            self._white = 0 if self._is_color else _white_of(read_mask(path, False) for path in paths)
        return self._white


def _found(files: Files, names: Collection[str], beside: bool) -> dict[str, Path]:
    """Return the masks of the photos that have one; `beside` is as for `mask_names`."""
    there = {}
    for name in names:
        accepted, lossy = mask_names(name, beside)
        if (path := files.first(accepted) or files.first(lossy)) is not None:
            there[name] = path
    return there


def _holds_for_most(condition: Callable[[Path], bool], paths: Sequence[Path]) -> bool:
    return 2 * sum(map(condition, paths)) > len(paths)


def _is_picture(path: Path) -> bool:
    """Return whether a file has more colors than a mask whose IDs are encoded as colors."""
    return is_three_channel(path) and read_image(path).getcolors(_MOST_COLORS) is None


def _white_of(masks: Iterable[np.ndarray]) -> int:
    """Return the value of white in masks that are in black and white, also with soft edges, or 0 if they have IDs.

    Grays are soft edges if they are no areas and most are between black and white, in shades from dark to light.
    """
    whites, count, soft = set(), 0, 0
    for ids in masks:
        white = 255 if ids.max(initial=0) <= 255 else 65535
        is_white, gray = ids == white, (ids != 0) & (ids != white)
        is_flat = (ids[1:] == ids[:-1])[:, 1:] & (ids[:, 1:] == ids[:, :-1])[1:]
        if 2 * (gray[1:, 1:] & is_flat).sum() > gray.sum():
            return 0
        if white > 255 or is_white.any():
            whites.add(white)
        rows, columns = np.nonzero(gray)
        part = ndimage.label(gray, np.ones((3, 3)))[0][rows, columns]
        padded, values = np.pad(ids, 1, "edge"), ids[rows, columns].astype(np.int64)
        around = np.stack([padded[rows + y, columns + x] for y in range(3) for x in range(3)])
        signs = (around == 0).any(0), (around == white).any(0), 2 * values < white, 2 * values > white
        is_soft = np.all([np.bincount(part, sign) > 0 for sign in signs], 0)
        count, soft = count + len(part), soft + int(is_soft[part].sum())
    return whites.pop() if len(whites) == 1 and 2 * soft >= count else 0


class MaskFolders:
    """Black and white files, of which each shows one segment.

    Args:
        folder: a folder with a folder for each photo, of its name without suffix, or for each object, of the object's
            name and with a file for each photo.
        photos: the photos of the capture.
    """

    def __init__(self, folder: Path, photos: Photos) -> None:
        by_photo: dict[str, list[tuple[Path, str]]] = {}
        by_object: dict[str, list[tuple[Path, str]]] = {}
        for path in sorted(folder.rglob("*")):
            is_image = path.suffix.lower() in (*MASK_SUFFIXES, *LOSSY_SUFFIXES) and not path.name.startswith(".")
            if not is_image or path.parent == folder:
                continue
            within = PurePosixPath(path.relative_to(folder).as_posix())
            own = PurePosixPath(*within.parts[1:])
            if (name := photos.find(within.parent.as_posix())) is not None:
                by_photo.setdefault(name, []).append((path, ""))
            if (name := photos.find(own.as_posix()) or photos.find(own.with_suffix("").as_posix())) is not None:
                by_object.setdefault(name, []).append((path, within.parts[0]))
        # Objects may be numbered as photos are.
        of_objects, of_photos = ((len(found), sum(map(len, found.values()))) for found in (by_object, by_photo))
        self._unclear = folder if of_objects == of_photos else None
        self._shapes = by_object if of_objects > of_photos else by_photo
        self.photos: Sequence[str] = sorted(self._shapes)
        self.what = f"a folder of masks for each {'object' if of_objects > of_photos else 'photo'}"

    def read(self, photo: str) -> Segments:
        """Return the segments of a photo; raises InputError."""
        if self._unclear is not None:
            raise InputError(
                f"The folders in {self._unclear} may be those of photos or of objects, since the files in them "
                "are named like photos, too; give the folders names of objects, or rename the files."
            )
        shapes, size = [], None
        for path, name in self._shapes[photo]:
            inside = read_black_and_white(path)
            if size is not None and inside.shape != size:
                raise InputError(f"{path} is not of the size of the other masks of {photo}; make it the photo's size.")
            size = inside.shape
            shapes.append(Shape.of(inside, name or None, name))
        assert size is not None
        return draw_shapes(shapes, size[::-1])


def read_black_and_white(path: Path) -> np.ndarray:
    """Read a mask in black and white, also a JPEG: (h, w) bool, True where it is white.

    Raises:
        InputError: It cannot be read, or is not black and white.
    """
    if path.suffix.lower() in (".npy", ".npz"):
        values = read_mask(path).astype(np.int64) > 0
        return np.asarray(values)
    gray = np.asarray(read_image(path).convert("L"))
    if gray.max(initial=0) <= 1:
        return gray > 0
    return _is_white(gray, path)


def _is_white(gray: np.ndarray, path: Path, most: float = _GRAY) -> np.ndarray:
    """Return where gray values from 0 to 255 (h, w) are white; raises InputError if more than `most` are neither."""
    between = float(((gray > 64) & (gray < 192)).mean())
    if between > most:
        raise InputError(
            f"{path} is not black and white, since {between:.0%} of its pixels are gray; save masks with several "
            "objects as PNG with IDs, and a mask of one object with sharp edges."
        )
    return gray > 127


def ids_of(segments: Segments) -> np.ndarray:
    """Return the IDs (h, w) int64 of segments whose objects are IDs."""
    return np.array([0, *segments.objects], np.int64)[segments.numbers]
