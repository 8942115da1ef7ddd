"""The figures that docs/results.md and README quote, as text, from the figures of the benchmarks."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from typing import Any

from benchmarks import length, shared

SOURCES = ("length", "mask-noise", "reliability", "stability")
"""The figures that are quoted."""

_FORMS = {
    "psnr": "{:.1f}", "miou": "{:.3f}", "mbiou": "{:.3f}", "f1_005": "{:.2f}", "f1": "{:.3f}", "f1_least": "{:.2f}",
    "texture_psnr": "{:.1f}",
}  # fmt: skip


def values(figures: Mapping[str, Mapping[str, Any]]) -> dict[str, str]:
    """Return name -> text of each figure that the templates quote.

    Args:
        figures: name -> figures of the benchmarks, as in docs/figures.

    Raises:
        KeyError: figures are missing.
    """
    lengths = figures["length"]
    demo = lengths[length.DEMO]
    short, minute, longest = (lengths[f"{seconds} s"] for seconds in length.QUOTED)
    noise = figures["mask-noise"]["cases"]["wrong IDs"]["0.3"]
    rows = figures["stability"]["rows"]
    meshed = [row for row in demo if row["mesh_seconds"]]
    return {
        **{f"demo_{name}": _spread(demo, name) for name in _FORMS},
        "demo_texture": _spread(demo, "texture_psnr"),
        "demo_minutes": f"{length.DEMO_SECONDS / 60:.1f}",
        "demo_seeds": str(len(demo)),
        **{f"{label}_seconds": str(seconds) for label, seconds in zip(("short", "minute", "longest"), length.QUOTED)},
        "short_miou": _spread(short, "miou"),
        "short_f1_005": _spread(short, "f1_005"),
        "minute_psnr": _spread(minute, "psnr"),
        "longest_psnr": _spread(longest, "psnr"),
        "noise_masks": f"{noise['masks']['miou_all']:.3f}",
        "noise_rendered": f"{noise['rendered']['miou_all']:.3f}",
        "noise_held_out": f"{noise['held_out']['miou_all']:.3f}",
        "stability_held": str(sum(row["held"] for row in rows)),
        "stability_cases": str(len(rows)),
        "fuzz_cases": f"{sum(figures['reliability']['cases'].values()):,}",
        "mesh_seconds": f"{statistics.fmean(row['mesh_seconds'] for row in meshed):.0f}",
        "mesh_gb": f"{max(row['mesh_mb'] for row in meshed) / 1000:.1f}",
    }


def _spread(rows: Sequence[Mapping[str, Any]], name: str) -> str:
    return shared.spread([row[name] for row in rows], _FORMS[name])
