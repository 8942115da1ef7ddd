"""How long a training takes and how good it is expected to become, to be said before it begins.

Standard library only, so that Blender's own Python can import it.
"""

from __future__ import annotations

import math
from bisect import bisect_left

DEFAULT_SECONDS = 300.0

PRESET_STEPS = {"preview": 600, "standard": 1500}
"""Lengths by name; `benchmarks/length.py` measures their places on the curve of error against run time."""

SHORT_OF_FINAL = {248: (3.6, 3.6), 488: (1.7, 1.7), 600: (1.2, 1.2), 1114: (0.5, 0.5), 1500: (0.2, 0.2)}
"""Steps -> by how many dB, PSNR of held-out views, trainings of so many fell short of one with an open end: the least
and the most of the captures that were measured, here those of the demo in docs/length.md."""

NANOSECONDS_A_PIXEL = (300.0, 1200.0)
"""What a step takes on a CPU for each pixel of a view, at least and at most, as long as nothing was measured here."""

_FINAL = "a training until it stops improving"


def expectation(
    steps: int | None, seconds: float | None, pixels: float | None, trained: tuple[int, float] = (0, 0.0)
) -> str | None:
    """What to expect of a training of so many steps, or of so many seconds, in a sentence; None where nobody knows.

    trained: how many steps of the same training are done, and the seconds they took; before it begins the time is
    guessed from the pixels of a view (None: it runs on something else than a CPU).
    """
    where = ""
    if all(trained):
        fastest = slowest = trained[1] / trained[0]
    elif pixels:
        fastest, slowest = (1e-9 * each * pixels for each in NANOSECONDS_A_PIXEL)
        where = " on a CPU"
    else:
        fastest = slowest = 0.0
    if steps is not None:
        fewest = most = float(steps)
        length = f" in {_range(_duration(steps * fastest), _duration(steps * slowest))}{where}" if slowest else ""
    elif seconds is not None and slowest:
        fewest, most = seconds / slowest, seconds / fastest
        length = f" of {_range(f'{_rounded(fewest):,}', f'{_rounded(most):,}')} steps{where}"
    else:
        return None
    if most < min(SHORT_OF_FINAL):
        return f"Expected{length}: more than {shortfall(most)[0]:.1f} dB below {_FINAL}"
    best, worst = (f"{short:.1f}" for short in (shortfall(most)[0], shortfall(fewest)[1]))
    if worst == "0.0":
        return f"Expected{length}: as good as {_FINAL}"
    return f"Expected{length}: {f'up to {worst}' if best == '0.0' else _range(best, worst)} dB below {_FINAL}"


def shortfall(steps: float) -> tuple[float, float]:
    """By how many dB so many steps fall short of a training with an open end, the least and the most: between what
    was measured, as the logarithm of the steps goes; outside, as at the nearest."""
    known = sorted(SHORT_OF_FINAL)
    above = bisect_left(known, steps)
    if above in (0, len(known)):
        return SHORT_OF_FINAL[known[min(above, len(known) - 1)]]
    before, after = known[above - 1], known[above]
    part = math.log(steps / before) / math.log(after / before)
    least, most = (
        (1 - part) * there + part * here
        for there, here in zip(SHORT_OF_FINAL[before], SHORT_OF_FINAL[after], strict=True)
    )
    return least, most


def _range(least: str, most: str) -> str:
    return least if least == most else f"{least} to {most}"


def _rounded(count: float) -> int:
    """To two digits, at least 1."""
    return int(round(count, 1 - math.floor(math.log10(count)))) if count >= 1 else 1


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{round(seconds)} s"
    return f"{seconds / 60:.0f} min" if seconds >= 600 else f"{seconds / 60:.1f} min"
