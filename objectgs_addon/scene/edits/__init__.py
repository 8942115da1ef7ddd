# SPDX-License-Identifier: GPL-3.0-or-later
"""Edits of objects in the scene: removal, fill, recoloring, placement and duplicates."""
