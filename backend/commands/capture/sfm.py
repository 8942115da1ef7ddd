"""`sfm`: makes a capture of photos alone, with poses and points computed by COLMAP."""

from __future__ import annotations

import argparse
import os
import shutil
import time
import unicodedata
from collections.abc import Collection, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pycolmap

from ...capture import BLURRED, load_capture, measure_contrasts
from ...sfm import check, database, model
from ...sfm.agreement import measure_agreement
from ...sfm.former_frame import former_poses, poses_of, similarity
from ...sfm.learned.checkpoint import LOFTR, kind_of
from ...sfm.learned.lightglue import LightGlue
from ...sfm.learned.loftr import EfficientLoFTR
from ...sfm.location import common_up, meters_per_unit, positions_in_meters, ups_in_cameras
from ...sfm.pairs import ALL_UP_TO, NEIGHBORS
from ...sfm.rig import rigs_of
from ...sfm.sources.calibration import photos_by_camera, read_calibration
from ...sfm.sources.photos import Photo, are_copied, take_photos
from ...sfm.sources.stamps import IMAGES
from ...sfm.stages import run_stage
from ...shared.errors import Cancelled, InputError
from ...shared.events import Reporter
from ...shared.formats.atomic import make_folder, recorded, require_still_there
from ...shared.formats.file_names import legible
from ...shared.formats.json_file import read_json, write_json
from ...shared.formats.photos_source import (
    PHOTOS,
    REPORT,
    SOURCE,
    VIDEOS,
    WORK,
    PhotosSource,
    read_source,
    write_source,
)
from ...shared.photos.former_model import undo_killed_run
from ...shared.photos.source_files import digest_of_files
from ...shared.reconstruction.folder import IGNORED
from ...shared.reconstruction.lock import locked
from ...shared.stopping import StoppingReporter
from ...stereo.dense_points import find_dense_points
from .photo_matches import GROUPS, LOG, Wanted, match_photos

PICTURE = "sfm.png"

_EXTRACT, _MATCH, _MAP, _DENSE = 0.5, 0.03, 0.3, 0.6
"""Expected seconds of the stages for each photo, pair, photo and photo on two cores, until the pace is known."""
_COMPARE = 0.0006
"""Those of a pair of photos that are compared to choose what is matched."""
_EXTRACT_LEARNED, _MATCH_LEARNED = 1.0, 1.5
"""Those of SuperPoint and LightGlue."""
_MATCH_LOFTR, _JOIN = 12.0, 0.02
"""Those of a pair by EfficientLoFTR."""
_ENOUGH = 0.95
"""Fraction of photos with trusted poses from which on the result of the first mapper is kept."""
_WORST = 10
_STOPPED = "Stopped; features and matches are kept. Run the same command again to continue."


def sfm(options: argparse.Namespace, reporter: StoppingReporter) -> None:
    """Find features, match the photos, compute poses and points, and write CAPTURE/sparse/0 and sfm/sfm.json."""
    listed, unwanted = ([], []) if options.list is None else _read_list(options.list)
    sources, leave_out = [*options.photos, *listed], [*options.leave_out, *unwanted]
    capture = options.out.absolute()  # COLMAP's processes run in another folder.
    undo_killed_run(capture)
    before = read_source(capture)
    if before is not None and before.photos == [path.resolve() for path in sources] and are_copied(sources, capture):
        reporter.warning(f"{_missing(sources)} does not exist any more, so its copies in {capture / IMAGES} are used.")
    else:
        _require_sources(sources)
    if options.calibration is not None:
        read_calibration(options.calibration)
    _require_own(sources[0], capture)
    if options.matcher is not None:
        # Before anything is written, it says what is wrong with the folder.
        (EfficientLoFTR if kind_of(options.matcher) == LOFTR else LightGlue)(options.matcher)
    with recorded() as created:
        try:
            make_folder(capture / WORK)
            with locked(capture / WORK):
                made_from = PhotosSource(
                    sources, options.cameras, options.frames, leave_out, options.features, options.set,
                    options.calibration,
                    options.matcher,
                )  # fmt: skip
                # Until there is a new model, the file says what the present one was computed from.
                if before is None or not (capture / model.SPARSE).exists():
                    write_source(capture, made_from)
                _run(made_from, capture, reporter)
        except InputError:
            if not any((capture / WORK).glob("*.db")):
                created.remove_files()
                created.remove_folders()
            raise


