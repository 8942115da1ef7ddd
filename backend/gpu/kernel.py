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
import struct
import threading
from collections.abc import Callable, Mapping
from ctypes import addressof, c_uint64, c_void_p
from pathlib import Path
from typing import Any

import torch

from . import emulator

SOURCE = Path(__file__).parent / "source"

WARP = 32

_FLOAT, _BITS = struct.Struct("<f"), struct.Struct("<I")
_LIMITS = {"int": 2**31, "long long": 2**63}
"""Absolute values from which on numbers do not fit into parameters of these types."""
_FOR_EACH = 128
"""Number of threads per block of kernels without shared memory."""
_TYPES = {
    "bool": torch.bool, "float": torch.float32, "double": torch.float64, "unsigned char": torch.uint8,
    "signed char": torch.int8, "short": torch.int16, "int": torch.int32, "long long": torch.int64,
}  # fmt: skip
_INCLUDE = re.compile(r'^#include "(.+)"$', re.MULTILINE)
_PARAMETERS = re.compile(r"^KERNEL\(.*?\) \w+\((.*?)\) \{", re.MULTILINE | re.DOTALL)

Argument = torch.Tensor | float | None


def source_of(name: str, variant: Mapping[str, Any]) -> str:
    """Return the complete source text of a kernel.

    Args:
        name: the kernel, defined in the file of that name.
        variant: constants: numbers, truth values, or names of types. An int is a macro if it is a part of a condition
            of the preprocessor; a group of them, a mapping, becomes an enumeration.
    """
    files = {path.name: path for path in SOURCE.rglob("*.*")}
    included = set()

    def text_of(file: str) -> str:
        # Emulated kernels alone need the emulator, which includes headers of the system.
        if file in included or (file == "emulator.h" and not emulator.emulated()):
            return ""
        included.add(file)
        return _INCLUDE.sub(lambda found: text_of(found[1]), files[file].read_text(encoding="utf-8"))

    lines = ["#define EMULATED 1"] if emulator.emulated() else []
    for constant, value in variant.items():
        if isinstance(value, Mapping):
            lines.append(f"enum {{ {', '.join(f'{column} = {number}' for column, number in value.items())} }};")
        else:
            lines.append(f"#define {constant} {_literal(value)}")
    return "\n".join([*lines, text_of(f"{name}.cu")])


@functools.cache
def digest_of_sources() -> str:
    """Return a hash of all files in `source/`."""
    texts = [path.read_bytes() for path in sorted(SOURCE.rglob("*.*"))]
    return hashlib.sha256(b"\0".join(texts)).hexdigest()


def _literal(value: Any) -> str:
    if isinstance(value, float):
        return f"({value!r})"
    return str(int(value)) if isinstance(value, int) else str(value)


class Kernel:
    """A kernel, compiled for the current device when it is first launched.

    Args:
        name: its name, which is that of its file in `source/`.
        variant: constants, as in `source_of`.
    """

    def __init__(self, name: str, variant: Mapping[str, Any]) -> None:
        self.name, self.variant = name, variant
        self.source = source_of(name, variant)
        found = _PARAMETERS.search(self.source)
        assert found, name
        self._types = [_type_of(words, variant) for words in found[1].split(",")]
        count = len(self._types)
        self._values = (c_uint64 * count)()
        start = addressof(self._values)
        self._pointers = (c_void_p * count)(*range(start, start + 8 * count, 8))
        self._lock = threading.Lock()

    def __call__(self, blocks: int, threads: int, *arguments: Argument) -> None:
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
        if len(arguments) != len(self._types):
            raise TypeError(f"{self.name} has {len(self._types)} parameters and was given {len(arguments)} arguments")
        values: list[Any] = [
            argument.data_ptr()
            if isinstance(argument, torch.Tensor) and argument.dtype is kind and argument.is_contiguous()
            else self._value(kind, argument)
            for kind, argument in zip(self._types, arguments, strict=True)
        ]
        # A launch copies the values, but until then another thread must not change them.
        with self._lock:
            self._values[:] = values
            self._launch(self._pointers, blocks, threads)

    def for_each(self, count: int, *arguments: Argument) -> None:
        """Launch a kernel without shared memory with one thread for each of `count` elements."""
        threads = min(_FOR_EACH, WARP * math.ceil(count / WARP)) or WARP
        self(math.ceil(count / threads), threads, *arguments)

    def _value(self, kind: torch.dtype | str, argument: Argument) -> int:
        """Return an argument that is no tensor as 8 bytes; kind: as in `_type_of`."""
        if argument is None:
            if not isinstance(kind, str):
                return 0
        elif not isinstance(argument, torch.Tensor) and isinstance(kind, str):
            if kind == "float":
                return int(_BITS.unpack(_FLOAT.pack(argument))[0])
            if kind in ("int", "long long") and argument == int(argument) and abs(argument) < _LIMITS[kind]:
                return int(argument)
        what: Any = argument
        if isinstance(argument, torch.Tensor):
            what = argument.dtype if argument.is_contiguous() else f"a part of a {argument.dtype} tensor"
        raise TypeError(f"an argument of {self.name} is {what}, and the parameter is {kind}")

    @functools.cached_property
    def _launch(self) -> Callable[[Any, int, int], None]:
        if emulator.emulated():
            return emulator.load(self.name, self.source)
        from . import driver

        return driver.load(self.name, self.source)


def _type_of(words: str, variant: Mapping[str, Any]) -> torch.dtype | str:
    """Return the type of the elements of a parameter in C; its name for a parameter that is no pointer."""
    kind, pointer, _ = words.strip().removeprefix("const ").rpartition("*")
    if not pointer:
        return " ".join(words.split()[:-1])
    return _TYPES[str(variant.get(kind.strip(), kind.strip()))]


@functools.cache
def kernel(name: str, **variant: Any) -> Kernel:
    """Return a kernel; arguments as for `Kernel`."""
    return Kernel(name, variant)
