"""How far computed poses can be trusted, photo by photo: figures, weak photos with the reason, and a picture."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pycolmap

from ..shared.formats.atomic import write_atomic
from . import database
from .agreement import Agreement
from .worker import residuals

_WEAK_SUPPORT = 0.8
"""Fraction of a photo's matches that fit to the poses, below which it is weak."""
_WEAK_ERROR = 2.5
"""Reprojection error relative to the median photo's, from which on a photo is weak, if it is also above a pixel."""
_FEW_POINTS = 40
_POINTS_SHOWN = 20_000
_NAMED = 6
_ALL_NAMED, _LONGEST_NAME = 30, 16
"""Largest number of photos whose names are all written along the axes, and of characters of such a name."""
_GOOD, _WEAK = "#3b7dd8", "#d9731a"


class PhotoFigures(NamedTuple):
    """Figures of a photo with a pose: `support` of `Agreement`, median reprojection error in pixels, and its points."""

    support: float
    error: float
    points: int


def figures_of(model: pycolmap.Reconstruction, agreement: Agreement) -> dict[str, PhotoFigures]:
    """Return the figures of the photos of a model, by name in alphabetical order."""
    distances: dict[int, list[float]] = {number: [] for number in model.reg_image_ids()}
    for distance, number, _ in residuals(model):
        distances[number].append(distance)
    found = {
        model.image(number).name: PhotoFigures(
            agreement.support.get(model.image(number).name, 0.0), float(np.median(own)) if own else 0.0, len(own)
        )
        for number, own in distances.items()
    }
    return dict(sorted(found.items()))


def mean_error(model: pycolmap.Reconstruction) -> float:
    """Return the mean reprojection error in pixels of the points that are seen where the lens allows."""
    found = np.array([distance for distance, _, _ in residuals(model)])
    found = found[np.isfinite(found)]
    return float(found.mean()) if len(found) else 0.0


def weak_photos(figures: Mapping[str, PhotoFigures]) -> dict[str, str]:
    """Return the photos whose poses are less certain than those of the others: name -> reason, worst first."""
    typical = float(np.median([each.error for each in figures.values()])) if figures else 0.0
    found: dict[str, tuple[float, str]] = {}
    for name, (support, error, points) in figures.items():
        if support < _WEAK_SUPPORT:
            found[name] = support, f"{1 - support:.0%} of its matches contradict its pose"
        elif error > max(_WEAK_ERROR * typical, 1.0):
            found[name] = 1.0 + typical / error, f"its points are off by {error:.1f} pixels, others by {typical:.1f}"
        elif points < _FEW_POINTS:
            found[name] = 2.0 + points, f"only {points} points determine its pose"
    return {name: why for name, (_, why) in sorted(found.items(), key=lambda entry: entry[1][0])}