def _read_list(path: Path) -> tuple[list[Path], list[str]]:
    """Read a list of photos, and of names to leave out."""
    stored = read_json(path)
    try:
        photos, leave_out = stored.get("photos", []), stored.get("leave_out", [])
        return [Path(photo) for photo in photos], [str(name) for name in leave_out]
    except (AttributeError, TypeError) as error:
        raise InputError(f'{path} is no list of photos; expected {{"photos": [...], "leave_out": [...]}}.') from error


def _missing(sources: list[Path]) -> Path:
    """Return the first source that does not exist."""
    return next(path for path in sources if not path.exists())


def _require_sources(sources: list[Path]) -> None:
    """Raise InputError unless the sources are a folder, or files of photos and videos."""
    if not all(path.exists() for path in sources):
        raise InputError(f"{_missing(sources)} does not exist; choose a folder of photos, or a video.")
    for path in sources:
        if legible(str(path)) != str(path):
            raise InputError(f"{legible(str(path))} is a name that is not text in UTF-8; rename it.")
        if path.is_dir() and len(sources) > 1:
            raise InputError(f"{path} is a folder beside other photos; choose one folder, or files.")
        if path.is_file() and path.suffix.lower() not in PHOTOS | VIDEOS:
            raise InputError(f"{path} is neither a photo nor a video that can be read; choose another file.")


def _require_own(source: Path, capture: Path) -> None:
    """Raise InputError if the capture's folder has files of others, or a model that this command has not made."""
    if not capture.exists() or (capture / WORK / SOURCE).exists():
        return
    if not capture.is_dir():
        raise InputError(f"{capture} is a file; choose another --out.")
    is_source = source.resolve() in (capture.resolve(), (capture / IMAGES).resolve())
    if (capture / "sparse").exists():
        raise InputError(f"{capture} has a COLMAP model already, {capture / 'sparse'}; choose another --out.")
    if is_source and (capture / IMAGES).is_dir():
        return
    if any(path.name not in (*IGNORED, WORK) for path in capture.iterdir()) or _has_files(capture / WORK):
        raise InputError(f"{capture} contains other files; choose a new folder as --out.")


def _has_files(work: Path) -> bool:
    """Return whether a folder sfm/ that this command has not made has files."""
    return work.exists() and (not work.is_dir() or any(path.name not in IGNORED for path in work.iterdir()))


