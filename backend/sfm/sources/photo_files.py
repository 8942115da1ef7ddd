"""Files of photos in all accepted formats: which camera took them, and copies that COLMAP and other programs read."""

from __future__ import annotations

import importlib
import io
import re
import shutil
import warnings
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pillow_heif
from PIL import ExifTags, ImageOps
from PIL import Image as PilImage

from ...capture.files import in_srgb, read_image, write_image
from ...shared.errors import InputError
from ...shared.formats.atomic import atomic_path, make_folder, write_atomic
from ...shared.formats.photos_source import RAW

COPIED = {".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp"}
"""Suffixes of files that COLMAP reads. HEIC becomes JPEG with its EXIF data, which may tell the focal length; other
formats become PNG."""
_JPEG_FORMATS, _HEIC_FORMATS = {"JPEG", "MPO"}, {"HEIF", "AVIF"}
_COPIED_FORMATS = _JPEG_FORMATS | {"PNG", "TIFF", "BMP"}
"""Pillow's names of the formats of JPEG, of HEIC, and of all that COLMAP reads."""
_MAKER = (ExifTags.Base.Make, ExifTags.Base.Model)
_ZOOM = (ExifTags.Base.FocalLength, ExifTags.Base.FocalLengthIn35mmFilm, ExifTags.Base.DigitalZoomRatio)
"""EXIF entries of the lens; a digital zoom keeps the size and the focal length."""
_QUALITY = 97
"""JPEG quality of photos that are converted or turned."""
_MOST_EXIF = 65_533
"""Number of bytes of EXIF data that a JPEG can have; those of HEIC are longer if its maker adds many notes."""
_PROJECTION = re.compile(rb"GPano:ProjectionType\W+(\w+)")
_PROJECTIONS = {b"equirectangular": "a 360-degree panorama", b"cylindrical": "a stitched panorama"}
"""Entry of Google's Photo Sphere data in XMP, and its values."""
_PANORAMA = 6
"""Value of the EXIF entry CustomRendered of panoramas taken with phones by Apple."""

pillow_heif.register_heif_opener()


def camera_of(path: Path, turned: bool) -> str:
    """Return what photos of one camera with one focal length have in common: size and, by EXIF, model, lens and zoom.

    Args:
        path: the photo.
        turned: whether JPEGs are turned as their EXIF orientation says, as HEIC and AVIF always are, and others never.

    Raises:
        InputError: it cannot be read.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with PilImage.open(path) as image:
                size, exif = image.size, image.getexif()
                is_upright = image.format in _HEIC_FORMATS or (turned and image.format in _JPEG_FORMATS)
                # Before the pixels, after which the file may be closed.
                lens = _lens_of(exif)
                image.draft("L", (64, 64))  # Decodes a JPEG at an eighth of its size.
                image.load()
    except Exception as error:
        raise InputError(f"{path.name} cannot be read as an image: it is damaged or its format is unknown.") from error
    if is_upright and _orientation(exif) > 4:
        size = size[::-1]
    return f"{size[0]}x{size[1]} {lens}"


def _lens_data(path: Path) -> PilImage.Exif:
    """Return the EXIF data of a raw photo that `camera_of` needs, as far as Pillow reads its format."""
    kept = PilImage.Exif()
    with suppress(Exception), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with PilImage.open(path) as image:
            exif = image.getexif()
            kept.update({tag: exif[tag] for tag in _MAKER if tag in exif})
            details = exif.get_ifd(ExifTags.IFD.Exif)
            kept.get_ifd(ExifTags.IFD.Exif).update({tag: details[tag] for tag in _ZOOM if tag in details})
    return kept


def _lens_of(exif: PilImage.Exif) -> str:
    """Return model, focal length and digital zoom by EXIF."""
    details = exif.get_ifd(ExifTags.IFD.Exif)
    maker = [str(exif.get(tag, "")).strip("\0 ") for tag in _MAKER]
    return " ".join([*maker, *(str(details.get(tag, "")) for tag in _ZOOM)])


def gps_position(path: Path) -> tuple[float, float, float] | None:
    """Return latitude and longitude in degrees and altitude in meters (0 if unknown) by EXIF; None without them."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with PilImage.open(path) as image:
                tags = image.getexif().get_ifd(ExifTags.IFD.GPSInfo)
        angles = []
        for tag, reference, negative in (
            (ExifTags.GPS.GPSLatitude, ExifTags.GPS.GPSLatitudeRef, "S"),
            (ExifTags.GPS.GPSLongitude, ExifTags.GPS.GPSLongitudeRef, "W"),
        ):
            degrees, minutes, seconds = (float(part) for part in tags[tag])
            angle = degrees + minutes / 60 + seconds / 3600
            angles.append(-angle if str(tags.get(reference, "")).strip("\0 ") == negative else angle)
        altitude = float(tags.get(ExifTags.GPS.GPSAltitude, 0.0))
    except (OSError, KeyError, TypeError, ValueError, ZeroDivisionError):
        return None
    latitude, longitude = angles
    is_known = bool(np.isfinite([latitude, longitude, altitude]).all()) and (latitude, longitude) != (0.0, 0.0)
    return (latitude, longitude, altitude) if is_known else None


