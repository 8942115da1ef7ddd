"""COCO JSON: instances as polygons or run lengths, and panoptic segmentation with its PNG files.

Instances that are tracked have `track_id`, `instance_id` or `object_id`, in the annotation or in its `attributes`.
Where they are not, and no photo shows two instances of one category, the category is the object.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...shared.errors import InputError
from ...shared.formats.json_file import read_json
from ..files import Files, read_mask
from ..models.photos import Photos, require_single
from .segments import Segments, Shape, checked_size, draw_shapes, identity_of, polygon, run_lengths

_TRACK = ("track_id", "instance_id", "object_id", "tracking_id")
_WHERE_PANOPTIC = ("", "panoptic", "masks", "annotations")


def recognizes(content: Any) -> bool:
    """Return whether JSON is of COCO: with a list of images and one of annotations."""
    return (
        isinstance(content, Mapping)
        and isinstance(content.get("images"), list)
        and isinstance(content.get("annotations"), list)
    )


class CocoMasks:
    """The masks of a COCO file.

    Args:
        content: its JSON.
        file: the file, for messages and for the PNG files of panoptic segmentation.
        photos: the photos of the capture.

    Raises:
        InputError: the file is not valid, or names none of the photos.
    """

    def __init__(self, content: Mapping[str, Any], file: Path, photos: Photos) -> None:
        self._file = file
        self._sizes: dict[str, tuple[int, int]] = {}
        self._annotations: dict[str, list[Mapping[str, Any]]] = {}
        try:
            self._names = {each["id"]: str(each["name"]) for each in content.get("categories", ())}
            name_of, reference_of = {}, {}
            named: dict[str, str] = {}
            for image in content["images"]:
                reference = str(image["file_name"])
                name = photos.find(reference)
                if name is not None:
                    name_of[image["id"]], reference_of[image["id"]] = name, reference
                    self._sizes[name] = checked_size(image["width"], image["height"], f"{file}: {name}")
                    self._annotations[name] = []
            for annotation in content["annotations"]:
                if (image_id := annotation["image_id"]) in name_of:
                    require_single(named, name_of[image_id], reference_of[image_id], file)
                    self._annotations[name_of[image_id]].append(annotation)
        except (AttributeError, KeyError, TypeError) as error:
            raise self._invalid(error) from error
        # Photos that nobody has annotated yet are listed, too.
        self.photos: Sequence[str] = sorted(name for name, found in self._annotations.items() if found)
        self._is_panoptic = any("segments_info" in each for found in self._annotations.values() for each in found)
        self.what = "COCO panoptic masks" if self._is_panoptic else "COCO annotations"
        self._pictures = Files(file.parent) if self._is_panoptic else None
        try:
            self._is_unique = self._categories_are_unique()
        except (AttributeError, TypeError) as error:
            raise self._invalid(error) from error

    def read(self, photo: str) -> Segments:
        """Return the segments of a photo; raises InputError."""
        try:
            if self._is_panoptic:
                return self._panoptic(photo)
            shapes = [self._shape(each, self._sizes[photo]) for each in self._annotations[photo]]
        except (AttributeError, KeyError, TypeError, ValueError, IndexError) as error:
            raise self._invalid(error, photo) from error
        return draw_shapes(shapes, self._sizes[photo])

    def _shape(self, annotation: Mapping[str, Any], size: tuple[int, int]) -> Shape:
        described = annotation.get("segmentation")
        inside = np.zeros(size[::-1], bool)
        if isinstance(described, Mapping):
            height, width = described["size"]
            if (width, height) != size:
                raise ValueError(f"run lengths for {width} x {height} pixels")
            inside = run_lengths(described["counts"], size)
        else:
            for corners in described or ():
                inside |= polygon(list(zip(corners[::2], corners[1::2], strict=True)), size)
        name = self._names.get(annotation.get("category_id"), "")
        return Shape.of(inside, self._object(annotation, name), name)

    def _panoptic(self, photo: str) -> Segments:
        described = [each for each in self._annotations[photo] if "segments_info" in each]
        if not described:
            return draw_shapes((), self._sizes[photo])
        name = described[0]["file_name"]
        assert self._pictures is not None
        folders = (*_WHERE_PANOPTIC, self._file.stem)
        path = self._pictures.first([f"{folder}/{name}".lstrip("/") for folder in folders])
        if path is None:
            raise InputError(f"{self._file} names {name}, which is not beside it; put the PNG files there.")
        ids = read_mask(path, color=True)
        shapes = []
        for segment in described[0]["segments_info"]:
            label = self._names.get(segment.get("category_id"), "")
            shapes.append(Shape.of(ids == segment["id"], self._object(segment, label), label))
        return draw_shapes(shapes, ids.shape[::-1])

    def _object(self, annotation: Mapping[str, Any], name: str) -> Hashable:
        attributes = annotation.get("attributes")
        found = identity_of({**(attributes if isinstance(attributes, Mapping) else {}), **annotation}, _TRACK)
        if found is not None:
            return found
        return name if name and self._is_unique else None

    def _categories_are_unique(self) -> bool:
        """Return whether no photo shows two instances of one category."""
        for found in self._annotations.values():
            listed = [part for each in found for part in each.get("segments_info", (each,))]
            if any(count > 1 for count in Counter(part.get("category_id") for part in listed).values()):
                return False
        return True

    def _invalid(self, error: Exception, photo: str = "") -> InputError:
        where = f" for {photo}" if photo else ""
        return InputError(f"{self._file} is not valid{where} ({error}); export it again in COCO's format.")


class PhotoJson:
    """A JSON file for each photo with the masks of Segment Anything, as in its dataset SA-1B.

    Args:
        folder: the folder of the files, named like the photos: a list `annotations` of masks as COCO's run lengths.
        photos: the photos of the capture.
    """

    what = "a JSON file of masks for each photo"

    def __init__(self, folder: Path, photos: Photos) -> None:
        self._files, self._size = {}, photos.size
        for name in Files(folder).paths:
            stem, _, suffix = name.rpartition(".")
            if suffix.lower() == "json" and (photo := photos.find(stem)) is not None:
                self._files[photo] = folder / name
        self.photos: Sequence[str] = sorted(self._files)

    def read(self, photo: str) -> Segments:
        """Return the segments of a photo; raises InputError."""
        path = self._files[photo]
        content = read_json(path)
        try:
            masks = content["annotations"] if isinstance(content, Mapping) else content
            sizes = {tuple(each["segmentation"]["size"]) for each in masks}
            if not sizes:
                return draw_shapes((), self._size(photo))
            if len(sizes) != 1:
                raise ValueError(f"{len(sizes)} different sizes of masks")
            height, width = next(iter(sizes))
            size = checked_size(width, height, str(path))
            shapes = [Shape.of(run_lengths(each["segmentation"]["counts"], size), None, "") for each in masks]
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise InputError(f"{path} is not valid ({error}); expected masks as run lengths, as in COCO.") from error
        return draw_shapes(shapes, size)