def _run(made_from: PhotosSource, capture: Path, reporter: StoppingReporter) -> None:
    started = time.monotonic()
    work = capture / WORK
    images, log = capture / IMAGES, work / LOG
    kind = None if made_from.matcher is None else kind_of(made_from.matcher)
    joining = {"join": ("Matching", 1.0)} if kind == LOFTR else {}
    reporter.expect({
        "photos": ("Photos", 2.0), "extract": ("Features", 30.0), "pairs": ("Pairs", 0.1), "match": ("Matching", 30.0),
        **joining,
        "global": ("Poses", 10.0), "incremental": ("Poses", 5.0), "refine": ("Poses", 2.0), "dense": ("Points", 10.0),
    })  # fmt: skip
    reporter.begin("photos", "Reading the photos")
    files = digest_of_files(made_from, capture)
    lenses = () if made_from.calibration is None else read_calibration(made_from.calibration)
    photos, unreadable, videos = take_photos(made_from.photos, capture, made_from.frames, reporter, lenses)
    if are_copied(made_from.photos, capture):
        source = images
    else:
        source = made_from.photos[0] if len(made_from.photos) == 1 else made_from.photos[0].parent
    unwanted = _unwanted(made_from.leave_out, photos, unreadable, reporter)
    photos = [photo for photo in photos if photo.name not in unwanted]
    names = [photo.name for photo in photos]
    count = len(photos)
    if count < 2:
        raise InputError(f"Too few photos are left in {source}; leave out fewer.")
    pairs_expected = min(count * (count - 1) / 2, NEIGHBORS * count)
    per_photo, per_pair = (_EXTRACT, _MATCH) if kind is None else (_EXTRACT_LEARNED, _MATCH_LEARNED)
    if kind == LOFTR:
        per_photo, per_pair = _EXTRACT if count > ALL_UP_TO else 0.0, _MATCH_LOFTR
        reporter.expect({"join": ("Matching", _JOIN * pairs_expected)})
    if count > ALL_UP_TO:
        reporter.expect({"pairs": ("Pairs", _COMPARE * count * (count - 1) / 2)})
    reporter.expect({
        "extract": ("Features", per_photo * count), "match": ("Matching", per_pair * pairs_expected),
        "global": ("Poses", _MAP * count), "incremental": ("Poses", 0.1 * _MAP * count),
        "refine": ("Poses", 0.2 * _MAP * count), "dense": ("Points", _DENSE * count),
    })  # fmt: skip

    groups = _groups(photos, images, made_from)
    if (work / GROUPS).exists() and _have_other_cameras(read_json(work / GROUPS), groups):
        database.remove_all(work)
    write_json(work / GROUPS, groups)
    calibrated = ["calibrated"] if made_from.calibration else []
    listed_names = work / "names.json"
    write_json(listed_names, names)
    wanted = Wanted(capture, names, videos, made_from.matcher)
    path = match_photos(wanted, source, made_from.features == "objects", reporter)
    on_objects = path.name.endswith(database.ON_OBJECTS)

    candidates: list[model.Candidate] = []
    has_failed = False
    for mapper in ("global", "incremental"):
        best = model.best_of(candidates)
        if best is not None and len(best.agreement.trusted) >= _ENOUGH * count:
            break
        reporter.begin(mapper, f"Computing poses ({mapper})")
        out = work / mapper
        shutil.rmtree(out, ignore_errors=True)
        require_still_there(work)
        make_folder(out)
        arguments = [mapper, str(path), str(images), str(out), str(listed_names), *calibrated]
        has_failed |= not run_stage(reporter, log, arguments, lambda lines: lines, count)
        candidate = model.read_candidate(mapper, out, path, made_from.set)
        if candidate is not None:
            candidates.append(candidate)
    best = model.best_of(candidates)
    if best is None and made_from.set > 1:
        raise InputError(f"The photos in {source} form fewer than {made_from.set} separate sets; use a smaller --set.")
    if best is None or len(best.agreement.trusted) < 2:
        raise InputError(
            f"The photos in {source} do not fit together: no two of them show the same scene from different places "
            "with enough detail; take more photos, each overlapping the one before by two thirds."
            + (f" If they do fit, {log} tells why COLMAP has failed." if has_failed else "")
        )
    wrong = model.drop_untrusted(best)
    model.require_parallax(best.model, source)
    best = best._replace(model=_refined(best.model, path, log, [str(listed_names), *calibrated], reporter))
    best = best._replace(agreement=measure_agreement(best.model, path))
    figures = check.figures_of(best.model, best.agreement)
    weak = check.weak_photos(figures)
    by_gps = meters_per_unit(model.centers_of(best.model), positions_in_meters(images, figures))
    _place(best.model, capture, by_gps)
    up = common_up(model.rotations_of(best.model), ups_in_cameras(images, figures))
    with model.former_on_error(capture):
        model.write_model(best.model, capture)
        write_source(capture, replace(made_from, features="objects" if on_objects else "auto"))
        weak |= _densify(best.model, capture, on_objects, reporter)
        check.write_picture(work / PICTURE, best.model, figures, path, list(weak))
        posed = list(figures)
        left_out = {**unreadable, **unwanted, **model.reasons(path, names, posed, wrong)}
        report = {
            "photos": len(names) + len(unreadable) + len(unwanted),
            "registered": len(posed),
            "points": best.model.num_points3D(),
            "reprojection_error": round(check.mean_error(best.model), 4),
            "mapper": best.mapper,
            "cameras": best.model.num_cameras(),
            "rigs": rigs_of(best.model),
            "set": made_from.set,
            "separate_sets": best.sets if len(best.sets) > 1 else [],
            "size_by_gps": by_gps is not None,
            "up": None if up is None else up.tolist(),
            "figures": {name: own._asdict() for name, own in figures.items()},
            "weak": weak,
            "left_out": left_out,
            "files": files,
            "seconds": round(time.monotonic() - started, 1),
        }
        write_json(work / REPORT, report)
    _tell(report, capture, reporter)


