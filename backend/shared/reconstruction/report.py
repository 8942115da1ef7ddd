"""evaluation.json and report.json: figures of a reconstruction on held-out views, for `report` and for other programs.

evaluation.json   {"step": 2000, "quality": {"psnr": 34.1, ...}, "objects": [...], "views": [...], "meshes": {...}}
report.json       the same with the capture, settings, machine, stages, curve and what was left out
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
    """What `evaluate` measured.

    step: of the model that was measured; quality: means over the held-out views, by the metric's name; objects: figures
    of each object; views: of each held-out view; meshes: of each mesh, by its key in meshes.json.
    """

    step: int
    quality: dict[str, Any] = field(default_factory=dict)
    objects: list[dict[str, Any]] = field(default_factory=list)
    views: list[dict[str, Any]] = field(default_factory=list)
    meshes: dict[str, dict[str, Any]] = field(default_factory=dict)


def write_evaluation(folder: Path, evaluation: Evaluation) -> None:
    """Write evaluation.json into the reconstruction `folder`."""
    write_json(folder / EVALUATION, plain(asdict(evaluation)))


def read_evaluation(folder: Path) -> Evaluation | None:
    """Read evaluation.json of the reconstruction `folder`; None where there is none.

    Raises:
        InputError: the file cannot be used.
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
        raise InputError(f"{path} does not hold figures as expected ({error!r}); run `evaluate` again.") from error


def write_report_json(folder: Path, report: Mapping[str, Any]) -> None:
    """Write report.json into the reconstruction `folder`."""
    write_json(folder / REPORT, plain(report))


def read_report(folder: Path) -> dict[str, Any]:
    """Read report.json of the reconstruction `folder`.

    Raises:
        InputError: it is missing or is no report.
    """
    content = read_json(folder / REPORT)
    if not isinstance(content, dict):
        raise InputError(f"{folder / REPORT} is not a report; run `report` again.")
    return content
