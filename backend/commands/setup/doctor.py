"""`doctor`: reports versions and devices, and tests everything on a tiny scene."""

from __future__ import annotations

import argparse
import time

from ...raster import devices
from ...shared.stopping import StoppingReporter
from .device import choose_device
from .kernels import PART, kernel_seconds, try_kernels
from .machine import machine_facts

_SECONDS = 10.0
"""Typical time of the test where the kernels are compiled already."""


def doctor(options: argparse.Namespace, reporter: StoppingReporter) -> None:
    """Report versions and devices, compile the kernels and run a short training."""
    device = choose_device(options.device, reporter, again=True)
    reporter.expect({PART: ("Compiling kernels", kernel_seconds(device) or _SECONDS)})
    found = machine_facts(device)
    for key, value in found.items():
        reporter.status(f"{key}: {value}")
    uses = "the CPU" if device.type == "cpu" else found["device"]
    why_not = devices.why_not_cuda()
    if why_not is not None:
        reporter.status(f"CUDA is not used: {why_not}")
    elif options.device == "cpu":
        reporter.status("CUDA works, but --device cpu was given")
    started = time.monotonic()
    try_kernels(reporter, device)
    seconds = time.monotonic() - started
    works = f"The backend works, and training uses {uses}; the kernels were ready in {seconds:.1f} s."
    reporter.done(message=works, machine=found)
