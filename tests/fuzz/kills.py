"""Commands killed at random moments: nothing that was complete before is lost, and the same command finishes."""

from __future__ import annotations

import random
import shutil
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from backend.export import read_splats
from backend.shared.errors import EXIT_DONE
from backend.shared.formats.mesh_ply import read_mesh
from backend.shared.reconstruction.folder import Reconstruction
from backend.shared.reconstruction.meshes import read_meshes
from backend.shared.reconstruction.objects import read_objects
from backend.shared.reconstruction.record import read_record
from backend.training.state import read_checkpoint

from .running import Outcome, Runner, differences, faults, snapshot
from .templates import Templates

_LONGEST = 120
_EDITS = ["--move", "2:x=0.5", "--remove", "1", "--fill"]

Command = Callable[[Path, Templates], list[Any]]

COMMANDS: dict[str, Command] = {
    "import": lambda folder, t: ["import", t.captures[1], "--out", folder / "out"],
    "vote": lambda folder, t: ["vote", t.captures[0], "--out", folder / "out"],
    "new training": lambda folder, t: ["train", t.captures[1], "--out", folder / "out", "--steps", 30, "--offsets", 3,
                                       "--checkpoint-seconds", 0.05],
    "longer training": lambda folder, t: ["train", t.captures[0], "--out", folder / "trained", "--steps", 40,
                                          "--offsets", 3, "--memory-mb", 100, "--checkpoint-seconds", 0.05],
    "restarted training": lambda folder, t: ["train", t.captures[0], "--out", folder / "trained", "--steps", 12,
                                             "--offsets", 3, "--restart"],
    "mesh": lambda folder, t: ["mesh", folder / "trained", "--objects", 1, 2, "--faces", 200, "--texture-size", 256,
                               "--restart"],
    "edit": lambda folder, t: ["edit", folder / "trained", *_EDITS],
    "export": lambda folder, t: ["export", folder / "trained", "--out", folder / "out", "--per-object"],
    "film": lambda folder, t: ["film", folder / "trained", "--shot", t.shot, "--out", folder / "out", "--png"],
    "render": lambda folder, t: ["render", folder / "trained", "--views", "all", "--depth"],
    "evaluate": lambda folder, t: ["evaluate", folder / "trained"],
    "report": lambda folder, t: ["report", folder / "trained"],
    "import-splats": lambda folder, t: ["import-splats", t.splats, "--out", folder / "out"],
}  # fmt: skip
"""Commands by name; those on `trained` work on a complete reconstruction."""


def run_kills(count: int, seed: int, folder: Path, templates: Templates, runner: Runner) -> list[str]:
    """Kill commands at `count` random moments, each in a subfolder of `folder`; return a sentence for each fault."""
    rng = random.Random(seed)
    names = list(COMMANDS)
    seconds = {}
    for name in names[:count]:
        with _prepared(folder / "time", name, templates) as arguments:
            seconds[name] = runner.run(arguments, folder / "time", _LONGEST).seconds
    found = []
    for number in range(count):
        name = names[number % len(names)]
        moment = rng.uniform(0.02, 1.0) * seconds[name]
        place = folder / f"kill-{seed}-{number}"
        with _prepared(place, name, templates) as arguments:
            wrong = _interrupt(place, arguments, runner, lambda words, at=moment, in_=place: runner.run(words, in_, at))
        found += [f"{name} killed after {moment:.2f} s: {what}" for what in wrong]
    return found


def run_full_disks(count: int, seed: int, folder: Path, templates: Templates, runner: Runner) -> list[str]:
    """Run commands that cannot write files beyond a random size; return a sentence for each fault."""
    rng = random.Random(seed)
    found = []
    for number in range(count):
        name = list(COMMANDS)[number % len(COMMANDS)]
        size = rng.choice((50, 100, 2_000, 20_000, 60_000))
        place = folder / f"disk-{seed}-{number}"
        with _prepared(place, name, templates) as arguments:
            outcome: list[Outcome] = []
            wrong = _interrupt(
                place,
                arguments,
                runner,
                lambda words, size=size, in_=place, out=outcome: out.append(runner.run(words, in_, _LONGEST, size)),
            )
            wrong += faults(outcome[0])
        found += [f"{name} with files of at most {size} bytes: {what}" for what in wrong]
    return found


