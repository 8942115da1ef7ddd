# SPDX-License-Identifier: GPL-3.0-or-later
"""Every capture of a folder, one after the other, with a summary that a later run goes on from."""

import time
import traceback
from pathlib import Path

from ...backend import __version__
from ...backend.protocol import Cancelled, InputError, Reconstruction, read_json, write_atomic, write_json
from .commands import BLEND, PICTURE, StepFailed, find_backend, reconstruct, sentence, whole
from .lines import say

DONE, BAD_INPUT, FAILED, UNFINISHED = "done", "bad input", "failed", "unfinished"


def batch(options) -> None:
    """Run every capture of a folder that is not done yet; raises what stands for the worst that happened."""
    source, out = whole(Path(options.source)), whole(options.out)
    captures = _captures(source)
    find_backend(options.backend_python)
    settings = {"version": __version__, "train": options.rest, "engine": options.engine, "samples": options.samples,
                "size": list(options.size) if options.size else None, "meshes": not options.no_meshes}
    Reconstruction(out).create()
    summary = _Summary(out, captures)
    for number, capture in enumerate(captures, 1):
        wanted = {**settings, "capture": str(capture), "files": fingerprint(capture)}
        entry = summary.entry(capture.name)
        title = f"{capture.name} ({number} of {len(captures)})"
        if _is_done(entry, wanted, out / capture.name):
            say(f"== {title}: done before, nothing to do.")
            continue
        say(f"== {title}")
        _run_one(capture, out / capture.name, entry, wanted, summary, options)
    say(f"{summary.sentence()} See {out / 'batch.md'}.")
    if summary.count(BAD_INPUT):
        raise InputError(f"{summary.count(BAD_INPUT)} of {len(captures)} captures cannot be used.")
    if summary.count(FAILED):
        raise StepFailed(f"{summary.count(FAILED)} of {len(captures)} captures failed.")


def _captures(source: Path) -> list[Path]:
    """Sub-folders that look like captures, whole or not, by name."""
    try:
        folders = sorted(entry for entry in source.iterdir() if entry.is_dir())
    except OSError as error:
        raise InputError(f"The folder {source} cannot be read ({error.strerror}).") from error
    found = [folder for folder in folders if (folder / "images").is_dir() or (folder / "sparse").is_dir()]
    if not found:
        raise InputError(f"The folder {source} holds no captures: no sub-folder has images/ or sparse/.")
    return found


def fingerprint(capture: Path) -> list[int]:
    """Count, bytes and latest change (ns) of the files that a reconstruction is made of."""
    states = [path.stat() for part in ("images", "masks", "sparse", "labels.json")
              for path in ([capture / part] if (capture / part).is_file() else (capture / part).rglob("*"))
              if path.is_file()]
    return [len(states), sum(state.st_size for state in states), max((s.st_mtime_ns for s in states), default=0)]


def _is_done(entry: dict, wanted: dict, folder: Path) -> bool:
    made = (folder / BLEND).is_file() and (folder / PICTURE).is_file()
    return entry.get("state") == DONE and entry.get("settings") == wanted and made


def _run_one(capture: Path, folder: Path, entry: dict, wanted: dict, summary: "_Summary", options) -> None:
    """One capture; its entry in the summary is true at any moment, also where the process is killed."""
    earlier = entry["seconds"] if entry["state"] == UNFINISHED and entry["settings"] == wanted else 0.0
    entry.update(state=UNFINISHED, settings=wanted, seconds=earlier, psnr=None, miou=None, splats=None, error=None)
    summary.write()
    started = time.monotonic()
    try:
        reconstruct(capture, folder, options)
        report = read_json(Reconstruction(folder).report_json)
        entry.update(state=DONE, psnr=report["quality"]["psnr"], miou=report["quality"]["miou"],
                     splats=report["model"]["gaussians"])
    except (Cancelled, KeyboardInterrupt):
        entry["error"] = "Cancelled; the same command goes on from there."
        raise
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
        summary.write()
    if entry["error"]:
        say(f"{capture.name}: {entry['error']}")


class _Summary:
    """batch.json and batch.md in `folder`: one entry for each capture."""

    def __init__(self, folder: Path, captures: list[Path]) -> None:
        self.json, self.table = folder / "batch.json", folder / "batch.md"
        known = {}
        if self.json.exists():
            content = read_json(self.json)
            try:
                known = {str(entry["name"]): dict(entry) for entry in content["captures"]}
            except (KeyError, TypeError, ValueError) as error:
                raise InputError(f"{self.json} was not written by this program; choose another --out.") from error
        fresh = {"state": UNFINISHED, "seconds": 0.0, "psnr": None, "miou": None, "splats": None, "error": None,
                 "settings": None}
        self.entries = [{"name": capture.name, **fresh, **known.get(capture.name, {})} for capture in captures]
        self.write()

    def entry(self, name: str) -> dict:
        return next(entry for entry in self.entries if entry["name"] == name)

    def count(self, state: str) -> int:
        return sum(entry["state"] == state for entry in self.entries)

    def sentence(self) -> str:
        parts = [f"{self.count(state)} {state}" for state in (DONE, BAD_INPUT, FAILED, UNFINISHED) if self.count(state)]
        return f"{len(self.entries)} captures: {', '.join(parts)}."

    def write(self) -> None:
        write_json(self.json, {"captures": self.entries})
        lines = ["| capture | state | seconds | PSNR | mIoU | splats | error |", "|---|---|---:|---:|---:|---:|---|"]
        for entry in self.entries:
            cells = (entry["name"], entry["state"], f"{entry['seconds']:.0f}", _figure(entry["psnr"], ".2f"),
                     _figure(entry["miou"], ".3f"), _figure(entry["splats"], "d"), entry["error"] or "")
            lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
        write_atomic(self.table, (f"{self.sentence()}\n\n" + "\n".join(lines) + "\n").encode())


def _figure(value, form: str) -> str:
    return "" if value is None else format(value, form)
