"""The sections of report.md as Markdown text."""

from __future__ import annotations

import json
import math
import re
import statistics
from collections.abc import Mapping, Sequence
from typing import Any

from ..shared.expectation import is_far_fewer
from ..shared.reconstruction.report import MIOU_LABELS, QUALITY, Report

OBJECTS_SHOWN = 40

_OF_OBJECTS = ("miou", "miou_all", "mbiou", "miou_alone", "dice", "accuracy")
"""The metrics that need masks of held-out photos."""
_PHOTOS_NAMED = 3

IOU_LABELS = {"iou_all": "IoU (all)", "iou": "IoU (labeled)"}
"""Names of the entries of an object that `MIOU_LABELS` are the means of."""

_MEANINGS = {
    "psnr": (
        "PSNR",
        "dB",
        "difference of the rendered pixels from the photos; 30 dB is good, 6 dB more halve the error",
    ),
    "psnr_corrected": (
        "PSNR, corrected",
        "dB",
        "the same with the colors of each render fitted to its photo, as if exposure and white balance were known",
    ),
    "ssim": ("SSIM", "", "similarity of local structure; 1 is identical"),
    "lpips": ("LPIPS", "", "perceptual difference; 0 is identical"),
    "miou": (
        MIOU_LABELS["miou"],
        "",
        "overlap of rendered and true masks where pixels have a label, mean over the objects; 1 is perfect",
    ),
    "miou_all": (
        MIOU_LABELS["miou_all"],
        "",
        "the same overlap over all pixels: an object that is rendered where no label is counts as an error",
    ),
    "miou_alone": (
        "mIoU alone",
        "",
        "overlap of the objects' masks with objects that are rendered without what hides them: parts that reach over "
        "the background count as errors",
    ),
    "mbiou": ("mBIoU", "", "the overlap on labeled pixels, but only along the outlines of the objects"),
    "dice": ("Dice", "", "overlap on labeled pixels as the Dice score, mean over the objects"),
    "accuracy": ("Pixel accuracy", "", "fraction of the labeled pixels that show the right object"),
}


_ROWS = {
    "anchors": "Anchors",
    "gaussians": "Splats",
    "bytes": "Size of splats.ply",
    "trained_steps": "Steps",
    "trained_seconds": "Time of all training",
    "psnr_of_export": "PSNR of splats.ply against the model, dB",
    "expected_psnr": "Expected PSNR, colors corrected, dB",
    "expected_steps": "Expected steps, at least",
    "skipped_updates": "Updates that were skipped, since they were not finite",
    "skipped_because_of": "Causes of these",
    "folder": "Folder",
    "views": "Photos that are used",
    "held_out": "Held-out photos",
    "validation": "Validation photos",
    "validation_joined": "Validation photos are trained on at the end",
    "objects": "Objects in the masks",
    "registered": "Photos with a pose",
    "used": "Photos with a pose and a file",
    "missing": "Photos with a pose, but no file",
    "unregistered": "Photos without a pose",
    "masks": "Masks",
    "points": "Points",
    "cameras": "Lenses",
    "exposure_varies": "Exposure varies",
    "supervise_background": "Pixels without a label are background",
    "minutes": "`--minutes`",
    "steps": "`--steps`",
    "max_size": "`--max-size`, pixels",
    "strategy": "`--strategy`",
    "seed": "`--seed`",
    "mode": "`--mode`",
    "sh_degree": "`--sh-degree`",
    "offsets": "`--offsets`",
    "voxel": "`--voxel`",
    "max_anchors": "`--max-anchors`",
    "background": "`--background`",
    "semantic_weight": "`--semantic-weight`",
    "ssim_weight": "Weight of SSIM in the loss",
    "volume_weight": "Weight of the splats' volume in the loss",
    "zero_is_object": "`--unlabeled-is-object`",
    "primitive": "`--primitive`",
    "normal_weight": "`--normal-weight`",
    "distortion_weight": "`--distortion-weight`",
    "pyramid": "Begins with reduced photos (—: large ones alone)",
    "fit_colors": "Fits the colors of each photo",
    "objectgs": "ObjectGS",
    "python": "Python",
    "system": "System",
    "cores": "Processor cores",
    "threads": "Threads",
    "memory_gb": "Memory, GB",
    "gpu_memory_gb": "Memory of the GPU, GB",
    "cuda": "CUDA or ROCm",
    "device": "Trained on",
}
"""Names for the user of entries of `model`, `capture`, `settings` and `machine`; others, as packages, have none."""


