"""The report of a reconstruction: report.json for programs, report.md with plots and pictures for people."""

from __future__ import annotations

import io
import json
import math
import re
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from PIL import Image

from ..palette import object_colours
from ..protocol import Reconstruction, plain, write_atomic, write_json
from .mesh_pictures import save_sheet
from .pictures import save_picture

QUALITY = ("psnr", "ssim", "lpips", "miou", "mbiou", "dice", "accuracy")
MESH = ("vertices", "faces", "watertight", "chamfer", "precision", "recall", "f1")
OBJECTS_SHOWN = 40

_ENTRIES = {
    "left_out": ("what", "why"),
    "stages": ("name", "seconds", "peak_rss_mb"),
    "curve": ("seconds", "step", "psnr", "miou"),
    "objects": ("id", "name", "iou", "anchors", "mesh"),
}
_REQUIRED = {"left_out": ("what", "why"), "stages": ("name",), "curve": ("seconds",), "objects": ("id",)}
_TEXTS = ("what", "why", "name")
_MEANINGS = {
    "psnr": (
        "PSNR",
        "dB",
        "how close the renders' pixels are to the photos; 30 dB is close, each 6 dB halve the error",
    ),
    "ssim": ("SSIM", "", "how well local structure agrees; 1 is equal"),
    "lpips": ("LPIPS", "", "difference that a viewer would notice; 0 is none"),
    "miou": ("mIoU", "", "overlap of rendered and true objects, mean over objects; 1 is perfect"),
    "mbiou": ("mBIoU", "", "the same, only along the objects' outlines"),
    "dice": ("Dice", "", "overlap again, as the Dice score"),
    "accuracy": ("Pixel accuracy", "", "part of the labelled pixels with the right object"),
}


