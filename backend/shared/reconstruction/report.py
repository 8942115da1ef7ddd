"""evaluation.json and report.json: metrics of a reconstruction on held-out views, for `report` and other programs.

evaluation.json   {"step": 2000, "quality": {"psnr": 34.1, ...}, "objects": [...], "views": [...], "meshes": {...}}
report.json       the same, with the capture, settings, machine, stages, training curve and omitted steps
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..formats.json_file import plain, read_json, write_json

EVALUATION = "evaluation.json"
REPORT = "report.json"


@dataclass(frozen=True)
class Evaluation:
    """The results of `evaluate`.

    Attributes:
        step: training step of the evaluated model.
        quality: means over the held-out views by metric name.
        objects: metrics of each object.
        views: metrics of each held-out view.
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


def write_report_json(folder: Path, report: Mapping[str, Any]) -> None:
    """Write report.json to the reconstruction `folder`."""
    write_json(folder / REPORT, plain(report))


def read_report(folder: Path) -> dict[str, Any]:
    """Read report.json from the reconstruction `folder`.

    Raises:
        InputError: The file is missing or is not a report.
    """
    content = read_json(folder / REPORT)
    if not isinstance(content, dict):
        raise InputError(f"{folder / REPORT} is not a report; run `report` again.")
    return content
