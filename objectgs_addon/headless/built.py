# SPDX-License-Identifier: GPL-3.0-or-later
"""Which .blend of a reconstruction folder may be written again: one that nobody has saved since."""

from __future__ import annotations

import hashlib
import itertools
from pathlib import Path

from ...backend.shared.errors import InputError
from ...backend.shared.events import Reporter
from ...backend.shared.formats.json_file import read_json, write_json
from ...backend.shared.reconstruction.folder import Reconstruction

BLEND = "objectgs.blend"


def blend_to_write(folder: Path, reporter: Reporter) -> Path:
    """Return DIR/objectgs.blend or, where that is not as it was built, one with the next number that is."""
    first, blend = folder / BLEND, _numbered(folder)[-1]
    if blend != first:
        reporter.warning(f"{first} may hold your own changes and is kept; {blend.name} is written instead.")
    return blend


def blend_to_render(folder: Path, reporter: Reporter) -> Path:
    """Return the .blend of a folder that was built last, or DIR/objectgs.blend if there is none."""
    first = folder / BLEND
    blend = next((path for path in reversed(_numbered(folder)) if path.exists()), first)
    if blend != first:
        reporter.status(f"Rendering {blend}, which was built after {first.name} was saved.")
    return blend


def remember_built(blend: Path) -> None:
    """Remember the content of a .blend in a reconstruction folder that was just built."""
    write_json(Reconstruction(blend.parent).built, {**_built(blend.parent), blend.name: digest_of(blend)})


def digest_of(path: Path) -> str:
    """Return a hash of a file's content."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _numbered(folder: Path) -> list[Path]:
    """Return DIR/objectgs.blend, -2 and so on, up to the first that is missing or as it was built."""
    first, built, paths = folder / BLEND, _built(folder), []
    for number in itertools.count(1):
        paths.append(first if number == 1 else first.with_stem(f"{first.stem}-{number}"))
        if not paths[-1].exists() or built.get(paths[-1].name) == digest_of(paths[-1]):
            break
    return paths


def _built(folder: Path) -> dict[str, str]:
    """Return name -> hash of the files that were built in a folder."""
    try:
        content = read_json(Reconstruction(folder).built)
    except InputError:
        return {}
    return content if isinstance(content, dict) else {}
