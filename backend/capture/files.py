"""The files of a capture: images, and ID masks in all accepted formats."""

from __future__ import annotations

import io
import os
import re
import unicodedata
import warnings
import zipfile
from collections.abc import Collection, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from PIL import ExifTags, ImageCms
from PIL import Image as PilImage

from ..shared.class_table import LARGEST_ID
from ..shared.errors import InputError
from ..shared.formats.atomic import write_atomic
from ..shared.formats.photos_source import NOT_OF_USERS
from ..shared.formats.regular_file import open_regular, require_regular

MASK_SUFFIXES = (".png", ".npy", ".npz", ".tif", ".tiff", ".bmp")
LOSSY_SUFFIXES = (".jpg", ".jpeg")
_MASK_WORDS = ("mask", "seg", "id")
"""Words that the names of masks may have before or after that of the photo, as in `photo_mask.png`."""
_ASPECT_TOLERANCE = 0.01
# Photos of phones have up to 200 million pixels; Pillow refuses images of more than twice this number.
PilImage.MAX_IMAGE_PIXELS = 200_000_000

_OPENING_ERRORS = (OSError, ValueError, SyntaxError, EOFError, MemoryError, PilImage.DecompressionBombError)


_SRGB = ("sRGB IEC61966-2.1", "sRGB built-in", "sRGB")
"""Descriptions of usual profiles of sRGB, which need no conversion."""


class Files:
    """The files below a folder, looked up by the names in a model.

    A name is matched exactly, then in composed Unicode (macOS writes decomposed names), then with backslashes as
    separators (models made on Windows), then case-insensitively. An ambiguous match counts as no match.
    """

    def __init__(self, folder: Path, without: Collection[str] = ()) -> None:
        """List the files of `folder`, without those in its subfolders `without`, and in those of no user."""
        self.folder = folder
        self.paths: list[str] = []
        for parent, folders, names in os.walk(folder, followlinks=True):
            within = Path(parent).relative_to(folder)
            inside = sorted(name for name in folders if name not in without or parent != str(folder))
            inside = [name for name in inside if not name.startswith(NOT_OF_USERS)]
            folders[:] = [name for name in inside if not _leads_back(folder, within / name)]
            self.paths += [(within / name).as_posix() for name in sorted(names) if not name.startswith(".")]
        self._levels: list[dict[str, list[str]]] = []
        for level in range(4):
            index: dict[str, list[str]] = {}
            for path in self.paths:
                index.setdefault(_folded(path, level), []).append(path)
            self._levels.append(index)

    def find(self, name: str) -> Path | None:
        """Return the file with this name, or None."""
        for level, index in enumerate(self._levels):
            matches = index.get(_folded(name, level), [])
            if len(matches) == 1:
                return self.folder / matches[0]
            if matches:
                return None
        return None

    def find_end(self, path: str) -> Path | None:
        """Return the file that the longest part of a path from the right names, or None."""
        parts = [part for part in re.split(r"[/\\]+", path) if part not in ("", ".", "..")]
        return self.first("/".join(parts[start:]) for start in range(len(parts)))

    def first(self, names: Iterable[str]) -> Path | None:
        """Return the first existing file of `names`, or None."""
        return next((path for name in names if (path := self.find(name)) is not None), None)


def _leads_back(folder: Path, path: Path) -> bool:
    """Return whether a path below a folder is, by links, one of the folders that it goes through, or contains one."""
    place = (folder / path).resolve()
    return any((folder / parent).resolve().is_relative_to(place) for parent in path.parents)


def _folded(name: str, level: int) -> str:
    if level >= 1:
        name = unicodedata.normalize("NFC", name)
    if level >= 2:
        name = name.replace("\\", "/")
    return name.casefold() if level >= 3 else name


