"""The document of what the fuzz tests found."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from .running import MEMORY_MB


def document(found: Mapping[str, Any]) -> str:
    """Return the text of docs/reliability.md; `found` as of `Results.as_dict`."""
    cases = found["cases"]
    kinds = {
        "tracebacks": "traceback", "wrong exit codes": "wrong exit", "hangs (over 40 s)": "hang",
        f"memory over {MEMORY_MB} MB": "memory", "files of others changed": "foreign files",
        "half-written or left-behind output": ("half-written", "left behind"),
        "refusals that are not one sentence, or do not name the file": ("no sentence", "file not named"),
    }  # fmt: skip
    lines = [
        "# Reliability", "",
        "Written by `make fuzz`, which damages inputs at random, kills commands and lets them compete. A case is a",
        "capture, a reconstruction, splats, a shot or a command line with something wrong, given to a command in a",
        "process of its own, among files that belong to others. A command may succeed, or refuse the input with exit",
        "code 2 and one sentence that says what is wrong.", "",
        "| random cases | |", "|---|---:|",
        *(f"| {kind} | {count:,} |" for kind, count in cases.items()),
        f"| **all** | **{sum(cases.values()):,}** |", "",
        "| found in them | |", "|---|---:|",
        *(f"| {what} | {_count(found, starts)} |" for what, starts in kinds.items()),
        f"| largest memory | {found['largest_mb']:,.0f} MB |",
        f"| longest case | {found['longest_seconds']:.0f} s |", "",
        "| other tests | runs | faults |", "|---|---:|---:|",
        *(f"| {what} | {own['runs']:,} | {own['faults']} |" for what, own in found["others"].items()), "",
        "After a kill, a full disk or a race everything that was complete before can be read, and the same command",
        "finishes.", "",
    ]  # fmt: skip
    return "\n".join(lines)


def _count(found: Mapping[str, Any], starts: str | tuple[str, ...]) -> int:
    return sum(any(fault.startswith(starts) for fault in faults) for faults in found["faults"])