def _unwanted(
    leave_out: Iterable[str], photos: list[Photo], unreadable: Collection[str], reporter: Reporter
) -> dict[str, str]:
    """Return the photos that are left out, with the reason; warns of names that no photo has."""

    def stem(name: str) -> str:
        # Photos that were converted have another suffix.
        path, suffix = os.path.splitext(name)  # noqa: PTH122 - names may have no stem
        return path if suffix.lower() in PHOTOS else name

    composed = {unicodedata.normalize("NFC", photo.name): photo.name for photo in photos}
    names = {**{stem(name): photo for name, photo in reversed(composed.items())}, **composed}
    found, missing = {}, []
    for given in leave_out:
        name = unicodedata.normalize("NFC", given)
        photo = names.get(name) or names.get(stem(name))
        if photo is not None:
            found[photo] = "it was left out by request"
        elif given not in unreadable:
            missing.append(given)
    if missing:
        reporter.warning(f"No photo is named {', '.join(missing)}, so nothing was left out for that.")
    return found


def _place(found: pycolmap.Reconstruction, capture: Path, by_gps: float | None) -> None:
    """Scale a model, and place it where that of an earlier run was, since a scene may have been set up there."""
    former = former_poses(capture) if _had_size_by_gps(capture) == (by_gps is not None) else {}
    as_before = similarity(poses_of(found), former)
    model.transform(found, model.scaling(by_gps or model.common_size(found)) if as_before is None else as_before)


def _had_size_by_gps(capture: Path) -> bool:
    """Return whether an earlier run has found the scene's true size."""
    try:
        return read_json(capture / WORK / REPORT)["size_by_gps"] is True
    except (InputError, KeyError, TypeError):
        return False


def _refined(
    found: pycolmap.Reconstruction, path: Path, log: Path, options: list[str], reporter: StoppingReporter
) -> pycolmap.Reconstruction:
    """Return a model after a last adjustment, or the model itself if that fails; path: of the database."""
    reporter.begin("refine", "Refining lenses and poses")
    before, after = path.parent / "chosen", path.parent / "refined"
    for folder in (before, after):
        shutil.rmtree(folder, ignore_errors=True)
        require_still_there(path.parent)
        make_folder(folder)
    found.write(before)
    if run_stage(reporter, log, ["refine", str(before), str(after), str(path), *options], lambda lines: lines, 1):
        return pycolmap.Reconstruction(after)
    reporter.warning(f"The lenses and poses could not be refined and are less exact; {log} tells why.")
    return found


def _densify(
    found: pycolmap.Reconstruction, capture: Path, on_objects: bool, reporter: StoppingReporter
) -> dict[str, str]:
    """Add points where features are few, from patches of the photos, and remove those in front of surfaces.

    Args:
        found: the model.
        capture: the capture, which has it.
        on_objects: whether only what masks show as objects belongs to the scene.
        reporter: receives progress.

    Returns:
        The photos that are blurred: name -> reason.
    """
    reporter.begin("dense", "Finding points on plain surfaces")
    scratch = capture / WORK / "undistorted"
    shutil.rmtree(scratch, ignore_errors=True)
    try:
        photos = load_capture(capture, scratch, reporter=_StopsOnly(reporter), photos_only=not on_objects)
        points = find_dense_points(photos, range(len(photos.views)), reporter.progress)
        model.remove_points(found, photos.points.ids[points.in_front])
        model.add_points(found, points.xyz, points.rgb)
        model.write_model(found, capture)
        contrasts = measure_contrasts(photos, range(len(photos.views)), reporter.check)
    except Cancelled as error:
        raise Cancelled(_STOPPED) from error
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    return {
        view.name: f"it is blurred, its details have {contrast:.0%} of the contrast that they have in other photos"
        for view, contrast in zip(photos.views, contrasts, strict=True)
        if contrast < BLURRED
    }


