# SPDX-License-Identifier: GPL-3.0-or-later
"""The command `batch`, which runs every capture of a folder and writes a summary; a later run continues from it."""

from __future__ import annotations

import argparse
import contextlib
import time
import traceback
from collections import Counter
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any
from urllib.parse import quote

from ...backend.shared.errors import Cancelled, InputError
from ...backend.shared.formats.atomic import write_atomic
from ...backend.shared.formats.file_names import legible
from ...backend.shared.formats.json_file import read_json, write_json
from ...backend.shared.formats.photos_source import NOT_OF_USERS
from ...backend.shared.formats.regular_file import is_folder
from ...backend.shared.reconstruction.folder import IGNORED, Reconstruction
from ...backend.shared.reconstruction.lock import FolderInUse, locked
from ...backend.shared.reconstruction.report import MIOU_LABELS, read_report
from ...backend.shared.version import __version__
from .built import BLEND
from .commands import PICTURE, StepFailed, absolute, find_backend, path_options, reconstruct, sentence

DONE, BAD_INPUT, FAILED, UNFINISHED = "done", "bad input", "failed", "unfinished"
NOT_BEGUN = "not begun"
"""What unfinished captures are for the user until a batch begins with them."""

_CAPTURE_FILES = {".json", ".txt", ".out", ".xml", ".csv", ".ply", ".obj"}
"""Suffixes of files beside images/ that a capture may consist of: labels, held-out views, cameras and points."""

_LOCK, _PATIENCE = ".batch.lock", 10.0
"""File name of the lock of the summary, and seconds to wait for another process that writes it."""

_NOTHING: dict[str, Any] = {
    "state": UNFINISHED, "psnr": None, "miou": None, "miou_all": None, "zero_is_background": None, "splats": None,
    "error": None, "step": None,
}  # fmt: skip


def batch(options: argparse.Namespace) -> None:
    """Run every capture of a folder that is not done yet.

    Raises:
        InputError: the folder or a capture cannot be used.
        StepFailed: a capture failed for another reason.
    """
    source, out = absolute(Path(options.source)), absolute(options.out)
    captures = _captures(source)
    find_backend(options.backend_python)
    settings = {
        "version": __version__,
        "train": [*path_options(options), *options.rest],
        "engine": options.engine,
        "samples": options.samples,
        "size": list(options.size) if options.size else None,
        "meshes": not options.no_meshes,
    }
    Reconstruction(out).create()
    summary, in_use = _Summary(out, captures), 0
    for number, capture in enumerate(captures, 1):
        entry = summary.entry(legible(capture.name))
        title = f"{entry['name']} ({number} of {len(captures)})"
        try:
            wanted = {**settings, "capture": _text(capture), "files": fingerprint(capture)}
        except (InputError, OSError) as error:
            reason = sentence(error) if isinstance(error, OSError) else str(error)
            entry.update(_NOTHING, settings=None, state=BAD_INPUT, error=reason)
            summary.update(entry)
            options.reporter.status(f"== {title}: {entry['error']}")
            continue
        with contextlib.ExitStack() as stack:
            try:
                stack.enter_context(locked(out, f".{capture.name}.run.lock"))
            except FolderInUse:
                options.reporter.status(f"== {title}: left to another batch, which runs it.")
                continue
            # Another batch may have finished it by now.
            entry = summary.entry(entry["name"])
            if _is_done(entry, wanted, out / capture.name):
                options.reporter.status(f"== {title}: already done.")
                continue
            options.reporter.status(f"== {title}")
            _run_one(capture, out / capture.name, entry, wanted, summary, options)
            in_use += entry["state"] == UNFINISHED
    summary.read()
    options.reporter.status(f"{_sentence(summary.entries)} See {out / 'batch.md'}.")
    if unusable := summary.count(BAD_INPUT) + in_use:
        raise InputError(f"{unusable} of {len(captures)} captures cannot be used.")
    if summary.count(FAILED):
        raise StepFailed(f"{summary.count(FAILED)} of {len(captures)} captures failed.")