def copy_photo(path: Path, target: Path, turn: bool, again: bool = False) -> Path:
    """Copy a photo, or convert it to JPEG or PNG, unless that was done.

    Args:
        path: the photo.
        target: the copy, whose suffix may change.
        turn: whether to turn a JPEG as its EXIF orientation says, so that it stands upright; HEIC and AVIF always are,
            and the pixels of others are kept.
        again: whether to do so even if it was done, as the photo has changed.

    Returns:
        The copy.

    Raises:
        InputError: it cannot be read.
    """
    target = path_of_copy(path, target)
    if target.exists() and not again:
        return target
    make_folder(target.parent)
    if path.suffix.lower() in RAW:
        write_image(target, _developed(path), _lens_data(path))
    elif _is_heic(path) or (turn and _is_jpeg(path) and _is_turned(path)):
        write_atomic(target, _upright_jpeg(path))
    elif not is_read_by_colmap(path) and not _is_jpeg(path):
        write_image(target, read_image(path))
    else:
        with atomic_path(target) as part:
            shutil.copyfile(path, part)
    return target


def path_of_copy(path: Path, target: Path) -> Path:
    """Return the path that the copy of a photo has, given the one that it would have if it is not converted."""
    if is_read_by_colmap(path):
        return target
    return target.with_suffix(".jpg" if _is_heic(path) or _is_jpeg(path) else ".png")


def _is_jpeg(path: Path) -> bool:
    """Return whether a photo is a JPEG by what is in it, as some programs name also those .heic."""
    return path.suffix.lower() not in RAW and _format_of(path) in _JPEG_FORMATS


def _is_heic(path: Path) -> bool:
    return path.suffix.lower() not in RAW and _format_of(path) in _HEIC_FORMATS


def is_read_by_colmap(path: Path) -> bool:
    """Return whether COLMAP reads a photo as it is, by its suffix and what is in it, which may be of another format."""
    return path.suffix.lower() in COPIED and _format_of(path) in _COPIED_FORMATS


def _format_of(path: Path) -> str | None:
    """Return Pillow's name of the format of a photo that is not raw; None if it cannot be told."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with PilImage.open(path) as image:
                return image.format
    except Exception:
        return None


def _upright_jpeg(path: Path) -> bytes:
    """Return a photo that stands upright as JPEG in sRGB with its EXIF data; raises InputError if it is damaged."""
    buffer = io.BytesIO()
    try:
        with PilImage.open(path) as image:
            changed = in_srgb(ImageOps.exif_transpose(image))
            exif = changed.getexif()
            if len(exif.tobytes()) > _MOST_EXIF:
                exif.get_ifd(ExifTags.IFD.Exif).pop(ExifTags.Base.MakerNote, None)
            changed.convert("RGB").save(buffer, "JPEG", quality=_QUALITY, subsampling=0, exif=exif)
    except Exception as error:
        raise InputError(f"{path.name} cannot be read as an image: it is damaged.") from error
    return buffer.getvalue()


def _orientation(exif: PilImage.Exif) -> int:
    value = exif.get(ExifTags.Base.Orientation, 1)
    return value if isinstance(value, int) and 1 <= value <= 8 else 1


def is_turned_by_right_angle(path: Path) -> bool:
    """Return whether a JPEG is to be shown with its width as height, by its EXIF orientation."""
    if not _is_jpeg(path):
        return False
    try:
        with PilImage.open(path) as image:
            return _orientation(image.getexif()) > 4
    except Exception:
        return False


def projection_of(path: Path) -> str | None:
    """Return what a photo is instead of a picture by one lens, by its XMP and EXIF data; None for all others."""
    if not _is_jpeg(path):
        return None
    with suppress(Exception), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with PilImage.open(path) as image:
            found = _PROJECTION.search(image.info.get("xmp", b""))
            if found is not None:
                return _PROJECTIONS.get(found[1].lower())
            if image.getexif().get_ifd(ExifTags.IFD.Exif).get(ExifTags.Base.CustomRendered) == _PANORAMA:
                return _PROJECTIONS[b"cylindrical"]
    return None


def _is_turned(path: Path) -> bool:
    with PilImage.open(path) as image:
        return _orientation(image.getexif()) > 1


def _developed(path: Path) -> PilImage.Image:
    """Develop a raw photo with the camera's white balance and the same brightness for all."""
    try:
        rawpy: Any = importlib.import_module("rawpy")
    except ImportError as error:
        raise InputError(
            f"{path.name} is a raw photo, which needs the package rawpy; install it in the backend's Python, or save "
            "the photo as JPEG."
        ) from error
    try:
        with rawpy.imread(str(path)) as raw:
            return PilImage.fromarray(raw.postprocess(use_camera_wb=True, no_auto_bright=True))
    except Exception as error:
        raise InputError(
            f"{path.name} cannot be read as a raw photo: it is damaged or of an unknown camera."
        ) from error
