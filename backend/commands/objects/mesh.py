"""`mesh`: make a textured mesh of each object, of sets of objects or of the whole scene, in DIR/meshes."""

from __future__ import annotations

import argparse
import io
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from ...mesh.field.extract import extract, is_watertight
from ...mesh.field.fusion import fuse
from ...mesh.refine import refine
from ...mesh.smooth import smooth
from ...mesh.surface import NoSurface, Surface
from ...mesh.texture.bake import bake_texture, texture_size
from ...mesh.texture.unwrap import unwrap
from ...mesh.views import Views
from ...model.object_model import ObjectModel
from ...raster import devices
from ...shared.errors import InputError, NothingMade
from ...shared.events import Reporter
from ...shared.formats.atomic import write_atomic
from ...shared.formats.file_names import hashed_stem
from ...shared.formats.mesh_ply import Mesh, write_mesh
from ...shared.reconstruction.folder import Reconstruction
from ...shared.reconstruction.meshes import MeshEntry, read_meshes, read_waiting, write_meshes
from ...shared.reconstruction.objects import default_name, find_object, members_of, read_objects, shown_as
from ...shared.stopping import StoppingReporter
from ..folder import READ, Trained, locked_reconstruction, memory_for_targets, open_trained, with_corrected_masks
from ..setup.device import choose_device
from ..setup.kernels import PART as KERNELS
from ..setup.kernels import ensure_kernels, kernel_seconds
from ..stages import finish_stage
from .discs import DISCS, model_of_discs, seconds_of_discs

SCENE = "scene"
SCENE_BUDGET = 5
"""Factor by which the whole scene may have more faces than an object."""

_FEWEST_ANCHORS, _BESIDE = 8, 0.25
"""Number of anchors of an object from which on a mesh of several should have a part of it, and how far beside them the
part may lie, relative to their extent."""
_PROGRESS_FRACTIONS = {"fuse": 0.4, "extract": 0.1, "refine": 0.2, "unwrap": 0.1, "bake": 0.2}
"""Fractions of the time of one mesh, for the progress."""
_SECONDS_A_MESH = 15.0
_FOR_RENDERS = 0.75
"""Fraction of the memory for targets that renders of the model take."""


@dataclass(frozen=True)
class Target:
    """A mesh to make: its key in meshes.json, its name for messages, and the IDs of its objects (None: everything)."""

    key: str
    name: str
    ids: tuple[int, ...] | None


def mesh(options: argparse.Namespace, reporter: StoppingReporter) -> None:
    """Make the selected meshes that do not exist yet; each is written as soon as it is complete."""
    device = choose_device(options.device, reporter)
    reporter.expect(
        {
            READ: ("Preparing", 5.0), KERNELS: ("Preparing", kernel_seconds(device)),
            DISCS: ("Fitting discs", 30.0), "meshes": ("Meshing", 30.0),
        }
    )  # fmt: skip
    with locked_reconstruction(options):
        trained = open_trained(options, reporter)
        folder = trained.folder
        ensure_kernels(reporter, trained.model.device)
        targets = _targets(options, folder)
        folder.meshes.mkdir(exist_ok=True)
        known = {} if options.restart else _known_meshes(folder)
        interrupted = read_waiting(folder.meshes)
        wanted = [
            target
            for target in targets
            if target.key in interrupted or not _is_current(known.get(target.key), target, options, trained)
        ]
        waiting = [target.key for target in wanted]
        if wanted or interrupted:
            write_meshes(folder.meshes, _known_meshes(folder), trained.progress.step, waiting)
        options.restart = False  # The same command would begin again.
        discs = seconds_of_discs(trained) if wanted else 0.0
        reporter.expect({DISCS: ("Fitting discs", discs), "meshes": ("Meshing", _SECONDS_A_MESH * len(wanted))})
        model = trained.model
        if wanted:
            # The scene has read no masks so far.
            trained.scene.capture = with_corrected_masks(trained, reporter)
            model = model_of_discs(trained, options, reporter)
        reporter.begin("meshes", "Reading the photos")
        current = [known[target.key] for target in targets if target not in wanted]
        existing = sum(entry.file is not None for entry in current)
        if existing:
            reporter.status(f"{existing} of {len(targets)} meshes exist already")
        if len(current) > existing:
            reporter.status(f"{len(current) - existing} of {len(targets)} meshes cannot be made; --restart tries again")
        started = time.monotonic()
        # Renders and photos share the memory; a pixel takes about four times as many bytes in the former.
        trained.scene.forget(1 - _FOR_RENDERS)
        renders = _FOR_RENDERS * memory_for_targets(options)
        views = Views(model, trained.scene, trained.capture.train_indices, memory_mb=renders)
        for done, target in enumerate(wanted):
            reporter.status(f"Making the mesh of {target.name} ({done + 1} of {len(wanted)})")
            entry = _make(target, options, trained, views, _Part(reporter, done, len(wanted)))
            if entry.why:
                reporter.warning(entry.why)
            known = {**_known_meshes(folder), target.key: entry}
            write_meshes(folder.meshes, known, trained.progress.step, waiting[done + 1 :])
        if wanted:
            finish_stage(folder, "mesh", time.monotonic() - started)
    made = [target.key for target in targets if target.key in known and known[target.key].file]
    if not made:
        raise NothingMade(f"No mesh could be made: {known[targets[0].key].why}")
    reporter.done(meshes=str(folder.meshes), made=len(made), without=len(targets) - len(made))


