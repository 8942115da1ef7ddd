"""Runs cases one after another, and judges each."""

from __future__ import annotations

import shutil
import time
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from backend.shared.errors import EXIT_BAD_INPUT

from .cases import Case, make_case
from .running import Outcome, Runner, differences, faults, snapshot, unfinished
from .templates import Templates


@dataclass
class Failure:
    """A case with something wrong."""

    seed: int
    case: Case
    outcome: Outcome
    faults: list[str]

    def __str__(self) -> str:
        last = "\n    ".join(line[:400] for line in self.outcome.err.strip().splitlines()[-12:])
        command = ascii(" ".join(map(str, self.case.arguments)))
        return (
            f"case {self.seed} ({self.case.kind}: {self.case.what[:200]!a}): {', '.join(self.faults)}\n"
            f"    {command[:400]}\n    exit {self.outcome.code} after {self.outcome.seconds} s, "
            f"{self.outcome.peak_mb:.0f} MB\n    {last.encode('ascii', 'backslashreplace').decode()}"
        )


@dataclass
class Tally:
    """Counts of what was run and found."""

    cases: Counter[str] = field(default_factory=Counter)
    exits: Counter[int] = field(default_factory=Counter)
    failures: list[Failure] = field(default_factory=list)
    largest_mb: float = 0.0
    longest_seconds: float = 0.0

    def add(self, other: Tally) -> None:
        """Add the counts of another tally."""
        self.cases += other.cases
        self.exits += other.exits
        self.failures += other.failures
        self.largest_mb = max(self.largest_mb, other.largest_mb)
        self.longest_seconds = max(self.longest_seconds, other.longest_seconds)


def run_cases(
    seeds: Iterable[int], folder: Path, templates: Templates, runner: Runner, until: float | None = None
) -> Tally:
    """Run the cases with these numbers, each in a subfolder of `folder`, until a time of time.monotonic()."""
    tally = Tally()
    for seed in seeds:
        if until is not None and time.monotonic() > until:
            break
        place = folder / f"case-{seed}"
        try:
            _run_case(seed, place, templates, runner, tally)
        finally:
            shutil.rmtree(place, ignore_errors=True)
    return tally


def _run_case(seed: int, place: Path, templates: Templates, runner: Runner, tally: Tally) -> None:
    case = make_case(seed, place, templates)
    before = snapshot(place)
    outcome = runner.run(case.arguments, place)
    after = snapshot(place)
    found = faults(outcome, case.named)
    changed = differences(before, after)
    foreign = [path for path in changed if not _may_change(path, case)]
    if foreign:
        found.append(f"foreign files: {', '.join(foreign[:5])}")
    if outcome.ended == "exit" and outcome.code >= 0 and (left := unfinished(place)):
        found.append(f"half-written: {', '.join(left[:5])}")
    if outcome.code == EXIT_BAD_INPUT:
        made = [path for path in case.writes if path not in before and path in after]
        if made:
            found.append(f"left behind: {', '.join(made)}")
    tally.cases[case.kind] += 1
    tally.exits[outcome.code] += 1
    tally.largest_mb = max(tally.largest_mb, outcome.peak_mb)
    tally.longest_seconds = max(tally.longest_seconds, outcome.seconds)
    if found:
        tally.failures.append(Failure(seed, case, outcome, found))


def _may_change(path: str, case: Case) -> bool:
    def is_within(entry: str) -> bool:
        return path == entry or path.startswith(f"{entry}/")

    return any(map(is_within, case.writes)) and not any(map(is_within, case.keeps))