def complete(report: Mapping[str, Any]) -> dict[str, Any]:
    """A copy of `report` with every name that readers rely on, in order; what is missing, NaN or infinite is null.

    Raises ValueError that names the entry where something has the wrong type: a program made it, not a user.
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
    pictures: Sequence[tuple[str, Image.Image]] = (),
    colours: Mapping[int, Sequence[int]] | None = None,
    title: str = "Reconstruction",
    mesh_sheet: Image.Image | None = None,
) -> dict[str, Any]:
    """Write report.json and report.md with its plots and `pictures` (caption, image); returns what report.json holds.

    `colours` are the objects' own (id -> red, green, blue 0 .. 255) where they differ from the palette's; `mesh_sheet`
    is the picture of the meshes.
    """
    report = complete(report)
    reconstruction.pictures.mkdir(parents=True, exist_ok=True)
    shown, rule = _objects_to_show(report["objects"])
    palette = {**object_colours(entry["id"] for entry in shown), **(colours or {})}
    files: list[tuple[str, Path]] = []
    curve = curve_plot(report["curve"])
    curve_file = curve and save_picture(curve, reconstruction.pictures / "error-over-time.png")
    bars = objects_plot(shown, palette)
    bars_file = bars and save_picture(bars, reconstruction.pictures / "objects.png")
    for i, (caption, image) in enumerate(pictures):
        slug = re.sub(r"[^a-z0-9]+", "-", caption.lower()).strip("-")[:40]
        files.append((caption, save_picture(image, reconstruction.pictures / f"{i + 1:02d}-{slug}.png")))
    sheet_file = reconstruction.pictures / "meshes.png"
    if mesh_sheet is None:
        sheet_file.unlink(missing_ok=True)
    else:
        save_sheet(mesh_sheet, sheet_file)
    swatches = _write_swatches(reconstruction.pictures / "swatches", shown, palette)

    def link(path: Path) -> str:
        return path.relative_to(reconstruction.report_md.parent).as_posix()

    parts = [f"# {_cell(title)}", _summary(report), *_quality_part(report)]
    if curve_file:
        parts += ["## Quality against run time", f"![PSNR and mIoU over run time]({link(curve_file)})"]
    if files:
        parts.append("## Pictures")
        parts += [f"**{_cell(caption)}**\n\n![{_cell(caption)}]({link(path)})" for caption, path in files]
    if shown:
        parts += ["## Objects", *([rule] if rule else [])]
        if bars_file:
            parts.append(f"![IoU of each object]({link(bars_file)})")
        parts.append(_objects_table(shown, {i: link(path) for i, path in swatches.items()}))
    parts += _meshes_part(report, None if mesh_sheet is None else link(sheet_file))
    parts += [*_stages_part(report), *_left_out_part(report)]
    for name, heading in (("model", "Model"), ("capture", "Capture"), ("settings", "Settings"), ("machine", "Machine")):
        rows = [(_cell(key), _value(key, value)) for key, value in report[name].items()]
        if rows:
            parts += [f"## {heading}", _table(("", "Value"), rows)]
    parts.append("Every figure is in `report.json`; — means not measured, or not set.")
    write_json(reconstruction.report_json, report)
    write_atomic(reconstruction.report_md, ("\n\n".join(parts) + "\n").encode())
    return report


def _summary(report: dict[str, Any]) -> str:
    """One sentence: what came out, how good, how long it took."""
    quality, model = report["quality"], report["model"]
    seconds = sum(stage["seconds"] or 0 for stage in report["stages"])
    facts = []
    if report["objects"]:
        facts.append(f"{len(report['objects']):,} object{'s' if len(report['objects']) != 1 else ''}")
    if model["gaussians"] is not None:
        facts.append(f"{model['gaussians']:,.0f} splats")
    if quality["psnr"] is not None:
        facts.append(f"PSNR {quality['psnr']:.2f} dB")
    if quality["miou"] is not None:
        facts.append(f"mIoU {quality['miou']:.3f}")
    if seconds:
        facts.append(f"{duration(seconds)} of computing")
    return (", ".join(facts) or "Nothing has been measured yet") + "."


def _quality_part(report: dict[str, Any]) -> list[str]:
    rows = []
    for key in QUALITY:
        label, unit, meaning = _MEANINGS[key]
        value = report["quality"][key]
        text = "—" if value is None else f"{value:.2f} {unit}" if unit else f"{value:.4f}"
        rows.append((label, f"**{text}**" if value is not None else text, meaning))
    intro = (
        "Measured on views that were held out of training (every 8th by file name). "
        "Pixels without a label in the masks count nowhere in the object scores."
    )
    return ["## Quality", intro, _table(("", "Value", "What it says"), rows, right=(1,))]


def _objects_to_show(objects: list[dict[str, Any]]) -> tuple[list[dict[str, Any]], str]:
    """All objects by ID, or, if there are many, the ones with the lowest IoU, with a sentence that says so."""
    by_id = sorted(objects, key=lambda entry: entry["id"])
    if len(objects) <= OBJECTS_SHOWN:
        return by_id, ""
    worst = sorted(by_id, key=lambda entry: math.inf if entry["iou"] is None else entry["iou"])
    return worst[:OBJECTS_SHOWN], (
        f"The {OBJECTS_SHOWN} objects of the lowest IoU; "
        f"the other {len(objects) - OBJECTS_SHOWN:,} are in `report.json`."
    )


def _objects_table(objects: list[dict[str, Any]], swatches: Mapping[int, str]) -> str:
    rows = [
        (
            f"![]({swatches[entry['id']]})",
            str(entry["id"]),
            _cell(entry["name"]),
            _number(entry["iou"], "{:.3f}"),
            _number(entry["anchors"], "{:,.0f}"),
        )
        for entry in objects
    ]
    return _table(("", "ID", "Name", "IoU", "Anchors"), rows, right=(1, 3, 4))


_MESH_COLUMNS = (
    ("Faces", "faces", "{:,.0f}"),
    ("Watertight", "watertight", ""),
    ("Manifold", "manifold", ""),
    ("Parts", "components", "{:,.0f}"),
    ("Cut faces", "self_intersections", "{:,.0f}"),
    ("Invented", "invented", "{:.1%}"),
    ("Chamfer", "chamfer", "{:.3g}"),
    ("Precision", "precision", "{:.3f}"),
    ("Recall", "recall", "{:.3f}"),
    ("F1", "f1", "{:.3f}"),
    ("F1 at 0.005", "f1_005", "{:.3f}"),
    ("F1 of all", "f1_all", "{:.3f}"),
    ("Texture", "texture_psnr", "{:.1f} dB"),
    ("Covered", "texture_coverage", "{:.1%}"),
)
_MESH_INTRO = """\
*Faces*: triangles; *watertight*: no open edges; *manifold*: and nowhere pinched; *parts*: separate pieces; \
*cut faces*: faces that cut through others of the mesh; *invented*: the share of faces that close what nobody saw."""
_TRUTH_INTRO = """\
*Chamfer*, *precision*, *recall* and *F1* compare with the true surface that the capture brings along, in its units: \
the mean distance, both ways, and the share of points that the other surface has within 0.02: of the mesh's, of the \
truth's, and both together. They count what at least two training views see; *F1 of all* counts hidden parts too."""
_TEXTURE_INTRO = """\
*Texture*: PSNR of the textured mesh against held-out photos inside the object's mask; *covered*: the share of the \
mask that the mesh covers."""


