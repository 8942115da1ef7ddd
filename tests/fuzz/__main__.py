"""`python -m tests.fuzz`: hostile inputs for minutes; see --help."""

from __future__ import annotations

import argparse
import itertools
import sys
import tempfile
import threading
import time
from pathlib import Path

from .running import Runner
from .session import Tally, run_cases
from .templates import make_templates


def main() -> int:
    """Run the cases and print what was found; return 1 if anything was."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--minutes", type=float, default=10, help="time to run for (10)")
    parser.add_argument("--seed", type=int, default=0, help="number of the first case (0)")
    parser.add_argument("--only", type=int, nargs="+", help="run only the cases with these numbers")
    parser.add_argument("--jobs", type=int, default=2, help="number of processes (2)")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="objectgs-fuzz-") as name:
        tally = _run(Path(name), options)
    for failure in tally.failures:
        print(failure, end="\n\n")
    print(f"{sum(tally.cases.values())} cases: {dict(tally.cases)}")
    print(f"exits {dict(tally.exits)}, largest {tally.largest_mb:.0f} MB, longest {tally.longest_seconds:.1f} s")
    print(f"{len(tally.failures)} failures")
    return bool(tally.failures)


def _run(folder: Path, options: argparse.Namespace) -> Tally:
    runners = [Runner() for _ in range(1 if options.only else options.jobs)]
    templates = make_templates(folder / "templates", runners[0])
    until = None if options.only else time.monotonic() + 60 * options.minutes
    tally, lock = Tally(), threading.Lock()

    def work(number: int) -> None:
        seeds = options.only or itertools.count(options.seed + number, len(runners))
        found = run_cases(seeds, folder / f"worker-{number}", templates, runners[number], until)
        with lock:
            tally.add(found)

    threads = [threading.Thread(target=work, args=(number,)) for number in range(len(runners))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for runner in runners:
        runner.close()
    return tally


if __name__ == "__main__":
    sys.exit(main())