def _captures(source: Path) -> list[Path]:
    """Return the subfolders with images/ or sparse/, sorted by name."""
    try:
        folders = sorted(entry for entry in source.iterdir() if is_folder(entry))
    except OSError as error:
        raise InputError(f"The folder {source} cannot be read ({error.strerror}).") from error
    # Of folders such as lost+found, which may not be read, nothing is known.
    found = [folder for folder in folders if is_folder(folder / "images") or is_folder(folder / "sparse")]
    if not found:
        raise InputError(f"The folder {source} contains no captures: no subfolder has images/ or sparse/.")
    return found


def _text(path: Path) -> str:
    """Return a path as text; raise InputError if it is not Unicode, which no file of a reconstruction can hold."""
    if legible(str(path)) != str(path):
        raise InputError(f"{legible(str(path))} is a name that is not text in UTF-8; rename it.")
    return str(path)


def fingerprint(capture: Path) -> list[int]:
    """Return the number, total size in bytes and latest modification time (ns) of a capture's files.

    Files that file browsers and network drives make are left out.
    """
    paths = [path for part in ("images", "masks", "sparse") for path in (capture / part).rglob("*")]
    paths += [path for path in capture.iterdir() if path.suffix.lower() in _CAPTURE_FILES]
    paths = [path for path in paths if path.name not in IGNORED and not _is_of_no_user(path.relative_to(capture))]
    states = [path.stat() for path in paths if path.is_file()]
    return [len(states), sum(state.st_size for state in states), max((s.st_mtime_ns for s in states), default=0)]


def _is_of_no_user(path: Path) -> bool:
    return any(part.startswith(NOT_OF_USERS) for part in path.parts)


def _is_done(entry: dict[str, Any], wanted: dict[str, Any], folder: Path) -> bool:
    made = (folder / BLEND).is_file() and (folder / PICTURE).is_file()
    return entry.get("state") == DONE and entry.get("settings") == wanted and made


def _run_one(
    capture: Path,
    folder: Path,
    entry: dict[str, Any],
    wanted: dict[str, Any],
    summary: _Summary,
    options: argparse.Namespace,
) -> None:
    """Run one capture; its entry in the summary stays valid even if the process is killed.

    The entry stays unfinished if another program uses the folder.
    """
    earlier = entry["seconds"] if entry["state"] == UNFINISHED and entry["settings"] == wanted else 0.0
    entry.update(_NOTHING, settings=wanted, seconds=earlier)
    summary.update(entry)
    started = time.monotonic()

    def begin(step: str) -> None:
        entry.update(step=step, seconds=round(earlier + time.monotonic() - started, 1))
        summary.update(entry)

    try:
        reconstruct(capture, folder, options, begin)
        report = read_report(folder)
        entry.update(
            state=DONE,
            step=None,
            psnr=report.quality["psnr"],
            miou=report.quality["miou"],
            miou_all=report.quality["miou_all"],
            zero_is_background=report.zero_is_background,
            splats=report.model["gaussians"],
        )
    except (Cancelled, KeyboardInterrupt):
        entry["error"] = "Cancelled; the same command continues from there."
        raise
    except FolderInUse as error:
        entry["error"] = str(error)
    except InputError as error:
        entry.update(state=BAD_INPUT, error=str(error))
    except OSError as error:
        entry.update(state=BAD_INPUT, error=sentence(error))
    except StepFailed as error:
        entry.update(state=FAILED, error=str(error))
    except Exception as error:
        traceback.print_exc()
        entry.update(state=FAILED, error=f"{type(error).__name__}: {' '.join(str(error).split())}")
    finally:
        entry["seconds"] = round(earlier + time.monotonic() - started, 1)
        summary.update(entry)
    if entry["error"]:
        options.reporter.status(f"{capture.name}: {entry['error']}")


