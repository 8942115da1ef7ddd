"""Kernels of `source/`: their source text, their variants, and their launch on torch tensors.

A kernel is compiled when it is first launched, by the compiler that comes with torch (`driver.py`), or for tests by the
C++ compiler of the system (`emulator.py`); users install nothing for it. Constants of Python modules become constants
of the source text, so that each has one definition.
"""

from __future__ import annotations

import functools
import hashlib
import math
import re
from collections.abc import Callable, Mapping
from ctypes import addressof, c_uint64, c_void_p
from pathlib import Path
from types import ModuleType
from typing import Any

import torch

from ...shared.splats import spherical_harmonics
from .. import discs, settings, splats
from ..devices import emulated

TILE = 16
"""Width and height of a tile in pixels; a block of THREADS draws one, with one thread per pixel."""

THREADS = TILE * TILE
STAGED, STAGED_BACKWARD, STAGED_IDS = 256, 64, 64
"""Numbers of splats staged in shared memory at a time: in blending, in its gradient, and in the ranking of IDs."""
SLOTS = 32
"""Number of objects whose probabilities a pass of the ranking of IDs sums up."""
SPLATS_PER_BLOCK, _COLUMNS_ABREAST = 128, 16
"""Number of splats that a block of the projection's gradient processes, and of threads that sum a row's columns."""

SOURCE = Path(__file__).parent / "source"

_TYPES = {
    "float": torch.float32, "double": torch.float64, "short": torch.int16, "int": torch.int32,
    "long long": torch.int64,
}  # fmt: skip
_INCLUDE = re.compile(r'^#include "(.+)"$', re.MULTILINE)
_PARAMETERS = re.compile(r"^KERNEL\(.*?\) \w+\((.*?)\) \{", re.MULTILINE | re.DOTALL)

# Constants of Python modules, by their names in kernels.
_COLUMNS = {
    splats: "U V SLOPE A C LOP RED GREEN BLUE DEPTH HALF_W HALF_H SPLAT_COLUMNS "
    "M0 MY MYY MX MXY MXX G_RED G_GREEN G_BLUE G_DEPTH MQ MQX MQY MSX MSY G_NORMAL",
    discs: "Q0 QX QY NEAREST SPOT_U MIDDLE NORMAL_X NORMAL_Y NORMAL_Z TILT_COLUMNS",
}
_NUMBERS = {
    splats: "MAX_COLOR",
    discs: "SPOT",
    settings: "ALPHA_MAX ALPHA_MIN EPS_2D EPS_2D_DISC MAX_EXTENT MIN_DISC_WIDTH MIN_QUAT_NORM2 TRANSMITTANCE_THRESHOLD",
}
_OWN_NUMBERS = {
    **{f"SH_C{degree}": getattr(spherical_harmonics, f"C{degree}") for degree in (0, 1, 2, 20, 30, 31, 32, 33)},
    "LN2": math.log(2.0), "HALF_LOG2E": 0.5 / math.log(2.0), "LOG2_CUT": math.log2(settings.ALPHA_MIN), "TILE": TILE,
    "STAGED": STAGED, "STAGED_BACKWARD": STAGED_BACKWARD, "STAGED_IDS": STAGED_IDS, "SLOTS": SLOTS,
    "SPLATS_PER_BLOCK": SPLATS_PER_BLOCK, "COLUMNS_ABREAST": _COLUMNS_ABREAST,
}  # fmt: skip


def _values_of(names: Mapping[ModuleType, str]) -> dict[str, Any]:
    """Return the constants with these names."""
    return {name: getattr(module, name) for module, listed in names.items() for name in listed.split()}


