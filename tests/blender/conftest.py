# SPDX-License-Identifier: GPL-3.0-or-later
"""Shared fixtures of the Blender tests; loads the repository root as package `objectgs`, like headless.py."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

bpy = pytest.importorskip("bpy")

import headless

headless.extension()

from objectgs.objectgs_addon.demo import capture as demo_capture
from objectgs.objectgs_addon.environment import known_folders

_status = pytest.ExitCode.OK


def pytest_sessionfinish(exitstatus):
    global _status
    _status = exitstatus


@pytest.hookimpl(trylast=True)
def pytest_unconfigure(config):
    """Exit early: after a property had a callback, Blender 4.2's module crashes when Python shuts down."""
    if bpy.app.version < (5, 0):
        config.get_terminal_writer().flush()
        os._exit(_status)


@pytest.fixture
def fresh():
    """An empty file before and after the test."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    yield
    bpy.ops.wm.read_factory_settings(use_empty=True)


@pytest.fixture(autouse=True)
def known(tmp_path_factory, monkeypatch) -> Path:
    """The file of accepted folders, which is empty at the start of each test, and not the user's."""
    path = tmp_path_factory.mktemp("user") / known_folders.NAME
    monkeypatch.setattr(known_folders, "_path", lambda: path)
    monkeypatch.setattr(known_folders, "_unwritten", [])
    return path


@pytest.fixture(scope="session")
def capture(tmp_path_factory) -> Path:
    """A demo capture of 3 objects and 12 views of 96x72; read-only."""
    settings = demo_capture.Settings(objects=3, views=12, width=96, height=72, samples=2)
    return demo_capture.make(tmp_path_factory.mktemp("capture") / "demo", settings)


@pytest.fixture(scope="session")
def backend_python() -> str:
    """Path of the Python that has the compute backend."""
    python = os.environ.get("OBJECTGS_PYTHON") or shutil.which(headless.ROOT / ".venv" / "bin" / "python")
    if not python:
        pytest.skip("no compute backend: set OBJECTGS_PYTHON, or run make venv")
    return str(python)


@pytest.fixture(scope="session")
def trained(capture, backend_python, tmp_path_factory) -> Path:
    """A reconstruction of `capture` after a few steps; read-only."""
    folder = tmp_path_factory.mktemp("reconstruction") / "demo"
    command = [backend_python, "-m", "backend", "train", capture, "--out", folder, "--steps", "30"]
    subprocess.run(command, cwd=headless.ROOT, check=True, timeout=300)
    return folder


@pytest.fixture
def registered():
    """The extension, registered as in Blender."""
    extension = headless.extension()
    extension.register()
    yield
    extension.unregister()
