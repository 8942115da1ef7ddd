"""`check`: what a capture holds, and what is wrong with it."""

from __future__ import annotations

import argparse

from ..capture import check_capture
from ..protocol import InputError
from ..stopping import StoppingReporter


def check(options: argparse.Namespace, reporter: StoppingReporter) -> None:
    """Report on a capture; InputError with the first problem if it cannot be used."""
    found = check_capture(options.capture, options.max_size, reporter)
    for sentence in found["warnings"] + found["problems"][1:]:
        reporter.warning(sentence)
    if found["problems"]:
        raise InputError(found["problems"][0])
    sizes = ", ".join(found["view_sizes"])
    error = found["mean_reprojection_error"]
    off = "" if error is None else f", on average {error:.2f} pixels off in the images"
    reporter.status(f"{found['counts']['used']} views with poses ({sizes}), {found['points']:,} points{off}")
    for camera in found["cameras"]:
        undo = "undistorted on first use" if camera["undistort"] else "used as it is"
        reporter.status(f"camera {camera['id']}: {camera['model']} {camera['width']}x{camera['height']}, {undo}")
    for entry in found["objects"]:
        reporter.status(f"object {entry['id']} {entry['name']}: in {entry['views']} views")
    if not found["objects"]:
        reporter.status("no masks: the scene can be trained as one, without objects")
    reporter.done(message="The capture can be used.", check=found)
