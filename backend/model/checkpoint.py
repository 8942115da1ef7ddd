"""Checkpoints of a training: safetensors, written to a temporary file and renamed; the previous one is kept."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from io import BufferedReader
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from ..shared.durations import awake_seconds
from ..shared.errors import InputError, is_lack_of_space
from ..shared.events import Reporter
from ..shared.formats.atomic import atomic_file, make_folder, replace_file, require_still_there
from ..shared.formats.json_file import parse_json
from ..shared.formats.regular_file import open_regular
from ..shared.reconstruction.checkpoint import CURRENT, FORMAT, LENGTH_BYTES, PREVIOUS, stored_header

_TYPES: dict[np.dtype[Any], str] = {
    np.dtype("<f4"): "F32",
    np.dtype("<f8"): "F64",
    np.dtype("<i4"): "I32",
    np.dtype("<i8"): "I64",
}
"""Types of tensors, and their names in the format."""

_DTYPES: dict[str, np.dtype[Any]] = {name: dtype for dtype, name in _TYPES.items()}

_SHARE, _LONGEST = 20.0, 600.0
"""Seconds between two checkpoints for each second that one takes, and their limit."""

Tensors = dict[str, np.ndarray]
Check = Callable[[Mapping[str, np.ndarray], dict[str, Any]], None]


def _accept(_tensors: Mapping[str, np.ndarray], _state: dict[str, Any]) -> None:
    """Accept any tensors and state."""


class Stored(Mapping[str, np.ndarray]):
    """The tensors of a file in the format safetensors, of which each is read when it is asked for, and not kept.

    The package's own functions map the file, so that all of it counts as memory of the process.

    Args:
        file: the open file.
        former: names of tensors in files of older versions, and their present names.

    Raises:
        ValueError, KeyError, TypeError: the file is damaged; also when a tensor is read.
    """

    def __init__(self, file: BufferedReader, former: Mapping[str, str]) -> None:
        self._file, self._size = file, os.fstat(file.fileno()).st_size
        header, self._start = stored_header(file)
        self.state = dict(parse_json(header.pop("__metadata__")["state"]))
        self._entries = {former.get(name, name): entry for name, entry in header.items()}

    def __getitem__(self, name: str) -> np.ndarray:
        return self.part(name, 0, None)

    def kind(self, name: str) -> tuple[np.dtype[Any], tuple[int, ...]]:
        """Return type and shape of the named tensor."""
        entry = self._entries[name]
        dtype, shape, (begin, end) = _DTYPES[entry["dtype"]], tuple(entry["shape"]), entry["data_offsets"]
        if min(shape, default=0) < 0 or math.prod(shape) * dtype.itemsize != end - begin or end > self._size:
            raise ValueError(f"{name} has another size")
        return dtype, shape

    def part(self, name: str, first: int, last: int | None) -> np.ndarray:
        """Return tensor[first:last] of the named tensor, without the other rows being read."""
        dtype, shape = self.kind(name)
        begin = self._entries[name]["data_offsets"][0]
        if shape:
            first, last, _ = slice(first, last).indices(shape[0])
            begin += first * math.prod(shape[1:]) * dtype.itemsize
            shape = (max(last - first, 0), *shape[1:])
        self._file.seek(self._start + begin)
        values = np.empty(shape, dtype)
        if values.nbytes and self._file.readinto(values.data.cast("B")) != values.nbytes:
            raise ValueError(f"{name} is truncated")
        return values

    def __contains__(self, name: object) -> bool:
        return name in self._entries

    def __iter__(self) -> Iterator[str]:
        return iter(self._entries)

    def __len__(self) -> int:
        return len(self._entries)


Take = Callable[[Stored, dict[str, Any]], Tensors]


def save_checkpoint(
    folder: Path, tensors: dict[str, np.ndarray], state: dict[str, Any], keep_current: bool = True
) -> None:
    """Write a checkpoint; after the first one, `folder` contains a complete checkpoint at any time.

    Args:
        folder: created if necessary, in one that exists.
        tensors: tensors by name.
        state: JSON-serializable state.
        keep_current: keep the current checkpoint as the previous one. Without it, the current one is replaced and the
            previous one is left, as is right if the current one may be damaged.

    Raises:
        InputError: the file cannot be written; the previous checkpoint can still be loaded.
    """
    require_still_there(folder.parent)
    try:
        make_folder(folder)
        with atomic_file(folder / CURRENT) as file:
            _write(file, tensors, {"state": json.dumps({"format": FORMAT, **state})})
            file.flush()
            if keep_current and (folder / CURRENT).exists():
                os.fsync(file.fileno())
                _keep_current(folder)
    except OSError as error:
        advice = (
            "free some space" if is_lack_of_space(error) else "close programs that use it, or check its permissions,"
        )
        raise InputError(
            f"The checkpoint {folder / CURRENT} could not be written ({error.strerror}); {advice} and run the same "
            "command again to continue from the previous checkpoint."
        ) from error


def _keep_current(folder: Path) -> None:
    """Make the current checkpoint the previous one, too, so that neither is missing until it is replaced."""
    try:
        (folder / PREVIOUS).unlink(missing_ok=True)
        os.link(folder / CURRENT, folder / PREVIOUS)
    except OSError:
        # File systems such as exFAT have no hard links.
        replace_file(folder / CURRENT, folder / PREVIOUS)


def _write(file: BinaryIO, tensors: dict[str, np.ndarray], metadata: dict[str, str]) -> None:
    """Write tensors in the format safetensors, one after another.

    The package's own functions copy all of them into one string of bytes first, and models may take half of the memory.
    """
    header: dict[str, Any] = {"__metadata__": metadata}
    # A scalar gets one dimension; others are copied only where they are not contiguous.
    tensors = {name: np.ascontiguousarray(values) for name, values in tensors.items()}
    # By alignment, as readers expect.
    order = sorted(tensors, key=lambda name: (-tensors[name].dtype.itemsize, name))
    end = 0
    for name in order:
        values = tensors[name]
        first, end = end, end + values.nbytes
        header[name] = {"dtype": _TYPES[values.dtype], "shape": list(values.shape), "data_offsets": [first, end]}
    encoded = json.dumps(header).encode()
    encoded += b" " * (-len(encoded) % 8)
    file.write(len(encoded).to_bytes(LENGTH_BYTES, "little") + encoded)
    for name in order:
        file.write(tensors[name].data)


def seconds_to_next(least: float, saving: float) -> float:
    """Return the seconds to train until the next checkpoint: `least`, or more if the last one took long to save."""
    return max(least, min(_SHARE * saving, _LONGEST))


class Saving:
    """Saves a training at intervals, which are longer where that takes long.

    Args:
        save: writes a checkpoint to a folder; raises InputError if it cannot.
        folder: folder of the checkpoints.
        least: least number of seconds between them.
        reporter: receives a warning where one at an interval cannot be written.
    """

    def __init__(self, save: Callable[[Path], None], folder: Path, least: float, reporter: Reporter) -> None:
        self._save, self._folder, self._least, self._reporter = save, folder, least, reporter
        self._last, self._interval = awake_seconds(), least
        self._failed = False

    def save(self) -> None:
        """Write a checkpoint; the interval to the next one begins.

        Raises:
            InputError: it cannot be written.
        """
        self._save(self._folder)
        self._last, self._failed = awake_seconds(), False

    def save_if_due(self) -> None:
        """Write a checkpoint if the interval is over; one that cannot be written is left for the next interval.

        Raises:
            InputError: nor could the one before.
        """
        started = awake_seconds()
        if started - self._last < self._interval:
            return
        try:
            self.save()
        except InputError as error:
            if self._failed:
                raise
            self._last, self._failed = awake_seconds(), True
            reason = error.__cause__.strerror if isinstance(error.__cause__, OSError) else error
            self._reporter.warning(
                f"{self._folder}: a checkpoint could not be written ({reason}); the training goes on, and tries again "
                "later."
            )
        self._interval = seconds_to_next(self._least, self._last - started)

    def delay(self, seconds: float) -> None:
        """Do not count a time in which the training has waited."""
        self._last += seconds


def has_checkpoint(folder: Path) -> bool:
    """Return whether `folder` contains files of a checkpoint, complete or damaged."""
    return any((folder / name).exists() for name in (CURRENT, PREVIOUS))


def load_checkpoint(
    folder: Path,
    check: Check = _accept,
    former: Mapping[str, str] | None = None,
    take: Take | None = None,
) -> tuple[Tensors, dict[str, Any], str | None] | None:
    """Read the latest complete checkpoint.

    Args:
        folder: The folder of the checkpoint.
        check: Called with all tensors and the state as stored; raises ValueError, KeyError or TypeError if they are not
            those of a training.
        former: Names of tensors in files of older versions, and their present names.
        take: Returns the tensors to return, for all of them, by their present names, and the state as stored. With
            it, tensors are checked one after another, and those that it does not return are not kept in memory. Its
            errors are not those of a damaged file. None: all.

    Returns:
        The tensors by name, the state, and a warning or None if the checkpoint is not the latest one that was written;
        None if there is no checkpoint.

    Raises:
        InputError: There are checkpoint files, but none can be read.
    """
    broken = None
    for name in (CURRENT, PREVIOUS):
        path = folder / name
        if not path.exists():
            continue
        with ExitStack() as opened:
            tensors: Tensors = {}
            try:
                stored = Stored(opened.enter_context(open_regular(path)), former or {})
                state = stored.state
                is_other_version = isinstance(state["format"], int) and state["format"] != FORMAT
                if not is_other_version:
                    if take is None:
                        tensors = dict(stored)
                    check(tensors or stored, state)
            except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError):
                broken = path
                continue
            if is_other_version:
                raise InputError(f"{path} was written by another version of ObjectGS; train again with --restart.")
            if take is not None:
                tensors = take(stored, state)
        warning = None
        if broken is not None:
            warning = f"{broken} is truncated or damaged; continuing from the previous checkpoint ({path.name})."
        elif name == PREVIOUS:
            warning = f"{folder / CURRENT} is missing; continuing from the previous checkpoint ({path.name})."
        return tensors, state, warning
    if broken is not None:
        raise InputError(f"{broken} is truncated or damaged, and there is no older one; train again with --restart.")
    return None
