# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators from the capture to labeled points."""