class _Part(Reporter):
    """Converts the progress of a step of a mesh to that of all meshes."""

    def __init__(self, reporter: StoppingReporter, done: int, total: int) -> None:
        self._reporter, self._done, self._total = reporter, done, total
        self._before, self._fraction, self._shown = 0.0, 0.0, float(done)

    def step(self, step: str) -> _Part:
        """Begin a step of the mesh and return self."""
        self._before += self._fraction
        self._fraction = _PROGRESS_FRACTIONS[step]
        self.progress(0, 1)
        return self

    def warning(self, message: str) -> None:
        self._reporter.warning(message)

    def progress(self, done: float, total: float, **_: Any) -> None:
        fraction = self._before + self._fraction * min(done / max(total, 1e-9), 1.0)
        # A step may pass over the views several times, each with a progress from 0.
        self._shown = max(self._shown, self._done + fraction)
        self._reporter.progress(round(self._shown, 4), self._total, what="meshes")


def _make(target: Target, options: argparse.Namespace, trained: Trained, views: Views, part: _Part) -> MeshEntry:
    """Make and write one mesh, and return its entry in meshes.json."""
    started = time.monotonic()
    model, folder = trained.model, trained.folder.meshes
    entry = _entry_of(target, options, trained)
    classes = np.arange(len(model.classes))
    if target.ids is not None:
        classes = model.classes.classes_among(target.ids)
    budget = options.faces * (SCENE_BUDGET if target.key == SCENE else 1)
    try:
        if not np.isin(devices.host(model.anchors.ids), classes).any():
            raise NoSurface(
                f"{target.name} has no splats, so it has no mesh; was it left out of training or separated?"
            )
        field = fuse(views, classes.tolist(), reporter=part.step("fuse"), name=target.name)
        surface = extract(field, closed=not options.open, faces=budget, reporter=part.step("extract"))
    except NoSurface as reason:
        for suffix in (".ply", ".png"):
            (folder / f"{_stem(target.key)}{suffix}").unlink(missing_ok=True)
        return replace(entry, why=str(reason))
    if lacking := _lacking(surface, model, classes):
        first = trained.capture.names.get(lacking[0], default_name(lacking[0]))
        more = f" and {len(lacking) - 1} more" if len(lacking) > 1 else ""
        part.warning(
            f"The mesh of {target.name} lacks {first}{more}, separate from the rest and small, or hardly seen; make a "
            "mesh of each alone."
        )
    surface = smooth(refine(surface, views, classes.tolist(), part.step("refine")))
    part.step("unwrap")
    uvs, size = _unwrapped(surface, views, options.texture_size)
    texture, colors = bake_texture(surface, uvs, size, views, classes.tolist(), reporter=part.step("bake"))
    stem = _stem(target.key)
    _write_image(folder / f"{stem}.png", texture)
    write_mesh(folder / f"{stem}.ply", _in_world(surface, colors, uvs, f"{stem}.png", model))
    figures = {
        "texture_size": size,
        "vertices": len(surface.vertices),
        "faces": len(surface.faces),
        "watertight": is_watertight(surface.faces),
        "unobserved": round(float(surface.unobserved.mean()), 4),
        "seconds": round(time.monotonic() - started, 2),
    }
    return replace(entry, file=f"{stem}.ply", texture=f"{stem}.png", figures=figures)


