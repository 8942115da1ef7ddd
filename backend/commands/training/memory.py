"""The memory that a training takes, computed before it begins."""

from __future__ import annotations

from ...model.anchors import Layout
from ...model.object_model import anchors_in_view
from ...shared.events import Reporter
from ...training.processes.team import processes_here
from ...training.step import frustum
from ...training.trainer import Trainer
from ..setup.machine import free_memory

_BASE = 0.7e9
"""Bytes of a training without a model and views: packages and kernels."""

_A_PIXEL = 180
"""Bytes of a pixel of the view that a step draws: the planes of the render and of its loss, and their gradients."""

_COPIES = 5
"""Arrays with the size of the anchors' rows: the rows, two moments, their mean, and one that growth replaces."""

_COPIES_IN_VIEW = 3
"""The same for the anchors in one view: their rows, the gradient, and what is generated of them."""

_VIEWS = 20
"""Number of views in which anchors are counted."""

_ROUNDING = 10_000


def bytes_per_anchor(layout: Layout, in_view: float) -> float:
    """Return the bytes that an anchor takes in a training on the CPU.

    Args:
        layout: columns of the anchors' rows.
        in_view: the largest fraction of the anchors in one view.
    """
    return 4 * layout.columns * (_COPIES + _COPIES_IN_VIEW * in_view) + 8 * layout.offsets + 24


def warn_of_memory(trainer: Trainer, memory_mb: float, reporter: Reporter) -> None:
    """Warn if a training on the CPU may take more memory than is free, and say what helps.

    Args:
        trainer: of a model or of a cell, before its first step or resumed.
        memory_mb: the limit for decoded images.
        reporter: receives the warning.
    """
    anchors, capture, fixed = trainer.model.anchors, trainer.scene.capture, trainer.region.fixed
    if trainer.model.device.type != "cpu" or not len(anchors):
        return
    views = capture.train_indices[:: -(-len(capture.train_indices) // _VIEWS)]
    counts = [len(anchors_in_view(anchors, *frustum(trainer.scene.camera(index)))) for index in views]
    each = bytes_per_anchor(anchors.layout, max(counts) / len(anchors))
    pixels = max(capture.views[index].width * capture.views[index].height for index in capture.train_indices)
    trained, rest = len(anchors) - fixed, _BASE + _A_PIXEL * pixels + memory_mb * 1e6 + fixed * each
    most, free = max(trainer.settings.max_anchors, trained), free_memory() / processes_here()
    if rest + most * each <= free:
        return
    fits = int((free - rest) / each) // _ROUNDING * _ROUNDING
    of_cell = not trainer.region.is_whole
    # Those with which a cell begins are not thinned out.
    if fits < (max(trained, _ROUNDING) if of_cell else _ROUNDING):
        advice = "close other programs, or use a smaller --memory-mb or --max-size"
    else:
        advice = f"{'--restart with ' if trainer.progress.step else ''}--max-anchors {fits} fits"
    otherwise = (
        "`split` with more --cells makes smaller ones" if of_cell else "`split` divides larger models into cells"
    )
    reporter.warning(
        f"With {most:,} anchors, this training may take {(rest + most * each) / 1e9:.0f} GB of memory, and "
        f"{free / 1e9:.0f} GB are free; {advice}, and {otherwise}."
    )
