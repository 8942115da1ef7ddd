"""The report of a reconstruction: report.json for programs, report.md with plots and images for people."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from PIL import Image

from ..shared.color.palette import object_colors
from ..shared.formats.atomic import write_atomic
from ..shared.reconstruction.folder import Reconstruction
from ..shared.reconstruction.report import Report, complete, write_report_json
from .images import save_image
from .mesh_sheet import save_sheet
from .report_plots import curve_measures, plot_curve, plot_objects
from .report_text import (
    choose_objects,
    escape,
    left_out_section,
    meshes_section,
    objects_table,
    quality_section,
    row_name,
    stages_section,
    summarize,
    table,
    value_text,
)


def write_report(
    reconstruction: Reconstruction,
    report: Report,
    images: Sequence[tuple[str, Image.Image]] = (),
    colors: Mapping[int, Sequence[int]] | None = None,
    title: str = "Reconstruction",
    mesh_sheet: Image.Image | None = None,
) -> Report:
    """Write report.json and report.md with its plots and images.

    Args:
        reconstruction: The folder that receives the files.
        report: The content of report.json; values that were not measured may be missing.
        images: (caption, image) of each image in report.md.
        colors: Object ID -> (red, green, blue), 0 .. 255, for objects whose color is not the palette's.
        title: The heading of report.md.
        mesh_sheet: The contact sheet of all meshes. None removes that of an earlier report.

    Returns:
        The report as written, see `complete`.

    Raises:
        ValueError: An entry of `report` has the wrong type.
    """
    report = complete(report)
    folder = reconstruction.pictures
    folder.mkdir(exist_ok=True)
    # The objects' IoU whose mean is the leading mIoU.
    iou = {"miou_all": "iou_all", "miou": "iou"}[report.lead_miou]
    shown, rule = choose_objects(report.objects, iou)
    palette = {**object_colors(entry["id"] for entry in shown), **(colors or {})}
    curve = plot_curve(report.curve, report.zero_is_background)
    curve_file = curve and save_image(curve, folder / "error-over-time.png")
    bars = plot_objects(shown, palette, iou)
    bars_file = bars and save_image(bars, folder / "objects.png")
    files: list[tuple[str, Path]] = []
    for i, (caption, image) in enumerate(images):
        slug = re.sub(r"[^a-z0-9]+", "-", caption.lower()).strip("-")[:40]
        files.append((caption, save_image(image, folder / f"{i + 1:02d}-{slug}.png")))
    sheet_file = folder / "meshes.png"
    if mesh_sheet is None:
        sheet_file.unlink(missing_ok=True)
    else:
        save_sheet(mesh_sheet, sheet_file)
    swatches = _write_swatches(folder / "swatches", shown, palette)

    def link(path: Path) -> str:
        return path.relative_to(reconstruction.report_md.parent).as_posix()

    parts = [f"# {escape(title)}", summarize(report), *quality_section(report)]
    if curve_file:
        drawn = " and ".join(curve_measures(report.curve, report.zero_is_background).values())
        parts += [f"## {drawn} over run time", f"![{drawn} of held-out views over run time]({link(curve_file)})"]
        last, steps = report.curve[-1]["step"], report.model.get("trained_steps")
        if last is not None and steps is not None and last < steps:
            parts.append(f"The last measurement was after {last:,} of {steps:,} steps.")
    if files:
        parts.append("## Images")
        parts += [f"**{escape(caption)}**\n\n![{escape(caption)}]({link(path)})" for caption, path in files]
    if shown:
        parts += ["## Objects", *([rule] if rule else [])]
        if bars_file:
            parts.append(f"![IoU of each object]({link(bars_file)})")
        parts.append(objects_table(shown, {i: link(path) for i, path in swatches.items()}, iou))
    parts += meshes_section(report, None if mesh_sheet is None else link(sheet_file))
    parts += [*stages_section(report), *left_out_section(report)]
    for name, heading in (("model", "Model"), ("capture", "Capture"), ("settings", "Settings"), ("machine", "Machine")):
        rows = [(row_name(key), value_text(key, value)) for key, value in getattr(report, name).items()]
        if rows:
            parts += [f"## {heading}", table(("", "Value"), rows)]
    parts.append("All values are in `report.json`. A dash (—) marks a value that was not measured or not set.")
    write_report_json(reconstruction.folder, report)
    write_atomic(reconstruction.report_md, ("\n\n".join(parts) + "\n").encode())
    return report


def _write_swatches(
    folder: Path, objects: list[dict[str, Any]], colors: Mapping[int, Sequence[int]]
) -> dict[int, Path]:
    """Write one small image of each object's color, since Markdown has no colors."""
    paths = {}
    if objects:
        folder.mkdir(exist_ok=True)
    for entry in objects:
        r, g, b = colors[entry["id"]]
        paths[entry["id"]] = save_image(Image.new("RGB", (16, 16), (r, g, b)), folder / f"{entry['id']}.png")
    return paths
