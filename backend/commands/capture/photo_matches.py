"""Features and matches of photos for `sfm`: by SIFT, or by the networks of a checkpoint."""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import pycolmap

from ...sfm import database, model
from ...sfm.background import stands_still
from ...sfm.learned import positions
from ...sfm.learned.checkpoint import LOFTR, fingerprint, kind_of
from ...sfm.pairs import ALL_UP_TO, choose_pairs
from ...sfm.sources.masks import write_object_masks
from ...sfm.sources.stamps import IMAGES, MASKS
from ...sfm.stages import run_stage
from ...shared.errors import InputError
from ...shared.formats.photos_source import WORK
from ...shared.stopping import StoppingReporter

GROUPS, LOG = "groups.json", "colmap.log"
"""Files in sfm/: which photos share a camera, and COLMAP's messages."""

_PAIRS = "pairs.txt"
_OBJECT_MASKS = "masks"


class Wanted(NamedTuple):
    """Photos to match.

    Attributes:
        capture: folder of the capture, with images/ and sfm/groups.json.
        names: the photos.
        videos: the names of the frames of each video in their order, so that neighbors show the same.
        matcher: folder with the checkpoint of networks, or None for SIFT.
    """

    capture: Path
    names: list[str]
    videos: list[list[str]]
    matcher: Path | None


def match_photos(wanted: Wanted, source: Path, on_objects: bool, reporter: StoppingReporter) -> Path:
    """Match photos, and verify the matches; what is known already is kept.

    Where the background stands still while the objects turn, only what is on objects is used, if there are masks.

    Args:
        wanted: the photos.
        source: where they come from, for errors.
        on_objects: whether only what is on objects is used in any case.
        reporter: receives progress.

    Returns:
        The database with features and verified matches.

    Raises:
        Cancelled: The user has stopped it.
        InputError: The photos cannot be matched, or show nothing in common from different places.
    """
    if on_objects:
        write_object_masks(wanted.capture, wanted.names, wanted.capture / WORK / _OBJECT_MASKS, reporter)
    if wanted.matcher is not None and kind_of(wanted.matcher) == LOFTR:
        path = _match_places(wanted, wanted.matcher, on_objects, reporter)
    else:
        path = _match_features(wanted, on_objects, reporter)
    if not on_objects and stands_still(path, wanted.names):
        if not (wanted.capture / MASKS).is_dir():
            raise InputError(model.still_background(source))
        reporter.warning("The background stands still while the objects turn: only features on objects are used.")
        return match_photos(wanted, source, True, reporter)
    _require_matches(path, wanted.names, source)
    return path


def _match_features(wanted: Wanted, on_objects: bool, reporter: StoppingReporter) -> Path:
    """Match features that are found in each photo, by SIFT or by LightGlue; return the database."""
    path = _find_features(wanted, on_objects, reporter)
    pairs = _choose_pairs(path, wanted, reporter)
    stage = ["match"] if wanted.matcher is None else ["match-learned", str(wanted.matcher.resolve())]
    arguments = [*stage, str(path)]
    if pairs is not None:
        arguments.append(str(_write_pairs(wanted, pairs)))
    count = len(wanted.names)
    total = count * (count - 1) // 2 if pairs is None else len(pairs)
    reporter.begin("match", f"Matching {total:,} pairs of photos")
    _match(wanted, reporter, arguments, lambda: database.count_pairs(path), total)
    return path


def _match_places(wanted: Wanted, matcher: Path, on_objects: bool, reporter: StoppingReporter) -> Path:
    """Match places that are found for each pair, by EfficientLoFTR; return the database.

    SIFT tells which pairs of a large set are matched.
    """
    work, network = wanted.capture / WORK, fingerprint(matcher)
    path, matched = work / database.name_of(on_objects, network), work / positions.name_of(network)
    pairs = None
    if len(wanted.names) > ALL_UP_TO:
        by_sift = wanted._replace(matcher=None)
        pairs = _choose_pairs(_find_features(by_sift, on_objects, reporter), by_sift, reporter)
    if pairs is None:
        pairs = list(combinations(wanted.names, 2))
    photos = _photos_of(wanted, on_objects)
    reporter.begin("match", f"Matching {len(pairs):,} pairs of photos")
    arguments = ["match-places", str(matcher.resolve()), str(matched), photos[0], str(_write_pairs(wanted, pairs))]
    _match(wanted, reporter, arguments, lambda: database.count_positions(matched), len(pairs))
    reporter.begin("join", "Joining the matches of all pairs")
    _match(
        wanted,
        reporter,
        ["join-pairs", str(matched), str(path), *photos],
        lambda: database.count_pairs(path),
        len(pairs),
    )
    return path


def _find_features(wanted: Wanted, on_objects: bool, reporter: StoppingReporter) -> Path:
    """Find features of each photo, by SIFT or by SuperPoint; return the database."""
    work, count, matcher = wanted.capture / WORK, len(wanted.names), wanted.matcher
    path = work / database.name_of(on_objects, "" if matcher is None else fingerprint(matcher))
    stage = ["extract"] if matcher is None else ["extract-learned", str(matcher.resolve())]
    arguments = [*stage, str(path), *_photos_of(wanted, on_objects)]
    reporter.begin("extract", f"Finding features in {count} photos")
    if not run_stage(reporter, work / LOG, arguments, lambda _: database.count_features(path), count):
        raise InputError(f"Features could not be found in the photos; see {work / LOG}.")
    return path


def _choose_pairs(path: Path, wanted: Wanted, reporter: StoppingReporter) -> list[tuple[str, str]] | None:
    reporter.begin("pairs", "Comparing the photos")
    return choose_pairs(path, wanted.names, wanted.videos, reporter.progress)


def _write_pairs(wanted: Wanted, pairs: list[tuple[str, str]]) -> Path:
    path = wanted.capture / WORK / _PAIRS
    database.write_pairs(path, pairs)
    return path


def _match(
    wanted: Wanted, reporter: StoppingReporter, arguments: list[str], count: Callable[[], int], total: int
) -> None:
    """Run a stage that matches pairs; raises InputError if it fails."""
    log = wanted.capture / WORK / LOG
    if not run_stage(reporter, log, arguments, lambda _: count(), total):
        raise InputError(f"The photos could not be matched; see {log}.")


def _photos_of(wanted: Wanted, on_objects: bool) -> list[str]:
    """Return the arguments of a stage for the photos: their folder, the groups with a camera each, and masks if any."""
    work = wanted.capture / WORK
    masks = [str(work / _OBJECT_MASKS)] if on_objects else []
    return [str(wanted.capture / IMAGES), str(work / GROUPS), *masks]


def _require_matches(path: Path, names: list[str], source: Path) -> None:
    """Raise InputError if none of the photos match, or all that do were taken from one spot."""
    pairs = database.verified_pairs(path, names)
    if not pairs:
        raise InputError(
            f"No two photos in {source} show the same: they are of different scenes, blurred, or without texture; take "
            "sharp photos that overlap by two thirds."
        )
    still = {
        int(pycolmap.TwoViewGeometryConfiguration.PANORAMIC),
        int(pycolmap.TwoViewGeometryConfiguration.PLANAR_OR_PANORAMIC),
    }
    if all(config in still for _, _, config, _ in pairs):
        raise InputError(model.one_spot(source))
