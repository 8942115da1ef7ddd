# SPDX-License-Identifier: GPL-3.0-or-later
"""Materials, node groups and modifiers for the viewport and for renders."""
