# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators that choose, merge, remove, restore, duplicate and reset objects."""
