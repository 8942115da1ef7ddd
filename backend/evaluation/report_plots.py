"""The plots of a report: quality over run time, and the IoU of each object."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any

from PIL import Image

from ..shared.reconstruction.report import MIOU_LABELS, lead_miou

_STYLE: dict[Any, Any] = {
    "font.size": 10,
    "axes.edgecolor": "#b9b9bf",
    "axes.labelcolor": "#55555b",
    "axes.titlecolor": "#26262a",
    "axes.titlesize": 12,
    "axes.titlelocation": "left",
    "axes.titlepad": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.grid.axis": "y",
    "axes.axisbelow": True,
    "grid.color": "#e9e9ec",
    "grid.linewidth": 0.8,
    "xtick.color": "#77777d",
    "ytick.color": "#77777d",
    "xtick.major.size": 3,
    "ytick.major.size": 0,
    "figure.facecolor": "white",
    "text.color": "#26262a",
}


def curve_measures(curve: Sequence[Mapping[str, Any]], zero_is_background: bool = False) -> dict[str, str]:
    """Return what `plot_curve` draws: the names for the user by the entries' keys; empty if nothing was measured."""
    lead = lead_miou(curve[-1] if curve else {}, zero_is_background)
    known = {"psnr": "PSNR", lead: MIOU_LABELS[lead]}
    return {key: name for key, name in known.items() if any(entry.get(key) is not None for entry in curve)}


def plot_curve(curve: Sequence[Mapping[str, Any]], zero_is_background: bool = False) -> Image.Image | None:
    """Plot PSNR and mIoU on held-out views over the run time, one panel each; None if nothing was measured.

    The mIoU is `lead_miou` of the latest measurement.
    """
    panels = []
    for key, name in curve_measures(curve, zero_is_background).items():
        title, color, how = (
            (f"{name} (dB), higher is better", "#3b7dd8", "{:.2f} dB")
            if key == "psnr"
            else (f"{name}, 1 is perfect", "#d9731a", "{:.3f}")
        )
        panels.append(
            (title, color, how, [(entry["seconds"], entry[key]) for entry in curve if entry.get(key) is not None])
        )
    if not panels:
        return None
    longest = max(point[0] for panel in panels for point in panel[3])
    divisor, unit = (
        (1.0, "seconds") if longest <= 300 else (60.0, "minutes") if longest <= 3 * 3600 else (3600.0, "hours")
    )

    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(_STYLE):
        figure = Figure(figsize=(5.0 * len(panels), 3.3), dpi=110, layout="constrained")
        figure.get_layout_engine().set(w_pad=0.15, wspace=0.04)  # type: ignore[call-arg, union-attr]
        for axes, (title, color, how, points) in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels):
            x = [point[0] / divisor for point in points]
            y = [point[1] for point in points]
            axes.plot(x, y, color=color, linewidth=2, marker="o", markersize=4 if len(x) <= 40 else 0)
            axes.plot(x[-1], y[-1], "o", color=color, markersize=6)
            axes.annotate(
                how.format(y[-1]),
                (x[-1], y[-1]),
                xytext=(0, 9),
                textcoords="offset points",
                ha="right" if len(x) > 1 else "center",
                color=color,
                fontweight="bold",
            )
            axes.set_title(title)
            axes.set_xlabel(f"run time ({unit})")
            axes.set_xlim(left=0)
            axes.margins(y=0.18)
        return _render(figure)


def plot_objects(
    objects: Sequence[Mapping[str, Any]], colors: Mapping[int, Sequence[int]], iou: str = "iou"
) -> Image.Image | None:
    """Plot the IoU of each object, its entry `iou`, as a bar in its color, the best on top; None if no object was
    measured."""
    measured = sorted((entry for entry in objects if entry[iou] is not None), key=lambda entry: entry[iou])
    if not measured:
        return None
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context({**_STYLE, "axes.grid.axis": "x", "axes.spines.left": False}):
        figure = Figure(figsize=(7.0, 0.9 + 0.27 * len(measured)), dpi=110, layout="constrained")
        axes = figure.subplots()
        values = [entry[iou] for entry in measured]
        bar_colors = [tuple(channel / 255 for channel in colors[entry["id"]]) for entry in measured]
        axes.barh(range(len(values)), values, color=bar_colors, height=0.68)
        for row, value in enumerate(values):
            axes.text(value + 0.012, row, f"{value:.3f}", va="center", fontsize=9, color="#55555b")
        labels = [str(entry["name"]).replace("$", r"\$") for entry in measured]
        axes.set_yticks(range(len(values)), [text if len(text) <= 28 else text[:27] + "…" for text in labels])
        axes.tick_params(axis="y", colors="#26262a")
        axes.set_xlim(0, 1.09)
        axes.set_xticks([0, 0.25, 0.5, 0.75, 1.0])
        axes.set_ylim(-0.6, len(values) - 0.4)
        axes.set_title("IoU of each object")
        return _render(figure)


def _render(figure: Any) -> Image.Image:
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    buffer = io.BytesIO()
    FigureCanvasAgg(figure)
    figure.savefig(buffer, format="png")
    return Image.open(buffer).convert("RGB")
