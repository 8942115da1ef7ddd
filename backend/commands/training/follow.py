"""What processes other than the first one do in a `train` that torchrun has started several times."""

from __future__ import annotations

import argparse
from contextlib import closing, suppress

from ...shared.errors import InputError
from ...shared.events import Reporter
from ...shared.stopping import StoppingReporter, StopRequest
from ...training.processes.team import Order, Processes
from ...training.trainer import Trainer
from ..folder import memory_for_targets, open_trained, with_corrected_masks
from ..setup.device import choose_device


def follow(options: argparse.Namespace) -> None:
    """Train with the first process, which plans, decides when to stop, evaluates, reports and writes.

    Raises:
        InputError: the reconstruction cannot be opened.
        ProcessLost: another process has ended.
    """
    silent = StoppingReporter(Reporter(), StopRequest())
    device = choose_device(options.device, silent)
    with closing(Processes(device)) as team:
        order, *_ = team.wait()
        if order == Order.END:
            return
        options.folder, options.capture = options.out, None
        trained = open_trained(options, silent)
        capture = with_corrected_masks(trained, silent)
        gains, checkpoint = trained.scene.gains, trained.folder.checkpoint
        del trained  # The model, which may be large.
        resumed = Trainer.resume(capture, checkpoint, None, memory_for_targets(options), device, gains)
        assert resumed is not None
        with suppress(InputError):  # The first process reports it.
            resumed[0].follow(team)
