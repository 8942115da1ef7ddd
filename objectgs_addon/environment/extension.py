# SPDX-License-Identifier: GPL-3.0-or-later
"""Folder of the extension, and name of its package in Blender."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
"""Folder of the extension, which contains headless.py and requirements/."""
PACKAGE = __package__.rsplit(".", 2)[0]
"""Name of the root package: bl_ext.REPOSITORY.objectgs if the extension is installed, objectgs for headless.py."""
