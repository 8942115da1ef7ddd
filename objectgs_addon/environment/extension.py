# SPDX-License-Identifier: GPL-3.0-or-later
"""The folder of the extension, and the name of its package in Blender."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
"""The extension's folder, with headless.py and requirements/."""
PACKAGE = __package__.rsplit(".", 2)[0]
"""bl_ext.REPOSITORY.objectgs for an installed extension, objectgs without a window."""
