"""`doctor`: versions and devices, and whether everything works here on a tiny scene."""

from __future__ import annotations

import argparse
import time

from ..stopping import StoppingReporter
from .kernels import try_kernels
from .machine import machine_facts


def doctor(options: argparse.Namespace, reporter: StoppingReporter) -> None:
    """Versions, devices, and whether the kernels compile and a small training runs here."""
    found = machine_facts()
    for key, value in found.items():
        reporter.status(f"{key}: {value}")
    started = time.monotonic()
    try_kernels(reporter)
    seconds = time.monotonic() - started
    reporter.done(message=f"The backend works; the kernels were ready in {seconds:.1f} s.", machine=found)