def _unwrapped(surface: Surface, views: Views, size: int | None) -> tuple[np.ndarray, int]:
    """Return the UVs of a surface, and the size of its texture, chosen if `size` is None."""
    if size:
        return unwrap(surface, size), size
    size = texture_size(surface, views)
    uvs = unwrap(surface, size)
    needed = texture_size(surface, views, uvs)
    return (unwrap(surface, needed), needed) if needed > size else (uvs, size)


def _lacking(surface: Surface, model: ObjectModel, classes: np.ndarray) -> list[int]:
    """Return the IDs of the objects that have no part of a surface, as small separate ones count as floaters."""
    found: list[int] = []
    if len(classes) < 2:
        return found
    ids, positions = devices.host(model.anchors.ids), devices.host(model.anchors.positions)
    for own, object_id in zip(classes, model.classes.ids_of(classes).tolist(), strict=True):
        points = positions[ids == own]
        if object_id and len(points) >= _FEWEST_ANCHORS:
            low, high = np.quantile(points, (0.02, 0.98), axis=0)
            margin = _BESIDE * (high - low).max()
            if not ((surface.vertices >= low - margin) & (surface.vertices <= high + margin)).all(1).any():
                found.append(object_id)
    return found


def _in_world(surface: Surface, colors: np.ndarray, uvs: np.ndarray, texture: str, model: ObjectModel) -> Mesh:
    vertices, normals = model.normalization.to_world(surface.vertices), surface.normals().astype(np.float32)
    return Mesh(vertices, normals, colors, surface.faces, uvs, surface.unobserved, texture)


def _write_image(path: Path, pixels: np.ndarray) -> None:
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG", compress_level=4)
    write_atomic(path, buffer.getvalue())


def _targets(options: argparse.Namespace, folder: Reconstruction) -> list[Target]:
    """Return the meshes that the options select; without a selection, those of all objects, merged ones as one."""
    objects = [entry for entry in read_objects(folder.objects) if entry.id] if folder.objects.exists() else []
    groups = {entry.id: Target(str(entry.id), entry.name, tuple(members_of(objects, entry.id))) for entry in objects}
    separated = {entry.id for entry in objects if entry.separated}
    shown = [i for i, target in shown_as(objects).items() if target == i and i not in separated]

    def find(word: str) -> int:
        return find_object(objects, word, folder.objects).id

    targets: list[Target] = []
    if options.objects:
        targets += [groups[i] for i in dict.fromkeys(find(word) for word in options.objects)]
    for name, words in options.set or ():
        ids = {i for word in words for i in (groups[find(word)].ids or ())}
        if name == SCENE or name.isdecimal():
            raise InputError(f"--set {name}=... would replace another mesh; choose another name.")
        if any(target.key == name for target in targets):
            raise InputError(f"--set {name}=... is given twice; choose two names.")
        targets.append(Target(name, name, tuple(sorted(ids))))
    if options.scene:
        targets.append(Target(SCENE, "the whole scene", None))
    if not targets:
        targets = [groups[i] for i in shown] or [Target(SCENE, "the whole scene", None)]
    return targets


def _stem(key: str) -> str:
    """Return the stem of the files of a mesh; that of a set differs from those of all other keys."""
    return hashed_stem(key)


def _known_meshes(folder: Reconstruction) -> dict[str, MeshEntry]:
    """Return the entries of meshes.json; none if it is invalid, so that the file is created anew."""
    try:
        return read_meshes(folder.meshes)
    except InputError:
        return {}


def _entry_of(target: Target, options: argparse.Namespace, trained: Trained) -> MeshEntry:
    """Return the entry of a mesh with the inputs that determine it, and without files."""
    settings = {"faces": options.faces, "closed": not options.open, "texture_size": options.texture_size}
    return MeshEntry(target.key, target.name, target.ids, trained.progress.step, settings)


def _is_current(entry: MeshEntry | None, target: Target, options: argparse.Namespace, trained: Trained) -> bool:
    """Return whether `entry` is an existing mesh of `target` with the same inputs."""
    wanted = _entry_of(target, options, trained)
    if entry is None or (entry.ids, entry.trained_steps, entry.settings) != (
        wanted.ids, wanted.trained_steps, wanted.settings,
    ):  # fmt: skip
        return False
    files = [name for name in (entry.file, entry.texture) if name]
    return entry.why is not None or (
        len(files) == 2 and all((trained.folder.meshes / name).is_file() for name in files)
    )
