"""meshes/meshes.json: what each mesh of a reconstruction was made of, and its files beside it.

{"trained_steps": 2000,
 "meshes": {"1": {"name": "mug", "ids": [1], "trained_steps": 2000, "settings": {"faces": 20000, ...},
                  "file": "1.ply", "texture": "1.png", "vertices": 9998, "faces": 20000, "watertight": true, ...},
            "3": {"name": "box", "ids": [3], ..., "why": "box has no splats."},
            "scene": {"name": "the whole scene", "ids": null, ...}}}
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..formats.json_file import plain, read_json, write_json

NAME = "meshes.json"

_FORMER_NAMES = {"invented": "unobserved"}
"""Of figures in files that older versions wrote."""


@dataclass(frozen=True)
class MeshEntry:
    """One mesh: an object's (its key is the object's ID), that of a set of objects (a name) or the whole scene's.

    name: as shown; ids: the objects that it shows, None: everything; trained_steps: of the model that it was made from,
    None: unknown; settings: that it was made with; file, texture: names beside meshes.json, None where there is no
    mesh; why: then the reason, one sentence; figures: what was counted and measured when it was made.
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
        """The object whose own mesh it is; None for a set or the whole scene."""
        return int(self.key) if self.key.isdecimal() and int(self.key) in (self.ids or ()) else None

    def as_dict(self) -> dict[str, Any]:
        """The entry as meshes.json holds it, without the key."""
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
        folder: `meshes` of a reconstruction folder.

    Returns:
        The entries by their keys, in the file's order; none where there is no file.

    Raises:
        InputError: the file cannot be used.
    """
    path = folder / NAME
    if not path.exists():
        return {}
    content = read_json(path)
    try:
        return {str(key): _entry(str(key), dict(values)) for key, values in content["meshes"].items()}
    except (AttributeError, KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(
            f"{path} does not list meshes as expected ({error!r}); delete it and make the meshes again."
        ) from error


def write_meshes(folder: Path, entries: Mapping[str, MeshEntry], trained_steps: int) -> None:
    """Write meshes.json into `folder`; trained_steps: of the model that the latest meshes were made from."""
    meshes = {key: entries[key].as_dict() for key in sorted(entries)}
    write_json(folder / NAME, plain({"trained_steps": trained_steps, "meshes": meshes}))


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
    """A file's name: nothing outside of the folder is read."""
    name = None if value is None else Path(str(value).replace("\\", "/")).name
    return name or None