def summarize(report: Report) -> str:
    """Return one sentence with the numbers of objects and splats, the quality and the computing time."""
    quality, model = report.quality, report.model
    seconds = sum(stage["seconds"] or 0 for stage in report.stages)
    facts = []
    if report.objects:
        facts.append(f"{len(report.objects):,} object{'s' if len(report.objects) != 1 else ''}")
    if model["gaussians"] is not None:
        facts.append(f"{model['gaussians']:,.0f} splats")
    if quality["psnr"] is not None:
        facts.append(f"PSNR {quality['psnr']:.2f} dB")
    lead = report.lead_miou
    if quality[lead] is not None:
        facts.append(f"{MIOU_LABELS[lead]} {quality[lead]:.3f}")
    if seconds:
        facts.append(f"{duration(seconds)} of computing time")
    return (", ".join(facts) or "Nothing has been measured yet") + "."


def quality_section(report: Report) -> list[str]:
    if all(value is None for value in report.quality.values()):
        return [each for each in ("## Quality", _why_nothing(report), _of_expectation(report)) if each]
    rows = []
    lead = report.lead_miou
    without = "" if any(report.quality[key] is not None for key in _OF_OBJECTS) else _why_no_objects(report)
    order = [key for key in QUALITY if key not in MIOU_LABELS]
    order[order.index("mbiou") : order.index("mbiou")] = sorted(MIOU_LABELS, key=lambda key: key != lead)
    for key in order:
        if report.quality[key] is None and (key == "miou_alone" or (without and key in _OF_OBJECTS)):
            continue
        label, unit, meaning = _MEANINGS[key]
        value = report.quality[key]
        text = "—" if value is None else f"{value:.2f} {unit}" if unit else f"{value:.4f}"
        rows.append((label, f"**{text}**" if value is not None else text, meaning))
    intro = (
        "Measured on the held-out views (every 8th image by file name, or those in test.txt), which were not used for "
        f"training. {_of_validation(report)}{without or _of_unlabeled(report)}"
    )
    parts = ["## Quality", intro, table(("", "Value", "Meaning"), rows, right=(1,))]
    if expected := _of_expectation(report):
        parts.append(expected)
    by_view = sorted((view[lead], view["name"]) for view in report.views if view.get(lead) is not None)
    if by_view:
        middle = statistics.median(value for value, _ in by_view)
        lowest, name = by_view[0]
        parts.append(
            f"{MIOU_LABELS[lead]} of single views: median {middle:.3f}, lowest {lowest:.3f} ({escape(name)}); all are "
            "in `report.json`."
        )
    return parts


def _why_nothing(report: Report) -> str:
    """Return a sentence on why nothing was measured, and what to do."""
    if report.capture.get("held_out") == 0:
        return "Not measured, since no photo is held out; the capture's test.txt can name some."
    return "Not measured yet; run `evaluate`, and then `report` again."


def _why_no_objects(report: Report) -> str:
    """Return a sentence on why no object was measured, and what to do."""
    if not report.capture.get("masks"):
        return "Objects were not measured, since the capture has no masks, which `masks` makes."
    names = [escape(view["name"]) for view in report.views]
    shown = names if len(names) <= _PHOTOS_NAMED else [*names[:_PHOTOS_NAMED], f"{len(names) - _PHOTOS_NAMED:,} more"]
    listed = f"{', '.join(shown[:-1])} and {shown[-1]}" if len(shown) > 1 else "".join(shown)
    return (
        "Objects were not measured, since no held-out photo has a mask with an object; those that `label` makes are of "
        f"training photos alone. Add masks of {listed} with the same IDs, and run `evaluate` and `report` again."
    )


def _of_expectation(report: Report) -> str:
    """Return how PSNR and steps compare with what was expected before the training; empty without an expectation."""
    bounds, found = report.model.get("expected_psnr"), report.quality["psnr_corrected"]
    steps, expected, sentences = report.model.get("trained_steps"), report.model.get("expected_steps"), []
    if bounds and found is not None:
        low, high = bounds
        verdict = "lower than" if found < low else "higher than" if found > high else "as"
        sentences.append(
            f"Expected before the training, from how well the photos agree: {low:.1f} to {high:.1f} dB with the colors "
            f"corrected, as on 80% of the captures measured so far. The result is {verdict} expected."
        )
    if steps is not None and is_far_fewer(steps, expected):
        sentences.append(
            f"Only {steps:,} steps were trained in the time that was given, of {expected:,} or more that were "
            "expected, perhaps since other programs used the processors; train for more minutes."
        )
    return " ".join(sentences)


