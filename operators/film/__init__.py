# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators for film frames and the compositor."""
