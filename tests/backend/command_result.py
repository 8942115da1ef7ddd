"""Exit code and output of a command, with checks."""

from __future__ import annotations

import json
from dataclasses import dataclass

from backend.shared.errors import EXIT_BAD_INPUT

TYPES = {"status", "progress", "preview", "quality", "warning", "error", "done"}


@dataclass
class CommandResult:
    """Exit code and output of a command."""

    code: int
    out: str
    err: str

    @property
    def events(self) -> list[dict]:
        """Lines of stdout as JSON objects of known types; the last one is `done` or `error`."""
        events = [json.loads(line) for line in self.out.splitlines()]
        assert events and {event["type"] for event in events} <= TYPES
        assert events[-1]["type"] in ("done", "error")
        assert sum(event["type"] in ("done", "error") for event in events) == 1
        return events

    def messages(self, kind: str) -> list[str]:
        return [event["message"] for event in self.events if event["type"] == kind]


def assert_rejected(result: CommandResult, *words: str) -> str:
    """Check that the command was rejected with a single sentence that contains `words`, and return it."""
    assert result.code == EXIT_BAD_INPUT, result
    sentences = [line for line in result.err.splitlines() if line.startswith("error: ")]
    assert len(sentences) == 1 and "Traceback" not in result.err, result.err
    assert all(line.startswith(("error: ", "warning: ")) for line in result.err.splitlines()), result.err
    assert sentences[0].endswith(".")
    for word in words:
        assert word in sentences[0], sentences[0]
    return sentences[0]
