"""Hostile inputs, kills, races, full disks and lost output; prints what went wrong, and exits with 1 if anything did.

`make fuzz MINUTES=10` runs all of it; --write also writes docs/reliability.md.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import tempfile
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks import documents

from .kills import run_deletions, run_full_disks, run_kills
from .races import edit_at_once, race_for_lock
from .report import document
from .running import Runner
from .session import Tally, run_cases
from .streams import run_signals, run_streams
from .templates import Templates, make_templates

KILLS, DISKS, DELETIONS, SIGNALS, ROUNDS, EDITS = 100, 52, 30, 30, 1000, 300


@dataclass
class Results:
    """What was run and found: the random cases, and for each other test its number of runs and the faults."""

    tally: Tally = field(default_factory=Tally)
    others: dict[str, tuple[int, list[str]]] = field(default_factory=dict)

    @property
    def faults(self) -> list[str]:
        """A text for each fault."""
        return [*map(str, self.tally.failures), *(fault for _, found in self.others.values() for fault in found)]

    def as_dict(self) -> dict[str, Any]:
        """Return the figures of docs/reliability.md."""
        tally = self.tally
        return {
            "cases": dict(sorted(tally.cases.items())),
            "faults": [failure.faults for failure in tally.failures],
            "largest_mb": tally.largest_mb,
            "longest_seconds": tally.longest_seconds,
            "others": {what: {"runs": runs, "faults": len(found)} for what, (runs, found) in self.others.items()},
        }


def main() -> int:
    """Run everything and print what was found; return 1 if anything was."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--minutes", type=float, default=10, help="time for the random cases (10)")
    parser.add_argument("--seed", type=int, default=0, help="number of the first case (0)")
    parser.add_argument("--only", type=int, nargs="+", help="run only the random cases with these numbers")
    parser.add_argument("--cases", action="store_true", help="run only random cases")
    parser.add_argument("--write", action="store_true", help="write docs/reliability.md")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="objectgs-fuzz-") as name:
        results = _run(Path(name), options)
    for fault in results.faults:
        print(fault, end="\n\n")
    print(document(results.as_dict()))
    if options.write:
        documents.save("reliability", results.as_dict())
    return bool(results.faults)


def _run(folder: Path, options: argparse.Namespace) -> Results:
    results = Results()
    runners = [Runner() for _ in range(1 if options.only else 2)]
    templates = make_templates(folder / "templates", runners[0])
    until = None if options.only else time.monotonic() + 60 * options.minutes
    lock = threading.Lock()

    def work(number: int) -> None:
        seeds = options.only or itertools.count(options.seed + number, len(runners))
        found = run_cases(seeds, folder / f"worker-{number}", templates, runners[number], until)
        with lock:
            results.tally.add(found)

    threads = [threading.Thread(target=work, args=(number,)) for number in range(len(runners))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if not (options.only or options.cases):
        _run_others(folder, options.seed, templates, runners, results)
    for runner in runners:
        runner.close()
    return results


def _run_others(folder: Path, seed: int, templates: Templates, runners: list[Runner], results: Results) -> None:
    halves: dict[str, list[str]] = {"kills": [], "disks": [], "deletions": []}

    def work(number: int) -> None:
        place, runner = folder / f"others-{number}", runners[number]
        share = len(runners)
        halves["kills"] += run_kills(KILLS // share, seed + number, place, templates, runner)
        halves["disks"] += run_full_disks(DISKS // share, seed + number, place, templates, runner)
        halves["deletions"] += run_deletions(DELETIONS // share, seed + number, place, templates, runner)

    threads = [threading.Thread(target=work, args=(number,)) for number in range(len(runners))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    twice, nobody = race_for_lock(ROUNDS, folder / "lock")
    refused, found = edit_at_once(EDITS, folder, templates)
    runs, lost = run_streams(templates, folder)
    race = [f"the lock of a folder had two holders in {twice} rounds"] * bool(twice)
    results.others = {
        "commands killed at random moments (kill -9)": (KILLS, halves["kills"]),
        "commands on a full disk": (DISKS, halves["disks"]),
        "folders deleted while a command uses them": (DELETIONS, halves["deletions"]),
        f"rounds in which three processes lock a folder at once (in {nobody} of them all gave way)": (ROUNDS, race),
        f"concurrent edits of objects.json ({refused} refused by one sentence, the others applied)": (EDITS, found),
        "commands whose output is closed, full, a broken pipe, or not UTF-8": (runs, lost),
        "signals at random moments, during imports too": (SIGNALS, run_signals(SIGNALS, seed, templates)),
    }


if __name__ == "__main__":
    sys.exit(main())
