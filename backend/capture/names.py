"""Names in a capture's folder: those of its labels, and of its held-out views."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from ..shared.class_table import LARGEST_ID
from ..shared.errors import InputError
from ..shared.formats.json_file import LARGEST, parse_json
from ..shared.formats.regular_file import read_regular

HELD_OUT = "test.txt"
"""File in a capture's folder with the names of the held-out views."""


def read_held_out(folder: Path) -> list[str] | None:
    """Read the names of the held-out views of a capture.

    Args:
        folder: The capture, with a file test.txt that has one view name a line.

    Returns:
        The names, in the file's order; None if there is no such file.

    Raises:
        InputError: The file cannot be read.
    """
    path = folder / HELD_OUT
    if not path.exists():
        return None
    try:
        lines = read_regular(path, LARGEST).decode("utf-8-sig").splitlines()
    except (OSError, ValueError) as error:
        not_text = isinstance(error, UnicodeDecodeError)
        why = "it is not text in UTF-8" if not_text else getattr(error, "strerror", None) or str(error)
        raise InputError(f"{path} cannot be read ({why}); write one view name a line, or remove it.") from error
    return [name for line in lines if (name := line.strip())]


def read_names(folder: Path) -> dict[int, str]:
    """Read the label names of a capture.

    Args:
        folder: The capture, with labels.json ({"1": "mug"}, {"mug": 1} or [{"id": 1, "name": "mug"}]) or labels.txt
            (lines `1 mug`, `1: mug` or `1,mug`).

    Returns:
        Names by ID, without 0; empty if there is no such file.

    Raises:
        InputError: The file is not a list of labels.
    """
    as_json, as_text = folder / "labels.json", folder / "labels.txt"
    try:
        if as_json.exists():
            pairs = _json_names(parse_json(read_regular(as_json, LARGEST).decode("utf-8-sig")))
            path = as_json
        elif as_text.exists():
            pairs = _text_names(read_regular(as_text, LARGEST).decode("utf-8-sig"))
            path = as_text
        else:
            return {}
    except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
        path = as_json if as_json.exists() else as_text
        raise InputError(
            f'{path} is not a list of labels; expected {{"1": "mug", "2": "box"}} in JSON or lines like "1 mug".'
        ) from error
    names = dict(pairs)
    outside = [key for key in names if not 0 <= key <= LARGEST_ID]
    if outside:
        raise InputError(f"{path} names the ID {outside[0]}, which lies outside 0 to {LARGEST_ID}.")
    names.pop(0, None)
    return dict(sorted(names.items()))


def _json_names(value: Any) -> list[tuple[int, str]]:
    if isinstance(value, list):
        return [(int(item["id"]), str(item["name"])) for item in value]
    if value and all(isinstance(v, int) and not isinstance(v, bool) for v in value.values()):
        return [(number, str(name)) for name, number in value.items()]
    return [(int(number), str(v["name"]) if isinstance(v, dict) else str(v)) for number, v in value.items()]


def _text_names(text: str) -> list[tuple[int, str]]:
    pairs = []
    for line in text.splitlines():
        line = line.strip()
        if line and not line.startswith("#"):
            match = re.fullmatch(r"(\d+)\s*[\s:,;=]\s*(.+)", line)
            if not match:
                raise ValueError(line)
            pairs.append((int(match[1]), match[2].strip()))
    return pairs
