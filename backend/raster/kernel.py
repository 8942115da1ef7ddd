"""Compilation of functions with numba, with a disk cache that is valid until code they may depend on changes."""

from __future__ import annotations

import contextlib
import dis
import functools
import hashlib
import inspect
import itertools
from collections.abc import Callable
from importlib.machinery import SourceFileLoader
from itertools import pairwise
from pathlib import Path
from types import CodeType
from typing import Any, cast

from filelock import FileLock
from numba import njit

_LAYERS = ("raster", "model", "training", "mesh", "pointing", "stereo")
"""The packages that contain kernels; each one may depend on itself and on those before it."""
_SHARED = ("blending.py", "spherical_harmonics.py")
"""The files of `backend.shared.splats` whose constants are compiled into kernels."""
_BACKEND = Path(__file__).resolve().parents[1]


def digest_of_code(code: CodeType) -> bytes:
    """Compute a hash of a code object that depends on names, constants and operations.

    Comments, docstrings and line numbers do not affect the hash.

    Args:
        code: a compiled module or function, including nested functions.

    Returns:
        The SHA-256 digest.
    """
    digest = hashlib.sha256(f"{code.co_name} {code.co_varnames} {code.co_names} {code.co_freevars}".encode())
    digest.update(code.co_code)
    docstrings = _docstring_indices(code)
    for index, constant in enumerate(code.co_consts):
        if isinstance(constant, CodeType):
            digest.update(digest_of_code(constant))
        elif index not in docstrings and constant is not None:
            shown = sorted(map(repr, constant)) if isinstance(constant, frozenset) else repr(constant)
            digest.update(f"{index} {type(constant).__name__} {shown}".encode())
    return digest.digest()


def _docstring_indices(code: CodeType) -> set[int]:
    """Return the indices of the constants that are the docstring of a function, a class or a module."""
    if code.co_flags & inspect.CO_NEWLOCALS:
        return {0} if isinstance(next(iter(code.co_consts), None), str) else set()
    if "__doc__" not in code.co_names:
        return set()
    steps = list(dis.get_instructions(code))
    stores = [before for before, step in pairwise(steps) if step.opname == "STORE_NAME" and step.argval == "__doc__"]
    return {before.arg for before in stores if before.arg is not None}


@functools.cache
def _digest_of_file(path: Path) -> bytes:
    """Return `digest_of_code` of a source file, using Python's cache of compiled files."""
    return digest_of_code(cast(CodeType, SourceFileLoader(path.stem, str(path)).get_code(path.stem)))


@functools.cache
def digest_up_to(layer: str) -> str:
    """Compute a hash of the code that kernels of `layer` (one of `_LAYERS`) may depend on."""
    digest = hashlib.sha256()
    for name in _SHARED:
        digest.update(_digest_of_file(_BACKEND / "shared" / "splats" / name))
    for folder in _LAYERS[: _LAYERS.index(layer) + 1]:
        for path in sorted((_BACKEND / folder).rglob("*.py")):
            digest.update(_digest_of_file(path))
    return digest.hexdigest()


class _Locked:
    """A function's compiled variants on disk, which several processes may add to at the same time."""

    def save(self: Any, key: Any, data: Any) -> None:
        """Add a variant: its file first, and then its entry in the index, which is right at any moment.

        Without the lock, two processes could give the same file to different variants.
        """
        with contextlib.ExitStack() as held:
            # Some network file systems have no locks.
            with contextlib.suppress(OSError, NotImplementedError):
                held.enter_context(FileLock(f"{self._index_path}.locked", timeout=10, fallback_to_soft=False))
            names = self._load_index()
            taken = set(names.values())
            free = (name for name in map(self._data_name, itertools.count(1)) if name not in taken)
            name = names.get(key) or next(free)
            self._save_data(name, data)
            self._save_index({**names, key: name})


@functools.cache
def locked(kind: Any) -> Any:
    """Return a class of numba's cache files whose variants processes may save at the same time."""
    return type("LockedCacheFile", (_Locked, kind), {})


def renew_with_layer(dispatcher: Any, function: Callable[..., Any]) -> None:
    """Tie the disk cache of a compiled function to `digest_up_to` of its layer instead of its file.

    The cache remains valid if the function moves to another line of its file.

    Args:
        dispatcher: numba's dispatcher of the function.
        function: the function itself.
    """
    layer = next(part for part in function.__module__.split(".") if part in _LAYERS)
    # Without a cache folder, or if numba's internals have changed, numba's default caching applies.
    with contextlib.suppress(AttributeError):
        cache = dispatcher._cache
        name = cache._impl.filename_base.replace(f"-{function.__code__.co_firstlineno}.py", ".py")
        kind: Any = type(cache._cache_file)
        cache._cache_file = locked(kind)(cache._cache_path, name, digest_up_to(layer))


def kernel(
    parallel: bool = False, fastmath: bool | set[str] = False, inline: bool = False
) -> Callable[[Callable[..., Any]], Any]:
    """Decorate a kernel: numba.njit with NumPy's division, cached on disk.

    By default, numba invalidates a function's cache only if the function's own file changes, although the compiled code
    contains constants and functions of other files. Here, the cache is valid as long as the code of the function's
    layer, of the layers below it, and of `_SHARED` is unchanged, apart from comments and docstrings.

    Args:
        parallel: whether `prange` loops run in parallel.
        fastmath: numba's fastmath flags.
        inline: whether numba inlines the function into the kernels that call it.

    Returns:
        The decorator.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        dispatcher = njit(
            parallel=parallel,
            cache=True,
            error_model="numpy",
            fastmath=fastmath,
            inline="always" if inline else "never",
        )(function)
        renew_with_layer(dispatcher, function)
        return dispatcher

    return decorate
