"""The segments that a model finds in each photo of a capture, as a source of masks."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from ..capture.files import read_image, read_mask
from ..capture.mask_sources.segments import Segments, Shape, draw_shapes
from ..networks.checkpoint_folder import CONFIG
from ..shared.formats.atomic import make_folder, write_atomic
from ..shared.formats.json_file import parse_json
from .segmenter import Segmenter

LONGEST_SIDE = 1024
"""Longer side in pixels of the photos that are segmented, which is that of the models' inputs."""

_VERSION = 1
"""Number to be raised with changes of what is found in a photo, so that kept results are not used any more."""


def is_checkpoint(folder: Path) -> bool:
    """Return whether a folder is one of a model rather than one with masks."""
    if any(folder.glob("*.safetensors")):
        return True
    try:
        content = parse_json((folder / CONFIG).read_bytes())
    except (OSError, ValueError):
        return False
    return isinstance(content, dict) and "model_type" in content


class PhotoSegments:
    """The segments of photos, found by a model and kept in files; a `MaskSource`.

    Args:
        segmenter: the model.
        images: the folder of the photos.
        photos: their names.
        kept: the folder in which results are kept.
        fingerprint: that of the model's checkpoint; results of others are not used.
    """

    def __init__(self, segmenter: Segmenter, images: Path, photos: Sequence[str], kept: Path, fingerprint: str) -> None:
        self.what = f"segments by a model of the type {segmenter.kind}"
        self.photos: Sequence[str] = photos
        self._segmenter, self._images = segmenter, images
        self._kept = kept / f"{fingerprint}-{_VERSION}"

    def missing(self) -> list[str]:
        """Return the photos that have no kept results, or older ones than the photo."""
        return [name for name in self.photos if not self._is_kept(name)]

    def find(self, progress: Callable[[float, float], object]) -> None:
        """Find the segments of the missing photos, and keep those of each photo at once.

        Args:
            progress: receives the number of finished photos, and of all that were missing; asked many times a photo.

        Raises:
            InputError: A photo cannot be read.
        """
        missing = self.missing()
        for done, name in enumerate(missing):
            photo = read_image(self._images / name)
            photo.thumbnail((LONGEST_SIDE, LONGEST_SIDE), Image.Resampling.BOX)

            def report(step: int, steps: int, done: int = done) -> None:
                progress(done + step / (steps + 1), len(missing))

            masks = self._segmenter.everything(np.array(photo), report)
            self._keep(name, draw_shapes((Shape(mask, None, "") for mask in masks), photo.size).numbers)
            progress(done + 1, len(missing))

    def read(self, photo: str) -> Segments:
        """Return the segments of a photo that `find` has found; raises InputError if their file cannot be read."""
        numbers = read_mask(self._path(photo))
        # Segments that smaller ones cover completely are not numbered.
        found, numbered = np.unique(numbers[numbers > 0], return_inverse=True)
        renumbered = np.zeros(numbers.shape, np.int32)
        renumbered[numbers > 0] = numbered + 1
        return Segments(renumbered, [None] * len(found), [""] * len(found))

    def _path(self, name: str) -> Path:
        return self._kept / f"{name}.npz"

    def _is_kept(self, name: str) -> bool:
        path = self._path(name)
        return path.is_file() and path.stat().st_mtime >= (self._images / name).stat().st_mtime

    def _keep(self, name: str, numbers: np.ndarray) -> None:
        stream = io.BytesIO()
        np.savez_compressed(stream, numbers.astype(np.uint16))
        make_folder(self._path(name).parent)
        write_atomic(self._path(name), stream.getvalue())
