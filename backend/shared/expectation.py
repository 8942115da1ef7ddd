"""Estimates of a training's duration and quality, shown before it begins."""

from __future__ import annotations

import math
from bisect import bisect_left
from typing import NamedTuple

DEFAULT_SECONDS = 300.0

PRESET_STEPS = {"preview": 600, "standard": 1500}
"""Training lengths of the presets; `benchmarks/length.py` measures their error and run time."""

SHORT_OF_FINAL = {253: (3.8, 3.8), 600: (1.5, 1.5), 1055: (0.7, 0.7), 1500: (0.2, 0.2), 2842: (0.0, 0.0)}
"""Steps -> deficit of a training's PSNR on held-out views, in dB, relative to a training until convergence: minimum and
maximum over the measured captures, which are those of the demo in docs/length.md."""


class PsnrFit(NamedTuple):
    """A fit of the PSNR on held-out views, colors corrected, of trainings until they stop improving.

    Attributes:
        at_zero: dB where photos agree by 0 dB and have one million pixels.
        by_agreement: dB for each dB that the photos agree better.
        by_size: dB for each doubling of the photos' number of pixels.
        margin: dB to both sides, within which 80% of captures are that were not used for the fit.
    """

    at_zero: float
    by_agreement: float
    by_size: float
    margin: float


PSNR_FIT = PsnrFit(-4.44, 0.911, -2.12, 4.90)
"""Of the captures in docs/suite.md; printed by `benchmarks/suite.py`."""

NANOSECONDS_A_PIXEL = (300.0, 1200.0)
"""Minimum and maximum time of a step on a CPU per pixel of a view, used until a training has been measured."""

_SHARPNESS = ((0.3, "nearly as sharp as Best"), (1.0, "a little softer than Best"), (math.inf, "softer than Best"))
"""Largest deficits in dB and what a training with them looks like; Best is what a training until it stops improving is
called in Blender."""

_LOOKS = ((20.0, "rough"), (24.0, "soft"), (28.0, "good"), (33.0, "sharp"), (math.inf, "very sharp"))
"""PSNR in dB, and what a training below it looks like."""

_FAR_FEWER = 0.5
"""Fraction of the expected steps, below which the computer had too little time for a training."""

_FINAL = "a training until it stops improving (measured on the demo)"


class _Outlook(NamedTuple):
    """Bounds of a training: fewest and most steps, seconds of the fastest and the slowest (0 if unknown)."""

    fewest: float
    most: float
    fastest: float
    slowest: float


def typical_psnr(agreement: float, pixels: float) -> float:
    """Return the PSNR on held-out views, colors corrected, that a training until it stops improving typically has.

    Args:
        agreement: How well the photos agree, in dB, see `backend.planning.agreement`.
        pixels: Mean number of pixels of a photo.
    """
    fit = PSNR_FIT
    return fit.at_zero + fit.by_agreement * agreement + fit.by_size * math.log2(max(pixels, 1.0) / 1e6)


def expected_psnr(
    typical: float,
    steps: int | None,
    seconds: float | None,
    pixels: float | None,
    trained: tuple[int, float] = (0, 0.0),
) -> tuple[float, float]:
    """Return the bounds of the PSNR on held-out views, in dB, within which 80% of captures are after a training.

    Args:
        typical: The result of `typical_psnr`.
        steps, seconds, pixels, trained: As for `expectation`; a training of unknown speed is taken to be long enough.
    """
    outlook = _outlook(steps, seconds, pixels, trained)
    short = 0.0 if outlook is None else sum(shortfall(math.sqrt(outlook.fewest * outlook.most))) / 2
    return typical - short - PSNR_FIT.margin, typical - short + PSNR_FIT.margin


def expected_steps(seconds: float, pixels: float | None, trained: tuple[int, float] = (0, 0.0)) -> int | None:
    """Return the fewest steps in a time that `expectation` tells, with the same arguments; None if it tells none."""
    outlook = _outlook(None, seconds, pixels, trained)
    return None if outlook is None else _rounded(outlook.fewest)


def is_far_fewer(steps: int, expected: int | None) -> bool:
    """Return whether a training had far fewer steps than the `expected_steps` of its time."""
    return expected is not None and steps < _FAR_FEWER * expected


