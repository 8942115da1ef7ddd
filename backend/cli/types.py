"""Types of options: each converts a word of the command line, or raises argparse.ArgumentTypeError."""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..shared.color.recolor import Recolor
from ..shared.reconstruction.objects import is_singular


def integer(text: str, least: int, expected: str) -> int:
    try:
        value = int(text)
    except ValueError:
        value = least - 1
    if not least <= value < 2**63:
        raise argparse.ArgumentTypeError(f"{text!r} is not an integer {expected}")
    return value


def count(text: str) -> int:
    return integer(text, 1, "above 0")


def several(text: str) -> int:
    return integer(text, 2, "of at least 2")


def index(text: str) -> int:
    return integer(text, 0, "of at least 0")


def faces(text: str) -> int:
    return integer(text, 100, "of at least 100")


def named_set(text: str) -> tuple[str, list[str]]:
    name, _, words = text.partition("=")
    found = [word.strip() for word in words.split(",") if word.strip()]
    if not name.strip() or not found:
        raise argparse.ArgumentTypeError(f"{text!r} is not NAME=ID,ID")
    return name.strip(), found


def names(text: str) -> list[str]:
    """Split NAME; NAME."""
    found: dict[str, str] = {}
    for part in text.split(";"):
        if name := " ".join(part.split()):
            found.setdefault(name.lower(), name)
    if not found:
        raise argparse.ArgumentTypeError(f"{text!r} names no object; write names such as 'red cup; book'")
    if wordless := [name for name in found.values() if not any(map(str.isalnum, name))]:
        raise argparse.ArgumentTypeError(f"{wordless[0]!r} is not a name of objects")
    return list(found.values())


def keys(text: str, known: Sequence[str]) -> tuple[str, dict[str, str]]:
    """Split OBJECT:KEY=VALUE,KEY=VALUE."""
    word, _, rest = text.rpartition(":")
    values = {}
    for part in rest.split(","):
        key, _, value = part.partition("=")
        values[key.strip()] = value.strip()
    if not word.strip() or not all(values.values()):
        raise argparse.ArgumentTypeError(f"{text!r} is not OBJECT:KEY=VALUE,KEY=VALUE")
    if unknown := [key for key in values if key not in known]:
        raise argparse.ArgumentTypeError(f"{text!r} has an unknown {unknown[0]!r}; the keys are {', '.join(known)}")
    return word.strip(), values


def number(key: str, text: str, least: float = -math.inf, most: float = math.inf) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and least <= value <= most):
        between = f" between {least:g} and {most:g}" if math.isfinite(most) else f" of at least {least:g}"
        wanted = between if math.isfinite(least) else ""
        raise argparse.ArgumentTypeError(f"{key}={text} is not a number{wanted}")
    return value


def matrix(text: str) -> list[list[float]]:
    words = text.split(",")
    if len(words) != 16:
        raise argparse.ArgumentTypeError(f"{text} are not 16 numbers with commas between them")
    values = [number("MATRIX", word) for word in words]
    rows = [values[row : row + 4] for row in (0, 4, 8, 12)]
    if not np.allclose(rows[3], (0, 0, 0, 1), rtol=0, atol=1e-4):
        raise argparse.ArgumentTypeError(f"{text} does not end in 0,0,0,1; write the matrix row by row")
    if is_singular(np.array(rows)):
        raise argparse.ArgumentTypeError(f"{text} flattens everything; give it a scale other than zero")
    return rows


def recolor(text: str) -> tuple[str, Recolor]:
    ranges = {"hue": (-0.5, 0.5), "amount": (0.0, 1.0)}
    word, given = keys(text, ("hue", "saturation", "value", "contrast", "tint", "replace", "amount"))
    values: dict[str, Any] = {}
    for key, value in given.items():
        if key not in ("tint", "replace"):
            values[key] = number(key, value, *ranges.get(key, (0.0,)))
        elif re.fullmatch("#[0-9a-fA-F]{6}", value):
            values[key] = tuple(channel / 255 for channel in bytes.fromhex(value[1:]))
        else:
            raise argparse.ArgumentTypeError(f"{key}={value} is not a color such as #ff8800")
    if "replace" in values:
        values.setdefault("amount", 1.0)
    return word, Recolor(**values)


def placement(text: str) -> tuple[str, dict[str, float]]:
    word, given = keys(text, ("x", "y", "z", "rx", "ry", "rz", "scale"))
    values = {key: number(key, value) for key, value in given.items()}
    if values.get("scale", 1.0) <= 0:
        raise argparse.ArgumentTypeError(f"scale={given['scale']} is not a number above 0")
    return word, values


def weight(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0 <= value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of at least 0")
    return value


def fraction(text: str) -> float:
    value = weight(text)
    if value > 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number from 0 to 1")
    return value


def amount(text: str) -> float:
    value = weight(text)
    if value == 0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number above 0")
    return value