class _StopsOnly(Reporter):
    """Says nothing, but ends what reports its progress when the user has stopped the command."""

    def __init__(self, reporter: StoppingReporter) -> None:
        self._reporter = reporter

    def progress(self, *_: Any, **_fields: Any) -> None:
        if self._reporter.stop():
            raise Cancelled(_STOPPED)


def _groups(photos: list[Photo], images: Path, made_from: PhotosSource) -> list[dict[str, Any]]:
    """Return the names of the photos of each camera, and its lens if that is known."""
    if made_from.calibration is not None:
        known = photos_by_camera(photos, images, read_calibration(made_from.calibration), made_from.calibration)
        return [
            {"names": names, "camera": {"model": camera.model, "params": list(camera.params)}}
            for names, camera in known
        ]
    groups: dict[str, list[str]] = {}
    for photo in photos:
        key = {"one": photo.size, "each": photo.name}.get(made_from.cameras, photo.camera)
        groups.setdefault(key, []).append(photo.name)
    return [{"names": names, "camera": None} for names in groups.values()]


def _have_other_cameras(before: list[dict[str, Any]], now: list[dict[str, Any]]) -> bool:
    """Return whether photos share cameras in another way than in an earlier run, or a known lens has changed."""
    common = {name for group in before for name in group["names"]} & {name for group in now for name in group["names"]}

    def shared(groups: list[dict[str, Any]]) -> dict[frozenset[str], dict[str, Any] | None]:
        return {frozenset(common.intersection(each["names"])): each["camera"] for each in groups}

    earlier, later = shared(before), shared(now)
    return any(names not in earlier or earlier[names] not in (None, lens) for names, lens in later.items() if names)


def _tell(report: dict[str, Any], capture: Path, reporter: StoppingReporter) -> None:
    """Report what was found, which photos have no pose and why, and which are weak."""
    path, left_out, weak = capture / WORK / REPORT, report["left_out"], report["weak"]
    number, sets = report["set"], report["separate_sets"]
    if sets:
        reporter.warning(
            f"The photos form {len(sets)} separate sets, of {', '.join(map(str, sets))} photos; set {number} is used. "
            f"Photos that show several sets would connect them; --set {number % len(sets) + 1} uses the next."
        )
    for name, why in list(left_out.items())[:_WORST]:
        reporter.warning(f"{name} has no pose: {why}.")
    if len(left_out) > _WORST:
        reporter.warning(f"{len(left_out) - _WORST} more photos have no pose; {path} lists them.")
    for folders in report["rigs"]:
        reporter.status(f"The cameras of {', '.join(folders)} are a rig: they keep their relative poses.")
    for name, why in list(weak.items())[:_WORST]:
        reporter.warning(f"{name} is weak: {why}.")
    if len(weak) > _WORST:
        reporter.warning(f"{len(weak) - _WORST} more photos are weak; {path} lists them.")
    if weak:
        reporter.warning("If the result looks wrong, compute the poses again without the weak photos.")
    reporter.done(
        message="{registered} of {photos} photos have a pose{doubtful}, with {points:,} points and a mean reprojection "
        "error of {reprojection_error:.2f} pixels.".format(**report, doubtful=f", {len(weak)} weak" if weak else "")
        + (
            " The scene has its true size, by GPS."
            if report["size_by_gps"]
            else " The photos of the scene do not tell its true size."
        ),
        capture=str(capture),
        picture=str(capture / WORK / PICTURE),
        weak=list(weak),
        set=number,
        separate_sets=sets,
        **{key: report[key] for key in ("photos", "registered", "points", "reprojection_error")},
    )
