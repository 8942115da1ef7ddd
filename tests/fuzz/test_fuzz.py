"""A short, fixed selection of what `make fuzz` runs for minutes."""

from __future__ import annotations

import os

import pytest

from .kills import run_deletions, run_full_disks, run_kills
from .races import edit_at_once, race_for_lock
from .running import Runner
from .session import run_cases
from .templates import make_templates

pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(os.name != "posix", reason="commands are forked, which Windows cannot"),
]
CASES = 20


@pytest.fixture(scope="module")
def runner():
    runner = Runner()
    yield runner
    runner.close()


@pytest.fixture(scope="module")
def templates(runner, tmp_path_factory):
    return make_templates(tmp_path_factory.mktemp("templates"), runner)


def test_random_cases_have_no_faults(templates, runner, tmp_path):
    tally = run_cases(range(CASES), tmp_path, templates, runner)
    assert not tally.failures, "\n\n".join(map(str, tally.failures))
    assert sum(tally.cases.values()) == CASES and set(tally.exits) == {0, 2}


def test_interrupted_commands_lose_nothing(templates, runner, tmp_path):
    assert run_kills(4, 1, tmp_path, templates, runner) == []
    assert run_full_disks(2, 1, tmp_path, templates, runner) == []
    assert run_deletions(2, 1, tmp_path, templates, runner) == []


def test_competing_processes_take_turns(templates, tmp_path):
    assert race_for_lock(20, tmp_path / "lock")[0] == 0
    assert edit_at_once(4, tmp_path, templates)[1] == []
