# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators that extract and export meshes."""
