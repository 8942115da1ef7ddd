"""`kernel` compiles a function with numba and caches the result on disk until code that it may depend on changes."""

from __future__ import annotations

import contextlib
import functools
import hashlib
from collections.abc import Callable
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import CodeType
from typing import Any, cast

from numba import njit

_LAYERS = ("raster", "model", "training", "mesh")
"""The packages that contain kernels; each may use itself and those before it."""
_SHARED = ("blending.py", "spherical_harmonics.py")
"""The files of `backend.shared.splats` whose constants are compiled into kernels."""
_BACKEND = Path(__file__).resolve().parents[1]


def digest_of_code(code: CodeType) -> bytes:
    """Hash what a code object does.

    Comments, docstrings and line numbers do not change the hash; names, constants and operations do.

    Args:
        code: a compiled module or function, with the functions that it contains.

    Returns:
        The SHA-256 digest.
    """
    digest = hashlib.sha256(f"{code.co_name} {code.co_varnames} {code.co_names} {code.co_freevars}".encode())
    digest.update(code.co_code)
    for index, constant in enumerate(code.co_consts):
        if isinstance(constant, CodeType):
            digest.update(digest_of_code(constant))
        # The first constant is the docstring, or None in its place.
        elif (index or not isinstance(constant, str)) and constant is not None:
            shown = sorted(map(repr, constant)) if isinstance(constant, frozenset) else repr(constant)
            digest.update(f"{index} {type(constant).__name__} {shown}".encode())
    return digest.digest()


def _digest_of_file(path: Path) -> bytes:
    """`digest_of_code` of a source file, through Python's own cache of compiled files."""
    return digest_of_code(cast(CodeType, SourceFileLoader(path.stem, str(path)).get_code(path.stem)))


@functools.cache
def digest_up_to(layer: str) -> str:
    """Hash the code that kernels of `layer` (one of `_LAYERS`) may depend on."""
    digest = hashlib.sha256()
    for name in _SHARED:
        digest.update(_digest_of_file(_BACKEND / "shared" / "splats" / name))
    for folder in _LAYERS[: _LAYERS.index(layer) + 1]:
        for path in sorted((_BACKEND / folder).rglob("*.py")):
            digest.update(_digest_of_file(path))
    return digest.hexdigest()


def renew_with_layer(dispatcher: Any, function: Callable[..., Any]) -> None:
    """Tie the disk cache of a compiled function to `digest_up_to` of its layer, instead of to its own file.

    The cache is also found again when the function has moved to another line of its file.

    Args:
        dispatcher: what numba made of the function.
        function: the function itself.
    """
    layer = next(part for part in function.__module__.split(".") if part in _LAYERS)
    # Without a cache folder, or if numba's internals have changed, numba's own rule applies.
    with contextlib.suppress(AttributeError):
        cache = dispatcher._cache
        name = cache._impl.filename_base.replace(f"-{function.__code__.co_firstlineno}.py", ".py")
        cache._cache_file = type(cache._cache_file)(cache._cache_path, name, digest_up_to(layer))


def kernel(
    parallel: bool = False, fastmath: bool | set[str] = False, inline: bool = False
) -> Callable[[Callable[..., Any]], Any]:
    """Decorate a kernel: numba.njit with NumPy's division, cached on disk.

    numba renews a function's cache when the function's own file changes, although the compiled code contains constants
    and functions of other files, too. Here the cache is valid as long as the code of the function's layer, of the
    layers below it, and of `_SHARED` is unchanged; comments and docstrings do not count.

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
