# SPDX-License-Identifier: GPL-3.0-or-later
"""The demo capture: a tabletop scene rendered by Cycles, in a folder with the layout of a real capture.

    images/0000.png ...                    8-bit sRGB images
    sparse/0/{cameras,images,points3D}.bin COLMAP model, one PINHOLE camera
    masks/0000.png ...                     16-bit object IDs, with simulated errors if requested
    labels.json                            ID -> name
    truth/masks, truth/depth (float32 .npy, meters along the camera axis), truth/meshes/<id>_<name>.ply,
    truth/objects.json, truth/points.npz (object_id and outlier for each point of the model), truth/settings.json

All coordinates are in meters with Z up, in one frame. Equal settings produce an equal capture.
"""

from __future__ import annotations

import json
import secrets
import shutil
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ...backend.shared.errors import Cancelled, InputError
from ...backend.shared.events import Reporter, StagedReporter
from ...backend.shared.formats.atomic import make_folder, recorded, replace_file
from . import files, mask_noise, points, scene
from .render import Renderer

VERSION = 1  # Incremented when equal settings produce a different capture.

_FILES = (
    *("images/????.png", "masks/????.png", "truth/masks/????.png", "truth/depth/????.npy", "truth/meshes/*.ply"),
    *("sparse/0/cameras.bin", "sparse/0/images.bin", "sparse/0/points3D.bin", "labels.json"),
    *("truth/objects.json", "truth/points.npz", "truth/settings.json"),
)
"""Patterns of the files in a demo capture."""

__all__ = ["Settings", "begin", "make", "write"]


@dataclass(frozen=True)
class Settings:
    """Settings of the capture: counts, image size in pixels, seed, mask noise 0..1, samples per pixel."""

    objects: int = 8
    views: int = 48
    width: int = 320
    height: int = 240
    seed: int = 0
    mask_noise: float = 0.0
    samples: int = 20

    def check(self) -> None:
        """Raise InputError if a value is out of range."""
        ranges = {
            "objects": (1, 60),
            "views": (4, 1000),
            "width": (32, 4096),
            "height": (32, 4096),
            "seed": (0, 2**31 - 1),
            "mask_noise": (0, 1),
            "samples": (1, 4096),
        }
        for name, (low, high) in ranges.items():
            value = getattr(self, name)
            if not low <= value <= high:
                what = name.replace("_", " ").capitalize()
                raise InputError(f"{what} must be between {low} and {high}, not {value}.")


def make(
    out: Any,
    settings: Settings | None = None,
    overwrite: bool = False,
    reporter: Reporter | None = None,
    stopped: Callable[[], bool] = lambda: False,
) -> Path:
    """Create the capture, or keep an existing equal one.

    After an error, no incomplete files are left.

    Args:
        out: output folder.
        settings: settings of the capture, or None for the defaults.
        overwrite: replace a demo capture with other settings.
        reporter: receives status and progress.
        stopped: called before each view; True cancels.

    Returns:
        The absolute path of the folder.

    Raises:
        InputError: A setting is out of range, or the folder cannot be used.
        Cancelled: `stopped()` returned True, or the render was cancelled.
    """
    settings, reporter = settings or Settings(), StagedReporter(reporter or Reporter())
    settings.check()
    out = Path(out).expanduser().absolute()
    if _is_there(out, settings, overwrite):
        reporter.status(f"The same demo capture is already in {out}; nothing to do.")
        return out
    part = _beside(out)
    with recorded() as created:
        try:
            make_folder(part)
        except OSError as error:
            raise InputError(f"The folder {out} cannot be written: {error.strerror or error}.") from error
        try:
            _fill(part, settings, reporter, stopped)
            _swap(part, out)
        except BaseException:
            shutil.rmtree(part, ignore_errors=True)
            created.remove_folders()
            raise
    return out


def _beside(out: Path) -> Path:
    """Return a new hidden name in the folder of `out`."""
    return out.with_name(f".{out.name[:60]}-{secrets.token_hex(8)}.part")


def _is_there(out: Path, settings: Settings, overwrite: bool) -> bool:
    """Return whether `out` holds this capture; raise InputError if it holds something that must not be replaced."""
    if not out.exists():
        return False
    if not out.is_dir():
        raise InputError(f"{out} is a file; the demo capture needs a folder.")
    if not any(out.iterdir()):
        return False
    if not (out / "truth" / "objects.json").is_file():
        raise InputError(f"The folder {out} is not empty and is not a demo capture; choose another one.")
    if _recorded(out) == _record(settings):
        return True
    if not overwrite:
        raise InputError(
            f"The folder {out} contains a demo capture with other settings; use --overwrite to replace it."
        )
    foreign = [path for path in sorted(out.rglob("*")) if not path.is_dir() and not _is_written(path.relative_to(out))]
    if foreign:
        raise InputError(f"{foreign[0]} is not part of the demo capture in {out}; move it, or choose another folder.")
    return False


def _is_written(path: Path) -> bool:
    """Return whether a demo capture contains a file of this relative path."""
    return any(path.match(pattern) and len(path.parts) == len(Path(pattern).parts) for pattern in _FILES)


def _record(settings: Settings) -> dict:
    return {"version": VERSION, **asdict(settings)}


