"""`kernel` compiles a function with numba and keeps the result on disk until anything changes that it may depend on."""

from __future__ import annotations

import contextlib
import functools
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba import njit

_LAYERS = ("raster", "model", "training", "mesh")
"""The packages that hold kernels; each may use what lies in it and in those before it."""


@functools.cache
def digest_up_to(package: str) -> str:
    """The content of all files that the kernels of `package` may be made of, as a hash."""
    backend = Path(__file__).parents[1]
    digest = hashlib.sha256((backend / "blending.py").read_bytes())
    for folder in _LAYERS[: _LAYERS.index(package) + 1]:
        for path in sorted((backend / folder).glob("*.py")):
            digest.update(path.read_bytes())
    return digest.hexdigest()


def renew_with_package(dispatcher: Any, function: Callable[..., Any]) -> None:
    """Let the cache on disk of a compiled function last as long as the files that `digest_up_to` its package."""
    digest = digest_up_to(function.__module__.split(".")[-2])
    # Without a cache folder, or with another numba inside, numba's own rule stays.
    with contextlib.suppress(AttributeError):
        cache_file = dispatcher._cache._cache_file
        cache_file._source_stamp = (cache_file._source_stamp, digest)


def kernel(
    parallel: bool = False, fastmath: bool | set[str] = False, inline: bool = False
) -> Callable[[Callable[..., Any]], Any]:
    """Decorator: numba.njit with NumPy's division, cached on disk; inline: a part of whatever kernel calls it.

    numba renews a function's cache when the function's own file changes, although the code holds constants and
    functions of other files too; here the cache is as old as the content of all files of the function's package, of the
    packages below it, and of the guards that they share with Blender's side.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        dispatcher = njit(
            parallel=parallel,
            cache=True,
            error_model="numpy",
            fastmath=fastmath,
            inline="always" if inline else "never",
        )(function)
        renew_with_package(dispatcher, function)
        return dispatcher

    return decorate
