"""Processes that want the same thing at the same time: the lock of a folder, and objects.json."""

from __future__ import annotations

import multiprocessing
import os
import shutil
import threading
from pathlib import Path
from typing import Any

from backend.shared.errors import EXIT_BAD_INPUT, EXIT_DONE
from backend.shared.reconstruction.lock import FolderInUse, locked
from backend.shared.reconstruction.objects import read_objects

from .running import Runner, faults
from .templates import Templates

_PROCESSES = 3
_EDITORS = 6


def race_for_lock(rounds: int, folder: Path) -> tuple[int, int]:
    """Let processes try to lock a folder at the same moment.

    Returns:
        In how many rounds two held it at once, and in how many nobody got it.
    """
    folder.mkdir(parents=True)
    context = multiprocessing.get_context("spawn")
    barrier, results = context.Barrier(_PROCESSES), context.Queue()
    processes = [context.Process(target=_compete, args=(folder, rounds, barrier, results)) for _ in range(_PROCESSES)]
    for process in processes:
        process.start()
    outcomes = [results.get(timeout=600) for _ in processes]
    for process in processes:
        process.join()
    twice = sum(map(sum, (outcome["overlaps"] for outcome in outcomes)))
    nobody = sum(not any(won) for won in zip(*(outcome["won"] for outcome in outcomes)))
    return twice, nobody


def _compete(folder: Path, rounds: int, barrier: Any, results: Any) -> None:
    won, overlaps = [False] * rounds, [False] * rounds
    for number in range(rounds):
        barrier.wait(60)
        try:
            with locked(folder, patience=0):
                won[number] = True
                try:
                    os.close(os.open(folder / "inside", os.O_CREAT | os.O_EXCL))
                    (folder / "inside").unlink()
                except FileExistsError:
                    overlaps[number] = True
        except FolderInUse:
            pass
    results.put({"won": won, "overlaps": overlaps})


def edit_at_once(count: int, folder: Path, templates: Templates) -> tuple[int, list[str]]:
    """Run `edit` `count` times, several at a time; each adds a duplicate.

    Returns:
        The number of edits that were refused, and a sentence for each fault.
    """
    out = folder / "edited"
    shutil.copytree(templates.trained, out)
    before = {entry.id: len(entry.copies) for entry in read_objects(out / "objects.json")}
    applied, refused, found, lock = 0, 0, [], threading.Lock()

    def work(number: int) -> None:
        nonlocal applied, refused
        runner = Runner()
        for edit in range(number, count, _EDITORS):
            outcome = runner.run(["edit", out, "--duplicate", f"1:x={edit + 1}"], folder)
            with lock:
                found.extend(f"edit {edit}: {what}: {outcome.err[-200:]}" for what in faults(outcome))
                applied += outcome.code == EXIT_DONE
                refused += outcome.code == EXIT_BAD_INPUT
        runner.close()

    threads = [threading.Thread(target=work, args=(number,)) for number in range(_EDITORS)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    made = {entry.id: len(entry.copies) for entry in read_objects(out / "objects.json")}[1] - before[1]
    if made != applied:
        found.append(f"{applied} edits were applied, but {made} duplicates are there")
    shutil.rmtree(out)
    return refused, found