def _of_validation(report: Report) -> str:
    """Return the sentence about the views that decided when the training ended; empty if there are none."""
    count = report.capture.get("validation")
    if not count:
        return ""
    views = "1 other view was" if count == 1 else f"{count} other views were"
    if report.capture.get("validation_joined"):
        return f"{views} trained on in the last part alone, since their PSNR tells when that begins. "
    return f"{views} used for validation instead of training: their PSNR tells when the training has converged. "


def _of_unlabeled(report: Report) -> str:
    """Return the sentence about what pixels without a label count for."""
    if report.quality["miou_all"] is None:
        return "Pixels without a label in the masks do not count in the object scores."
    if report.zero_is_background:
        return (
            "Pixels without a label in the masks show the background: objects that are rendered there count as errors "
            "in mIoU (all); the other object scores ignore these pixels."
        )
    return (
        "Pixels without a label in the masks are gaps, and objects that are rendered there may be right, although "
        "mIoU (all) counts them as errors; the other object scores ignore these pixels."
    )


def choose_objects(objects: list[dict[str, Any]], iou: str = "iou") -> tuple[list[dict[str, Any]], str]:
    """Return all objects by ID or, if there are many, those with the lowest IoU (the entry `iou`), and a sentence about
    the selection."""
    by_id = sorted(objects, key=lambda entry: entry["id"])
    if len(objects) <= OBJECTS_SHOWN:
        return by_id, ""
    worst = sorted(by_id, key=lambda entry: math.inf if entry[iou] is None else entry[iou])
    return worst[:OBJECTS_SHOWN], (
        f"These are the {OBJECTS_SHOWN} objects with the lowest IoU; "
        f"the other {len(objects) - OBJECTS_SHOWN:,} are in `report.json`."
    )


def objects_table(objects: list[dict[str, Any]], swatches: Mapping[int, str], iou: str = "iou") -> str:
    columns = [
        (head, key, how)
        for head, key, how in (
            (IOU_LABELS[iou], iou, "{:.3f}"), ("IoU alone", "iou_alone", "{:.3f}"), ("Anchors", "anchors", "{:,.0f}")
        )
        if key == "anchors" or any(entry[key] is not None for entry in objects)
    ]  # fmt: skip
    rows = [
        [f"![]({swatches[entry['id']]})", str(entry["id"]), escape(entry["name"])]
        + [_number(entry[key], how) for _, key, how in columns]
        for entry in objects
    ]
    return table(["", "ID", "Name", *(head for head, _, _ in columns)], rows, right=(1, *range(3, 3 + len(columns))))


