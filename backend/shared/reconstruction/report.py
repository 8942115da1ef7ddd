"""evaluation.json and report.json: metrics of a reconstruction on held-out views, for `report` and other programs.

evaluation.json   {"step": 2000, "quality": {"psnr": 34.1, ...}, "objects": [...], "views": [...], "meshes": {...}}
report.json       the same, with the capture, settings, machine, stages, training curve and omitted steps
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..formats.json_file import plain, read_json, write_json

EVALUATION = "evaluation.json"
REPORT = "report.json"

QUALITY = (
    "psnr", "psnr_corrected", "ssim", "lpips", "miou", "miou_all", "mbiou", "miou_alone", "dice", "accuracy"
)  # fmt: skip
"""Metrics over the held-out views; `backend/evaluation/metrics.py` defines them."""

MIOU_LABELS = {"miou_all": "mIoU (all)", "miou": "mIoU (labeled)"}
"""Names for the user: over all pixels, and over those with a label in the masks."""


def lead_miou(figures: Mapping[str, Any], zero_is_background: bool) -> str:
    """Return which of `MIOU_LABELS` to show first.

    Args:
        figures: Metrics by name.
        zero_is_background: Whether pixels without a label show the background, as the training has decided (`rest`).

    Returns:
        `miou_all`, which counts objects on the background as errors. `miou`, where pixels without a label are gaps in
        the masks, or if only it was measured, as by earlier versions.
    """
    return "miou_all" if zero_is_background and figures.get("miou_all") is not None else "miou"


MESH_FIGURES = ("vertices", "faces", "watertight", "chamfer", "precision", "recall", "f1")
_MODEL = ("anchors", "gaussians", "bytes")
_ENTRIES = {
    "left_out": ("what", "why"),
    "stages": ("name", "seconds", "peak_rss_mb"),
    "curve": ("seconds", "step", "psnr", "miou", "miou_all"),
    "objects": ("id", "name", "iou", "iou_all", "iou_alone", "anchors", "mesh"),
}
_REQUIRED = {"left_out": ("what", "why"), "stages": ("name",), "curve": ("seconds",), "objects": ("id",)}
_TEXTS = ("what", "why", "name")


@dataclass(frozen=True)
class Evaluation:
    """The results of `evaluate`.

    Attributes:
        step: training step of the evaluated model.
        quality: means over the held-out views by metric name.
        objects: metrics of each object.
        views: metrics of each held-out view, with its miou and miou_all.
        meshes: metrics of each mesh by its key in meshes.json.
    """

    step: int
    quality: dict[str, Any] = field(default_factory=dict)
    objects: list[dict[str, Any]] = field(default_factory=list)
    views: list[dict[str, Any]] = field(default_factory=list)
    meshes: dict[str, dict[str, Any]] = field(default_factory=dict)


def write_evaluation(folder: Path, evaluation: Evaluation) -> None:
    """Write evaluation.json to the reconstruction `folder`."""
    write_json(folder / EVALUATION, plain(asdict(evaluation)))


def read_evaluation(folder: Path) -> Evaluation | None:
    """Read evaluation.json from the reconstruction `folder`; return None if there is none.

    Raises:
        InputError: The file is invalid.
    """
    path = folder / EVALUATION
    if not path.exists():
        return None
    content = read_json(path)
    try:
        return Evaluation(
            int(content["step"]),
            dict(content["quality"]),
            [dict(entry) for entry in content["objects"]],
            [dict(entry) for entry in content["views"]],
            {str(key): dict(values) for key, values in content.get("meshes", {}).items()},
        )
    except (AttributeError, KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{path} has invalid content ({error!r}); run `evaluate` again.") from error


@dataclass(frozen=True)
class Report:
    """The content of report.json, in the order of the file.

    Attributes:
        capture: folder name, numbers of views, objects and images.
        settings: what the training was asked for.
        machine: the computer, and the device that trained.
        left_out: {"what", "why"} of each omitted step.
        stages: {"name", "seconds", "peak_rss_mb"} of each command.
        curve: {"seconds", "step", "psnr", "miou", "miou_all"} on held-out views over the training.
        model: numbers of anchors and Gaussians, size in bytes, trained steps.
        quality: means over the held-out views by metric name, with all of `QUALITY`.
        objects: {"id", "name", "iou", "iou_all", "iou_alone", "anchors", "mesh"} and other metrics of each object;
            "mesh" has all of `MESH_FIGURES`.
        plan: the decisions of plan.json.
        views: metrics of each held-out view, with its miou and miou_all.
        meshes: figures of the meshes that are not of one object.
    """

    capture: dict[str, Any] = field(default_factory=dict)
    settings: dict[str, Any] = field(default_factory=dict)
    machine: dict[str, Any] = field(default_factory=dict)
    left_out: list[dict[str, Any]] = field(default_factory=list)
    stages: list[dict[str, Any]] = field(default_factory=list)
    curve: list[dict[str, Any]] = field(default_factory=list)
    model: dict[str, Any] = field(default_factory=dict)
    quality: dict[str, Any] = field(default_factory=dict)
    objects: list[dict[str, Any]] = field(default_factory=list)
    plan: list[dict[str, Any]] = field(default_factory=list)
    views: list[dict[str, Any]] = field(default_factory=list)
    meshes: list[dict[str, Any]] = field(default_factory=list)

    @property
    def lead_miou(self) -> str:
        """The metric of the objects to show first, see `lead_miou`."""
        return lead_miou(self.quality, self.zero_is_background)

    @property
    def zero_is_background(self) -> bool:
        """Whether pixels without a label show the background; False for reports without it."""
        return self.capture.get("supervise_background") is True

    def as_dict(self) -> dict[str, Any]:
        """Return the fields as they stand in report.json."""
        return {entry.name: getattr(self, entry.name) for entry in fields(self)}


def complete(report: Report) -> Report:
    """Return a copy that has all figures and can be written as JSON.

    Args:
        report: A report whose entries may lack figures.

    Returns:
        A report with plain numbers. Figures that are missing, NaN or infinite are None.

    Raises:
        ValueError: An entry has the wrong type; the message contains its name.
    """
    content = plain(report.as_dict(), "report")
    model = {**dict.fromkeys(_MODEL), **_mapping(content, "model")}
    quality = {**dict.fromkeys(QUALITY), **_mapping(content, "quality")}
    objects = _entries(content, "objects")
    for entry in objects:
        if entry["name"] is None:
            entry["name"] = str(entry["id"])
        entry["mesh"] = {**dict.fromkeys(MESH_FIGURES), **(entry["mesh"] or {})}
    return Report(
        capture=_mapping(content, "capture"),
        settings=_mapping(content, "settings"),
        machine=_mapping(content, "machine"),
        left_out=_entries(content, "left_out"),
        stages=_entries(content, "stages"),
        curve=sorted(_entries(content, "curve"), key=lambda entry: entry["seconds"]),
        model=_numbers(model, "model", _MODEL),
        quality=_numbers(quality, "quality", QUALITY),
        objects=objects,
        plan=content["plan"],
        views=content["views"],
        meshes=content["meshes"],
    )


def write_report_json(folder: Path, report: Report) -> None:
    """Write report.json to the reconstruction `folder`; raise ValueError if `report` has a wrong entry."""
    write_json(folder / REPORT, complete(report).as_dict())


def read_report(folder: Path) -> Report:
    """Read report.json from the reconstruction `folder`; figures that it lacks are None, unknown names are left out.

    Raises:
        InputError: The file is missing or is not a report.
    """
    content = read_json(folder / REPORT)
    try:
        if not isinstance(content, dict):
            raise ValueError("it is not a JSON object")
        known = {entry.name: content[entry.name] for entry in fields(Report) if entry.name in content}
        return complete(Report(**known))
    except (TypeError, ValueError) as error:
        raise InputError(f"{folder / REPORT} is not a report ({error}); run `report` again.") from error


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


def _numbers(values: dict[str, Any], where: str, keys: Sequence[str]) -> dict[str, Any]:
    for key in keys:
        if values[key] is not None and (isinstance(values[key], bool) or not isinstance(values[key], int | float)):
            raise ValueError(f"report.{where}.{key} must be a number or null, not {values[key]!r}")
    return values
