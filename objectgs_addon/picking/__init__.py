# SPDX-License-Identifier: GPL-3.0-or-later
"""Picking and selecting objects in the viewport."""