class _Summary:
    """Summary in batch.json and batch.md in `folder`, with one entry per capture.

    The files are read again before each change, since another computer may run other captures. Entries of captures that
    are not among `captures` are kept if `folder` has results of them, or if they tell why there are none.
    """

    def __init__(self, folder: Path, captures: list[Path]) -> None:
        self.json, self.table = folder / "batch.json", folder / "batch.md"
        self.names = [legible(capture.name) for capture in captures]
        self.entries: list[dict[str, Any]] = []
        self.others: list[dict[str, Any]] = []
        with self._alone():
            self.read()
            self._write()

    def entry(self, name: str) -> dict[str, Any]:
        self.read()
        return next(entry for entry in self.entries if entry["name"] == name)

    def update(self, entry: dict[str, Any]) -> None:
        """Write the entry of a capture."""
        with self._alone():
            self.read()
            self.entries = [entry if other["name"] == entry["name"] else other for other in self.entries]
            self._write()

    def read(self) -> None:
        """Read all entries."""
        known: dict[str, dict[str, Any]] = {}
        if self.json.exists():
            content = read_json(self.json)
            try:
                known = {str(entry["name"]): dict(entry) for entry in content["captures"]}
            except (KeyError, TypeError, ValueError) as error:
                raise InputError(f"{self.json} was not written by this program; choose another --out.") from error
        fresh = {**_NOTHING, "seconds": 0.0, "settings": None}
        self.entries = [{"name": name, **fresh, **known.get(name, {})} for name in self.names]
        others = [{**fresh, **entry} for name, entry in known.items() if name not in self.names]
        self.others = [each for each in others if each["error"] or is_folder(self.json.parent / each["name"])]

    def _alone(self) -> AbstractContextManager[None]:
        return locked(self.json.parent, _LOCK, _PATIENCE)

    def count(self, state: str) -> int:
        return sum(entry["state"] == state for entry in self.entries)

    def _write(self) -> None:
        entries = [*self.entries, *self.others]
        write_json(self.json, {"captures": entries})
        heads = ("capture", "image", "state", "seconds", "PSNR", *MIOU_LABELS.values(), "splats")
        lines = ["| " + " | ".join(heads) + " |", "|---|---|---|---:|---:|---:|---:|---:|"]
        for entry in entries:
            name, is_done = entry["name"], entry["state"] == DONE
            cells = (
                _link(name, f"{name}/report.md") if is_done else name,
                _link("image", f"{name}/{PICTURE}") if is_done else "",
                f"{_state_of(entry)}, in {entry['step']}" if entry["step"] else _state_of(entry),
                f"{entry['seconds']:.0f}",
                _figure(entry["psnr"], ".2f"),
                # Where pixels without a label are gaps in the masks, objects there are no errors.
                _figure(entry["miou_all"] if entry["zero_is_background"] else None, ".3f"),
                _figure(entry["miou"], ".3f"),
                _figure(entry["splats"], "d"),
            )
            lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
        # Sentences would make the table wider than a screen.
        errors = [f"- {entry['name']}: {entry['error']}" for entry in entries if entry["error"]]
        lines += ["", *errors] if errors else []
        write_atomic(self.table, (f"{_sentence(entries)}\n\n" + "\n".join(lines) + "\n").encode())


def _sentence(entries: list[dict[str, Any]]) -> str:
    counts = Counter(map(_state_of, entries))
    states = (DONE, BAD_INPUT, FAILED, UNFINISHED, NOT_BEGUN)
    parts = [f"{counts[state]} {state}" for state in states if counts[state]]
    return f"{len(entries)} captures: {', '.join(parts)}."


def _state_of(entry: dict[str, Any]) -> str:
    """Return an entry's state for the user, who has to know what remains to be done."""
    is_begun = entry["state"] != UNFINISHED or entry["settings"] is not None
    return entry["state"] if is_begun else NOT_BEGUN


def _link(text: str, path: str) -> str:
    escaped = text.replace("[", "\\[").replace("]", "\\]")
    return f"[{escaped}]({quote(path)})"


def _figure(value: float | None, form: str) -> str:
    return "" if value is None else format(value, form)
