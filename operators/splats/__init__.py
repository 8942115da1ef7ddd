# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators that export and import splats."""
