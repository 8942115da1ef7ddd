"""objectgs.json: what was asked for, so that a later command knows what the files beside it were made from.

{"version": "0.1.0",
 "capture": {"folder": "/captures/garden", "max_size": 1600, "digest": "0f..."},
 "votes": {"strategy": "majority", "seed": null, "max_size": 1600, "capture": "0f...", "masks": "a1..."},
 "training": {"settings": {...}, "minutes": 5.0, "steps": null, "preset": null, "device": "cpu", "left_out": [],
              "votes": {...}, "plan": [...]},
 "export": {"splats": 81000, "anchors": 21000, "psnr_of_export": null},
 "imported": {"file": "/splats/point_cloud.ply", "splats": 81000},
 "stages": [{"name": "train", "seconds": 300.0, "peak_rss_mb": 900.0}]}
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any, TypeVar

from ..errors import InputError
from ..formats.json_file import read_json, write_json
from ..version import __version__
from .folder import Reconstruction

_Part = TypeVar("_Part")


@dataclass(frozen=True)
class CaptureRecord:
    """The capture: its folder, the longest side of its images in pixels, and a hash of its content."""

    folder: str
    max_size: int
    digest: str


@dataclass(frozen=True)
class VotesRecord:
    """What the votes in points.ply depend on.

    strategy, seed: of the vote (seed: None where none is used); max_size: longest side of the masks in pixels; capture,
    masks: hashes (masks: None where there are none).
    """

    strategy: str
    seed: int | None
    max_size: int
    capture: str
    masks: str | None


@dataclass(frozen=True)
class TrainingRecord:
    """What the training in checkpoint/ was asked for.

    settings: as `backend.training.settings.Settings` has them; minutes, steps, preset: its length; device: name of the
    device; left_out: IDs of objects that were not made; votes: that it began with; plan: its decisions, as in
    plan.json.
    """

    settings: dict[str, Any]
    votes: VotesRecord
    minutes: float | None = None
    steps: int | None = None
    preset: str | None = None
    device: str = "cpu"
    left_out: list[int] = field(default_factory=list)
    plan: list[dict[str, Any]] | None = None


@dataclass(frozen=True)
class ExportRecord:
    """How many splats and anchors splats.ply and anchors.ply hold; psnr_of_export: dB of the splats to the model's own
    images, None where they are the same or it was not measured."""

    splats: int
    anchors: int
    psnr_of_export: float | None = None


@dataclass(frozen=True)
class ImportRecord:
    """The file of another program that splats.ply was made from, and how many splats it held."""

    file: str
    splats: int


@dataclass(frozen=True)
class StageRecord:
    """The latest run of a stage: its seconds, and the process's peak memory until its end."""

    name: str
    seconds: float
    peak_rss_mb: float


@dataclass(frozen=True)
class Record:
    """The content of objectgs.json; what was not recorded is None."""

    capture: CaptureRecord | None = None
    votes: VotesRecord | None = None
    training: TrainingRecord | None = None
    export: ExportRecord | None = None
    imported: ImportRecord | None = None
    stages: tuple[StageRecord, ...] = ()


def read_record(folder: Reconstruction) -> Record:
    """Read objectgs.json; an empty record where there is none.

    Raises:
        InputError: the file cannot be used.
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
            f"{folder.settings} does not hold what is expected ({error!r}); choose another folder, or make it anew."
        ) from error


def update_record(folder: Reconstruction, **parts: Any) -> None:
    """Replace parts of objectgs.json, named and typed as the fields of `Record`; the others stay."""
    stored = {
        name: [asdict(entry) for entry in part] if name == "stages" else None if part is None else asdict(part)
        for name, part in parts.items()
    }
    write_json(folder.settings, {**_content(folder), "version": __version__, **stored})


def record_stage(folder: Reconstruction, stage: StageRecord) -> None:
    """Record the latest run of a stage in place of the one before."""
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


def _as(cls: Callable[..., _Part]) -> Callable[[Any], _Part]:
    """Reads a JSON object as a dataclass; what other versions added is passed over."""
    known = {entry.name for entry in fields(cls)}  # type: ignore[arg-type]
    return lambda values: cls(**{name: value for name, value in values.items() if name in known})


def _training(values: Mapping[str, Any]) -> TrainingRecord:
    return _as(TrainingRecord)(
        {**values, "votes": _as(VotesRecord)(values["votes"]), "settings": {**values["settings"]}}
    )
