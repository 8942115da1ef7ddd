# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators that pick, select and isolate objects."""