def expectation(
    steps: int | None,
    seconds: float | None,
    pixels: float | None,
    trained: tuple[int, float] = (0, 0.0),
    typical: float | None = None,
) -> str | None:
    """Describe the expected duration and quality of a training.

    Args:
        steps: Length in steps, or None.
        seconds: Length in seconds, or None; ignored if `steps` is given.
        pixels: Pixels of a view, from which the time on a CPU is estimated before the training begins; None on other
            devices.
        trained: Steps of the same training that are done, and the seconds that they took.
        typical: The result of `typical_psnr` for the capture; None if it is not known.

    Returns:
        A sentence, or None if there is no basis for an estimate.
    """
    outlook = _outlook(steps, seconds, pixels, trained)
    length, quality = "", []
    if typical is not None:
        bounds = _in_decibels(expected_psnr(typical, steps, seconds, pixels, trained))
        quality.append(f"PSNR of {bounds} on held-out views with their colors corrected, as on 80% of captures")
    if outlook is not None:
        where = "" if all(trained) or not outlook.slowest else " on a CPU"
        if steps is None:
            length = f" of {_range(f'{_rounded(outlook.fewest):,}', f'{_rounded(outlook.most):,}')} steps{where}"
        elif outlook.slowest:
            length = f" in {_between(outlook.fastest, outlook.slowest)}{where}"
        quality.append(f"{_below_final(outlook)} {_FINAL}")
    return f"Expected{length}: {'; '.join(quality)}" if quality else None


def expectation_in_words(
    steps: int | None,
    seconds: float | None,
    pixels: float | None,
    trained: tuple[int, float] = (0, 0.0),
    typical: float | None = None,
) -> str | None:
    """Describe a training's expected duration and sharpness in a few words, such as "about 2 to 8 min, probably good".

    The arguments are those of `expectation`; None if there is no basis for an estimate. What could be one or the other
    is not told.
    """
    outlook, said = _outlook(steps, seconds, pixels, trained), []
    if outlook is not None and steps is not None and outlook.slowest:
        said.append(f"about {_between(outlook.fastest, outlook.slowest)}")
    if typical is not None:
        said.append(f"probably {_word(_LOOKS, sum(expected_psnr(typical, steps, seconds, pixels, trained)) / 2)}")
    if outlook is not None:
        found = {_word(_SHARPNESS, sum(shortfall(each)) / 2) for each in (outlook.fewest, outlook.most)}
        said += found if len(found) == 1 else ()
    return ", ".join(said) or None


def _below_final(outlook: _Outlook) -> str:
    """Return how far trainings end below one until it stops improving, as the beginning of a clause."""
    if outlook.most < min(SHORT_OF_FINAL):
        return f"more than {shortfall(outlook.most)[0]:.1f} dB below"
    best, worst = (f"{short:.1f}" for short in (shortfall(outlook.most)[0], shortfall(outlook.fewest)[1]))
    if worst == "0.0":
        return "as good as"
    return f"{f'up to {worst}' if best == '0.0' else _range(best, worst)} dB below"


def _outlook(
    steps: int | None, seconds: float | None, pixels: float | None, trained: tuple[int, float]
) -> _Outlook | None:
    """Return the bounds of a training with the arguments of `expectation`; None if there is no basis for them."""
    fastest = slowest = 0.0
    if all(trained):
        fastest = slowest = trained[1] / trained[0]
    elif pixels:
        fastest, slowest = (1e-9 * each * pixels for each in NANOSECONDS_A_PIXEL)
    if steps is not None:
        return _Outlook(steps, steps, steps * fastest, steps * slowest)
    if seconds is not None and slowest:
        return _Outlook(seconds / slowest, seconds / fastest, seconds, seconds)
    return None


def _word(words: tuple[tuple[float, str], ...], value: float) -> str:
    return next(word for most, word in words if value <= most)


def _in_decibels(bounds: tuple[float, float]) -> str:
    return f"{_range(*(f'{bound:.0f}' for bound in bounds))} dB"


def shortfall(steps: float) -> tuple[float, float]:
    """Return the minimum and maximum PSNR deficit in dB of a training of `steps` steps.

    Interpolates `SHORT_OF_FINAL` linearly in log(steps); outside its range, the nearest value is used.
    """
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
    """Round to two significant digits, at least 1."""
    return int(round(count, 1 - math.floor(math.log10(count)))) if count >= 1 else 1


def _between(fastest: float, slowest: float) -> str:
    """Format two durations in seconds as one or as a range, such as 5 to 20 min."""
    least, most = _duration(fastest), _duration(slowest)
    number, unit = least.split()
    return _range(number if least != most and most.endswith(f" {unit}") else least, most)


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{round(seconds)} s"
    minutes = seconds / 60
    return f"{minutes:.0f} min" if minutes >= 3 else f"{round(minutes, 1):g} min"
