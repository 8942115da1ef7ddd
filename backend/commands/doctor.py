"""`doctor`: versions and devices, and whether everything works here on a tiny scene."""

from __future__ import annotations

import argparse
import time

from .. import device
from ..stopping import StoppingReporter
from .kernels import try_kernels
from .machine import machine_facts


def doctor(options: argparse.Namespace, reporter: StoppingReporter) -> None:
    """Versions, devices, and whether the kernels compile and a small training runs here."""
    place = device.pick(options.device)
    found = machine_facts(place)
    for key, value in found.items():
        reporter.status(f"{key}: {value}")
    why_not = device.why_not_cuda()
    if why_not is not None:
        reporter.status(f"CUDA is not used: {why_not}")
    elif options.device == "cpu":
        reporter.status("CUDA would work, and is not used since --device cpu was asked for")
    started = time.monotonic()
    try_kernels(reporter, place)
    seconds = time.monotonic() - started
    reporter.done(message=f"The backend works; the kernels were ready in {seconds:.1f} s.", machine=found)
