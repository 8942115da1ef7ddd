"""`point`: answers the strokes of a controlling program, such as Blender, with the object of each splat."""

from __future__ import annotations

import argparse
import base64
import json
import zlib
from queue import Empty
from typing import Any

import numpy as np

from ...pointing.pointer import StrokeOnNothing
from ...pointing.strokes import content_of, strokes_of
from ...shared.defaults import DETAIL
from ...shared.errors import InputError
from ...shared.stopping import StoppingReporter
from ..folder import READ
from ..setup.kernels import PART as KERNELS
from ..setup.kernels import ensure_kernels
from .pointable import GRAPH, open_pointable, segmentation

_WAIT = 0.2
"""Interval in seconds at which a stop is noticed."""

_AT_ONCE = 500_000
"""Number of bytes for the splats in one line of an answer, since the length of lines is limited."""


def point(options: argparse.Namespace, reporter: StoppingReporter) -> None:
    """Answer each request with the objects of the splats, until the controlling program ends or stops the command."""
    if not options.json:
        raise InputError("`point` answers another program; run it with --json, or use `label` with a file of strokes.")
    reporter.expect({READ: ("Preparing", 3.0), KERNELS: ("Preparing", 0.0), GRAPH: ("Preparing", 3.0)})
    opened = open_pointable(options, reporter)
    segment = segmentation(options, opened.device)
    ensure_kernels(reporter, opened.device)
    reporter.begin(GRAPH, "Comparing the splats with their neighbors")
    pointer = opened.pointer(reporter.progress, segment)
    reporter.answer(ready=True, splats=int(opened.in_file.sum()))
    while not reporter.stop():
        content = _latest(reporter)
        if content is None:
            continue
        request: Any = content.get("request")
        if content.get("propose"):
            detail = content.get("detail", DETAIL)
            if not (isinstance(detail, int | float) and 0 <= detail <= 1):
                reporter.answer(request=request, problem=f"The detail {detail!r} is not a number from 0 to 1.")
                continue
            reporter.answer(request=request, proposed=content_of(pointer.propose(detail, reporter.progress)))
            continue
        try:
            ids = pointer.solve(strokes_of(content, "the request", opened.views.names))[opened.in_file]
        except InputError as error:
            number = error.number if isinstance(error, StrokeOnNothing) else None
            reporter.answer(request=request, problem=str(error), stroke=number)
            continue
        objects, classes = np.unique(ids, return_inverse=True)
        kind = "u1" if len(objects) <= 256 else "<u4"
        step = _AT_ONCE // np.dtype(kind).itemsize
        for first in range(0, max(len(ids), 1), step):
            part = np.ascontiguousarray(classes[first : first + step], kind).tobytes()
            reporter.answer(
                request=request, objects=objects.tolist(), kind=kind, first=first, splats=len(ids),
                classes=base64.b64encode(zlib.compress(part, 1)).decode(),
            )  # fmt: skip
    reporter.done()


def _latest(reporter: StoppingReporter) -> dict[str, Any] | None:
    """Return the latest request, or None; earlier ones that wait are outdated."""
    try:
        line = reporter.stop.requests.get(timeout=_WAIT)
        while not reporter.stop.requests.empty():
            line = reporter.stop.requests.get()
        content = json.loads(line)
    except (Empty, ValueError):
        return None
    return content if isinstance(content, dict) else None
