"""meshes/meshes.json: the source objects, settings and files of each mesh of a reconstruction.

{"trained_steps": 2000,
 "meshes": {"1": {"name": "mug", "ids": [1], "trained_steps": 2000, "settings": {"faces": 20000, ...},
                  "file": "1.ply", "texture": "1.png", "vertices": 9998, "faces": 20000, "watertight": true, ...},
            "3": {"name": "box", "ids": [3], ..., "why": "box has no splats."},
            "scene": {"name": "the whole scene", "ids": null, ...}},
 "waiting": ["4"]}

"waiting" are the keys of meshes that a job is still to make; one that was interrupted leaves them.
"""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..formats.json_file import plain, read_json, write_json

NAME = "meshes.json"

_FORMER_NAMES = {"invented": "unobserved"}
"""Names of figures in files of older versions, and their present names."""


@dataclass(frozen=True)
class MeshEntry:
    """A mesh of an object, a set of objects, or the whole scene.

    Attributes:
        key: the object's ID, the name of the set, or "scene".
        name: display name.
        ids: IDs of the objects in the mesh; None for everything.
        trained_steps: training steps of the model that it was extracted from; None if unknown.
        settings: settings of the extraction.
        file, texture: file names beside meshes.json; None if there is no mesh.
        why: the reason in one sentence if there is no mesh.
        figures: counts and measurements of the extraction.
    """

    key: str
    name: str
    ids: tuple[int, ...] | None
    trained_steps: int | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    file: str | None = None
    texture: str | None = None
    why: str | None = None
    figures: Mapping[str, Any] = field(default_factory=dict)

    @property
    def object_id(self) -> int | None:
        """ID of the object if the mesh is that of one object; None for a set or the whole scene."""
        return int(self.key) if self.key.isdecimal() and int(self.key) in (self.ids or ()) else None

    def as_dict(self) -> dict[str, Any]:
        """Return the entry as stored in meshes.json, without the key."""
        files = {"file": self.file, "texture": self.texture, "why": self.why}
        return {
            "name": self.name,
            "ids": None if self.ids is None else list(self.ids),
            "trained_steps": self.trained_steps,
            "settings": dict(self.settings),
            **{name: value for name, value in files.items() if value is not None},
            **self.figures,
        }


def read_meshes(folder: Path) -> dict[str, MeshEntry]:
    """Read meshes.json.

    Args:
        folder: The `meshes` folder of a reconstruction.

    Returns:
        The entries by key, in the order of the file; empty if there is no file.

    Raises:
        InputError: The file is invalid.
    """
    path = folder / NAME
    if not path.exists():
        return {}
    content = read_json(path)
    try:
        return {str(key): _entry(str(key), dict(values)) for key, values in content["meshes"].items()}
    except (AttributeError, KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(
            f"{path} is not a valid list of meshes ({error!r}); delete it and make the meshes again."
        ) from error


def read_waiting(folder: Path) -> list[str]:
    """Return the keys of the meshes that a job in `folder` was still to make; none if meshes.json is invalid."""
    path = folder / NAME
    try:
        waiting = read_json(path).get("waiting") if path.exists() else None
    except (InputError, AttributeError):
        return []
    return [str(key) for key in waiting] if isinstance(waiting, list) else []


def write_meshes(
    folder: Path, entries: Mapping[str, MeshEntry], trained_steps: int | None, waiting: Sequence[str] = ()
) -> None:
    """Write meshes.json.

    Args:
        folder: The `meshes` folder of a reconstruction.
        entries: The entries by key.
        trained_steps: Training steps of the model of the latest meshes, if known.
        waiting: Keys of the meshes that are still to be made.
    """
    meshes = {key: entries[key].as_dict() for key in sorted(entries)}
    content = {"trained_steps": trained_steps, "meshes": meshes, **({"waiting": list(waiting)} if waiting else {})}
    write_json(folder / NAME, plain(content))


def outdate_meshes(folder: Path, objects: Container[int]) -> None:
    """Mark meshes as those of an earlier model, whose number of steps the present one may have, too.

    Args:
        folder: The `meshes` folder of a reconstruction.
        objects: IDs of its present objects; the meshes of others are deleted.
    """
    try:
        entries = read_meshes(folder)
    except InputError:
        return  # It is created anew.
    if not entries:
        return
    kept = {
        key: replace(entry, trained_steps=None)
        for key, entry in entries.items()
        if entry.ids is None or any(i == 0 or i in objects for i in entry.ids)
    }
    write_meshes(folder, kept, None)
    for entry in (entries[key] for key in entries.keys() - kept.keys()):
        for name in filter(None, (entry.file, entry.texture)):
            (folder / name).unlink(missing_ok=True)


def _entry(key: str, values: dict[str, Any]) -> MeshEntry:
    values = {_FORMER_NAMES.get(name, name): value for name, value in values.items()}
    ids = values.pop("ids", [int(key)] if key.isdecimal() else None)
    steps = values.pop("trained_steps", None)
    return MeshEntry(
        key,
        " ".join(str(values.pop("name", None) or key).split()),
        None if ids is None else tuple(sorted(int(i) for i in ids)),
        None if steps is None else int(steps),
        dict(values.pop("settings", None) or {}),
        _file_name(values.pop("file", None)),
        _file_name(values.pop("texture", None)),
        None if (why := values.pop("why", None)) is None else str(why),
        values,
    )


def _file_name(value: Any) -> str | None:
    """Return the last component of a path, so that no file outside the folder is read."""
    name = None if value is None else Path(str(value).replace("\\", "/")).name
    return name or None
