# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators for training, its jobs, previews and results."""
