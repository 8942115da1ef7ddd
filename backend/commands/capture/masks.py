"""`masks`: makes the masks of a capture, with one ID for each object in all photos.

They are made of those of another program, or of the segments that a model finds in each photo.
"""

from __future__ import annotations

import argparse
import shutil
import zlib
from collections import Counter
from collections.abc import Hashable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ...capture.colmap import Model
from ...capture.files import Files, image_size, read_image, same_shape
from ...capture.made_masks import (
    OVERVIEW,
    RECORD,
    is_made,
    is_made_of_others,
    kept_masks,
    new_masks,
    require_place_for_given,
    write_mask,
)
from ...capture.mask_sources import MaskSource, Segments, open_source
from ...capture.models import Photos, read_capture_model, with_observations
from ...capture.names import read_names
from ...evaluation.images import MaskSheet
from ...labels.association import Association, Seen, associate, consistency, object_mask
from ...segmentation import chosen_checkpoint, is_checkpoint
from ...shared.class_table import LARGEST_ID
from ...shared.errors import InputError
from ...shared.formats.json_file import write_json
from ...shared.stopping import StoppingReporter
from ..folder import READ
from .former_masks import FormerMasks, read_former
from .segmented import require_fitting_options, segmented

_GIVEN_LABELS = "labels-given.json"
"""File of the capture with the names that its labels.json had before the first masks were made here."""

_SEGMENT, _FIND, _WRITE = "segment", "find", "write"
_POINTS = 20_000
"""Largest number of points that segments are compared on."""

_CONSISTENT = 0.6
"""IDs that agree on a smaller part of the points are not taken for those of objects."""

_LISTED = 10
"""Largest number of IDs in a warning."""


class _Found(NamedTuple):
    """The objects of all segments.

    Attributes:
        ids: for each photo, the IDs of its segments, from that of no segment.
        names: by ID, the names that the source gives, or "".
        keys: by ID, what the source calls an object in all photos, if it says so.
    """

    ids: dict[str, np.ndarray]
    names: dict[int, str]
    keys: dict[int, Hashable]


class _Packed:
    """The segments of a photo, as in `Segments`, with compressed numbers, since those of all photos are kept."""

    def __init__(self, segments: Segments) -> None:
        self.objects, self.names, self.shape = segments.objects, segments.names, segments.numbers.shape
        self._kind = np.min_scalar_type(len(self.objects))
        self._numbers = zlib.compress(segments.numbers.astype(self._kind).tobytes(), 1)

    @property
    def numbers(self) -> np.ndarray:
        """(h, w) int32."""
        return np.frombuffer(zlib.decompress(self._numbers), self._kind).reshape(self.shape).astype(np.int32)


def masks(options: argparse.Namespace, reporter: StoppingReporter) -> None:
    """Read or find the segments of the photos, find the objects where IDs differ between photos, and write masks/."""
    options.masks = chosen_checkpoint(options.masks)
    capture, given = options.capture, options.masks
    segments_by_model = is_checkpoint(given)
    reporter.expect({
        **({_SEGMENT: ("Segmenting", 600.0)} if segments_by_model else {}),
        READ: ("Reading", 5.0), _FIND: ("Comparing", 5.0), _WRITE: ("Writing", 5.0),
    })  # fmt: skip
    require_fitting_options(options, segments_by_model)
    if not capture.is_dir():
        raise InputError(f"The capture {capture} does not exist; expected a folder with images/.")
    if not segments_by_model:
        reporter.begin(READ, "Reading the masks")
    model = _model(capture, needed=options.objects == "find" or segments_by_model)
    own = Photos(capture)
    images, names = own.folder, own.names
    if model is not None:
        model = _with_names_of_files(model, images)
        names = sorted(image.name for image in model.images)
    if not names:
        raise InputError(f"{capture / 'images'} contains no photos; put them there.")
    _require_replaceable(capture, given)
    if segments_by_model:
        source: MaskSource = segmented(options, names, reporter, _SEGMENT)
        reporter.begin(READ, "Reading the segments")
    else:
        source = open_source(given, capture, names)
    photos = [name for name in source.photos if name in set(names)]
    segments = {name: _Packed(_checked(source, name, images, given)) for name in _counted(photos, reporter)}
    if not any(found.objects for found in segments.values()):
        if options.text is not None:
            raise InputError(f"No photo shows {_listed(options.text)} as far as the model finds; use other words.")
        if segments_by_model:
            raise InputError(f"The model in {given} finds no segments in the {len(photos)} photos; use another one.")
        raise InputError(f"{given} shows no object in the {len(photos)} photos that it has masks of; check the masks.")
    reporter.begin(_FIND, "Comparing the segments of the photos")
    former = read_former(capture, photos, source.what)
    found, association, seen = _objects(segments, model, options.objects, former, reporter)
    found = _named(found, association, segments, former, reporter)
    if options.text is not None:
        _warn_of_missing(options.text, segments, found, reporter)
    reporter.begin(_WRITE, f"Writing masks of {len(photos)} photos")
    record = _record(source, given, found, association, former)
    _write(capture, given, _drawn(segments, found, association, seen, reporter), found, record)
    _report(record, reporter)
    reporter.done(masks=str(capture / "masks"), photos=len(photos), result=record)