def _meshes_part(report: dict[str, Any], sheet: str | None) -> list[str]:
    """The section about meshes; nothing where there are none."""
    objects = [(entry["name"], entry["mesh"]) for entry in report["objects"]]
    named = [*objects, *((entry["name"], entry) for entry in report.get("meshes") or [])]
    made = [(name, mesh) for name, mesh in named if mesh.get("faces") is not None]
    without = [(name, mesh["why"]) for name, mesh in named if mesh.get("faces") is None and mesh.get("why")]
    if not made and not without:
        return []
    columns = [column for column in _MESH_COLUMNS if any(mesh.get(column[1]) is not None for _, mesh in made)]
    keys = {key for _, key, _ in columns}
    intros = ((_MESH_INTRO, "faces"), (_TRUTH_INTRO, "f1_all"), (_TEXTURE_INTRO, "texture_psnr"))
    parts = ["## Meshes", _mesh_summary(objects)]
    if sheet:
        parts.append(f"![Each mesh: surface, wires and texture]({sheet})")
    if made:
        rows = [[_cell(name), *(_mesh_cell(mesh.get(key), how) for _, key, how in columns)] for name, mesh in made]
        parts.append(_table(["", *(head for head, _, _ in columns)], rows, right=range(1, 1 + len(columns))))
        parts.append(" ".join(intro for intro, key in intros if key in keys))
    if without:
        parts.append(_table(("No mesh of", "Why"), [(_cell(name), _cell(why)) for name, why in without]))
    return parts


def _mesh_cell(value: Any, how: str) -> str:
    if value is None:
        return "—"
    return how.format(value) if how else {True: "yes", False: "**no**"}[bool(value)]


def _mesh_summary(objects: Sequence[tuple[str, dict[str, Any]]]) -> str:
    """One sentence: how many objects have a mesh, and how good these are."""
    made = [(name, mesh) for name, mesh in objects if mesh.get("faces") is not None]
    facts = [f"{len(made)} of {len(objects)} objects have a mesh"]
    for key in ("watertight", "manifold"):
        known = [mesh[key] for _, mesh in made if mesh.get(key) is not None]
        if known:
            facts.append(f"{'all' if all(known) else sum(known)} {key}")
    for key, label, how in (
        ("f1", "median F1 at 0.02", "{:.3f}"),
        ("texture_psnr", "median texture PSNR", "{:.1f} dB"),
    ):
        values = sorted((mesh[key], name) for name, mesh in made if mesh.get(key) is not None)
        if values:
            middle = statistics.median(value for value, _ in values)
            facts.append(f"{label} **{how.format(middle)}**, lowest {how.format(values[0][0])} ({_cell(values[0][1])})")
    return "; ".join(facts) + "."


def _stages_part(report: dict[str, Any]) -> list[str]:
    if not report["stages"]:
        return []
    rows = [
        (
            _cell(stage["name"]),
            "—" if stage["seconds"] is None else duration(stage["seconds"]),
            _number(stage["peak_rss_mb"], "{:,.0f} MB"),
        )
        for stage in report["stages"]
    ]
    return ["## Stages", _table(("Stage", "Time", "Peak memory"), rows, right=(1, 2))]


def _left_out_part(report: dict[str, Any]) -> list[str]:
    if not report["left_out"]:
        return ["## Left out", "Nothing was reported as left out."]
    rows = [(_cell(entry["what"]), _cell(entry["why"])) for entry in report["left_out"]]
    return ["## Left out", _table(("What", "Why"), rows)]


def duration(seconds: float) -> str:
    """Seconds as a person says them: 4.2 s, 35 s, 2 min 30 s, 1 h 05 min."""
    if seconds < 9.95:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


def _number(value: float | None, how: str) -> str:
    return "—" if value is None else how.format(value)