def mask_names(image_name: str, beside: bool = False) -> tuple[list[str], list[str]]:
    """Return the names that an image's mask may have below masks/: accepted ones, and lossy ones that are refused.

    If the masks are beside the images, only names that contain a word for masks.
    """
    place, name = re.fullmatch(r"(.*[/\\])?([^/\\]*)", image_name).groups()  # type: ignore[union-attr]
    stem = re.sub(r"\.[^.]*$", "", name)
    found = [*(f"{stem}_{word}" for word in _MASK_WORDS), *(f"{word}_{stem}" for word in _MASK_WORDS)]
    if not beside:
        found = [name, stem, *found]
    found = [(place or "") + each for each in found]
    return [each + suffix for each in found for suffix in MASK_SUFFIXES], [
        each + suffix for each in found for suffix in LOSSY_SUFFIXES
    ]


# Images


def image_size(path: Path) -> tuple[int, int]:
    """Read the width and height from an image's header; raises InputError with the file's path."""
    with _opened(path) as image:
        return image.size


def read_image(path: Path) -> PilImage.Image:
    """Read an image as 8-bit sRGB without alpha; as in COLMAP, orientation tags are ignored. Raises InputError."""
    with _opened(path) as opened:
        try:
            opened.load()
            image: PilImage.Image = in_srgb(opened)
            if image.mode in ("I", "I;16", "I;16B", "I;16L"):
                values = np.asarray(image).astype(np.int64)
                image = PilImage.fromarray((np.clip(values, 0, 65535) // 257).astype(np.uint8))
            elif image.mode == "F":
                raise InputError(f"{path} contains floating-point pixels; save it as an 8- or 16-bit image.")
            if image.mode == "P" and "transparency" in image.info:
                return image.convert("RGBA").convert("RGB")
            return _without_alpha(image).convert("RGB")
        except _OPENING_ERRORS as error:
            raise _unreadable(path, error) from error


def _without_alpha(image: PilImage.Image) -> PilImage.Image:
    # Not convert(): some versions turn fully transparent pixels black.
    return PilImage.merge("RGB", image.split()[:3]) if image.mode in ("RGBA", "RGBX") else image


def in_srgb(image: PilImage.Image) -> PilImage.Image:
    """Return an image in the colors of sRGB, if it has a profile of others, as photos of phones (Display P3)."""
    profile = image.info.get("icc_profile")
    if profile and image.mode == "P":
        image = image.convert("RGBA")
    if not profile or image.mode not in ("RGB", "RGBA", "RGBX", "L", "CMYK"):
        return image
    try:
        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        if ImageCms.getProfileDescription(source).strip() in _SRGB:
            return image
        srgb = ImageCms.createProfile("sRGB")
        shown = ImageCms.profileToProfile(_without_alpha(image), source, srgb, outputMode="RGB")
    except (ImageCms.PyCMSError, OSError):
        return image
    assert shown is not None
    # Its EXIF data refer to places in themselves, so they are not copied entry by entry.
    shown.info["exif"] = image.info.get("exif", b"")
    return shown


def _opened(path: Path) -> PilImage.Image:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", PilImage.DecompressionBombWarning)
            image = PilImage.open(require_regular(path))
            if image.format == "TIFF":
                _ignore_orientation(image)
            return image
    except _OPENING_ERRORS as error:
        raise _unreadable(path, error) from error


def _ignore_orientation(image: Any) -> None:
    """Keep the pixels of a TIFF as they are stored; Pillow would turn them, unlike those of other formats."""
    exif = image.getexif()
    if exif.get(ExifTags.Base.Orientation, 1) != 1:
        del exif[ExifTags.Base.Orientation]
        image.tag_v2.pop(ExifTags.Base.Orientation, None)
        image._size = image._tile_size


def _unreadable(path: Path, error: BaseException) -> InputError:
    if isinstance(error, OSError) and error.strerror:
        return InputError(f"{path} cannot be read ({error.strerror}); put it back, or check it and its permissions.")
    why = f" ({error})" if isinstance(error, PilImage.DecompressionBombError) else ""
    return InputError(f"{path} cannot be read as an image{why}: it is damaged or its format is unknown; replace it.")


# Masks


def is_color_mask(path: Path) -> bool:
    """Return whether a mask file has three channels that differ, so that its IDs are encoded as colors."""
    if path.suffix.lower() in (".npy", ".npz"):
        return False
    with _opened(path) as image:
        if image.mode not in ("RGB", "RGBA"):
            return False
        try:
            planes = np.asarray(image)
        except _OPENING_ERRORS as error:
            raise _unreadable(path, error) from error
        return bool((planes[..., 0] != planes[..., 1]).any() or (planes[..., 0] != planes[..., 2]).any())


def is_three_channel(path: Path) -> bool:
    """Return whether a mask file has three channels, and thus may be gray or encode IDs as colors."""
    if path.suffix.lower() in (".npy", ".npz"):
        return False
    with _opened(path) as image:
        return image.mode in ("RGB", "RGBA")


def mask_size(path: Path) -> tuple[int, int]:
    """Read the width and height of a mask from its header; raises InputError with the file's path."""
    if path.suffix.lower() not in (".npy", ".npz"):
        return image_size(path)
    with _opened_array(path) as file:
        height, width = _array_size(path, file)
    return width, height


def same_shape(size: tuple[int, int], of: tuple[int, int]) -> bool:
    """Return whether a mask's size (width, height) has nearly the proportions of another."""
    expected = size[1] * of[0] / of[1]
    return is_resized(size, of) or abs(size[0] - expected) <= _ASPECT_TOLERANCE * expected


def is_resized(size: tuple[int, int], of: tuple[int, int]) -> bool:
    """Return whether a size (width, height) is another one, reduced or enlarged and rounded to whole pixels."""
    # Both sides of the smaller one may be rounded up or down.
    return abs(size[0] * of[1] - size[1] * of[0]) <= max(sum(size), sum(of))


def read_mask(path: Path, color: bool | None = None) -> np.ndarray:
    """Read an ID map.

    8-bit or 16-bit gray: the value is the ID. Palette: the index is the ID. Three channels: the gray value is the ID
    if the channels are equal in the whole capture, otherwise R + 256 G + 65536 B; alpha is ignored. .npy and .npz (the
    only array, or the one named `ids`, `mask` or `masks`): integers, or floats with integer values.

    Args:
        path: The mask.
        color: Whether three channels encode IDs as colors; None to decide from this file alone.

    Returns:
        (h, w) uint8, uint16 or uint32, the smallest type that can represent the IDs.

    Raises:
        InputError: The file is not an ID map; the message contains its path.
    """
    suffix = path.suffix.lower()
    if suffix in LOSSY_SUFFIXES:
        raise InputError(f"{path} is a JPEG, whose compression changes IDs; save it as PNG, or use `masks`.")
    ids = _array_mask(path) if suffix in (".npy", ".npz") else _image_mask(path, color)
    return compact(ids)


def compact(ids: np.ndarray) -> np.ndarray:
    """Convert IDs to the smallest unsigned type that can represent them."""
    largest = int(ids.max()) if ids.size else 0
    return ids.astype(np.uint8 if largest < 256 else np.uint16 if largest < 65536 else np.uint32, copy=False)


@contextmanager
def _opened_array(path: Path) -> Iterator[BinaryIO]:
    """Open the array of a .npy or .npz mask for reading; errors are raised as InputError with the file's path."""
    try:
        with ExitStack() as stack:
            file: Any = stack.enter_context(open_regular(path))
            if file.read(2) == b"PK":
                archive = stack.enter_context(zipfile.ZipFile(file))
                stored = [name.removesuffix(".npy") for name in archive.namelist()]
                names = [name for name in ("ids", "mask", "masks") if name in stored] or stored
                if len(names) != 1:
                    arrays = ", ".join(names[:10]) or "(none)"
                    raise InputError(f"{path} contains the arrays {arrays}; expected one named ids.")
                file = stack.enter_context(archive.open(f"{names[0]}.npy"))
            else:
                file.seek(0)
            yield file
    except InputError:
        raise
    except Exception as error:  # NumPy and zipfile raise many types on damaged files
        if isinstance(error, OSError) and error.strerror:
            raise _unreadable(path, error) from error
        raise InputError(f"{path} cannot be read as a NumPy array: it is damaged or not one; replace it.") from error


def _array_size(path: Path, file: BinaryIO) -> tuple[int, int]:
    """Read the header of an array (h, w), (1, h, w) or (h, w, 1) of numbers, and return its height and width."""
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(file)
    if dtype.kind not in "buif":
        raise _not_ids(path, f"its values are of type {str(dtype)[:40]}")
    size = shape
    if len(size) == 3 and 1 in (size[0], size[2]):
        size = size[1:] if size[0] == 1 else size[:2]
    if len(size) != 2 or 0 in size:
        raise _not_ids(path, f"its array has the shape {shape}, expected height x width")
    return size


def _array_mask(path: Path) -> np.ndarray:
    with _opened_array(path) as file:
        height, width = _array_size(path, file)
    with _opened_array(path) as file:
        ids = np.lib.format.read_array(file, allow_pickle=False).reshape(height, width)
    if ids.dtype.kind == "f":
        with np.errstate(invalid="ignore"):
            if not (np.isfinite(ids).all() and (ids == np.rint(ids)).all()):
                raise _not_ids(path, "its values are not whole numbers")
    if ids.min() < 0 or ids.max() > LARGEST_ID:
        raise _not_ids(path, f"its values lie outside 0 to {LARGEST_ID}")
    return ids.astype(np.uint32)


def _image_mask(path: Path, color: bool | None) -> np.ndarray:
    with _opened(path) as image:
        tile = getattr(image, "tile", None)
        raw_mode = str(tile[0][3]) if tile else ""
        if image.format == "JPEG":
            raise InputError(f"{path} is a JPEG, whose compression changes IDs; save it as PNG, or use `masks`.")
        try:
            values = np.asarray(image)
        except _OPENING_ERRORS as error:
            raise _unreadable(path, error) from error
        mode = image.mode
    if mode in ("L", "P", "1", "I;16", "I;16B", "I;16L", "I"):
        if mode == "L" and image.format == "PNG" and ("L;2" in raw_mode or "L;4" in raw_mode):
            # Pillow scales 2-bit and 4-bit gray to the full range.
            values = values // (85 if "L;2" in raw_mode else 17)
        if mode == "I" and int(values.min()) < 0:
            raise _not_ids(path, "it contains negative values")
        return values.astype(np.uint32)
    if mode == "LA":
        return values[..., 0].astype(np.uint32)
    if mode in ("RGB", "RGBA"):
        if "16" in raw_mode:
            raise _not_ids(path, "it has 16 bits for each of three channels")
        red, green, blue = (values[..., channel].astype(np.uint32) for channel in range(3))
        if color is None:
            color = bool((red != green).any() or (red != blue).any())
        if not color:
            return red
        ids = red + (green << 8) + (blue << 16)
        if ids.size > 4096 and (ids[:, 1:] == ids[:, :-1]).mean() < 0.3:
            raise _not_ids(path, "hardly any neighboring pixels are equal, so it is probably a photo")
        return ids
    raise _not_ids(path, f"its pixels are of Pillow's mode {mode}")


def _not_ids(path: Path, why: str) -> InputError:
    return InputError(f"{path} is not an ID map: {why}; expected one integer per pixel, 0 for unlabeled.")


def encode_mask(ids: np.ndarray) -> tuple[str, bytes]:
    """Encode an ID map for `read_mask`; returns the suffix and bytes of a file: PNG up to 16 bits, otherwise .npz."""
    ids = compact(ids)
    buffer = io.BytesIO()
    if ids.dtype == np.uint32:
        np.savez_compressed(buffer, ids=ids)
        return ".npz", buffer.getvalue()
    PilImage.fromarray(ids).save(buffer, "PNG", compress_level=3)
    return ".png", buffer.getvalue()


def write_image(path: Path, image: PilImage.Image, exif: PilImage.Exif | None = None) -> None:
    """Write a PNG atomically, with EXIF data if there are any."""
    buffer = io.BytesIO()
    image.save(buffer, "PNG", compress_level=1, **({"exif": exif} if exif else {}))
    write_atomic(path, buffer.getvalue())