def _model(capture: Path, needed: bool) -> Model | None:
    """Return the model of the capture's cameras; None if there is none, unless it is needed."""
    try:
        return read_capture_model(capture)
    except InputError as error:
        if needed:
            raise InputError(f"Objects are found by the points of the photos: {error}") from error
        return None


def _with_names_of_files(model: Model, images: Path) -> Model:
    """Return the model with the photos that exist, which may be spelled differently in it, by the names of their files.

    A photo that is missing is no reason to refuse the masks of the others.
    """
    there = Files(images)
    found = [(image, there.find(image.name)) for image in model.images]
    present = [replace(image, name=path.relative_to(images).as_posix()) for image, path in found if path is not None]
    return replace(model, images=present)


def _require_replaceable(capture: Path, given: Path) -> None:
    """Raise InputError if the capture has masks that are neither the given ones nor made here."""
    folder = capture / "masks"
    if given.resolve() == folder.resolve():
        if is_made_of_others(folder):
            raise InputError(f"{folder} was made of other masks, which {folder / RECORD} names; give those.")
        require_place_for_given(capture)
    elif folder.exists() and not is_made(folder):
        raise InputError(f"{folder} exists; move it elsewhere, or give it as the masks.")


def _counted(photos: Sequence[str], reporter: StoppingReporter) -> Iterator[str]:
    """Yield the photos, and report the progress."""
    for done, name in enumerate(photos, 1):
        yield name
        reporter.progress(done, len(photos), what="photos")


def _checked(source: MaskSource, name: str, images: Path, given: Path) -> Segments:
    """Read the segments of a photo; raises InputError if their size does not fit it."""
    found = source.read(name)
    height, width = found.numbers.shape
    size = image_size(images / name)
    if not same_shape((width, height), size):
        raise InputError(
            f"{given} has a mask of {width}x{height} pixels for {name}, which is {size[0]}x{size[1]}; make masks of "
            "the capture's photos."
        )
    return found


# --- objects ---------------------------------------------------------------------------------------------------------


def _objects(
    segments: dict[str, _Packed], model: Model | None, how: str, former: FormerMasks, reporter: StoppingReporter
) -> tuple[_Found, Association | None, dict[str, Seen]]:
    """Return the objects of the segments: those that the source says, or those found by the model's points."""
    seen = {} if model is None else _seen(segments, model)
    given = None if any(None in found.objects for found in segments.values()) else _given(segments, former)
    if how == "given" and given is None:
        raise InputError("The masks do not say which segments show the same object; use --objects find.")
    if given is None and model is None:
        raise InputError(
            "The masks do not say which segments show the same object, and the capture has no cameras and points to "
            "find out; run `sfm` first."
        )
    if given is not None and (how == "given" or model is None):
        return given, None, seen
    if given is not None and how == "auto":
        agrees = consistency([given.ids[name][photo.segments] for name, photo in seen.items()], list(seen.values()))
        if agrees >= _CONSISTENT:
            return given, None, seen
        reporter.warning(
            f"The IDs agree between photos on {agrees:.0%} of the points only, so objects are found anew; --objects "
            "given keeps the IDs."
        )
    assert model is not None
    association = associate(list(seen.values()), len(model.xyz))
    association = former.with_ids(association, seen, {name: own.shape for name, own in segments.items()})
    ids = dict(zip(seen, association.objects, strict=True))
    if not any(part.any() for part in ids.values()):
        raise InputError("No segments of two photos show the same points, so no object was found; check the masks.")
    return _Found(ids, _names(segments, ids), {}), association, seen


