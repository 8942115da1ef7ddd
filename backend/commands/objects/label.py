"""`label`: strokes on objects in a few photos become masks of the capture."""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

import numpy as np
import torch

from ...capture.files import encode_mask
from ...evaluation.images import as_bytes
from ...model.generate import Generated
from ...pointing.splat_graph import build_graph, contributions
from ...pointing.strokes import Strokes, read_strokes
from ...raster import devices, object_map, rasterize
from ...shared.errors import InputError
from ...shared.formats.atomic import PART_PREFIX, PART_SUFFIX
from ...shared.formats.json_file import write_json
from ...shared.reconstruction.objects import default_name
from ...shared.stopping import StoppingReporter
from ..folder import READ, Trained, open_trained
from ..stages import stage

STROKES = "strokes.json"
"""The strokes that masks were made of, in the folder of the masks."""


def label(options: argparse.Namespace, reporter: StoppingReporter) -> None:
    """Find the object of each splat from the strokes, and write masks/ and labels.json of the capture."""
    reporter.expect({READ: ("Preparing", 5.0), "graph": ("Comparing splats", 10.0), "masks": ("Writing masks", 10.0)})
    trained = open_trained(options, reporter)
    capture, model = trained.capture, trained.model
    if not model.explicit:
        raise InputError(f"{options.folder} has a view-dependent model; train it with --mode explicit to label it.")
    folder = capture.folder / "masks"
    own = (folder / STROKES).is_file()
    for path in (folder, capture.folder / "labels.json"):
        if path.exists() and not own:
            raise InputError(f"{path} was not made of strokes; move it elsewhere to make masks of strokes.")
    strokes = read_strokes(options.strokes, [view.name for view in capture.views])
    reporter.begin("graph", "Comparing the splats with their neighbors")
    with stage(trained.folder, "label"):
        splats = model.generate()
        seeds = _seeds(trained, splats, strokes)
        indices = list(capture.train_indices)
        graph = build_graph(
            splats, model.primitive, [trained.scene.camera(index) for index in indices],
            lambda number: as_bytes(capture.image(indices[number])), lambda done, of: reporter.progress(done, of),
        )  # fmt: skip
        ids = graph.solve(seeds)
        reporter.begin("masks", f"Writing masks of {len(indices)} photos")
        _write_masks(trained, splats, ids, options.strokes, reporter)
        names = {str(i): strokes.names.get(i) or default_name(i) for i in np.unique(ids).tolist() if i}
        write_json(capture.folder / "labels.json", names)
    objects = sorted({stroke.object for stroke in strokes.strokes} - {0})
    reporter.status(f"{len(objects)} objects in {folder}; train the capture again to separate them.")
    reporter.done(masks=str(folder), objects=len(objects), views=len(indices))


def _seeds(trained: Trained, splats: Generated, strokes: Strokes) -> dict[int, np.ndarray]:
    """Return the (N,) contributions of the splats to the strokes of each object.

    Raises:
        InputError: a stroke shows no splat.
    """
    index_of = {view.name: index for index, view in enumerate(trained.capture.views)}
    seeds: dict[int, np.ndarray] = {}
    for number, stroke in enumerate(strokes.strokes, 1):
        camera = trained.scene.camera(index_of[stroke.view])
        pixels = stroke.pixels(camera.width, camera.height)
        found = contributions(splats, camera, np.stack([pixels] * 3), trained.model.primitive)[:, 0]
        if not found.sum() > 0.5:
            raise InputError(
                f"Stroke {number} shows no splats, since nothing was reconstructed there in {stroke.view}; draw it "
                "elsewhere on the object."
            )
        # So that each stroke counts as much, however long it is.
        seeds[stroke.object] = seeds.get(stroke.object, 0.0) + found / found.sum()
    return seeds


def _write_masks(
    trained: Trained, splats: Generated, ids: np.ndarray, strokes: Path, reporter: StoppingReporter
) -> None:
    """Render the objects into masks of the training photos, which replace those of earlier strokes when complete."""
    capture = trained.capture
    objects, classes = np.unique(ids, return_inverse=True)
    labeled = splats._replace(ids=torch.from_numpy(classes.astype(np.int32)).to(splats.means.device))
    folder = capture.folder / "masks"
    part = capture.folder / f"{PART_PREFIX}masks{PART_SUFFIX}"
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir()
    try:
        for done, index in enumerate(capture.train_indices, 1):
            with torch.no_grad():
                drawn = rasterize(*labeled[:6], trained.scene.camera(index), primitive=trained.model.primitive)
            found, _ = object_map(drawn)
            found = devices.host(found)
            shown = np.where(found >= 0, objects[np.maximum(found, 0)], 0)
            suffix, data = encode_mask(capture.photo_mask(index, shown))
            path = part / (capture.views[index].name + suffix)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
            reporter.progress(done, len(capture.train_indices), what="photos")
        shutil.copyfile(strokes, part / STROKES)
        if folder.exists():
            shutil.rmtree(folder)
        part.rename(folder)
    finally:
        shutil.rmtree(part, ignore_errors=True)
