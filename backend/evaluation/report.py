"""The report of a reconstruction: report.json for programs, report.md with plots and images for people."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from PIL import Image

from ..shared.color.palette import object_colors
from ..shared.formats.atomic import write_atomic
from ..shared.formats.json_file import plain, write_json
from ..shared.reconstruction.folder import Reconstruction
from .images import save_image
from .mesh_sheet import save_sheet
from .report_plots import plot_curve, plot_objects
from .report_text import (
    QUALITY,
    choose_objects,
    escape,
    left_out_section,
    meshes_section,
    objects_table,
    quality_section,
    stages_section,
    summarize,
    table,
    value_text,
)

MESH = ("vertices", "faces", "watertight", "chamfer", "precision", "recall", "f1")

_ENTRIES = {
    "left_out": ("what", "why"),
    "stages": ("name", "seconds", "peak_rss_mb"),
    "curve": ("seconds", "step", "psnr", "miou"),
    "objects": ("id", "name", "iou", "anchors", "mesh"),
}
_REQUIRED = {"left_out": ("what", "why"), "stages": ("name",), "curve": ("seconds",), "objects": ("id",)}
_TEXTS = ("what", "why", "name")


def complete(report: Mapping[str, Any]) -> dict[str, Any]:
    """Fill in all keys of report.json.

    Args:
        report: The content of report.json; any key may be missing.

    Returns:
        A copy with all keys, in a fixed order. Values that are missing, NaN or infinite are None.

    Raises:
        ValueError: An entry has the wrong type; the message contains its name.
    """
    as_json = plain(report, "report")
    out: dict[str, Any] = {}
    for name in ("capture", "settings", "machine"):
        out[name] = _mapping(as_json, name)
    for name in ("left_out", "stages", "curve"):
        out[name] = _entries(as_json, name)
    model = _mapping(as_json, "model")
    out["model"] = _numbers({**dict.fromkeys(("anchors", "gaussians", "bytes")), **model}, "model")
    quality = _mapping(as_json, "quality")
    out["quality"] = _numbers({**dict.fromkeys(QUALITY), **quality}, "quality", QUALITY)
    out["objects"] = _entries(as_json, "objects")
    for entry in out["objects"]:
        if entry["name"] is None:
            entry["name"] = str(entry["id"])
        entry["mesh"] = {**dict.fromkeys(MESH), **(entry["mesh"] or {})}
    out["curve"].sort(key=lambda entry: entry["seconds"])
    return {**out, **{name: value for name, value in as_json.items() if name not in out}}


def _mapping(as_json: Mapping[str, Any], name: str) -> dict[str, Any]:
    value = as_json.get(name)
    if value is not None and not isinstance(value, dict):
        raise ValueError(f"report.{name} must be an object, not a {type(value).__name__}")
    return value or {}


def _entries(as_json: Mapping[str, Any], name: str) -> list[dict[str, Any]]:
    value = as_json.get(name) or []
    if not isinstance(value, list) or not all(isinstance(entry, dict) for entry in value):
        raise ValueError(f"report.{name} must be a list of objects")
    entries = [{**dict.fromkeys(_ENTRIES[name]), **entry} for entry in value]
    for i, entry in enumerate(entries):
        for key in _REQUIRED[name]:
            if entry[key] is None:
                raise ValueError(f"report.{name}[{i}] has no {key}")
        for key in _ENTRIES[name]:
            if key == "mesh":
                if entry[key] is not None and not isinstance(entry[key], dict):
                    raise ValueError(f"report.{name}[{i}].mesh must be an object")
            elif key in _TEXTS:
                if entry[key] is not None and not isinstance(entry[key], str):
                    raise ValueError(f"report.{name}[{i}].{key} must be text, not {entry[key]!r}")
            else:
                _numbers(entry, f"{name}[{i}]", (key,))
    return entries


def _numbers(values: dict[str, Any], where: str, keys: Sequence[str] | None = None) -> dict[str, Any]:
    for key in keys or ("anchors", "gaussians", "bytes"):
        if values[key] is not None and (isinstance(values[key], bool) or not isinstance(values[key], int | float)):
            raise ValueError(f"report.{where}.{key} must be a number or null, not {values[key]!r}")
    return values


def write_report(
    reconstruction: Reconstruction,
    report: Mapping[str, Any],
    images: Sequence[tuple[str, Image.Image]] = (),
    colors: Mapping[int, Sequence[int]] | None = None,
    title: str = "Reconstruction",
    mesh_sheet: Image.Image | None = None,
) -> dict[str, Any]:
    """Write report.json and report.md with its plots and images.

    Args:
        reconstruction: The folder that receives the files.
        report: The content of report.json, see `complete`.
        images: (caption, image) of each image in report.md.
        colors: Object ID -> (red, green, blue), 0 .. 255, for objects whose color is not the palette's.
        title: The heading of report.md.
        mesh_sheet: The contact sheet of all meshes. None removes that of an earlier report.

    Returns:
        The content of report.json as written.

    Raises:
        ValueError: An entry of `report` has the wrong type.
    """
    report = complete(report)
    folder = reconstruction.pictures
    folder.mkdir(parents=True, exist_ok=True)
    shown, rule = choose_objects(report["objects"])
    palette = {**object_colors(entry["id"] for entry in shown), **(colors or {})}
    curve = plot_curve(report["curve"])
    curve_file = curve and save_image(curve, folder / "error-over-time.png")
    bars = plot_objects(shown, palette)
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
        parts += ["## Quality over run time", f"![PSNR and mIoU over run time]({link(curve_file)})"]
    if files:
        parts.append("## Images")
        parts += [f"**{escape(caption)}**\n\n![{escape(caption)}]({link(path)})" for caption, path in files]
    if shown:
        parts += ["## Objects", *([rule] if rule else [])]
        if bars_file:
            parts.append(f"![IoU of each object]({link(bars_file)})")
        parts.append(objects_table(shown, {i: link(path) for i, path in swatches.items()}))
    parts += meshes_section(report, None if mesh_sheet is None else link(sheet_file))
    parts += [*stages_section(report), *left_out_section(report)]
    for name, heading in (("model", "Model"), ("capture", "Capture"), ("settings", "Settings"), ("machine", "Machine")):
        rows = [(escape(key), value_text(key, value)) for key, value in report[name].items()]
        if rows:
            parts += [f"## {heading}", table(("", "Value"), rows)]
    parts.append("All values are in `report.json`. A dash (—) marks a value that was not measured or not set.")
    write_json(reconstruction.report_json, report)
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