def source_of(name: str, variant: Mapping[str, Any]) -> str:
    """Return the complete source text of a kernel.

    Args:
        name: the kernel, defined in the file of that name.
        variant: further macros.
    """
    included = set()

    def text_of(file: str) -> str:
        if file in included:
            return ""
        included.add(file)
        # Emulated kernels alone need the emulator, which includes headers of the system.
        if file == "emulator.h" and not emulated():
            return ""
        text = (SOURCE / file).read_text(encoding="utf-8")
        return _INCLUDE.sub(lambda found: text_of(found[1]), text)

    columns = ", ".join(f"{column} = {number}" for column, number in _values_of(_COLUMNS).items())
    macros = {**_values_of(_NUMBERS), **_OWN_NUMBERS, **variant, **({"EMULATED": 1} if emulated() else {})}
    lines = [f"#define {macro} {_literal(value)}" for macro, value in macros.items()]
    return "\n".join([*lines, f"enum {{ {columns} }};", text_of(f"{name}.cu")])


@functools.cache
def digest_of_sources() -> str:
    """Return a hash of all files in `source/`."""
    texts = [path.read_bytes() for path in sorted(SOURCE.iterdir())]
    return hashlib.sha256(b"\0".join(texts)).hexdigest()


def _literal(value: Any) -> str:
    if isinstance(value, float):
        return f"({value!r})"
    return str(int(value)) if isinstance(value, int) else str(value)


class Kernel:
    """A kernel, compiled for the current device when it is first launched; see `kernel`."""

    def __init__(self, name: str, variant: Mapping[str, Any]) -> None:
        self.name = name
        self.source = source_of(name, variant)
        found = _PARAMETERS.search(self.source)
        assert found, name
        self._types = [_type_of(words, variant) for words in found[1].split(",")]

    def __call__(self, blocks: int, threads: int, *arguments: torch.Tensor | int | None) -> None:
        """Launch the kernel in torch's current stream, without synchronization; does nothing for 0 blocks.

        Args:
            blocks: number of blocks.
            threads: threads per block.
            arguments: contiguous tensors of the types of the kernel's parameters, on the current device; None for a
                pointer that the kernel does not use; numbers.

        Raises:
            TypeError: an argument does not match its parameter.
        """
        if not blocks:
            return
        count = len(self._types)
        if len(arguments) != count:
            raise TypeError(f"{self.name} has {count} parameters and was given {len(arguments)} arguments")
        values = (c_uint64 * count)(*map(self._value, self._types, arguments))
        start = addressof(values)
        self._launch((c_void_p * count)(*range(start, start + 8 * count, 8)), blocks, threads)

    def for_each(self, count: int, *arguments: torch.Tensor | int | None) -> None:
        """Launch a kernel without shared memory with one thread for each of `count` elements."""
        threads = min(128, 32 * math.ceil(count / 32)) or 32
        self(math.ceil(count / threads), threads, *arguments)

    def _value(self, kind: torch.dtype | None, argument: torch.Tensor | int | None) -> int:
        """Return an argument as 8 bytes; kind: type of the elements behind a pointer, None for a number."""
        if isinstance(argument, torch.Tensor):
            if argument.dtype is kind and argument.is_contiguous():
                return argument.data_ptr()
        elif argument is None:
            if kind:
                return 0
        elif not kind:
            return int(argument)
        what = argument.dtype if isinstance(argument, torch.Tensor) else argument
        raise TypeError(f"an argument of {self.name} is {what}, and the parameter {kind or 'a number'}")

    @functools.cached_property
    def _launch(self) -> Callable[[Any, int, int], None]:
        if emulated():
            from . import emulator

            return emulator.load(self.name, self.source)
        from . import driver

        return driver.load(self.name, self.source)


def _type_of(words: str, variant: Mapping[str, Any]) -> torch.dtype | None:
    """Return the type of the elements of a parameter in C, None if it is no pointer."""
    kind, pointer, _ = words.strip().removeprefix("const ").rpartition("*")
    return _TYPES[str(variant.get(kind.strip(), kind.strip()))] if pointer else None


@functools.cache
def kernel(name: str, **variant: Any) -> Kernel:
    """Return a kernel.

    Args:
        name: its name, which is that of its file in `source/`.
        variant: macros of this variant: numbers and truth values, or names of types.
    """
    return Kernel(name, variant)