def _recorded(out: Path) -> Any:
    try:
        return json.loads((out / "truth" / "settings.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def _swap(part: Path, out: Path) -> None:
    """Move the finished folder into place; the old one is deleted only after that succeeds."""
    old = _beside(out)
    if out.exists():
        replace_file(out, old)
    try:
        replace_file(part, out)
    except OSError:
        if old.exists():
            replace_file(old, out)
        raise
    shutil.rmtree(old, ignore_errors=True)


def _json(path: Path, value: Any) -> None:
    path.write_text(json.dumps(value, indent=1) + "\n", encoding="utf-8")


def _fill(part: Path, settings: Settings, reporter: Any, stopped: Any) -> None:
    start = time.monotonic()
    begin(reporter, settings.views)
    built, objs = scene.build(settings.objects, settings.seed)
    try:
        views = scene.cameras(settings.views, settings.seed)
        found = write(part, built, objs, views, settings, reporter, stopped)
    finally:
        scene.remove(built)
    _json(part / "truth" / "settings.json", _record(settings))
    reporter.status(f"{len(views)} views, {len(objs)} objects, {found} points in {time.monotonic() - start:.0f} s.")


def begin(reporter: StagedReporter, views: int) -> None:
    """Announce the stages of `write` for a number of views, and that the scene is being built."""
    reporter.expect(
        {"truth": ("Rendering", 0.2 * views), "pictures": ("Rendering", 1.0 * views), "write": ("Saving", 0.1 * views)}
    )
    reporter.begin("truth", "Building the scene")


def write(
    part: Path,
    built: bpy.types.Scene,
    objs: list[scene.DemoObject],
    views: list[scene.View],
    settings: Settings,
    reporter: Any,
    stopped: Callable[[], bool] = lambda: False,
    develop: Callable[[np.ndarray, int], np.ndarray] = lambda image, _index: image,
    prepare: Callable[[bpy.types.Scene], None] = lambda _scene: None,
    target: int = points.TARGET,
) -> int:
    """Render a scene, write all files of a capture except the record of its settings, and return the number of points.

    Args:
        part: existing folder.
        built: the scene.
        objs: objects whose meshes are the truth; pixels of others have the ID 0 and no points.
        views: cameras, in the order of the COLMAP model.
        settings: image size, samples, seed and mask noise.
        reporter: a StagedReporter after `begin`.
        stopped: called before each view; True cancels.
        develop: changes the picture (H, W, 3) uint8 of a view, given its index, as a camera might.
        prepare: called with the scene before pictures are rendered, for other settings of Cycles.
        target: wanted number of points.

    Raises:
        Cancelled: `stopped()` returned True, or the render was cancelled.
    """
    for name in ("images", "masks", "sparse/0", "truth/masks", "truth/depth", "truth/meshes"):
        (part / name).mkdir(parents=True)
    images, depths, ids = _render(built, views, settings, part, reporter, stopped, prepare)
    _write_truth(part, objs)
    images = [develop(image, i) for i, image in enumerate(images)]
    reporter.begin("write", "Writing the photos and masks")
    for view, image, depth, labels, i in zip(views, images, depths, ids, range(len(views))):
        files.write_png(part / "images" / view.name, image)
        files.write_png(part / "truth" / "masks" / view.name, labels)
        noisy = mask_noise.disturb(labels, settings.mask_noise, scene.rng_for(settings.seed, 6, i))
        files.write_png(part / "masks" / view.name, noisy)
        np.save(part / "truth" / "depth" / (view.name[:-4] + ".npy"), depth)
        reporter.progress(i + 1, len(views) + 1)
    reporter.status("Finding points")
    intrinsics = scene.intrinsics(settings.width, settings.height)
    cloud = points.make(views, intrinsics, images, depths, ids, scene.rng_for(settings.seed, 5), target)
    files.write_colmap(
        part / "sparse" / "0",
        intrinsics,
        (settings.width, settings.height),
        [v.name for v in views],
        [v.rotation for v in views],
        [v.translation for v in views],
        cloud.observations,
        cloud.points,
    )
    np.savez(part / "truth" / "points.npz", object_id=cloud.object_id.astype(np.int32), outlier=cloud.outlier)
    _json(part / "labels.json", {str(obj.id): obj.name for obj in objs})
    return len(cloud.points["xyz"])


def _render(built: Any, views: Any, settings: Settings, part: Path, reporter: Any, stopped: Any, prepare: Any) -> Any:
    """Return images, depths and ID maps of all views; each kind is rendered in one pass, since switching is slow."""
    renderer = Renderer(built, settings.width, settings.height, settings.samples, settings.seed, part)
    images, truth = [], []
    try:
        reporter.status("Rendering IDs and depth")
        renderer.for_truth()
        for i, view in enumerate(views, 1):
            if stopped():
                raise Cancelled
            truth.append(renderer.truth(view))
            reporter.progress(i, len(views))
        reporter.begin("pictures", "Rendering pictures")
        renderer.for_pictures()
        prepare(built)
        for i, view in enumerate(views, 1):
            if stopped():
                raise Cancelled
            images.append(renderer.picture(view))
            reporter.progress(i, len(views))
    finally:
        renderer.close()
    return images, [depth for _, depth in truth], [labels for labels, _ in truth]


def _write_truth(part: Path, objs: Iterable[scene.DemoObject]) -> None:
    rows = []
    for obj in objs:
        vertices, triangles = scene.triangles(obj)
        name = f"meshes/{obj.id}_{obj.name}.ply"
        files.write_ply(part / "truth" / name, vertices, triangles)
        box = {"min": vertices.min(0).round(6).tolist(), "max": vertices.max(0).round(6).tolist()}
        rows.append({"id": obj.id, "name": obj.name, "mesh": name, "bounding_box": box})
    _json(part / "truth" / "objects.json", {"unit": "meter", "objects": rows})