def _warn_of_missing(
    names: Sequence[str], segments: dict[str, _Packed], found: _Found, reporter: StoppingReporter
) -> None:
    """Warn of names that no segment has, and of those that segments have, but no object."""
    shown = {name for own in segments.values() for name in own.names}
    if missing := [name for name in names if name not in shown]:
        reporter.warning(f"No photo shows {_listed(missing)} as far as the model finds; other words may help.")
    if lost := [name for name in names if name in shown and name not in found.names.values()]:
        reporter.warning(
            f"No object is named {_listed(lost)}, since only single photos show it, or most show it by another name."
        )


def _listed(names: Sequence[str]) -> str:
    """Return names as a part of a sentence."""
    return " or ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


def _given(segments: dict[str, _Packed], former: FormerMasks) -> _Found:
    """Return the objects that the source says; whole numbers are IDs, and others get former or new ones."""
    known = {key for found in segments.values() for key in found.objects}
    numbers: dict[Hashable, int] = {key: key for key in known if isinstance(key, int) and 0 < key <= LARGEST_ID}
    if len(numbers) < len(known) or any(former.ids.get(key, key) != key for key in numbers):
        new = sorted((key for key in known if key not in former.ids), key=str)
        numbers = {key: former.ids[key] for key in known if key in former.ids}
        numbers |= {key: number for number, key in enumerate(new, former.largest_id + 1)}
    ids = {name: np.array([0, *(numbers[key] for key in found.objects)], np.int64) for name, found in segments.items()}
    texts = {number: key for key, number in numbers.items() if isinstance(key, str)}
    return _Found(ids, {**_names(segments, ids), **texts}, {number: key for key, number in numbers.items()})


def _named(
    found: _Found,
    association: Association | None,
    segments: dict[str, _Packed],
    former: FormerMasks,
    reporter: StoppingReporter,
) -> _Found:
    """Return the objects with names for all, and warn of IDs that were those of other objects."""
    others: list[int] = []
    if association is None:
        others = former.others((name, found.ids[name][own.numbers]) for name, own in segments.items())
    if others:
        shown = ", ".join([*map(str, others[:_LISTED]), *(["..."] if len(others) > _LISTED else [])])
        reporter.warning(
            f"The masks before had other objects with the IDs {shown}, whose edits the new ones get; check these in "
            "the list of objects."
        )
    return found._replace(names=former.named(found.names, found.keys, others))


def _names(segments: dict[str, _Packed], ids: dict[str, np.ndarray]) -> dict[int, str]:
    """Return the most frequent name of each object's segments, or ""."""
    named: dict[int, Counter[str]] = {}
    for photo, of in ids.items():
        for object_id, name in zip(of[1:].tolist(), segments[photo].names, strict=True):
            if object_id:
                named.setdefault(object_id, Counter())[name] += bool(name)
    common = {object_id: counts.most_common(1)[0] for object_id, counts in sorted(named.items())}
    return {object_id: name if count else "" for object_id, (name, count) in common.items()}