_MESH_COLUMNS = (
    ("Faces", "faces", "{:,.0f}"),
    ("Watertight", "watertight", ""),
    ("Manifold", "manifold", ""),
    ("Parts", "components", "{:,.0f}"),
    ("Cut faces", "self_intersections", "{:,.0f}"),
    ("Unobserved", "unobserved", "{:.1%}"),
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
*Faces*: number of triangles; *watertight*: the mesh has no open edges; *manifold*: it is also nowhere pinched; \
*parts*: number of connected components; *cut faces*: faces that intersect other faces of the mesh; \
*unobserved*: fraction of the faces that close the mesh where no camera saw the object."""
_TRUTH_INTRO = """\
*Chamfer*, *precision*, *recall* and *F1* compare the mesh with the true surface in the capture. *Chamfer* is the mean \
distance in both directions, in the capture's units. *Precision* is the fraction of the mesh that lies within 0.02 of \
the true surface, *recall* the fraction of the true surface that lies within 0.02 of the mesh, and *F1* their harmonic \
mean. Only parts that at least two training views see are counted; *F1 of all* also counts hidden parts."""
_TEXTURE_INTRO = """\
*Texture*: PSNR of the textured mesh against the held-out photos, within the object's mask; *covered*: fraction of the \
mask that the mesh covers."""


def meshes_section(report: Report, sheet: str | None) -> list[str]:
    """Return the section about the meshes; empty if there are none. `sheet` links to the image of all meshes."""
    objects = [(entry["name"], entry["mesh"]) for entry in report.objects]
    named = [*objects, *((entry["name"], entry) for entry in report.meshes)]
    made = [(name, mesh) for name, mesh in named if mesh.get("faces") is not None]
    without = [(name, mesh["why"]) for name, mesh in named if mesh.get("faces") is None and mesh.get("why")]
    if not made and not without:
        return []
    columns = [column for column in _MESH_COLUMNS if any(mesh.get(column[1]) is not None for _, mesh in made)]
    keys = {key for _, key, _ in columns}
    intros = ((_MESH_INTRO, "faces"), (_TRUTH_INTRO, "f1_all"), (_TEXTURE_INTRO, "texture_psnr"))
    parts = ["## Meshes", _mesh_summary(objects)]
    if sheet:
        parts.append(f"![Each mesh: surface, wireframe and texture]({sheet})")
    if made:
        rows = [[escape(name), *(_mesh_cell(mesh.get(key), how) for _, key, how in columns)] for name, mesh in made]
        parts.append(table(["", *(head for head, _, _ in columns)], rows, right=range(1, 1 + len(columns))))
        parts.append(" ".join(intro for intro, key in intros if key in keys))
    if without:
        parts.append(table(("No mesh of", "Why"), [(escape(name), escape(why)) for name, why in without]))
    return parts


def _mesh_cell(value: Any, how: str) -> str:
    if value is None:
        return "—"
    return how.format(value) if how else {True: "yes", False: "**no**"}[bool(value)]


def _mesh_summary(objects: Sequence[tuple[str, dict[str, Any]]]) -> str:
    """Return one sentence with the number of objects that have a mesh, and the quality of these meshes."""
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
            facts.append(
                f"{label} **{how.format(middle)}**, lowest {how.format(values[0][0])} ({escape(values[0][1])})"
            )
    return "; ".join(facts) + "."


def stages_section(report: Report) -> list[str]:
    if not report.stages:
        return []
    rows = [
        (
            escape(stage["name"]),
            "—" if stage["seconds"] is None else duration(stage["seconds"]),
            _number(stage["peak_rss_mb"], "{:,.0f} MB"),
        )
        for stage in report.stages
    ]
    return ["## Stages", table(("Stage", "Time", "Peak memory"), rows, right=(1, 2))]


def left_out_section(report: Report) -> list[str]:
    if not report.left_out:
        return ["## Left out", "Nothing was left out."]
    rows = [(escape(entry["what"]), escape(entry["why"])) for entry in report.left_out]
    return ["## Left out", table(("What", "Why"), rows)]


def duration(seconds: float) -> str:
    """Return `seconds` as text, such as 4.2 s, 35 s, 2 min 30 s or 1 h 05 min."""
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


def row_name(key: str) -> str:
    """Return the name of an entry of capture, settings, machine or model as Markdown text."""
    return _ROWS.get(key) or escape(key)


def value_text(key: str, value: Any) -> str:
    """Return one value of capture, settings, machine or model as text."""
    if value is None:
        return "—"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if key == "trained_seconds":
        return duration(value)
    if key == "expected_psnr":
        return " to ".join(f"{bound:.1f}" for bound in value)
    if key == "bytes" and isinstance(value, int | float):
        return f"{value / 1e6:,.1f} MB"
    if isinstance(value, int) and abs(value) >= 10_000 and key != "seed":
        return f"{value:,}"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list | dict):
        text = json.dumps(value, ensure_ascii=False)
        return escape(text if len(text) <= 200 else text[:200] + " ...")
    return escape(value)


def escape(value: Any) -> str:
    """Return `value` as text that cannot break out of a cell of a Markdown table."""
    text = " ".join(str(value).split())
    return re.sub(r"([\\|<>\[\]*_`])", r"\\\1", text)


def table(head: Sequence[str], rows: Sequence[Sequence[str]], right: Sequence[int] = ()) -> str:
    """Return a Markdown table; `right` are the indices of the right-aligned columns."""
    lines = ["| " + " | ".join(head) + " |"]
    lines.append("|" + "|".join("---:" if i in right else "---" for i in range(len(head))) + "|")
    lines += ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join(lines)
