"""`kernel` compiles a function with numba and keeps the result on disk until anything in this package changes."""

from __future__ import annotations

import contextlib
import functools
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba import njit


@functools.cache
def _package_digest() -> str:
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def kernel(parallel: bool = False) -> Callable[[Callable[..., Any]], Any]:
    """Decorator: numba.njit with NumPy's division, cached on disk.

    numba renews a function's cache when the function's own file changes, although the code holds constants and
    functions of other files too; here the cache is as old as the content of all of this package's files.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        dispatcher = njit(parallel=parallel, cache=True, error_model="numpy")(function)
        # Without a cache folder, or with another numba inside, numba's own rule stays.
        with contextlib.suppress(AttributeError):
            cache_file = dispatcher._cache._cache_file
            cache_file._source_stamp = (cache_file._source_stamp, _package_digest())
        return dispatcher

    return decorate
