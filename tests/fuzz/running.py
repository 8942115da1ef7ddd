"""Commands of the backend in processes of their own, and what is wrong with how they ended."""

from __future__ import annotations

import hashlib
import json
import os
import stat
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from backend.shared.errors import EXIT_BAD_INPUT, EXIT_DONE
from backend.shared.formats.atomic import PART_PREFIX

ROOT = Path(__file__).resolve().parents[2]
MEMORY_MB = 2000
SECONDS = 40
_LONGEST_SENTENCE = 2000


@dataclass(frozen=True)
class Outcome:
    """How a command ended: exit code, output, duration, memory, and `exit`, `timeout` or `memory`."""

    code: int
    out: str
    err: str
    seconds: float
    peak_mb: float
    ended: str


class Runner:
    """A server process that runs one command after another; see `tests.fuzz.server`."""

    def __init__(self) -> None:
        environment = {**os.environ, "NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
        self._server = subprocess.Popen(
            [sys.executable, "-m", "tests.fuzz.server"],
            cwd=ROOT, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1,
        )  # fmt: skip

    def run(
        self, arguments: list[Any], cwd: Path, seconds: float = SECONDS, largest_file: int | None = None
    ) -> Outcome:
        """Run `python -m backend ARGUMENTS` in the folder `cwd`.

        It is killed after `seconds`. Writing files of more than `largest_file` bytes fails, as on a full disk.
        """
        assert self._server.stdin is not None
        assert self._server.stdout is not None
        request = {"arguments": [str(word) for word in arguments], "cwd": str(cwd), "seconds": seconds,
                   "largest_file": largest_file}  # fmt: skip
        self._server.stdin.write(json.dumps(request) + "\n")
        return Outcome(**json.loads(self._server.stdout.readline()))

    def close(self) -> None:
        """End the server."""
        assert self._server.stdin is not None
        self._server.stdin.close()
        self._server.wait(60)


def faults(outcome: Outcome, named: str | None = None) -> list[str]:
    """Return what is wrong with how a command ended, whatever its input: an empty list if nothing.

    Args:
        outcome: How it ended.
        named: A word that a refusal must contain, such as the name of the damaged file.
    """
    found = []
    if outcome.ended == "timeout":
        return ["hang"]
    if outcome.ended == "memory" or outcome.peak_mb > MEMORY_MB:
        found.append("memory")
    if "Traceback" in outcome.err:
        found.append("traceback")
    if outcome.code not in (EXIT_DONE, EXIT_BAD_INPUT):
        found.append("wrong exit")
    if outcome.code == EXIT_BAD_INPUT:
        sentences = [line for line in outcome.err.splitlines() if line.startswith("error: ")]
        others = [line for line in outcome.err.splitlines() if not line.startswith(("error: ", "warning: "))]
        if len(sentences) != 1 or others or not sentences[0].endswith(".") or len(sentences[0]) > _LONGEST_SENTENCE:
            found.append("no sentence")
        elif named is not None and named not in sentences[0]:
            found.append("file not named")
    return found


def snapshot(folder: Path) -> dict[str, str]:
    """Return the path of each entry below a folder -> a hash of its type and content."""
    found = {}
    for parent, folders, names in os.walk(folder):
        for name in (*folders, *names):
            path = Path(parent) / name
            mode = path.lstat().st_mode
            if stat.S_ISLNK(mode):
                content = os.fsencode(path.readlink())
            elif stat.S_ISREG(mode):
                content = path.read_bytes()
            else:
                content = b""
            relative = path.relative_to(folder).as_posix()
            found[relative] = f"{stat.S_IFMT(mode):o} {hashlib.blake2b(content, digest_size=16).hexdigest()}"
    return found


def differences(before: dict[str, str], after: dict[str, str]) -> list[str]:
    """Return the paths that were added, changed or removed between two snapshots."""
    return sorted(path for path in before.keys() | after.keys() if before.get(path) != after.get(path))


def unfinished(folder: Path) -> list[str]:
    """Return the temporary files and locks that a command has left in a folder."""
    return sorted(
        str(path.relative_to(folder))
        for path in folder.rglob(".*")
        if path.name.startswith(PART_PREFIX) or path.name == ".lock"
    )
