"""`propose`: finds objects without strokes, and writes strokes that mark them, for `label`."""

from __future__ import annotations

import argparse
from functools import partial

import numpy as np

from ...evaluation.images import MaskSheet
from ...pointing.strokes import content_of
from ...shared.errors import InputError
from ...shared.formats.json_file import write_json
from ...shared.reconstruction.folder import Reconstruction, require_writable
from ...shared.stopping import StoppingReporter
from ..folder import READ
from ..setup.kernels import PART as KERNELS
from ..setup.kernels import ensure_kernels
from .pointable import GRAPH, open_pointable

_DRAW = "draw"


def propose(options: argparse.Namespace, reporter: StoppingReporter) -> None:
    """Find the objects of splats without masks, and write a file of strokes on them."""
    reporter.expect(
        {
            READ: ("Preparing", 3.0), KERNELS: ("Preparing", 0.0), GRAPH: ("Preparing", 3.0),
            _DRAW: ("Finding objects", 3.0),
        }
    )  # fmt: skip
    if options.strokes is None:
        Reconstruction(options.folder).require_writable()
    else:
        require_writable(options.strokes.parent, "choose another with --strokes")
    opened = open_pointable(options, reporter)
    ensure_kernels(reporter, opened.device)
    reporter.begin(GRAPH, "Comparing the splats with their neighbors")
    pointer = opened.pointer(reporter.progress)
    reporter.begin(_DRAW, "Finding objects")
    masks: dict[int, np.ndarray] = {}
    found = pointer.propose(options.detail, reporter.progress, masks.__setitem__)
    if not found.strokes:
        raise InputError(
            f"No objects were found in {opened.folder.folder}; try another --detail, or mark them by strokes."
        )
    path = options.strokes or opened.folder.strokes
    sheet, picture = MaskSheet(len(masks)), path.with_suffix(".jpg")
    for index, mask in masks.items():
        title = opened.views.names[index] if opened.views.names else f"view {index + 1}"
        sheet.add(title, mask, partial(pointer.picture, index))
    write_json(path, content_of(found))
    sheet.save(picture, found.names)
    reporter.status(
        f"Found {sheet.summary('photos' if opened.views.names else 'views')}; see {picture}. If things are in parts, "
        "lower --detail; if several are one, raise it"
    )
    reporter.done(objects=len(found.names), strokes=str(path), picture=str(picture))
