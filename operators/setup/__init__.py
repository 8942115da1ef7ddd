# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators that set up, check and remove the compute backend."""
