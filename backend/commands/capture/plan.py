"""`plan`: decides what training needs for a capture, in plan.json."""

from __future__ import annotations

import argparse
from contextlib import ExitStack

from ...capture import load_capture
from ...planning.agreement import measure_agreement
from ...planning.decisions import decide, planned_capture
from ...shared.reconstruction.folder import Reconstruction
from ...shared.reconstruction.plan import write_plan
from ...shared.stopping import StoppingReporter
from ..folder import READ, memory_for_files, open_output
from ..length import budget_of, expected_of
from ..planning import build_context, choices, find_requested_objects, voted_points
from ..setup.device import choose_device


def plan(options: argparse.Namespace, reporter: StoppingReporter) -> None:
    """Report the steps that training would do and omit; with --out, use and write the files of that folder."""
    reporter.expect({READ: ("Preparing", 5.0), "plan": ("Planning", 5.0)})
    reporter.begin(READ, "Reading the capture")
    device, budget = choose_device(options.device, reporter), budget_of(options)
    folder = Reconstruction(options.out) if options.out else None
    with ExitStack() as held:
        if folder is not None:
            held.enter_context(open_output(options))
        # A plan reads images that are already prepared, but does not prepare any.
        cache = folder.cache if folder is not None and folder.cameras.exists() else None
        capture = load_capture(options.capture, cache, memory_for_files(options), options.max_size, reporter)
        reporter.begin("plan", "Planning the training")
        objects, _ = find_requested_objects(folder, capture, options)
        points = voted_points(folder, capture) if folder is not None else None
        found = decide(build_context(capture, choices(options), objects, reporter, points))
        agreement = None
        if capture.prepared:
            agreement = measure_agreement(planned_capture(capture, found), reporter.check)
        if folder is not None:
            write_plan(folder.plan, found)
    for decision in found.decisions:
        reporter.status(decision.sentence())
    if expected := expected_of(budget, capture, device, agreement=agreement):
        reporter.status(expected)
    reporter.done(plan=found.as_list())