def write_picture(
    target: Path, model: pycolmap.Reconstruction, figures: Mapping[str, PhotoFigures], path: Path, weak: Sequence[str]
) -> None:
    """Draw the scene from above, which photos match, and the photos' reprojection errors, as a PNG.

    Args:
        target: the PNG.
        model: the poses and points.
        figures: of `figures_of`.
        path: the database with the matches.
        weak: names of photos to emphasize.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    style: dict[Any, Any] = {
        "font.size": 9,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.titlelocation": "left",
    }
    with rc_context(style):
        figure = Figure(figsize=(13, 4.2), dpi=110, layout="constrained")
        top, matches, errors = figure.subplots(1, 3, width_ratios=(1.1, 1, 1.2))
        _draw_from_above(top, model, weak)
        _draw_matches(matches, list(figures), path)
        _draw_errors(errors, figures, weak)
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png")
    write_atomic(target, buffer.getvalue())


def _draw_from_above(axes, model: pycolmap.Reconstruction, weak: Sequence[str]) -> None:  # type: ignore[no-untyped-def]
    """Draw points and cameras, seen along the mean vertical of the photos."""
    images = [model.image(number) for number in model.reg_image_ids()]
    turns = np.array([image.cam_from_world().rotation.matrix() for image in images])
    centers = np.array([image.projection_center() for image in images])
    up = -turns[:, 1].sum(0)
    up /= max(float(np.linalg.norm(up)), 1e-12)
    right = np.cross(turns[0, 2], up)
    if np.linalg.norm(right) < 1e-6:
        right = turns[0, 0]
    right /= np.linalg.norm(right)
    plane = np.stack([right, np.cross(up, right)])
    points = list(model.points3D.values())
    shown = np.unique(np.linspace(0, len(points) - 1, _POINTS_SHOWN).astype(int)) if points else np.zeros(0, int)
    xyz = np.array([points[number].xyz for number in shown]).reshape(-1, 3) @ plane.T
    axes.scatter(*xyz.T, s=0.6, c=np.array([points[number].color for number in shown]).reshape(-1, 3) / 255, lw=0)
    places, axes_of_views = centers @ plane.T, turns[:, 2] @ plane.T
    colors = [_WEAK if image.name in weak else _GOOD for image in images]
    reach = 0.06 * max(float(np.ptp(places, axis=0).max()), 1e-6)
    axes.quiver(
        *places.T, *(reach * axes_of_views).T, color=colors, angles="xy", scale_units="xy", scale=1, width=0.004
    )
    axes.scatter(*places.T, s=12, c=colors, zorder=3)
    low, high = np.percentile(np.concatenate([xyz, places]), (1, 99), axis=0)
    low, high = np.minimum(low, places.min(0)), np.maximum(high, places.max(0))
    axes.set(xlim=(low[0] - reach, high[0] + reach), ylim=(low[1] - reach, high[1] + reach), xticks=[], yticks=[])
    axes.set_aspect("equal")
    axes.set_title(f"From above: {len(images)} photos, {len(points):,} points")


def _draw_matches(axes, names: Sequence[str], path: Path) -> None:  # type: ignore[no-untyped-def]
    """Draw the numbers of matches between photos, in the order of their names."""
    ids = database.image_ids(path)
    order = {ids[name]: number for number, name in enumerate(names) if name in ids}
    counts = np.full((len(names), len(names)), np.nan)
    for first, second, _, count in database.verified_pairs(path, names):
        counts[order[first], order[second]] = counts[order[second], order[first]] = np.log10(count)
    shown = axes.imshow(counts, cmap="Blues", vmin=1, vmax=3.2, interpolation="nearest")
    bar = axes.figure.colorbar(shown, ax=axes, shrink=0.8, ticks=[1, 2, 3])
    bar.ax.set_yticklabels(["10", "100", "1,000"])
    _name_photos(axes.xaxis, names)
    _name_photos(axes.yaxis, names)
    axes.set_title("Matches between photos, by name")


def _draw_errors(axes, figures: Mapping[str, PhotoFigures], weak: Sequence[str]) -> None:  # type: ignore[no-untyped-def]
    """Draw the reprojection error of each photo, and name all, or the weak ones of many."""
    values = [each.error for each in figures.values()]
    axes.bar(range(len(values)), values, width=1.0, color=[_WEAK if name in weak else _GOOD for name in figures])
    axes.axhline(float(np.median(values)), color="#26262a", lw=0.8, label="median of the photos")
    axes.legend(frameon=False, loc="upper right")
    numbers = {name: number for number, name in enumerate(figures)}
    for name in list(weak)[:_NAMED]:
        if name in numbers and len(figures) > _ALL_NAMED:
            at = numbers[name]
            axes.annotate(
                name, (at, values[at]), rotation=30, fontsize=7, ha="left", va="bottom", color=_WEAK, parse_math=False
            )
    axes.margins(y=0.25)
    _name_photos(axes.xaxis, list(figures))
    axes.set(xlabel="photo, by name", ylabel="pixels")
    axes.set_title("Median reprojection error of each photo;\nweak ones in orange")


def _name_photos(axis, names: Sequence[str]) -> None:  # type: ignore[no-untyped-def]
    """Write the names of photos along an axis if they are few enough; there are numbers otherwise."""
    if len(names) <= _ALL_NAMED:
        shown = [name if len(name) <= _LONGEST_NAME else f"…{name[1 - _LONGEST_NAME :]}" for name in names]
        axis.set_ticks(range(len(names)), shown, parse_math=False, fontsize=6)
        axis.set_tick_params(rotation=90 if axis.axis_name == "x" else 0)
