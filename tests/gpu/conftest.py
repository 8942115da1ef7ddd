"""Tests that need an NVIDIA GPU. Where there is none they say so in one sentence, and nothing counts as passed."""

import pytest

pytest.register_assert_rewrite("tests.backend.test_raster", "tests.backend.test_raster_stiff")


def why_no_gpu():
    """One sentence, or None where the tests can run."""
    import torch

    if not torch.cuda.is_available():
        return "torch sees no NVIDIA GPU here, so nothing was tested on one."
    try:
        import numba_cuda  # noqa: F401
        from numba import cuda
    except ImportError:
        return "numba-cuda is not installed, so nothing was tested on the GPU: see requirements/cuda.txt."
    if not cuda.is_available():
        return "numba-cuda cannot use the GPU that torch sees, so nothing was tested on it."
    return None


WHY_NOT = why_no_gpu()
collect_ignore_glob = ["test_*.py"] if WHY_NOT else []


def pytest_sessionfinish(session, exitstatus):
    if WHY_NOT and exitstatus == pytest.ExitCode.NO_TESTS_COLLECTED:
        session.exitstatus = pytest.ExitCode.OK


def pytest_terminal_summary(terminalreporter):
    if WHY_NOT:
        terminalreporter.write_line(WHY_NOT)
