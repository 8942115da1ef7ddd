"""Check of values read from files against the types of a dataclass's fields."""

from __future__ import annotations

import functools
import math
import types
from collections.abc import Mapping
from typing import Any, Union, get_args, get_origin, get_type_hints


def typed(cls: type, values: Mapping[str, Any]) -> dict[str, Any]:
    """Check the values of a dataclass's fields against their types.

    Args:
        cls: The dataclass; its fields are scalars, lists, tuples, dicts, dataclasses, or optional ones of these.
        values: Values by field name, as parsed from JSON.

    Returns:
        The values of known fields; unknown ones, as of other versions, are left out.

    Raises:
        TypeError: A value has another type, or is not finite. Integers are accepted as floats, lists as tuples.
    """
    hints = _hints(cls)
    known = {name: value for name, value in dict(values).items() if name in hints}
    for name, value in known.items():
        if not _fits(value, hints[name]):
            raise TypeError(f"{name} is {str(value)[:60]!r}")
    return known


@functools.cache
def _hints(cls: type) -> dict[str, Any]:
    return get_type_hints(cls)


def _fits(value: Any, hint: Any) -> bool:
    origin = get_origin(hint) or hint
    if origin is Any:
        return True
    if origin in (Union, types.UnionType):
        return any(_fits(value, part) for part in get_args(hint))
    if origin is float:
        return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    if origin is int:
        return isinstance(value, int) and not isinstance(value, bool)
    if origin in (list, tuple):
        parts = [part for part in get_args(hint) if part is not Ellipsis]
        return isinstance(value, list | tuple) and (not parts or all(_fits(entry, parts[0]) for entry in value))
    if origin is dict:
        parts = list(get_args(hint))
        return isinstance(value, dict) and (not parts or all(_fits(entry, parts[1]) for entry in value.values()))
    return isinstance(value, origin)