def run_deletions(count: int, seed: int, folder: Path, templates: Templates, runner: Runner) -> list[str]:
    """Delete the folder that a command uses, or its capture, while it runs; return a sentence for each fault."""
    rng = random.Random(seed)
    found = []
    for number in range(count):
        place, moment = folder / f"deletion-{seed}-{number}", rng.uniform(0.05, 1.5)
        place.mkdir(parents=True)
        shutil.copytree(templates.captures[0], place / "capture")
        gone = rng.choice((place / "out", place / "capture", place / "capture" / "images"))
        timer = threading.Timer(moment, shutil.rmtree, (gone,), {"ignore_errors": True})
        timer.start()
        command = rng.choice(
            (["train", "--steps", 60, "--offsets", 3, "--checkpoint-seconds", 0.05], ["vote"], ["import"])
        )
        outcome = runner.run([command[0], place / "capture", "--out", place / "out", *command[1:]], place, _LONGEST)
        timer.join()
        found += [f"{command[0]} while {gone.name} was deleted after {moment:.2f} s: {what}: {outcome.err[-300:]}"
                  for what in faults(outcome)]  # fmt: skip
        shutil.rmtree(place, ignore_errors=True)
    return found


@contextmanager
def _prepared(place: Path, name: str, templates: Templates) -> Iterator[list[Any]]:
    """Fill the folder `place` for a command, yield its command line, and delete the folder."""
    place.mkdir(parents=True)
    try:
        (place / "thesis.txt").write_text("not yours")
        arguments = COMMANDS[name](place, templates)
        if place / "trained" in arguments:
            shutil.copytree(templates.trained, place / "trained")
            (place / "trained" / "notes.txt").write_text("not yours")
        yield arguments
    finally:
        shutil.rmtree(place, ignore_errors=True)


def _interrupt(place: Path, arguments: list[Any], runner: Runner, run: Callable[[list[Any]], Any]) -> list[str]:
    """Run a command so that it does not finish, then again; return what is wrong after each."""
    before = snapshot(place)
    run(arguments)
    trained = Reconstruction(place / "trained")
    found = _damage(trained) if trained.folder.exists() else []
    again = runner.run(arguments, place, _LONGEST)
    found += faults(again)
    if again.code != EXIT_DONE:
        found.append(f"the same command then exits with {again.code}: {again.err.strip()[-300:]}")
    for folder in (Reconstruction(place / "out"), trained):
        if folder.settings.exists():
            found += _damage(folder)
    own = {path for path in before if path.startswith("trained")} - {"trained/notes.txt"}
    foreign = [path for path in differences(before, snapshot(place)) if path in before and path not in own]
    return found + [f"{path} was changed" for path in foreign]


def _damage(folder: Reconstruction) -> list[str]:
    """Return what cannot be read in a reconstruction; a checkpoint that is there must be complete."""

    def read_listed_meshes() -> None:
        for entry in read_meshes(folder.meshes).values():
            if entry.file is not None:
                read_mesh(folder.meshes / entry.file)

    readers: list[Callable[[], Any]] = [lambda: read_record(folder), read_listed_meshes]
    if folder.objects.exists():
        readers.append(lambda: read_objects(folder.objects))
    if folder.splats.exists():
        readers.append(lambda: read_splats(folder.splats))
    if folder.checkpoint.exists():
        readers.append(lambda: read_checkpoint(folder.checkpoint))
    found = []
    for read in readers:
        try:
            read()
        except Exception as error:
            found.append(f"{type(error).__name__}: {error}")
    return found