def _seen(segments: dict[str, _Packed], model: Model) -> dict[str, Seen]:
    """Return the points that each photo with masks shows, and their segments."""
    images = [image for image in model.images if image.name in segments]
    seen = {}
    projected = with_observations(replace(model, images=images), _POINTS).images
    for image, shown in zip(images, projected, strict=True):
        camera, numbers = model.cameras[image.camera_id], segments[image.name].numbers
        points = np.concatenate([image.point_index, shown.point_index])
        xy = np.concatenate([image.xy, shown.xy]) * (numbers.shape[1] / camera.width, numbers.shape[0] / camera.height)
        inside = ((xy >= 0) & (xy < numbers.shape[::-1])).all(1)
        points, first = np.unique(points[inside], return_index=True)
        at = xy[inside][first].astype(np.int64)
        is_certain = np.flatnonzero(inside)[first] < len(image.point_index)
        seen[image.name] = Seen(
            points, at, numbers[at[:, 1], at[:, 0]].astype(np.int64), is_certain, len(segments[image.name].objects)
        )
    return seen


# --- files -----------------------------------------------------------------------------------------------------------


def _drawn(
    segments: dict[str, _Packed],
    found: _Found,
    association: Association | None,
    seen: dict[str, Seen],
    reporter: StoppingReporter,
) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the name and the mask of each photo."""
    for done, (name, own) in enumerate(segments.items(), 1):
        if association is None:
            yield name, found.ids[name][own.numbers]
        else:
            yield name, object_mask(own.numbers, seen[name], found.ids[name], association.points)
        reporter.progress(done, len(segments), what="photos")


def _record(
    source: MaskSource, given: Path, found: _Found, association: Association | None, former: FormerMasks
) -> dict[str, Any]:
    """Return the content of masks.json."""
    shown_in = Counter(i for ids in found.ids.values() for i in np.unique(ids).tolist())
    agreement = (
        None if association is None else dict(zip(found.ids, association.agreement.round(4).tolist(), strict=True))
    )
    return {
        "source": str(given.resolve()),
        "kind": source.what,
        "found": association is not None,
        "largest_id": max(former.largest_id, *found.names, 0),
        "objects": [
            {"id": i, "name": name, "photos": shown_in[i], **({"key": found.keys[i]} if i in found.keys else {})}
            for i, name in found.names.items()
        ],
        "agreement": agreement,
    }


def _write(
    capture: Path, given: Path, drawn: Iterable[tuple[str, np.ndarray]], found: _Found, record: dict[str, Any]
) -> None:
    """Write the masks, which replace those of an earlier run when they are complete, and labels.json."""
    photos, is_kept = Photos(capture).folder, given.resolve() == (capture / "masks").resolve()
    was_made, labels = is_made(capture / "masks"), capture / "labels.json"
    if is_kept:
        record["source"] = str(kept_masks(capture).resolve())
    with new_masks(capture, kept_masks(capture) if is_kept else None) as folder:
        sheet = MaskSheet(len(found.ids))
        for name, mask in drawn:
            write_mask(folder, name, mask)
            sheet.add(name, mask, lambda photo=photos / name: np.asarray(read_image(photo)))  # type: ignore[misc]
        sheet.save(folder / OVERVIEW, found.names)
        write_json(folder / RECORD, record)
    if not was_made:
        # Beside the given masks, the names are those of their IDs, also where labels.json has later ones.
        has_other_ids = is_kept and record["found"]
        _keep_labels(labels, kept_masks(capture) / labels.name if has_other_ids else capture / _GIVEN_LABELS, found)
    write_json(labels, {str(i): name for i, name in found.names.items()})


def _keep_labels(labels: Path, kept: Path, found: _Found) -> None:
    """Copy a labels.json that was not made here, unless it has the same names."""
    with suppress(InputError):
        if read_names(labels.parent) == found.names:
            return
    if labels.is_file() and not kept.exists():
        shutil.copyfile(labels, kept)


def _report(record: dict[str, Any], reporter: StoppingReporter) -> None:
    """Tell what was found."""
    for entry in record["objects"]:
        reporter.status(f"object {entry['id']} {entry['name']}: in {entry['photos']} photos")
    agreement = record["agreement"]
    if agreement:
        worst = min(agreement, key=agreement.get)
        mean = sum(agreement.values()) / len(agreement)
        reporter.status(
            f"The segments agree with the objects on {mean:.0%} of the points; least in {worst}, on "
            f"{agreement[worst]:.0%}"
        )
