"""Tests that require an NVIDIA GPU; without one, a message is printed and no test counts as passed."""

import pytest

from backend.raster.devices import why_not_cuda

pytest.register_assert_rewrite("tests.backend.test_raster", "tests.backend.test_raster_stiff")


WHY_NOT = why_not_cuda()
collect_ignore_glob = ["test_*.py"] if WHY_NOT else []


def pytest_sessionfinish(session, exitstatus):
    if WHY_NOT and exitstatus == pytest.ExitCode.NO_TESTS_COLLECTED:
        session.exitstatus = pytest.ExitCode.OK


def pytest_terminal_summary(terminalreporter):
    if WHY_NOT:
        terminalreporter.write_line(f"Nothing was tested on a GPU. {WHY_NOT}")
