"""`render`: render images, object IDs and depth of the splats, into DIR/renders."""

from __future__ import annotations

import argparse
import io
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from ...evaluation.images import as_bytes
from ...model.draw import draw
from ...shared.formats.atomic import require_still_there, write_atomic
from ...shared.reconstruction.folder import Reconstruction
from ...shared.stopping import StoppingReporter
from ..folder import READ, open_trained
from ..stages import stage


def render(options: argparse.Namespace, reporter: StoppingReporter) -> None:
    """Render views into DIR/renders, under the names of the images."""
    reporter.expect({READ: ("Preparing", 5.0), "views": ("Rendering", 20.0)})
    Reconstruction(options.folder).require_writable()
    trained = open_trained(options, reporter)
    folder, capture = trained.folder, trained.capture
    indices = list(capture.test_indices)
    if options.views == "all" or not indices:
        indices = list(range(len(capture.views)))
    reporter.begin("views", f"Rendering {len(indices)} views")
    paths = _render_paths(folder.renders, [view.name for view in capture.views])
    with stage(folder, "render"):
        for done, index in enumerate(indices, 1):
            rendered = draw(trained.model, trained.scene.camera(index), options.ids, options.depth)
            path = paths[index]
            require_still_there(folder.folder)
            path.parent.mkdir(parents=True, exist_ok=True)
            _save_png(path, as_bytes(rendered.image))
            if rendered.ids is not None:
                _save_ids(path, rendered.ids)
            if rendered.depth is not None:
                _save_array(path.with_suffix(".depth.npy"), rendered.depth)
            reporter.progress(done, len(indices), what="views")
    reporter.done(renders=str(folder.renders), views=len(indices))


def _render_paths(folder: Path, names: Sequence[str]) -> list[Path]:
    """Return the path of each view's render: its name with .png; names that differ only in the suffix keep it."""
    paths = [folder / Path(name).with_suffix(".png") for name in names]
    count = Counter(paths)
    return [
        path if count[path] == 1 else path.with_name(Path(name).name + ".png")
        for path, name in zip(paths, names, strict=True)
    ]


def _save_png(path: Path, pixels: np.ndarray) -> None:
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG")
    write_atomic(path, buffer.getvalue())


def _save_array(path: Path, values: np.ndarray) -> None:
    buffer = io.BytesIO()
    np.save(buffer, values)
    write_atomic(path, buffer.getvalue())


def _save_ids(image_path: Path, ids: np.ndarray) -> None:
    """Write the IDs of a render beside it, as 16-bit PNG, or as .npy if one is larger."""
    if ids.max(initial=0) > 0xFFFF:
        _save_array(image_path.with_suffix(".ids.npy"), ids.astype(np.uint32))
    else:
        _save_png(image_path.with_suffix(".ids.png"), ids.astype(np.uint16))
