# SPDX-License-Identifier: GPL-3.0-or-later
"""The checkout's root as package `objectgs`, as headless.py loads it, and what the tests of the Blender side share."""

import pytest

bpy = pytest.importorskip("bpy")

import headless  # noqa: E402

headless.extension()


@pytest.fixture
def fresh():
    """An empty file for the test, and another one after it."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    yield
    bpy.ops.wm.read_factory_settings(use_empty=True)
