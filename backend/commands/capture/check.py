"""`check`: lists a capture's contents and problems."""

from __future__ import annotations

import argparse

from ...capture import check_capture
from ...shared.errors import InputError
from ...shared.stopping import StoppingReporter
from ..folder import READ


def check(options: argparse.Namespace, reporter: StoppingReporter) -> None:
    """Report a capture's contents; raise InputError with the first problem if it cannot be used."""
    reporter.expect({READ: ("Checking", 5.0)})
    reporter.begin(READ, "Checking the capture")
    found = check_capture(options.capture, options.max_size, reporter)
    for sentence in found["warnings"] + found["problems"][1:]:
        reporter.warning(sentence)
    if found["problems"]:
        raise InputError(found["problems"][0])
    sizes = ", ".join(found["view_sizes"])
    error = found["mean_reprojection_error"]
    accuracy = "" if error is None else f" with a mean reprojection error of {error:.2f} pixels"
    reporter.status(f"{found['counts']['used']} views with poses ({sizes}), {found['points']:,} points{accuracy}")
    for camera in found["cameras"]:
        handling = "undistorted on first use" if camera["undistort"] else "used unchanged"
        reporter.status(f"camera {camera['id']}: {camera['model']} {camera['width']}x{camera['height']}, {handling}")
    for entry in found["objects"]:
        reporter.status(f"object {entry['id']} {entry['name']}: in {entry['views']} views")
    if not found["objects"]:
        reporter.status("no masks: the scene can be trained as a whole, without objects")
    reporter.done(message="The capture can be used.", check=found)
