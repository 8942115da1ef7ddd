"""objectgs.json: the inputs and settings that the other files of the reconstruction folder were made from.

{"version": "0.1.0",
 "capture": {"folder": "/captures/garden", "max_size": 1600, "digest": "0f...", "agreement": 33.1},
 "votes": {"strategy": "majority", "seed": null, "max_size": 1600, "capture": "0f...", "masks": "a1..."},
 "training": {"settings": {...}, "minutes": 5.0, "steps": null, "preset": null, "device": "cpu", "left_out": [],
              "votes": {...}, "plan": [...], "expected_psnr": [24.1, 31.9], "expected_steps": 460},
 "export": {"splats": 81000, "anchors": 21000, "psnr_of_export": null},
 "imported": {"file": "/splats/point_cloud.ply", "splats": 81000},
 "stages": [{"name": "train", "seconds": 300.0, "peak_rss_mb": 900.0}]}
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, TypeVar

from ..errors import InputError
from ..formats.json_file import read_json, write_json
from ..formats.typed import typed
from ..version import __version__
from .folder import Reconstruction

_Part = TypeVar("_Part")


@dataclass(frozen=True)
class CaptureRecord:
    """The capture.

    Attributes:
        folder: its folder.
        max_size: maximum length of its images' longer side in pixels.
        digest: hash of its content.
        agreement: how well its photos agree, in dB, see `backend.planning.agreement`; None if it is not known.
    """

    folder: str
    max_size: int
    digest: str
    agreement: float | None = None


@dataclass(frozen=True)
class VotesRecord:
    """The inputs of the vote in points.ply.

    Attributes:
        strategy: strategy of the vote.
        seed: random seed, or None if the strategy uses none.
        max_size: maximum length of the masks' longer side in pixels.
        capture: hash of the capture.
        masks: hash of the masks, or None without masks.
    """

    strategy: str
    seed: int | None
    max_size: int
    capture: str
    masks: str | None


@dataclass(frozen=True)
class TrainingRecord:
    """The inputs of the training in checkpoint/.

    Attributes:
        settings: the fields of `backend.training.settings.Settings`.
        votes: the vote that it started from.
        minutes, steps, preset: requested length.
        device: name of the device.
        left_out: IDs of the objects that were left out.
        plan: the decisions, as in plan.json.
        expected_psnr: bounds in dB of the PSNR on held-out views that was expected before, see `expected_psnr` in
            `backend.shared.expectation`; None without an expectation.
        expected_steps: the fewest steps in total that were expected of a training for a time; None likewise.
    """

    settings: dict[str, Any]
    votes: VotesRecord
    minutes: float | None = None
    steps: int | None = None
    preset: str | None = None
    device: str = "cpu"
    left_out: list[int] = field(default_factory=list)
    plan: list[dict[str, Any]] | None = None
    expected_psnr: list[float] | None = None
    expected_steps: int | None = None


@dataclass(frozen=True)
class ExportRecord:
    """Sizes of splats.ply and anchors.ply, and how well splats.ply shows the model.

    psnr_of_export: PSNR in dB of renders of the exported splats, on the model's background, to renders of the model;
    None if they are identical or it was not measured. psnr_on_black: the same with the splats on black, as programs
    show them that do not know the background. background: red, green and blue in display space, 0 .. 1.
    """

    splats: int
    anchors: int
    psnr_of_export: float | None = None
    psnr_on_black: float | None = None
    background: list[float] | None = None


@dataclass(frozen=True)
class ImportRecord:
    """The file of another program that splats.ply was imported from, and its number of splats."""

    file: str
    splats: int


@dataclass(frozen=True)
class StageRecord:
    """The latest run of a stage: its duration, and the peak memory of the process up to its end."""

    name: str
    seconds: float
    peak_rss_mb: float


@dataclass(frozen=True)
class Record:
    """The content of objectgs.json; parts that were not recorded are None."""

    capture: CaptureRecord | None = None
    votes: VotesRecord | None = None
    training: TrainingRecord | None = None
    export: ExportRecord | None = None
    imported: ImportRecord | None = None
    stages: tuple[StageRecord, ...] = ()


def read_record(folder: Reconstruction) -> Record:
    """Read objectgs.json; return an empty record if there is none.

    Raises:
        InputError: The file is invalid.
    """
    content = _content(folder)
    try:
        return Record(
            _part(content, "capture", _as(CaptureRecord)),
            _part(content, "votes", _as(VotesRecord)),
            _part(content, "training", _training),
            _part(content, "export", _as(ExportRecord)),
            _part(content, "imported", _as(ImportRecord)),
            tuple(_as(StageRecord)(entry) for entry in content.get("stages") or ()),
        )
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{folder.settings} is invalid ({error!r}); choose another folder, or create it again."
        ) from error


def update_record(folder: Reconstruction, **parts: Any) -> None:
    """Replace parts of objectgs.json, given by the names and types of the fields of `Record`; keep the others."""
    stored = {
        name: [asdict(entry) for entry in part] if name == "stages" else None if part is None else asdict(part)
        for name, part in parts.items()
    }
    write_json(folder.settings, {**_content(folder), "version": __version__, **stored})


def record_stage(folder: Reconstruction, stage: StageRecord) -> None:
    """Record the latest run of a stage, replacing the previous one."""
    stages = {entry.name: entry for entry in read_record(folder).stages}
    update_record(folder, stages=tuple({**stages, stage.name: stage}.values()))


def _content(folder: Reconstruction) -> dict[str, Any]:
    if not folder.settings.exists():
        return {}
    content = read_json(folder.settings)
    if not isinstance(content, dict):
        raise InputError(f"{folder.settings} was not written by this program; choose another folder.")
    return content


def _part(content: Mapping[str, Any], name: str, read: Callable[[Any], _Part]) -> _Part | None:
    return None if content.get(name) is None else read(content[name])


def _as(cls: type[_Part]) -> Callable[[Any], _Part]:
    """Return a function that converts a JSON object to a dataclass and ignores unknown fields of other versions."""
    return lambda values: cls(**typed(cls, values))


def _training(values: Mapping[str, Any]) -> TrainingRecord:
    return _as(TrainingRecord)(
        {**values, "votes": _as(VotesRecord)(values["votes"]), "settings": {**values["settings"]}}
    )
