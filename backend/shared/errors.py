"""Exceptions that end a command, and exit codes."""

from __future__ import annotations

import errno
import re
import sys
from typing import Any

EXIT_DONE = 0
EXIT_FAILED = 1
EXIT_BAD_INPUT = 2
EXIT_CANCELLED = 130

_UNALLOCATED = re.compile(r"allocate memory|not enough memory|error (?:code: <)?1455\b|\(os error 12\)", re.IGNORECASE)
"""Error texts where memory is lacking: those of torch and of systems; of Windows, only the number is in English."""


class InputError(Exception):
    """Invalid user input; the message is one plain sentence that names the file.

    Attributes:
        fields: More fields of the event that reports it.
    """

    fields: dict[str, Any] = {}


class NothingMade(InputError):
    """The input is valid, but a command can make nothing of it, as without a surface or without held-out views."""

    fields = {"nothing_made": True}


class MissingPackage(InputError):
    """An option needs a Python package that is not part of the backend's environment."""

    def __init__(self, option: str, package: str, install: str) -> None:
        super().__init__(f"{option} needs the package {package}; run {install} in a terminal.")
        self.fields = {"lacks": package, "option": option}


class Cancelled(Exception):
    """The user stopped the command; all results worth keeping are on disk."""


class ProcessLost(Exception):
    """Another process of the same training has ended; the message says what to do."""


def is_lack_of_memory(error: BaseException) -> bool:
    """Return whether an error means that the computer's memory, not that of a GPU, is too small."""
    lacks = isinstance(error, MemoryError) or (isinstance(error, OSError) and error.errno == errno.ENOMEM)
    return lacks or _UNALLOCATED.search(str(error)) is not None


def is_lack_of_space(error: OSError) -> bool:
    """Return whether an error means that a disk is full, or that a file would be larger than it may be."""
    return error.errno in (errno.ENOSPC, errno.EFBIG, getattr(errno, "EDQUOT", None))


def describe_missing_package(error: ModuleNotFoundError) -> str:
    """Return the message for a Python without the backend's packages."""
    return (
        f"The Python {sys.executable} lacks the package {error.name}, which the compute backend needs; "
        "set up the backend, or choose a Python that has its packages."
    )
