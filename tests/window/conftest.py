# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender versions for the window tests, which are skipped if there is none."""

import subprocess
import sys
from pathlib import Path

import pytest

from . import harness


@pytest.fixture(scope="session")
def extension_zip(tmp_path_factory):
    """The extension as `make zip` builds it."""
    subprocess.run(["make", "zip"], cwd=harness.ROOT, check=True, stdout=subprocess.DEVNULL)
    return max((harness.ROOT / "build").glob("objectgs-*.zip"), key=lambda path: path.stat().st_mtime)


def pytest_addoption(parser):
    parser.addoption("--all-blenders", action="store_true", help="in every Blender that is here, not only in one")


def pytest_generate_tests(metafunc):
    if "blender" in metafunc.fixturenames:
        names = list(harness.blenders()) or ["none"]
        wanted = names if metafunc.config.getoption("--all-blenders") else names[:1]
        metafunc.parametrize("blender", wanted, indirect=True, scope="module")


@pytest.fixture(scope="module")
def blender(request, tmp_path_factory, extension_zip):
    """A Blender with a window and the extension installed; one for all tests of a module."""
    if request.param == "none":
        pytest.skip("no Blender with a window: set OBJECTGS_BLENDER to one of version 4.2 or newer")
    missing = harness.missing_tools()
    if missing:
        pytest.skip(f"{', '.join(missing)} must be installed to drive a window")
    command, variables = harness.blenders()[request.param]
    shots = harness.ROOT / "build" / "window" / request.param
    running = harness.Blender(command, variables, tmp_path_factory.mktemp("blender"), shots)
    try:
        try:
            running.wait_for("True", timeout=120)
        except harness.Failed as failure:
            # The extension is not installed yet, so this is no fault of the extension.
            pytest.skip(f"Blender {request.param} opens no window here: {failure}")
        running.install(extension_zip, Path(sys.executable))
        yield running
    finally:
        running.close()
