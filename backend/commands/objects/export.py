"""`export`: write the splats with all edits for other programs."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...capture import Upright
from ...editing import apply_edits, apply_splat_edits, transformed
from ...export import (
    DOWN_TO_UP,
    background_sphere,
    coarser_splats,
    read_splats,
    write_gltf,
    write_splat,
    write_splats,
    write_spz,
    write_usd,
)
from ...model.splats import Splats, concatenate
from ...shared.errors import InputError
from ...shared.formats.file_names import distinct_stems
from ...shared.formats.regular_file import resolved
from ...shared.formats.splat_ply import Description
from ...shared.reconstruction.folder import Reconstruction, require_writable
from ...shared.reconstruction.objects import SceneObject, default_name, find_object, read_objects
from ...shared.reconstruction.record import Record, read_record
from ...shared.stopping import StoppingReporter
from ..cameras import read_upright
from ..folder import READ

_FORMATS = ("ply", "spz", "splat", "glb", "usdc")
"""Formats, as the suffixes of their files."""

_MOST_LISTED = 10
_SKIPPED = "since those that are deleted, cropped, or of removed or left-out objects are skipped."
_Z_TO_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


def export(options: argparse.Namespace, reporter: StoppingReporter) -> None:
    """Write one file, or one for each object."""
    folder = Reconstruction(options.folder)
    record = read_record(folder)
    background = record.export.background if record.export else None
    if options.bake_background and not background:
        raise InputError(f"{folder.settings} names no background to bake; train on, or leave out --bake-background.")
    if options.to_world is not None and options.coordinates != "blender":
        raise InputError("--to-world is for --coordinates blender; add this, or leave out --to-world.")
    if options.per_object and resolved(options.out) == resolved(folder.folder):
        raise InputError(f"{options.out} is the reconstruction's own folder; name another one for the objects' files.")
    require_writable(options.out if options.per_object else options.out.parent, "choose another with --out")
    kind = _format(options)
    objects = read_objects(folder.objects) if folder.objects.exists() else []
    found = [find_object(objects, word, folder.objects) for word in options.objects or ()]
    chosen = {entry.id: entry.name for entry in found}
    reporter.expect({READ: ("Reading", 3.0), "edit": ("Editing", 3.0), "write": ("Saving", 3.0)})
    reporter.begin(READ, f"Reading {folder.splats.name}")
    captured, warnings = read_splats(folder.splats)
    captured, more = apply_splat_edits(captured, folder)
    for sentence in warnings + more:
        reporter.warning(sentence)
    _warn_about_fit(folder, record, reporter)
    reporter.begin("edit", "Applying the edits")
    splats = apply_edits(captured, objects, reporter)
    if chosen:
        splats = splats.select(np.isin(splats.object_ids, list(chosen)))
    if len(splats) == 0:
        raise InputError(f"No splats of {folder.splats} are left to export, {_SKIPPED}")
    present = set(np.unique(splats.object_ids).tolist())
    if gone := [name for object_id, name in chosen.items() if object_id not in present]:
        reporter.warning(f"No splats of {_listed(gone)} are left to export, {_SKIPPED}")
    if splats.unobserved.any():
        reporter.status(f"{splats.unobserved.sum():,} splats fill the holes of removed and moved objects")
    if options.sh_degree is not None:
        splats = splats.with_degree(options.sh_degree)
    sphere = background_sphere(splats, background) if options.bake_background and background else None
    upright = read_upright(folder)
    splats = _in_coordinates(splats, options, upright, kind)
    versions = {options.out: splats}
    if options.levels:
        reporter.status("Merging splats")
        for level, coarser in enumerate(coarser_splats(splats, options.levels), 1):
            versions[options.out.with_name(f"{options.out.stem}-{level}{options.out.suffix}")] = coarser
    if sphere is not None:  # Merged splats of the sphere would have gaps.
        sphere = _in_coordinates(sphere, options, upright, kind)
        versions = {path: concatenate([version, sphere]) for path, version in versions.items()}
        splats = versions[options.out]
    files = {
        path: (version, ids)
        for out, version in versions.items()
        for path, ids in _files(out, options.per_object, splats, objects, kind).items()
    }
    for path in files:
        folder.require_foreign(path)
    up = [0.0, 0.0, 1.0] if options.coordinates == "blender" else upright.rotation[2].tolist()
    description = Description(up, None if options.bake_background else background)
    names = {entry.id: entry.name for entry in objects}
    reporter.begin("write", f"Writing {len(files)} file{'' if len(files) == 1 else 's'}")
    for done, (path, (version, ids)) in enumerate(files.items(), 1):
        path.parent.mkdir(parents=True, exist_ok=True)
        part = version if ids is None else version.select(np.isin(version.object_ids, ids))
        for sentence in _write(path, part, kind, not options.no_ids, description, names):
            reporter.warning(sentence)
        reporter.progress(done, len(files), what="files")
    if options.per_object:
        _warn_about_others(files, reporter)
    reporter.done(exported=str(options.out), files=len(files), splats=len(splats))


def _format(options: argparse.Namespace) -> str:
    """Return the name of the format, which is also the suffix of its files; raises InputError for unknown suffixes."""
    suffix = options.out.suffix[1:].lower()
    suffix = "usdc" if suffix == "usd" else suffix  # A .usd may be of either kind.
    if options.format or options.per_object or not suffix:
        return options.format or "ply"
    if suffix not in _FORMATS:
        raise InputError(
            f"{options.out} ends in .{suffix}, but splats are written as .{', .'.join(_FORMATS[:-1])} or "
            f".{_FORMATS[-1]}; name such a file, or choose a --format."
        )
    return suffix


def _write(
    path: Path, splats: Splats, kind: str, with_ids: bool, description: Description, names: Mapping[int, str]
) -> list[str]:
    """Write a file in a format, with the IDs and names of the objects where it has them; returns warnings."""
    if kind == "spz":
        return write_spz(path, splats)
    if kind == "splat":
        return write_splat(path, splats)
    if kind == "ply":
        present = np.unique(splats.object_ids).tolist() if with_ids else ()
        return write_splats(
            path, splats, with_ids, replace(description, names={i: names[i] for i in present if i in names})
        )
    if not with_ids:
        splats, names = replace(splats, object_ids=np.zeros_like(splats.object_ids)), {0: path.stem}
    named = {i: names.get(i, default_name(i)) for i in np.unique(splats.object_ids).tolist()}
    return write_gltf(path, splats, named) if kind == "glb" else write_usd(path, splats, named)


def _warn_about_others(files: Iterable[Path], reporter: StoppingReporter) -> None:
    """Warn if folders with one file per object hold other files of the format, as of objects that were renamed."""
    written = {path.with_name(path.name.lower()) for path in files}
    for folder in sorted({path.parent for path in files}):
        same = (path for path in folder.iterdir() if path.suffix.lower() in {own.suffix for own in written})
        others = sorted(path.name for path in same if path.with_name(path.name.lower()) not in written)
        if others:
            reporter.warning(
                f"{folder} also contains {_listed(others)}, which this export did not write; delete what is of an "
                "earlier one."
            )


def _listed(names: list[str]) -> str:
    more = f" and {len(names) - _MOST_LISTED} more" if len(names) > _MOST_LISTED else ""
    return f"{', '.join(names[:_MOST_LISTED])}{more}"


def _warn_about_fit(folder: Reconstruction, record: Record, reporter: StoppingReporter) -> None:
    """Warn if the splats are only a fit of the trained model, with its PSNR."""
    psnr = record.export.psnr_of_export if record.export else None
    if psnr is not None and record.training and record.training.settings.get("mode") != "explicit":
        reporter.warning(
            f"{folder.splats.name} is a fit of a model whose splats change with the camera; its PSNR to renders of "
            f"that model is {psnr:.1f} dB."
        )


def _in_coordinates(splats: Splats, options: argparse.Namespace, upright: Upright, kind: str) -> Splats:
    """Return the splats in the capture's coordinates, or as they are in Blender, in the axes of the format.

    In Blender's coordinates, SPZ and glTF are Y up. In those of the capture, only SPZ, which has axes of its own,
    differs from COLMAP.
    """
    if options.coordinates == "blender":
        splats = replace(splats, means=splats.means.astype(np.float64) - upright.origin)
        stand = np.eye(4)
        stand[:3, :3], stand[:3, 3] = upright.rotation, upright.translation
        if options.to_world is not None:
            stand = np.array(options.to_world)
        return transformed(splats, (_Z_TO_Y_UP if kind in ("spz", "glb") else np.eye(4)) @ stand)
    return transformed(splats, DOWN_TO_UP) if kind == "spz" else splats


def _files(
    out: Path, per_object: bool, splats: Splats, objects: list[SceneObject], kind: str
) -> dict[Path, list[int] | None]:
    """Return path -> IDs of the splats in this file, None: all."""
    if not per_object:
        if out.is_dir():
            raise InputError(f"{out} is a folder; name a file, such as {out / f'splats.{kind}'}.")
        return {out: None}
    if out.exists() and not out.is_dir():
        raise InputError(f"{out} is a file; with --per-object, name a folder.")
    known = {entry.id: entry.name for entry in objects}
    names = {i: known.get(i, default_name(i).lower()) for i in np.unique(splats.object_ids).tolist()}
    return {out / f"{stem}.{kind}": [i] for i, stem in distinct_stems(names).items()}
