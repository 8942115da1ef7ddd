"""`mesh`: a textured mesh of each object, of sets of objects or of the whole scene, in DIR/meshes.

meshes.json beside them says what each was made of: {"trained_steps": n, "meshes": {"<id>": {"file": "1.ply",
"texture": "1.png", "ids": [1], "trained_steps": n, "settings": {...}, "vertices": n, "faces": n, "watertight": true,
"invented": 0.1, "seconds": s}}}, or {"why": "..."} in place of the files where there is no mesh. Sets stand under their
name, the whole scene under "scene".
"""

from __future__ import annotations

import argparse
import io
import re
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from ..mesh.extract import extract, is_watertight
from ..mesh.fusion import fuse
from ..mesh.refine import refine
from ..mesh.surface import NoSurface, Surface
from ..mesh.texture import dress, texture_size
from ..mesh.unwrap import unwrap
from ..mesh.views import Views
from ..mesh_file import Mesh, write_mesh
from ..model.object_model import ObjectModel
from ..objects import find_object, merged, read_objects
from ..protocol import InputError, Reconstruction, Reporter, read_json, write_atomic, write_json
from ..stopping import StoppingReporter
from .folder import Trained, open_trained
from .kernels import have_kernels_ready
from .lock import locked
from .record import record_stage

SCENE = "scene"
SCENE_BUDGET = 5
"""The whole scene may have so many times the faces of an object."""

_SHARES = {"fuse": 0.4, "extract": 0.1, "refine": 0.2, "unwrap": 0.1, "dress": 0.2}
"""How the time of one mesh is spent, for the estimate of what is left."""


@dataclass(frozen=True)
class Target:
    """One mesh to make: its key in meshes.json, what people call it, and the IDs of its objects (None: everything)."""

    key: str
    name: str
    ids: tuple[int, ...] | None


def mesh(options: argparse.Namespace, reporter: StoppingReporter) -> None:
    """Make the meshes that are asked for and are not there yet; each is written as soon as it is done."""
    trained = open_trained(options, reporter)
    folder = trained.folder
    have_kernels_ready(reporter, trained.model.device)
    with locked(folder.folder):
        targets = _targets(options, folder, trained.model)
        folder.meshes.mkdir(exist_ok=True)
        known = {} if options.restart else _known(folder)
        wanted = [target for target in targets if not _is_current(known.get(target.key), target, options, trained)]
        if len(wanted) < len(targets):
            reporter.status(f"{len(targets) - len(wanted)} of {len(targets)} meshes are there already")
        started = time.monotonic()
        views = Views(trained.model, trained.scene, trained.capture.train_indices)
        for done, target in enumerate(wanted):
            reporter.status(f"Making the mesh of {target.name} ({done + 1} of {len(wanted)})")
            entry = _make(target, options, trained, views, _Part(reporter, done, len(wanted), started))
            if "why" in entry:
                reporter.warning(entry["why"])
            known = {**_known(folder), target.key: entry}
            write_json(
                folder.meshes / "meshes.json",
                {"trained_steps": trained.progress.step, "meshes": dict(sorted(known.items()))},
            )
        if wanted:
            record_stage(folder, "mesh", time.monotonic() - started)
    made = [key for key in (target.key for target in targets) if "file" in known.get(key, {})]
    if not made:
        raise InputError(f"There is no mesh to be had: {known[targets[0].key]['why']}")
    reporter.done(meshes=str(folder.meshes), made=len(made), without=len(targets) - len(made))


class _Part(Reporter):
    """Turns the progress of one step of one mesh into that of the whole command, with the time that is left."""

    def __init__(self, reporter: StoppingReporter, done: int, total: int, started: float) -> None:
        self._reporter, self._done, self._total, self._started = reporter, done, total, started
        self._before, self._share, self._shown = 0.0, 0.0, float(done)

    def begin(self, step: str) -> _Part:
        """What follows is this step of the mesh; returns itself."""
        self._before += self._share
        self._share = _SHARES[step]
        self.progress(0, 1)
        return self

    def warning(self, message: str) -> None:
        self._reporter.warning(message)

    def progress(self, done: float, total: float, **fields: Any) -> None:
        share = self._before + self._share * min(done / max(total, 1e-9), 1.0)
        # A step that goes over the views more than once counts anew each time.
        self._shown = max(self._shown, self._done + share)
        behind = self._shown / self._total
        spent = time.monotonic() - self._started
        left = {"seconds_left": round(spent / behind - spent, 1)} if behind > 0 else {}
        self._reporter.progress(round(self._shown, 4), self._total, what="meshes", **left)