def _value(key: str, value: Any) -> str:
    """One entry of capture, settings, machine or model as text."""
    if value is None:
        return "—"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if key == "bytes" and isinstance(value, int | float):
        return f"{value / 1e6:,.1f} MB"
    if isinstance(value, int) and abs(value) >= 10_000 and key != "seed":
        return f"{value:,}"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list | dict):
        text = json.dumps(value, ensure_ascii=False)
        return _cell(text if len(text) <= 200 else text[:200] + " ...")
    return _cell(value)


def _cell(value: Any) -> str:
    """Text that cannot break out of a cell of a Markdown table."""
    text = " ".join(str(value).split())
    return re.sub(r"([\\|<>\[\]*_`])", r"\\\1", text)


def _table(head: Sequence[str], rows: Sequence[Sequence[str]], right: Sequence[int] = ()) -> str:
    lines = ["| " + " | ".join(head) + " |"]
    lines.append("|" + "|".join("---:" if i in right else "---" for i in range(len(head))) + "|")
    lines += ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join(lines)


def _write_swatches(
    folder: Path, objects: list[dict[str, Any]], colours: Mapping[int, Sequence[int]]
) -> dict[int, Path]:
    """One small picture of each object's colour, since Markdown has no colours."""
    paths = {}
    if objects:
        folder.mkdir(exist_ok=True)
    for entry in objects:
        r, g, b = colours[entry["id"]]
        paths[entry["id"]] = save_picture(Image.new("RGB", (16, 16), (r, g, b)), folder / f"{entry['id']}.png")
    return paths


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


def curve_plot(curve: Sequence[Mapping[str, Any]]) -> Image.Image | None:
    """PSNR and mIoU on held-out views over the run time, a panel each; None where nothing was measured."""
    panels = []
    for key, title, colour, how in (
        ("psnr", "PSNR (dB), higher is better", "#3b7dd8", "{:.2f} dB"),
        ("miou", "mIoU, 1 is perfect", "#d9731a", "{:.3f}"),
    ):
        points = [(entry["seconds"], entry[key]) for entry in curve if entry.get(key) is not None]
        if points:
            panels.append((title, colour, how, points))
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
        for axes, (title, colour, how, points) in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels):
            x = [point[0] / divisor for point in points]
            y = [point[1] for point in points]
            axes.plot(x, y, color=colour, linewidth=2, marker="o", markersize=4 if len(x) <= 40 else 0)
            axes.plot(x[-1], y[-1], "o", color=colour, markersize=6)
            axes.annotate(
                how.format(y[-1]),
                (x[-1], y[-1]),
                xytext=(0, 9),
                textcoords="offset points",
                ha="right" if len(x) > 1 else "center",
                color=colour,
                fontweight="bold",
            )
            axes.set_title(title)
            axes.set_xlabel(f"run time ({unit})")
            axes.set_xlim(left=0)
            axes.margins(y=0.18)
        return _drawn(figure)


def objects_plot(objects: Sequence[Mapping[str, Any]], colours: Mapping[int, Sequence[int]]) -> Image.Image | None:
    """The IoU of each object as a bar of its colour, best on top; None where it was not measured."""
    measured = sorted((entry for entry in objects if entry["iou"] is not None), key=lambda entry: entry["iou"])
    if not measured:
        return None
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context({**_STYLE, "axes.grid.axis": "x", "axes.spines.left": False}):
        figure = Figure(figsize=(7.0, 0.9 + 0.27 * len(measured)), dpi=110, layout="constrained")
        axes = figure.subplots()
        values = [entry["iou"] for entry in measured]
        bar_colours = [tuple(channel / 255 for channel in colours[entry["id"]]) for entry in measured]
        axes.barh(range(len(values)), values, color=bar_colours, height=0.68)
        for row, value in enumerate(values):
            axes.text(value + 0.012, row, f"{value:.3f}", va="center", fontsize=9, color="#55555b")
        labels = [str(entry["name"]).replace("$", r"\$") for entry in measured]
        axes.set_yticks(range(len(values)), [text if len(text) <= 28 else text[:27] + "…" for text in labels])
        axes.tick_params(axis="y", colors="#26262a")
        axes.set_xlim(0, 1.09)
        axes.set_xticks([0, 0.25, 0.5, 0.75, 1.0])
        axes.set_ylim(-0.6, len(values) - 0.4)
        axes.set_title("IoU of each object")
        return _drawn(figure)


def _drawn(figure: Any) -> Image.Image:
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    buffer = io.BytesIO()
    FigureCanvasAgg(figure)
    figure.savefig(buffer, format="png")
    return Image.open(buffer).convert("RGB")