def _make(target: Target, options: argparse.Namespace, trained: Trained, views: Views, part: _Part) -> dict[str, Any]:
    """Make and write one mesh; returns its entry in meshes.json."""
    started = time.monotonic()
    model, folder = trained.model, trained.folder.meshes
    entry = {"name": target.name, **_origin(target, options, trained)}
    classes = np.arange(len(model.object_ids))
    if target.ids is not None:
        classes = np.flatnonzero(np.isin(model.object_ids, target.ids))
    budget = options.faces * (SCENE_BUDGET if target.key == SCENE else 1)
    try:
        if not np.isin(model.anchors.ids, classes).any():
            raise NoSurface(f"{target.name} has no splats, so it has no mesh; was it left out of the training?")
        field = fuse(views, classes.tolist(), reporter=part.begin("fuse"))
        surface = extract(field, closed=not options.open, faces=budget, reporter=part.begin("extract"))
    except NoSurface as reason:
        for suffix in (".ply", ".png"):
            (folder / f"{_stem(target.key)}{suffix}").unlink(missing_ok=True)
        return {**entry, "why": str(reason)}
    surface = refine(surface, views, classes.tolist(), part.begin("refine"))
    part.begin("unwrap")
    size = options.texture_size or texture_size(surface, views, classes.tolist())
    uvs = unwrap(surface, size)
    texture, colors = dress(surface, uvs, size, views, classes.tolist(), reporter=part.begin("dress"))
    stem = _stem(target.key)
    _write_picture(folder / f"{stem}.png", texture)
    write_mesh(folder / f"{stem}.ply", _in_world(surface, colors, uvs, f"{stem}.png", model))
    return {
        **entry,
        "file": f"{stem}.ply",
        "texture": f"{stem}.png",
        "texture_size": size,
        "vertices": len(surface.vertices),
        "faces": len(surface.faces),
        "watertight": is_watertight(surface.faces),
        "invented": round(float(surface.invented.mean()), 4),
        "seconds": round(time.monotonic() - started, 2),
    }


def _in_world(surface: Surface, colors: np.ndarray, uvs: np.ndarray, texture: str, model: ObjectModel) -> Mesh:
    vertices, normals = model.normalization.to_world(surface.vertices), surface.normals().astype(np.float32)
    return Mesh(vertices, normals, colors, surface.faces, uvs, surface.invented, texture)


def _write_picture(path: Path, pixels: np.ndarray) -> None:
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG", compress_level=4)
    write_atomic(path, buffer.getvalue())


# --- what is asked for -----------------------------------------------------------------------------------------------


def _targets(options: argparse.Namespace, folder: Reconstruction, model: ObjectModel) -> list[Target]:
    """The meshes that are asked for: all objects where nothing is named, merged ones as one."""
    objects = [entry for entry in read_objects(folder.objects) if entry.id] if folder.objects.exists() else []
    into = merged(objects)
    groups = {entry.id: Target(str(entry.id), entry.name, _with_merged(entry.id, into)) for entry in objects}
    shown = [entry.id for entry in objects if into[entry.id] == entry.id and not entry.left_out]

    def find(word: str) -> int:
        return find_object(objects, word, folder.objects).id

    targets: list[Target] = []
    if options.objects:
        targets += [groups[i] for i in dict.fromkeys(find(word) for word in options.objects)]
    for name, words in options.set or ():
        ids = {i for word in words for i in (groups[find(word)].ids or ())}
        if name == SCENE or name in {str(i) for i in groups}:
            raise InputError(f"--set {name}=... would take the place of another mesh; choose another name.")
        targets.append(Target(name, name, tuple(sorted(ids))))
    if options.scene:
        targets.append(Target(SCENE, "the whole scene", None))
    if not targets:
        targets = [groups[i] for i in shown] or [Target(SCENE, "the whole scene", None)]
    return targets


def _with_merged(object_id: int, into: dict[int, int]) -> tuple[int, ...]:
    return tuple(sorted(i for i, shown_as in into.items() if shown_as == object_id))


def _stem(key: str) -> str:
    """A file's name for a key: names of sets may hold what a file system does not take."""
    return re.sub(r"[^\w.-]+", "_", key).strip("._") or "set"


# --- what is there ---------------------------------------------------------------------------------------------------


def _known(folder: Reconstruction) -> dict[str, dict[str, Any]]:
    """The entries of meshes.json; none where it is missing or was not written by this program."""
    path = folder.meshes / "meshes.json"
    content = read_json(path) if path.exists() else {}
    found = content.get("meshes") if isinstance(content, dict) else None
    return found if isinstance(found, dict) and all(isinstance(entry, dict) for entry in found.values()) else {}


def _origin(target: Target, options: argparse.Namespace, trained: Trained) -> dict[str, Any]:
    """What decides how a mesh comes out."""
    settings = {"faces": options.faces, "closed": not options.open, "texture_size": options.texture_size}
    ids: Sequence[int] | None = None if target.ids is None else list(target.ids)
    return {"ids": ids, "trained_steps": trained.progress.step, "settings": settings}


def _is_current(entry: dict[str, Any] | None, target: Target, options: argparse.Namespace, trained: Trained) -> bool:
    """Whether the mesh of `target` is there and would come out the same."""
    if entry is None or any(entry.get(key) != value for key, value in _origin(target, options, trained).items()):
        return False
    files = [entry[key] for key in ("file", "texture") if key in entry]
    return "why" in entry or (len(files) == 2 and all((trained.folder.meshes / name).is_file() for name in files))
